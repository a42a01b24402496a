// tests/test_describe.c - what clients see of a take and of the rig is what is, and Prometheus can read it.
#include "rigd/describe.h"
#include "rigd/panorama_plan.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

enum { N = 3 };
static struct config config;
static struct rig *rig;

static int set_up(void **state)
{
    (void)state;
    config = (struct config){ .objects_per_shot = 1, .n_cameras = N, .heartbeat_s = 25, .lag_max_std_ms = 5 };
    strcpy(config.name, "studio");
    strcpy(config.takes_dir, "/takes");
    config.camera = calloc(N, sizeof(*config.camera));
    for (int i = 0; i < N; i++) {
        snprintf(config.camera[i].name, sizeof(config.camera[i].name), "A%02d", i + 1);
        snprintf(config.camera[i].port, sizeof(config.camera[i].port), "usb:1-%d", i + 1);
    }
    return rig_create(&rig, &config);
}

static int tear_down(void **state)
{
    (void)state;
    rig_free(rig);
    config_free(&config);
    return 0;
}

// A01 delivered, A02 is missed, A03 was left out.
static void make_ledger(struct ledger *l, const char *id)
{
    const struct camera_object o = { "/store_00010001/DCIM/100NIKON", "DSC_0002.NEF", 1000 };
    ledger_init(l, &config);
    strcpy(l->id, id);
    strcpy(l->name, "vase");
    l->state = TAKE_FAILED;
    strcpy(l->reason, "1 of 3 cameras did not deliver");
    l->spread_ns = 2500000, l->sigma_ns = 500000, l->n_measured = 2;
    struct ledger_object *copy = ledger_add(&l->camera[0], &o);
    copy->state = OBJECT_COPIED;
    strcpy(copy->xxh128, "0123456789abcdef0123456789abcdef");
    l->camera[0].debt = DEBT_PAID;
    l->camera[0].lag_ns = 97250000;
    ledger_add(&l->camera[1], &o); // on its card only
    l->camera[1].debt = DEBT_MISSED;
    strcpy(l->camera[1].note, "check its card");
    l->camera[2].expected = false;
    strcpy(l->camera[2].note, "left out: no card");
}

static double number(const struct json *v, const char *path)
{
    double n = NAN;
    if (json_get_number(v, path, &n))
        fail_msg("no number %s", path);
    return n;
}

static const char *text(const struct json *v, const char *path)
{
    const char *s = "";
    if (json_get_string(v, path, &s))
        fail_msg("no text %s", path);
    return s;
}

static void a_take_counts_what_is_here_and_names_who_is_missing(void **state)
{
    (void)state;
    struct ledger l;
    make_ledger(&l, "20261122T090000000_vase");
    struct json *t = describe_take(&l, true);
    assert_true(number(t, "n_expected") == 2 && number(t, "n_delivered") == 1 && number(t, "n_frames") == 1 && number(t, "bytes") == 1000);
    assert_true(fabs(number(t, "spread_ms") - 2.5) < 1e-9 && fabs(number(t, "sigma_ms") - .5) < 1e-9);
    assert_string_equal(text(t, "state"), "failed");
    assert_int_equal(json_length(t, "missing"), 1);
    assert_string_equal(text(t, "missing.0.camera"), "A02");
    assert_string_equal(text(t, "missing.0.port"), "usb:1-2");
    assert_string_equal(text(t, "missing.0.note"), "check its card");
    assert_int_equal(json_length(t, "left_out"), 1);
    assert_string_equal(text(t, "left_out.0.camera"), "A03");
    assert_true(fabs(number(t, "cameras.0.lag_ms") - 97.25) < 1e-9);
    assert_string_equal(text(t, "cameras.0.files.0.xxh128"), "0123456789abcdef0123456789abcdef");
    assert_null(json_get(t, "cameras.1.lag_ms"));
    json_free(t);
    l.spread_ns = -1; // nothing was measured: nothing is said
    t = describe_take(&l, false);
    assert_null(json_get(t, "spread_ms"));
    assert_null(json_get(t, "cameras"));
    json_free(t);
    ledger_free(&l);
}

static void takes_are_listed_oldest_first_and_what_is_none_is_not(void **state)
{
    (void)state;
    static const char *const ids[] = { "20261122T100000000_b", "20261121T100000000_a" };
    char dir[200], path[400];
    const char *tmp = getenv("TMPDIR");
    snprintf(dir, sizeof(dir), "%s/studiorig-test-XXXXXX", tmp ? tmp : "/tmp");
    assert_non_null(mkdtemp(dir));
    for (int i = 0; i < 2; i++) {
        struct ledger l;
        make_ledger(&l, ids[i]);
        char *ledger = ledger_text(&l);
        assert_int_equal(ledger_create(ledger, LEDGER_CAPTURE, ids[i], dir), 0);
        free(ledger);
        ledger_free(&l);
    }
    snprintf(path, sizeof(path), "%s/holiday", dir);
    assert_int_equal(make_directories(path), 0);
    struct json *o = json_new_object(), *list = describe_takes(dir, 100);
    assert_non_null(list);
    json_set(o, "takes", list);
    assert_int_equal(json_length(o, "takes"), 2);
    assert_string_equal(text(o, "takes.0.id"), ids[1]);
    assert_string_equal(text(o, "takes.1.id"), ids[0]);
    json_free(o);
    o = json_new_object();
    json_set(o, "takes", describe_takes(dir, 1)); // the newest of them
    assert_int_equal(json_length(o, "takes"), 1);
    assert_string_equal(text(o, "takes.0.id"), ids[0]);
    json_free(o);
    snprintf(path, sizeof(path), "rm -r %s", dir);
    assert_int_equal(system(path), 0);
}

static void metrics_are_as_prometheus_reads_them(void **state)
{
    (void)state;
    const struct counters counters = { .n_takes = 7, .n_verified = 5, .n_failed = 2, .n_frames = 11, .n_bytes = INT64_C(5000000000), .last_take_s = 1.25 };
    char *all = describe_metrics(rig, &config, &counters), typed[80] = "";
    int n_samples = 0, n_conditions = 0;
    assert_non_null(strstr(all, "\nrigd_takes_total 7\n"));
    assert_non_null(strstr(all, "\nrigd_takes_verified_total 5\n"));
    assert_non_null(strstr(all, "\nrigd_takes_failed_total 2\n"));
    assert_non_null(strstr(all, "\nrigd_bytes_total 5000000000\n"));
    assert_non_null(strstr(all, "\nrigd_take_seconds 1.250\n"));
    assert_non_null(strstr(all, "\nrigd_cameras{condition=\"off\"} 3\n"));
    assert_null(strstr(all, "battery_percent{")); // nobody has said yet
    for (char *line = strtok(all, "\n"); line; line = strtok(NULL, "\n")) { // each sample below the TYPE of its own name
        if (!strncmp(line, "# TYPE ", 7)) {
            assert_int_equal(sscanf(line, "# TYPE %79s", typed), 1);
        } else if (line[0] != '#') {
            char *end;
            const size_t n = strcspn(line, "{ ");
            assert_true(n == strlen(typed) && !strncmp(line, typed, n));
            assert_non_null(strrchr(line, ' '));
            strtod(strrchr(line, ' ') + 1, &end);
            assert_int_equal(*end, 0);
            n_conditions += !strncmp(line, "rigd_cameras{", 13);
            n_samples++;
        }
    }
    assert_int_equal(n_conditions, RIG_QUARANTINED + 1);
    assert_int_equal(n_samples, n_conditions + 6 + 2 + N);
    free(all);
}

static void status_and_lag_say_only_what_is_known(void **state)
{
    (void)state;
    const struct lag lag[N] = { { .mean_ms = 97, .std_ms = 1, .error_ms = .2, .n = 30 }, { .mean_ms = 117, .std_ms = 9, .error_ms = 2, .n = 30, .n_rejected = 1 } };
    rig_set_lag(rig, lag);
    struct json *s = describe_rig(rig, &config, "gpio");
    json_set(s, "cameras", describe_cameras(rig, &config));
    assert_string_equal(text(s, "state"), "idle");
    assert_string_equal(text(s, "trigger"), "gpio");
    assert_true(number(s, "n_cameras") == N && number(s, "n_ready") == 0 && number(s, "n_quarantined") == 0);
    assert_string_equal(text(s, "cameras.1.condition"), "off");
    assert_true(number(s, "cameras.1.lag_ms") == 117);
    assert_null(json_get(s, "cameras.2.lag_ms"));
    assert_null(json_get(s, "cameras.0.battery_percent"));
    assert_null(json_get(s, "cameras.0.clock_offset_s"));
    assert_null(json_get(s, "take"));
    json_free(s);
    bool steady = false;
    s = describe_lag(rig, &config);
    assert_int_equal(json_get_bool(s, "lag.0.steady", &steady), 0);
    assert_true(steady);
    assert_int_equal(json_get_bool(s, "lag.1.steady", &steady), 0);
    assert_false(steady);
    assert_true(number(s, "lag.2.n") == 0);
    assert_null(json_get(s, "lag.2.mean_ms"));
    json_free(s);
}

// What rigd-panorama reads: the frames that can be used, in the order in which they were shot, stop by stop; a stop without any is there too.
static void the_plan_of_a_panorama_is_what_the_merge_reads(void **state)
{
    (void)state;
    struct ledger l;
    struct panorama_plan plan;
    struct config c = config;
    strcpy(c.panorama.camera_name, config.camera[0].name);
    c.panorama.camera = 0;
    c.panorama.lens = (struct lens){ .model = LENS_EQUISOLID, .width_px = 600, .height_px = 400, .focal_px = 141, .centre_px = { 300, 200 }, .k = { .01, -.02, 0 }, .p = { .001, -.002 }, .circle_px = 190 };
    assert_int_equal(lens_init(&c.panorama.lens, "t"), 0);
    c.panorama.nodal_offset_m = .01;
    c.panorama.neutral_density_ev = 6;
    c.panorama.n_stops = 3;
    c.panorama.stop[1] = (struct config_stop){ 120, 5 };
    c.panorama.stop[2] = (struct config_stop){ 240, -5 };
    ledger_init_panorama(&l, &c);
    strcpy(l.id, "20261122T090000000_panorama");
    l.state = TAKE_VERIFIED;
    for (int e = 0; e < 5; e++) {
        const struct camera_object o = { "/store_00010001/DCIM/100NIKON", "DSC_0002.NEF", 1000 };
        assert_int_equal(ledger_expose(&l, &c, e / 3, e % 3, exp2(-e)), e);
        struct ledger_camera *k = &l.camera[e];
        ledger_add(k, &o)->state = OBJECT_COPIED;
        k->debt = DEBT_PAID;
        k->exposure.object = 0;
        k->exposure.facts.light.exposure_s = exp2(-e);
        k->exposure.rejected = e == 1;
    }
    struct json *o = describe_plan(&l, &c);
    char *said = json_text(o);
    assert_int_equal(panorama_plan_parse(&plan, said, strlen(said), "plan", "/takes/x/panorama"), 0);
    assert_int_equal(plan.n_stops, 3);
    assert_int_equal(plan.stop[0].n_frames, 2);
    assert_int_equal(plan.stop[1].n_frames, 2);
    assert_int_equal(plan.stop[2].n_frames, 0);
    assert_string_equal(plan.stop[0].frame[1].file, "/takes/x/panorama/raw/00_02.nef");
    assert_true(plan.stop[0].frame[1].exposure_s == .25);
    assert_true(plan.stop[1].yaw_deg == 120 && plan.stop[2].pitch_deg == -5);
    assert_true(plan.nodal_offset_m == .01);
    assert_memory_equal(plan.lens.k, c.panorama.lens.k, sizeof(plan.lens.k));
    assert_memory_equal(plan.lens.p, c.panorama.lens.p, sizeof(plan.lens.p));
    assert_true(plan.lens.focal_px == 141 && plan.lens.circle_px == 190 && plan.lens.model == LENS_EQUISOLID);
    assert_true(fabs(plan.lens.max_angle_rad - c.panorama.lens.max_angle_rad) < 1e-12);
    free(said);
    json_free(o);
    panorama_plan_free(&plan);
    o = describe_take(&l, false);
    assert_string_equal(text(o, "kind"), "panorama");
    assert_true(number(o, "n_expected") == 5);
    json_free(o);
    const struct rig_progress p = { RIG_STEP_FRAME, 1, 3, 4, 120, 5, "1/250", "brightest" };
    o = describe_progress(&l, &p);
    assert_string_equal(text(o, "step"), "frame");
    assert_string_equal(text(o, "exposure"), "1/250");
    assert_true(number(o, "stop") == 2 && number(o, "n_stops") == 3 && number(o, "frame") == 5);
    json_free(o);
    ledger_free(&l);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_take_counts_what_is_here_and_names_who_is_missing),
        cmocka_unit_test(takes_are_listed_oldest_first_and_what_is_none_is_not),
        cmocka_unit_test(metrics_are_as_prometheus_reads_them),
        cmocka_unit_test(status_and_lag_say_only_what_is_known),
        cmocka_unit_test(the_plan_of_a_panorama_is_what_the_merge_reads),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
