// tests/test_camera.c - what daemon and worker say survives the way, and nothing else gets through.
#include "rigd/camera.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

static void fill(char *out, size_t room, const char *what, int i)
{
    snprintf(out, room, "%s%d", what, i);
}

static void every_command_survives_the_way(void **state)
{
    (void)state;
    for (int kind = 0; kind < CAMERA_N_COMMANDS; kind++) {
        struct camera_command c, back;
        memset(&c, 0, sizeof(c));
        c.kind = kind, c.seq = 4000000000u + (unsigned)kind, c.timeout_ms = 1500;
        fill(c.port, sizeof(c.port), "ptpip:127.0.0.1:15740:1574", kind);
        fill(c.model, sizeof(c.model), "Nikon DSC \"D850\" ", kind);
        fill(c.personality, sizeof(c.personality), "/etc/rigd/cameras/nikon.conf", kind);
        fill(c.serial, sizeof(c.serial), "00", kind);
        c.reset = kind & 1;
        c.n_settings = CAMERA_SETTINGS_MAX;
        for (int i = 0; i < c.n_settings; i++) {
            fill(c.setting[i].name, sizeof(c.setting[i].name), "shutter", i);
            fill(c.setting[i].value, sizeof(c.setting[i].value), "1/", i);
        }
        c.quiet_ms = 200, c.n_objects = 2;
        c.n_after = CAMERA_STORES_MAX;
        for (int i = 0; i < c.n_after; i++)
            c.after[i] = (struct camera_object){ "/store_00010001/DCIM/100NIKON", "DSC_0001.NEF", -1 };
        c.object = (struct camera_object){ "/store_00010001/DCIM/100NIKON", "DSC_0001.NEF", (int64_t)5 << 32 };
        strcpy(c.path, "/var/lib/rigd/takes/t/raw/A01.nef");
        strcpy(c.xxh128, "0123456789abcdef0123456789abcdef");
        strcpy(c.judge, "{\"model\":\"equisolid\"}");
        size_t n;
        char *text = camera_command_encode(&c, &n);
        assert_non_null(text);
        assert_true(n < CAMERA_MESSAGE_MAX);
        assert_int_equal(camera_command_decode(&back, text, n), 0);
        assert_memory_equal(&c, &back, sizeof(c));
        free(text);
    }
}

static void the_longest_answer_fits_into_a_message(void **state)
{
    (void)state;
    struct camera_event e, back;
    memset(&e, 0, sizeof(e));
    e.kind = CAMERA_DONE, e.seq = UINT32_MAX, e.command = CAMERA_LIST;
    e.n_settings = CAMERA_SETTINGS_MAX;
    for (int i = 0; i < e.n_settings; i++) {
        memset(e.setting[i].name, 1, sizeof(e.setting[i].name) - 1); // six bytes each when escaped
        memset(e.setting[i].wanted, 1, sizeof(e.setting[i].wanted) - 1);
        memset(e.setting[i].found, 1, sizeof(e.setting[i].found) - 1);
        e.setting[i].equal = true;
    }
    e.n_listed = CAMERA_LISTING_MAX, e.n_objects = INT32_MAX, e.more = true;
    for (int i = 0; i < e.n_listed; i++) {
        memset(e.object[i].folder, 'x', sizeof(e.object[i].folder) - 1);
        e.object[i].folder[0] = '/';
        memset(e.object[i].name, 'y', sizeof(e.object[i].name) - 1);
        e.object[i].size_bytes = INT64_MAX;
    }
    size_t n;
    char *text = camera_event_encode(&e, &n);
    assert_true(n < CAMERA_MESSAGE_MAX);
    assert_int_equal(camera_event_decode(&back, text, n), 0);
    assert_memory_equal(&e, &back, sizeof(e));
    free(text);
}

static void what_a_frame_shows_arrives_as_it_was_measured(void **state)
{
    (void)state;
    struct camera_event e, back;
    memset(&e, 0, sizeof(e));
    e.kind = CAMERA_DONE, e.seq = 9, e.command = CAMERA_FETCH, e.size_bytes = 8000000, e.judged = true;
    strcpy(e.xxh128, "0123456789abcdef0123456789abcdef");
    e.frame.f_number = 8, e.frame.iso = 64;
    strcpy(e.frame.serial, "6001001");
    e.frame.light = (struct bracket_statistics){ .exposure_s = 1. / 3, .n_sites = { 1, 2, 3 }, .n_over = { 0, 2, 1 }, .brightest = { .1, 1. / 3, 1 }, .first_percentile = { -.001, 0, .1 },
                                                 .median = { .2, .3, .4 }, .plateau_dn = 15892 };
    size_t n;
    char *text = camera_event_encode(&e, &n);
    assert_int_equal(camera_event_decode(&back, text, n), 0);
    assert_true(back.judged);
    assert_memory_equal(&e.frame, &back.frame, sizeof(e.frame));
    free(text);
}

static void a_status_keeps_what_is_unknown_unknown(void **state)
{
    (void)state;
    struct camera_event e, back;
    memset(&e, 0, sizeof(e));
    e.kind = CAMERA_DONE, e.seq = 7, e.command = CAMERA_STATUS;
    e.status = (struct camera_status){ -1, -1, -1, -1, NAN, -1, -1, -1, "" };
    size_t n;
    char *text = camera_event_encode(&e, &n);
    assert_int_equal(camera_event_decode(&back, text, n), 0);
    assert_true(isnan(back.status.clock_offset_s));
    assert_int_equal(back.status.battery_percent, -1);
    assert_int_equal(back.status.free_images, -1);
    free(text);
}

static void strange_messages_are_refused(void **state)
{
    (void)state;
    static const char *const bad_events[] = {
        "", "{", "[]", "1", "{\"event\":\"done\"}", "{\"event\":\"hello\",\"seq\":3}",
        "{\"event\":\"done\",\"seq\":0,\"command\":\"open\"}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"fetch\"}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"fetch\",\"xxh128\":\"0123456789ABCDEF0123456789ABCDEF\"}",
        "{\"event\":\"object\",\"seq\":1}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"fetch\",\"xxh128\":\"0123456789abcdef0123456789abcdef\",\"frame\":{}}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"fetch\",\"xxh128\":\"0123456789abcdef0123456789abcdef\",\"frame\":{\"exposure_s\":-1,\"f_number\":8,\"iso\":100,\"serial\":\"\","
        "\"sites\":[1,1,1],\"over\":[0,0,0],\"brightest\":[0,0,0],\"first_percentile\":[0,0,0],\"median\":[0,0,0]}}",
        "{\"event\":\"object\",\"seq\":1,\"objects\":[{\"folder\":\"/a\",\"name\":\"../x\",\"size\":1}]}",
        "{\"event\":\"object\",\"seq\":1,\"objects\":[{\"folder\":\"/a\",\"name\":\".hidden\",\"size\":1}]}",
        "{\"event\":\"object\",\"seq\":1,\"objects\":[{\"folder\":\"a\",\"name\":\"x\",\"size\":1}]}",
        "{\"event\":\"object\",\"seq\":1,\"objects\":[{\"folder\":\"/a\",\"name\":\"x\",\"size\":-2}]}",
        "{\"event\":\"object\",\"seq\":1,\"objects\":{\"folder\":\"/a\"}}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"status\"}",
        "{\"event\":\"done\",\"seq\":1,\"command\":\"format_the_card\"}",
        "{\"event\":\"progress\",\"seq\":1,\"size\":-5}",
        "{\"event\":\"failed\",\"seq\":1,\"command\":\"open\",\"trouble\":\"lost\",\"err\":5}",
    };
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(bad_events) / sizeof(bad_events[0]); i++) {
        struct camera_event e;
        if (camera_event_decode(&e, bad_events[i], strlen(bad_events[i])) != -EINVAL)
            fail_msg("accepted: %s", bad_events[i]);
    }
    struct camera_command c;
    const char *relative = "{\"do\":\"fetch\",\"seq\":1,\"timeout_ms\":5,\"path\":\"raw/A01.nef\"}";
    assert_int_equal(camera_command_decode(&c, relative, strlen(relative)), -EINVAL);
    log_set_level(LOG_INFO);
}

static void cards_are_read_in_the_order_they_were_written(void **state)
{
    (void)state;
    static const struct camera_object order[] = {
        { "/store_00010001/DCIM/100NIKON", "DSC_9998.NEF", 1 },
        { "/store_00010001/DCIM/100NIKON", "DSC_9999.JPG", 1 },
        { "/store_00010001/DCIM/100NIKON", "DSC_9999.NEF", 1 },
        { "/store_00010001/DCIM/101NIKON", "DSC_0001.NEF", 1 }, // the counter wrapped, the folder went on
        { "/store_00010001/DCIM/101NIKON", "_DSC0002.NEF", 1 },
        { "/store_00020001/DCIM/100NIKON", "DSC_0001.NEF", 1 }, // another card
    };
    enum { N = sizeof(order) / sizeof(order[0]) };
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            const int o = camera_object_order(&order[i], &order[j]);
            assert_int_equal((o > 0) - (o < 0), (i > j) - (i < j));
            assert_int_equal(camera_same_store(&order[i], &order[j]), (i < N - 1) == (j < N - 1));
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_command_survives_the_way),
        cmocka_unit_test(the_longest_answer_fits_into_a_message),
        cmocka_unit_test(what_a_frame_shows_arrives_as_it_was_measured),
        cmocka_unit_test(a_status_keeps_what_is_unknown_unknown),
        cmocka_unit_test(strange_messages_are_refused),
        cmocka_unit_test(cards_are_read_in_the_order_they_were_written),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
