// tests/test_changes.c - what changed is told once, and what did not is not told.
#include "rigd/changes.h"
#include "rigd/describe.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { N = 3 };

static void handle(void *arg, uint64_t token, const char *what, const struct json *request)
{
    (void)arg, (void)token, (void)what, (void)request;
}

static int count(const char *text, const char *part)
{
    int n = 0;
    for (; (text = strstr(text, part)); text += strlen(part))
        n++;
    return n;
}

static void what_changed_is_told_once(void **state)
{
    struct config config = { .objects_per_shot = 1, .n_cameras = N, .heartbeat_s = 25 };
    struct lag lag[N] = { 0 };
    struct control *control;
    struct changes *changes;
    struct rig *rig;
    char *said;
    (void)state;
    config.camera = calloc(N, sizeof(*config.camera));
    for (int i = 0; i < N; i++)
        snprintf(config.camera[i].name, sizeof(config.camera[i].name), "A%02d", i + 1);
    assert_int_equal(rig_create(&rig, &config), 0);
    assert_int_equal(control_open_virtual(&control, handle, NULL), 0);
    assert_int_equal(changes_create(&changes, N), 0);
    assert_false(control_has_subscribers(control));
    const int client = control_virtual_client(control);
    assert_false(control_has_subscribers(control));
    control_feed(control, client, "{\"do\":\"subscribe\"}\n", 19);
    assert_true(control_has_subscribers(control));
    free(control_take(control, client));
    // At first everything is new.
    changes_publish(changes, control, describe_rig(rig, &config, "gpio"), rig, &config);
    said = control_take(control, client);
    assert_int_equal(count(said, "\"event\":\"cameras\""), 1);
    assert_int_equal(count(said, "\"event\":\"rig\""), 1);
    assert_int_equal(count(said, "\"condition\""), N);
    free(said);
    // Nothing happened.
    changes_publish(changes, control, describe_rig(rig, &config, "gpio"), rig, &config);
    said = control_take(control, client);
    assert_string_equal(said, "");
    free(said);
    // One camera.
    lag[1] = (struct lag){ .mean_ms = 97, .n = 30 };
    rig_set_lag(rig, lag);
    changes_publish(changes, control, describe_rig(rig, &config, "gpio"), rig, &config);
    said = control_take(control, client);
    assert_int_equal(count(said, "\n"), 1);
    assert_int_equal(count(said, "\"condition\""), 1);
    assert_non_null(strstr(said, "\"name\":\"A02\""));
    assert_non_null(strstr(said, "\"lag_ms\":97"));
    free(said);
    // The trigger.
    changes_publish(changes, control, describe_rig(rig, &config, "broken"), rig, &config);
    said = control_take(control, client);
    assert_int_equal(count(said, "\n"), 1);
    assert_non_null(strstr(said, "\"event\":\"rig\""));
    assert_non_null(strstr(said, "\"trigger\":\"broken\""));
    assert_int_equal(count(said, "\"condition\""), 0);
    free(said);
    changes_free(changes);
    control_close(control);
    rig_free(rig);
    config_free(&config);
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(what_changed_is_told_once) };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
