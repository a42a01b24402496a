// tests/test_rigsim.c - the simulated camera's pure parts: wire packets, data sets, personalities, body, responder, raws, scripts.
#include "solver/take/log.h"
#include "tests/rigsim/dataset.h"
#include "tests/rigsim/faults.h"
#include "tests/rigsim/frame.h"
#include "tests/rigsim/ptp.h"
#include "tests/rigsim/ptpip.h"
#include "tests/rigsim/raw_dng.h"
#include "rigd/shutter_line.h"
#include "tests/scratch.h"

#include "solver/take/image.h"

#include <errno.h>
#include <math.h>
#include <string.h>
#include <sys/stat.h>

#define MS INT64_C(1000000)
#define S INT64_C(1000000000)
enum { WIDTH = 64, HEIGHT = 48 };

static char last_log[512];

static void keep_log(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    (void)level;
    snprintf(last_log, sizeof(last_log), "%s", message);
}

static const char *name_of(unsigned camera)
{
    return camera == 0 ? "A01" : camera == 1 ? "A02" : "A03";
}

struct rig {
    struct personality personality;
    struct scene *scene;
    struct body body;
    struct ptp_session session;
    struct ptp_reply reply;
};

// A camera at time 1 s that looks at a folder (NULL: the built-in picture).
static void rig_open(struct rig *r, const char *personality, unsigned index, uint64_t seed, const char *folder)
{
    memset(r, 0, sizeof(*r));
    assert_int_equal(personality_load(&r->personality, personality), 0);
    assert_int_equal(scene_open(&r->scene, folder, WIDTH, HEIGHT, 3, name_of), 0);
    assert_int_equal(body_init(&r->body, &r->personality, index, seed, S, 1767225600 * S), 0);
    r->body.measure = frame_measure;
    r->body.measure_arg = r->scene;
    ptp_session_init(&r->session, &r->body);
    r->session.thumbnail = frame_thumbnail;
    r->session.arg = r->scene;
    r->session.width_px = WIDTH;
    r->session.height_px = HEIGHT;
}

static void rig_close(struct rig *r)
{
    dataset_free(&r->reply.data);
    body_free(&r->body);
    scene_close(r->scene);
}

static uint16_t ask(struct rig *r, uint16_t code, int n, const uint32_t *param, const void *data, size_t n_data)
{
    struct ptp_request q = { .code = code, .n_params = n, .data = data, .n_data = n_data };
    for (int i = 0; i < n; i++)
        q.param[i] = param[i];
    ptp_answer(&r->session, &q, &r->reply);
    return r->reply.code;
}
#define ASK(r, code, ...) \
    ask(r, code, (int)(sizeof((uint32_t[]){ __VA_ARGS__ }) / 4), (uint32_t[]){ __VA_ARGS__ }, NULL, 0)

static uint16_t set_u32(struct rig *r, uint16_t property, uint32_t value, int n_bytes)
{
    const uint8_t v[4] = { value & 255, value >> 8 & 255, value >> 16 & 255, value >> 24 };
    return ask(r, 0x1016, 1, &(uint32_t){ property }, v, (size_t)n_bytes);
}

// ---- wire ------------------------------------------------------------------------------------------------------------------

static void a_packet_survives_writing_and_parsing(void **state)
{
    (void)state;
    const uint8_t payload[5] = { 1, 2, 3, 4, 5 };
    const struct ptpip_packet all[] = {
        { .type = PTPIP_INIT_COMMAND_REQUEST, .guid = { 1, 2, 3 }, .name = "host", .version = 0x10000 },
        { .type = PTPIP_INIT_COMMAND_ACK, .connection = 7, .name = "camera", .version = 0x10000 },
        { .type = PTPIP_INIT_EVENT_REQUEST, .connection = 7 },
        { .type = PTPIP_INIT_EVENT_ACK },
        { .type = PTPIP_INIT_FAIL, .reason = 2 },
        { .type = PTPIP_COMMAND, .data_phase = 1, .code = 0x1009, .transaction = 99, .n_params = 5, .param = { 1, 2, 3, 4, 5 } },
        { .type = PTPIP_RESPONSE, .code = 0x2001, .transaction = 99, .n_params = 1, .param = { 0xffffffff } },
        { .type = PTPIP_EVENT, .code = 0x4002, .n_params = 1, .param = { 0x10010 } },
        { .type = PTPIP_START_DATA, .transaction = 99, .total = UINT64_C(0x123456789) },
        { .type = PTPIP_DATA, .transaction = 99, .payload = payload, .n_payload = 5 },
        { .type = PTPIP_END_DATA, .transaction = 99, .payload = payload, .n_payload = 5 },
        { .type = PTPIP_CANCEL, .transaction = 99 },
        { .type = PTPIP_PING },
        { .type = PTPIP_PONG },
    };
    for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); i++) {
        struct dataset d = { 0 }, again = { 0 };
        struct ptpip_packet p;
        size_t used = 0;
        ptpip_write(&d, &all[i]);
        assert_int_equal(ptpip_parse(d.data, d.n, &p, &used), 0);
        assert_int_equal(used, d.n);
        assert_int_equal(p.type, all[i].type);
        assert_int_equal(p.code, all[i].code);
        assert_int_equal(p.transaction, all[i].transaction);
        assert_int_equal(p.total, all[i].total);
        assert_int_equal(p.n_params, all[i].n_params);
        assert_string_equal(p.name, all[i].name);
        assert_int_equal(p.n_payload, all[i].n_payload);
        ptpip_write(&again, &p);
        assert_int_equal(again.n, d.n);
        assert_memory_equal(again.data, d.data, d.n);
        for (size_t n = 0; n < d.n; n++) // any part of it asks for more
            assert_int_equal(ptpip_parse(d.data, n, &p, &used), -EAGAIN);
        dataset_free(&d);
        dataset_free(&again);
    }
}

static void hostile_packets_are_refused(void **state)
{
    (void)state;
    static const struct {
        uint8_t bytes[24];
        size_t n;
    } bad[] = {
        { { 7, 0, 0, 0, 6, 0, 0, 0 }, 8 },                            // shorter than its header
        { { 0xff, 0xff, 0xff, 0xff, 6, 0, 0, 0 }, 8 },                // 4 GiB
        { { 1, 0, 0x10, 0, 10, 0, 0, 0 }, 8 },                        // a byte over the limit
        { { 8, 0, 0, 0, 99, 0, 0, 0 }, 8 },                           // no such type
        { { 8, 0, 0, 0, 0, 0, 0, 0 }, 8 },                            // type 0
        { { 10, 0, 0, 0, 6, 0, 0, 0, 1, 0 }, 10 },                    // a command cut short
        { { 20, 0, 0, 0, 6, 0, 0, 0, 1, 0, 0, 0, 1, 0x10, 0, 0, 0, 0, 1, 1 }, 20 }, // half a parameter
        { { 9, 0, 0, 0, 13, 0, 0, 0, 0 }, 9 },                        // a ping with a body
        { { 11, 0, 0, 0, 10, 0, 0, 0, 1, 1, 1 }, 11 },                // data without its transaction
    };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        struct ptpip_packet p;
        size_t used;
        assert_int_equal(ptpip_parse(bad[i].bytes, bad[i].n, &p, &used), -EPROTO);
    }
    uint8_t endless[40] = { 40, 0, 0, 0, 1 }; // a name without end
    memset(endless + 24, 'x', 16);
    struct ptpip_packet p;
    size_t used;
    assert_int_equal(ptpip_parse(endless, 40, &p, &used), -EPROTO);
}

static void strings_and_short_data_sets_are_read_safely(void **state)
{
    (void)state;
    struct dataset d = { 0 };
    char text[64], tight[4];
    dataset_string(&d, "a\xc3\xa9\xe2\x82\xac"); // a, e acute, euro
    assert_int_equal(d.data[0], 4);
    struct dataset_reader r = { d.data, d.n, 0, false };
    dataset_read_string(&r, text, sizeof(text));
    assert_false(r.failed);
    assert_string_equal(text, "a\xc3\xa9\xe2\x82\xac");
    r = (struct dataset_reader){ d.data, d.n, 0, false };
    dataset_read_string(&r, tight, sizeof(tight));
    assert_string_equal(tight, "a\xc3\xa9"); // never half a character
    for (size_t n = 0; n < d.n; n++) {
        r = (struct dataset_reader){ d.data, n, 0, false };
        dataset_read_string(&r, text, sizeof(text));
        assert_true(r.failed);
        assert_string_equal(text, "");
    }
    dataset_free(&d);
}

// ---- personality -----------------------------------------------------------------------------------------------------------

static void a_file_changes_what_it_names(void **state)
{
    (void)state;
    static const char text[] = "base = nikon\nmodel = D850   # ours\nlag_ms = 42.5\nwb = .4 1 .8\nno_property 0xd1f1\n"
                               "property 0x5007 u16 rw aperture.100 enum 800,1100 = 1100\n";
    struct personality p;
    scratch_write("d850.conf", text, sizeof(text) - 1);
    assert_int_equal(personality_load(&p, scratch_path("d850.conf")), 0);
    assert_string_equal(p.model, "D850");
    assert_int_equal(p.vendor, VENDOR_NIKON);
    assert_true(p.lag_ms == 42.5 && p.wb[2] == .8);
    assert_null(personality_property(&p, 0xd1f1));
    assert_int_equal(personality_property(&p, 0x5007)->initial, 1100);
    assert_int_equal(personality_property(&p, 0x5007)->n_choices, 2);
    assert_non_null(personality_property(&p, 0xd100));
    scratch_empty();
}

static void a_wrong_statement_is_named_by_file_and_line(void **state)
{
    (void)state;
    static const struct {
        const char *text, *found;
    } bad[] = {
        { "base = nikon\nlag_msec = 4\n", "2: found 'lag_msec'" },
        { "base = sony\n", "1: found 'sony'" },
        { "base = generic\n\nlag_ms = fast\n", "3: found 'fast'" },
        { "base = generic\nlag_ms = nan\n", "2: found 'nan'" },
        { "base = generic\nproperty 0x5007 u17 rw none any\n", "2: found 'u17'" },
        { "base = generic\nproperty 0x15007 u16 rw none any\n", "2: found '0x15007'" },
        { "base = generic\nproperty 0x5007 u16 rw none enum\n", "2: found 'no choice'" },
        { "base = generic\nproperty 0x5007 u16 rw none range 5 1 1\n", "2: found '0x5007'" },
        { "base = generic\nformats = 4:raw 7:tiff\n", "2: found 'tiff'" },
        { "base = generic\nserial = 0123456789012345678901234567890123456789\n", "2: found '01234567890" },
        { "nonsense\n", "1: found 'nonsense'" },
    };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        struct personality p;
        scratch_write("bad.conf", bad[i].text, strlen(bad[i].text));
        assert_int_equal(personality_load(&p, scratch_path("bad.conf")), -EINVAL);
        assert_non_null(strstr(last_log, bad[i].found));
    }
    scratch_empty();
}

// ---- body ------------------------------------------------------------------------------------------------------------------

static int events_of(struct body *b, enum body_event_kind kind, struct body_event *last)
{
    struct body_event e;
    int n = 0;
    while (body_take_event(b, &e))
        if (e.kind == kind) {
            n++;
            *last = e;
        }
    return n;
}

static void lag_is_measured_from_the_press_and_differs_per_body_and_shot(void **state)
{
    (void)state;
    enum { BODIES = 40, SHOTS = 30 };
    double mean[BODIES], spread = 0, all = 0;
    for (unsigned i = 0; i < BODIES; i++) {
        struct rig r;
        rig_open(&r, "canon", i, 9, NULL);
        double sum = 0, sum2 = 0;
        for (int k = 0; k < SHOTS; k++) {
            const int64_t at = (10 + 2 * k) * S;
            struct body_event e = { 0 };
            assert_int_equal(body_line(&r.body, SHUTTER_LINE_HALF, 1, at - S, 0), 0);
            assert_int_equal(body_line(&r.body, SHUTTER_LINE_FULL, 1, at, (uint64_t)k), 0);
            assert_int_equal(body_line(&r.body, SHUTTER_LINE_FULL, 0, at + 50 * MS, 0), 0);
            assert_int_equal(body_line(&r.body, SHUTTER_LINE_HALF, 0, at + 50 * MS, 0), 0);
            body_step(&r.body, at + S / 2);
            assert_int_equal(events_of(&r.body, BODY_EXPOSED, &e), 1);
            assert_int_equal(e.tag, k);
            assert_int_equal(e.at_ns, at + e.lag_ns);
            assert_int_equal(e.end_ns, e.at_ns + (int64_t)llround(1e9 / 128)); // 1/125 on the dial
            sum += (double)e.lag_ns * 1e-6;
            sum2 += (double)e.lag_ns * 1e-6 * (double)e.lag_ns * 1e-6;
        }
        mean[i] = sum / SHOTS;
        all += mean[i] / BODIES;
        const double sigma = sqrt(sum2 / SHOTS - mean[i] * mean[i]);
        assert_true(sigma > .1 && sigma < .5);                                                // lag_jitter_ms .25
        assert_true(fabs(mean[i] - (double)r.body.lag_ns * 1e-6) < 4 * .25 / sqrt(SHOTS));   // around the body's own
        rig_close(&r);
    }
    for (int i = 0; i < BODIES; i++)
        spread += (mean[i] - all) * (mean[i] - all) / BODIES;
    assert_true(fabs(all - 97) < 4 * 7 / sqrt(BODIES)); // lag_ms 97, lag_spread_ms 7
    assert_true(sqrt(spread) > 4 && sqrt(spread) < 11);
}

static void half_press_wakes_and_silences(void **state)
{
    (void)state;
    struct rig r;
    struct body_event e = { 0 };
    rig_open(&r, "canon", 0, 1, NULL);
    assert_false(body_is_silent(&r.body));
    body_line(&r.body, SHUTTER_LINE_FULL, 1, 10 * S, 0); // asleep for 9 s
    body_step(&r.body, 10 * S);
    assert_true(body_is_silent(&r.body));
    body_line(&r.body, SHUTTER_LINE_FULL, 0, 11 * S, 0);
    body_step(&r.body, 11 * S);
    assert_false(body_is_silent(&r.body));
    assert_int_equal(events_of(&r.body, BODY_EXPOSED, &e), 1);
    const int64_t asleep = e.lag_ns;
    body_line(&r.body, SHUTTER_LINE_HALF, 1, 20 * S, 0); // asleep again, but woken in time
    body_line(&r.body, SHUTTER_LINE_FULL, 1, 20 * S + 250 * MS, 0);
    body_line(&r.body, SHUTTER_LINE_FULL, 0, 21 * S, 0);
    body_step(&r.body, 20 * S + MS);
    assert_true(body_is_silent(&r.body));
    body_step(&r.body, 22 * S);
    assert_int_equal(events_of(&r.body, BODY_EXPOSED, &e), 1);
    assert_true(asleep - e.lag_ns > 195 * MS && asleep - e.lag_ns < 205 * MS);
    assert_true(body_is_silent(&r.body)); // half is still closed
    body_open_lines(&r.body);
    assert_false(body_is_silent(&r.body));
    rig_close(&r);
}

static void a_press_during_an_exposure_or_with_a_full_card_takes_no_frame(void **state)
{
    (void)state;
    struct rig r;
    struct body_event e = { 0 };
    rig_open(&r, "generic", 0, 1, NULL);
    body_line(&r.body, SHUTTER_LINE_FULL, 1, 2 * S, 0);
    body_line(&r.body, SHUTTER_LINE_FULL, 0, 2 * S + 20 * MS, 0);
    body_line(&r.body, SHUTTER_LINE_FULL, 1, 2 * S + 60 * MS, 0); // the first still lags
    body_line(&r.body, SHUTTER_LINE_FULL, 0, 2 * S + 80 * MS, 0);
    body_step(&r.body, 4 * S);
    assert_int_equal(events_of(&r.body, BODY_EXPOSED, &e), 1);
    assert_int_equal(r.body.n_objects, 3);
    r.body.faults.card_full = true;
    body_line(&r.body, SHUTTER_LINE_FULL, 1, 5 * S, 0);
    body_step(&r.body, 6 * S);
    assert_int_equal(events_of(&r.body, BODY_STORE_FULL, &e), 1);
    assert_int_equal(r.body.n_shots, 1);
    assert_int_equal(body_release(&r.body, false), PTP_STORE_FULL);
    assert_int_equal(body_release(&r.body, true), PTP_OK); // RAM is not the card
    rig_close(&r);
}

static void a_card_fills_by_the_bytes_of_its_files_and_empties_by_deletion(void **state)
{
    (void)state;
    struct rig r;
    rig_open(&r, "generic", 0, 1, NULL);
    const struct exposure one = { .shot = 1, .time_s = 0x1p-7, .f_number = 8, .iso = 100 };
    const uint64_t raw = frame_measure(r.scene, &r.body, &one, FILES_RAW);
    char set[64];
    snprintf(set, sizeof(set), "card_bytes = %llu", (unsigned long long)(3 * raw + raw / 2));
    assert_int_equal(personality_statement(&r.personality, set, "set", 1), 0);
    assert_int_equal(body_free_images(&r.body), 3);
    for (int k = 1; k <= 3; k++) {
        assert_int_equal(body_release(&r.body, false), PTP_OK);
        body_step(&r.body, (1 + k) * 2 * S);
        assert_int_equal(body_free_images(&r.body), 3 - k);
    }
    assert_int_equal(body_release(&r.body, false), PTP_STORE_FULL);
    const uint32_t handle = r.body.object[3].handle;
    assert_int_equal(body_delete(&r.body, handle), PTP_OK);
    assert_int_equal(body_delete(&r.body, handle), PTP_INVALID_HANDLE);
    assert_int_equal(body_delete(&r.body, r.body.object[0].handle), PTP_WRITE_PROTECTED); // DCIM
    assert_int_equal(body_free_images(&r.body), 1);
    assert_int_equal(body_release(&r.body, false), PTP_OK);
    rig_close(&r);
}

static void raw_and_jpeg_come_as_two_files_one_late(void **state)
{
    (void)state;
    struct rig r;
    struct body_event e;
    rig_open(&r, "generic", 0, 1, NULL);
    assert_int_equal(ASK(&r, 0x1002, 1), PTP_OK);
    assert_int_equal(set_u32(&r, 0x5004, 7, 1), PTP_OK);
    assert_int_equal(ASK(&r, 0x100e, 0, 0), PTP_OK);
    int64_t added[2] = { 0 }, complete = 0;
    int n = 0;
    for (int64_t t = S; t < 3 * S; t += 5 * MS) {
        body_step(&r.body, t);
        while (body_take_event(&r.body, &e)) {
            if (e.kind == BODY_OBJECT_ADDED && n < 2)
                added[n++] = e.at_ns;
            if (e.kind == BODY_CAPTURE_COMPLETE)
                complete = e.at_ns;
        }
    }
    assert_int_equal(n, 2);
    assert_int_equal(added[1] - added[0], 250 * MS);
    assert_int_equal(complete - added[1], 10 * MS);
    assert_string_equal(r.body.object[2].name, "SIM_0001.DNG");
    assert_string_equal(r.body.object[3].name, "SIM_0001.JPG");
    rig_close(&r);
}

static void dials_have_labels_and_shutters_powers_of_two(void **state)
{
    (void)state;
    static const double cases[][2] = { { 1. / 125, 1. / 128 }, { 1. / 60, 1. / 64 }, { 1. / 15, 1. / 16 }, { 1. / 4000, 1. / 4096 },
                                       { 30, 32 }, { 15, 16 }, { 1, 1 } };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
        assert_true(fabs(body_true_time_s(cases[i][0]) / cases[i][1] - 1) < 1e-12);
    assert_true(fabs(body_true_time_s(.01) * exp2(20. / 3) - 1) < 1e-12);
    struct rig r;
    rig_open(&r, "canon", 0, 0, NULL); // codes of eighths of stops
    assert_true(body_exposure_time_s(&r.body) == 1. / 128 && body_f_number(&r.body) == 8 && body_iso(&r.body) == 100);
    const struct personality *p = &r.personality;
    for (int i = 0; i < p->n_properties; i++) {
        if (p->property[i].role == ROLE_ISO_EOS)
            assert_int_equal(body_set(&r.body, i, 77, NULL), PTP_OK); // 5/8 above 100
        if (p->property[i].role == ROLE_APERTURE_EOS)
            assert_int_equal(body_set(&r.body, i, 45, NULL), PTP_OK);
        if (p->property[i].role == ROLE_SHUTTER_EOS)
            assert_int_equal(body_set(&r.body, i, 91, NULL), PTP_OK); // 35/8 stops: 4 1/3
    }
    assert_int_equal(body_iso(&r.body), 160);
    assert_true(body_f_number(&r.body) == 5);
    assert_true(fabs(body_exposure_time_s(&r.body) * exp2(13. / 3) - 1) < 1e-12);
    rig_close(&r);
}

static void one_setting_shown_twice_moves_together(void **state)
{
    (void)state;
    struct rig r;
    rig_open(&r, "nikon", 0, 0, NULL);
    assert_int_equal(ASK(&r, 0x1002, 1), PTP_OK);
    assert_int_equal(set_u32(&r, 0xd100, 65596, 4), PTP_OK); // 1/60
    assert_int_equal(ASK(&r, 0x1015, 0x500d), PTP_OK);
    const uint8_t *v = r.reply.data.data;
    assert_int_equal(v[0] | v[1] << 8 | v[2] << 16 | v[3] << 24, 166); // 0.1 ms
    assert_true(body_exposure_time_s(&r.body) == 1. / 64);
    assert_int_equal(set_u32(&r, 0x500d, 20000, 4), PTP_OK); // 2 s
    assert_true(body_exposure_time_s(&r.body) == 2);
    rig_close(&r);
}

static void the_same_seed_gives_the_same_life(void **state)
{
    (void)state;
    int64_t at[2][10];
    for (int run = 0; run < 2; run++) {
        struct rig r;
        struct body_event e = { 0 };
        rig_open(&r, "generic", 2, 77, NULL);
        for (int k = 0; k < 10; k++) {
            body_line(&r.body, SHUTTER_LINE_FULL, 1, (2 + k) * S, 0);
            body_line(&r.body, SHUTTER_LINE_FULL, 0, (2 + k) * S + MS, 0);
            for (int64_t t = (2 + k) * S; t < (3 + k) * S; t += run ? 7 * MS : S / 2) // stepped finely or coarsely
                body_step(&r.body, t);
            body_step(&r.body, (3 + k) * S - 1);
            assert_int_equal(events_of(&r.body, BODY_EXPOSED, &e), 1);
            at[run][k] = e.at_ns;
        }
        rig_close(&r);
    }
    assert_memory_equal(at[0], at[1], sizeof(at[0]));
}

static void faults_lose_delay_and_spoil_what_they_say(void **state)
{
    (void)state;
    struct rig r;
    struct body_event e = { 0 };
    rig_open(&r, "generic", 0, 0, NULL);
    r.body.faults.lose_object_added = 1;
    r.body.faults.short_objects = 1;
    assert_int_equal(body_release(&r.body, false), PTP_OK);
    body_step(&r.body, 3 * S);
    assert_int_equal(events_of(&r.body, BODY_OBJECT_ADDED, &e), 0);
    assert_int_equal(r.body.n_objects, 3); // the file is there all the same
    assert_int_equal(r.body.object[2].told, r.body.object[2].size / 2);
    r.body.faults.late_events = 1;
    r.body.faults.late_event_ns = 5 * S;
    assert_int_equal(body_release(&r.body, false), PTP_OK);
    body_step(&r.body, 5 * S);
    assert_int_equal(events_of(&r.body, BODY_OBJECT_ADDED, &e), 0);
    body_step(&r.body, 9 * S);
    assert_int_equal(events_of(&r.body, BODY_OBJECT_ADDED, &e), 1);
    assert_int_equal(r.body.object[3].told, r.body.object[3].size);
    assert_int_equal(ASK(&r, 0x1002, 1), PTP_OK);
    r.body.faults.busy_until_ns = 10 * S;
    assert_int_equal(ASK(&r, 0x1015, 0x5001), PTP_BUSY);
    body_step(&r.body, 10 * S);
    assert_int_equal(ASK(&r, 0x1015, 0x5001), PTP_OK);
    r.body.faults = (struct body_faults){ .drift_code = 0x5007, .drift_value = 560, .drifts = 1 };
    assert_int_equal(set_u32(&r, 0x5007, 1100, 2), PTP_OK);
    assert_true(body_f_number(&r.body) == 5.6);
    assert_int_equal(set_u32(&r, 0x5007, 1100, 2), PTP_OK);
    assert_true(body_f_number(&r.body) == 11);
    rig_close(&r);
}

// ---- responder -------------------------------------------------------------------------------------------------------------

static void the_responder_refuses_what_it_should(void **state)
{
    (void)state;
    struct rig r;
    rig_open(&r, "generic", 0, 0, NULL);
    assert_int_equal(ASK(&r, 0x1001, 0), PTP_OK); // DeviceInfo without session
    assert_int_equal(ASK(&r, 0x1004, 0), PTP_SESSION_NOT_OPEN);
    assert_int_equal(ASK(&r, 0x1002, 0), PTP_INVALID_PARAMETER);
    assert_int_equal(ASK(&r, 0x1002, 1), PTP_OK);
    assert_int_equal(ASK(&r, 0x1002, 1), PTP_SESSION_ALREADY_OPEN);
    assert_int_equal(ASK(&r, 0x9207, 0, 1), PTP_NOT_SUPPORTED); // Nikon's
    assert_int_equal(ASK(&r, 0x1014, 0x5fff), PTP_NO_SUCH_PROPERTY);
    assert_int_equal(ASK(&r, 0x1008, 0x12345), PTP_INVALID_HANDLE);
    assert_int_equal(ASK(&r, 0x1009, 0x10001), PTP_INVALID_HANDLE); // a folder has no bytes
    assert_int_equal(ASK(&r, 0x1005, 0x99), PTP_INVALID_STORAGE);
    assert_int_equal(ASK(&r, 0x1007, 0x99, 0, 0), PTP_INVALID_STORAGE);
    assert_int_equal(set_u32(&r, 0x5007, 801, 2), PTP_BAD_VALUE);
    assert_int_equal(set_u32(&r, 0x5007, 800, 4), PTP_BAD_FORMAT);
    assert_int_equal(set_u32(&r, 0x5007, 800, 1), PTP_BAD_FORMAT);
    assert_int_equal(set_u32(&r, 0x5001, 50, 1), PTP_ACCESS_DENIED);
    assert_int_equal(r.reply.has_data, false);
    rig_close(&r);
}

static void device_info_lists_what_the_personality_says(void **state)
{
    (void)state;
    static const char *const names[] = { "generic", "nikon", "canon" };
    for (int k = 0; k < 3; k++) {
        struct rig r;
        rig_open(&r, names[k], 4, 0, NULL);
        assert_int_equal(ASK(&r, 0x1001, 0), PTP_OK);
        struct dataset_reader d = { r.reply.data.data, r.reply.data.n, 0, false };
        char text[64];
        dataset_read_u16(&d);
        assert_int_equal(dataset_read_u32(&d), r.personality.extension);
        dataset_read_u16(&d);
        dataset_read_string(&d, text, sizeof(text));
        dataset_read_u16(&d);
        assert_int_equal(dataset_read_u32(&d), r.personality.operations.n);
        d.at += (size_t)r.personality.operations.n * 2;
        for (int list = 0; list < 4; list++) {
            const uint32_t n = dataset_read_u32(&d);
            d.at += n * 2;
        }
        dataset_read_string(&d, text, sizeof(text));
        assert_string_equal(text, r.personality.manufacturer);
        dataset_read_string(&d, text, sizeof(text));
        assert_string_equal(text, r.personality.model);
        dataset_read_string(&d, text, sizeof(text));
        dataset_read_string(&d, text, sizeof(text));
        assert_false(d.failed);
        assert_int_equal(d.at, d.n);
        assert_string_equal(text, r.body.serial);
        assert_string_equal(text + strlen(text) - 3, "005"); // the fifth body
        rig_close(&r);
    }
}

static void partial_reads_join_to_the_whole_object(void **state)
{
    (void)state;
    struct rig r;
    struct frame *f;
    rig_open(&r, "generic", 1, 3, NULL);
    ASK(&r, 0x1002, 1);
    ASK(&r, 0x100e, 0, 0);
    body_step(&r.body, 3 * S);
    const struct body_object *o = &r.body.object[2];
    assert_int_equal(frame_open(&f, r.scene, &r.body, &o->exposure, o->file), 0);
    const size_t size = (size_t)frame_size(f);
    assert_int_equal(size, o->size);
    uint8_t *whole = malloc(size), *pieces = malloc(size), *backwards = malloc(size);
    frame_read(f, 0, whole, size);
    size_t at = 0;
    for (uint32_t n = 1; at < size; n = n * 3 % 1021 + 1) {
        assert_int_equal(ASK(&r, 0x101b, o->handle, (uint32_t)at, n), PTP_OK);
        assert_int_equal(r.reply.object, o->handle);
        assert_int_equal(r.reply.offset, at);
        assert_int_equal(r.reply.param[0], r.reply.n);
        frame_read(f, at, pieces + at, (size_t)r.reply.n);
        at += (size_t)r.reply.n;
    }
    assert_int_equal(at, size);
    for (size_t end = size; end;) {
        const size_t n = end < 333 ? end : 333;
        frame_read(f, end - n, backwards + end - n, n);
        end -= n;
    }
    assert_memory_equal(whole, pieces, size);
    assert_memory_equal(whole, backwards, size);
    assert_int_equal(ASK(&r, 0x101b, o->handle, (uint32_t)size, 10), PTP_OK);
    assert_int_equal(r.reply.n, 0);
    assert_int_equal(ASK(&r, 0x101b, o->handle, (uint32_t)size + 1, 10), PTP_INVALID_PARAMETER);
    frame_close(f);
    free(whole);
    free(pieces);
    free(backwards);
    rig_close(&r);
}

static void vendors_tell_events_their_own_way(void **state)
{
    (void)state;
    static const char *const names[] = { "generic", "nikon", "canon" };
    for (int k = 0; k < 3; k++) {
        struct rig r;
        struct body_event e;
        struct ptp_event wire = { 0 };
        int n_wire = 0;
        rig_open(&r, names[k], 0, 0, NULL);
        ASK(&r, 0x1002, 1);
        if (k == 2) {
            ASK(&r, 0x9114, 1);
            ASK(&r, 0x9115, 1);
            assert_int_equal(ASK(&r, 0x9116, 0), PTP_OK);
            assert_true(r.reply.data.n > 500); // every property, once
            assert_int_equal(ASK(&r, 0x9116, 0), PTP_OK);
            assert_int_equal(r.reply.data.n, 8);
            assert_int_equal(ASK(&r, 0x9128, 2, 0), PTP_OK);
        } else {
            assert_int_equal(k ? ASK(&r, 0x9207, 0xffffffff, 0) : ASK(&r, 0x100e, 0, 0), PTP_OK);
        }
        body_step(&r.body, 3 * S);
        while (body_take_event(&r.body, &e))
            n_wire += ptp_notice(&r.session, &e, &wire);
        assert_int_equal(n_wire, k == 0 ? 2 : 0);
        if (k == 1) {
            assert_int_equal(ASK(&r, 0x90c7, 0), PTP_OK);
            assert_int_equal(r.reply.data.n, 2 + 2 * 6);
            assert_int_equal(r.reply.data.data[2] | r.reply.data.data[3] << 8, 0x4002);
        } else if (k == 2) {
            assert_int_equal(ASK(&r, 0x9116, 0), PTP_OK);
            assert_non_null(memmem(r.reply.data.data, r.reply.data.n, "IMG_0001.DNG", 13));
        }
        rig_close(&r);
    }
}

// ---- raws ------------------------------------------------------------------------------------------------------------------

// The words of a frame's pixels, its black subtracted.
static double *pixels(struct rig *r, const struct exposure *e)
{
    struct frame *f;
    uint8_t bytes[2];
    const struct raw_dng_info any = { .width_px = WIDTH, .height_px = HEIGHT, .make = r->personality.manufacturer,
                                      .model = r->personality.model, .lens = r->personality.lens, .serial = r->body.serial,
                                      .firmware = r->personality.firmware, .time_s = e->time_s, .f_number = e->f_number,
                                      .focal_mm = 50, .iso = e->iso, .wb = { .5, 1, .5 } };
    struct raw_dng d;
    double *v = malloc(WIDTH * HEIGHT * sizeof(*v));
    assert_int_equal(raw_dng_make(&d, &any), 0);
    assert_int_equal(frame_open(&f, r->scene, &r->body, e, FILES_RAW), 0);
    for (size_t i = 0; i < WIDTH * HEIGHT; i++) {
        frame_read(f, d.n_head + 2 * i, bytes, 2);
        v[i] = (bytes[0] | bytes[1] << 8) - r->personality.black_level;
    }
    frame_close(f);
    raw_dng_free(&d);
    return v;
}

static void flat_folder(float red, float green, float blue)
{
    struct image im;
    assert_int_equal(image_new(&im, WIDTH, HEIGHT, 3, NULL), 0);
    for (int i = 0; i < WIDTH * HEIGHT; i++) {
        im.data[3 * i] = red;
        im.data[3 * i + 1] = green;
        im.data[3 * i + 2] = blue;
    }
    assert_int_equal(image_write_exr(&im, scratch_path("A01.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    image_free(&im);
}

static double mean_of(const double *v, int x0, int y0)
{
    double sum = 0;
    for (int y = y0; y < HEIGHT; y += 2)
        for (int x = x0; x < WIDTH; x += 2)
            sum += v[y * WIDTH + x];
    return sum / (WIDTH * HEIGHT / 4.);
}

static void a_frame_follows_time_aperture_iso_and_colour(void **state)
{
    (void)state;
    struct rig r;
    flat_folder(.4f, .2f, .1f);
    rig_open(&r, "generic", 0, 5, scratch_dir);
    const struct personality *p = &r.personality;
    const double range = p->white_level - p->black_level;
    static const struct exposure cases[] = { { .shot = 1, .time_s = 0x1p-7, .f_number = 8, .iso = 100 }, { .shot = 2, .time_s = 0x1p-8, .f_number = 8, .iso = 100 }, { .shot = 3, .time_s = 0x1p-7, .f_number = 16, .iso = 100 },
                                             { .shot = 4, .time_s = 0x1p-7, .f_number = 8, .iso = 200 }, { .shot = 5, .time_s = 0x1p-9, .f_number = 8, .iso = 400 } };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        const struct exposure *e = &cases[i];
        const double k = e->time_s / p->t_ref_s * pow(p->n_ref / e->f_number, 2) * e->iso / 100;
        double *v = pixels(&r, e);
        const double colour[4] = { .4 * p->wb[0], .2, .2, .1 * p->wb[2] };
        for (int c = 0; c < 4; c++) {
            const double expected = range * k * colour[c];
            const double sigma = sqrt(expected / range * 100 / e->iso * p->full_well_e + p->read_noise_e * p->read_noise_e) *
                                 range / p->full_well_e * e->iso / 100;
            const double got = mean_of(v, c & 1, c >> 1);
            assert_true(fabs(got - expected) < 5 * sigma / sqrt(WIDTH * HEIGHT / 4.) + .01);
            double variance = 0;
            for (int y = c >> 1; y < HEIGHT; y += 2)
                for (int x = c & 1; x < WIDTH; x += 2)
                    variance += pow(v[y * WIDTH + x] - got, 2);
            variance /= WIDTH * HEIGHT / 4. - 1;
            assert_true(fabs(sqrt(variance) / sqrt(sigma * sigma + 1. / 12) - 1) < .15); // n = 768: sigma of sigma 2.6%
        }
        free(v);
    }
    rig_close(&r);
    scratch_empty();
}

static void a_raw_clips_at_its_white_level_and_never_wraps(void **state)
{
    (void)state;
    struct rig r;
    flat_folder(1e4f, 1e4f, 0);
    rig_open(&r, "nikon", 0, 5, scratch_dir);
    double *v = pixels(&r, &(struct exposure){ .shot = 1, .time_s = 1, .f_number = 1, .iso = 6400 });
    const double top = r.personality.white_level - r.personality.black_level;
    for (int i = 0; i < WIDTH * HEIGHT; i++) {
        const int x = i % WIDTH, y = i / WIDTH;
        if ((x & 1) && (y & 1))
            assert_true(v[i] >= -r.personality.black_level && v[i] < top / 2); // blue: only read noise
        else
            assert_true(v[i] == top);
    }
    free(v);
    rig_close(&r);
    scratch_empty();
}

static void noise_is_named_by_seed_camera_and_shot(void **state)
{
    (void)state;
    struct rig a, b, c, d;
    flat_folder(.3f, .3f, .3f);
    rig_open(&a, "generic", 0, 5, scratch_dir);
    rig_open(&b, "generic", 0, 5, scratch_dir);
    rig_open(&c, "generic", 0, 6, scratch_dir);
    rig_open(&d, "generic", 1, 5, scratch_dir);
    const struct exposure one = { .shot = 1, .time_s = 0x1p-7, .f_number = 8, .iso = 100 }, two = { .shot = 2, .time_s = 0x1p-7, .f_number = 8, .iso = 100 };
    double *v[5] = { pixels(&a, &one), pixels(&b, &one), pixels(&c, &one), pixels(&d, &one), pixels(&a, &two) };
    assert_memory_equal(v[0], v[1], WIDTH * HEIGHT * sizeof(double));
    for (int k = 2; k < 5; k++) {
        double product = 0, square = 0;
        const double m0 = mean_of(v[0], 1, 0), m = mean_of(v[k], 1, 0);
        for (int y = 0; y < HEIGHT; y += 2)
            for (int x = 1; x < WIDTH; x += 2) {
                product += (v[0][y * WIDTH + x] - m0) * (v[k][y * WIDTH + x] - m);
                square += pow(v[0][y * WIDTH + x] - m0, 2);
            }
        assert_true(fabs(product / square) < 5 / sqrt(WIDTH * HEIGHT / 4.)); // uncorrelated
    }
    for (int k = 0; k < 5; k++)
        free(v[k]);
    rig_close(&a);
    rig_close(&b);
    rig_close(&c);
    rig_close(&d);
    scratch_empty();
}

// ---- scripts ---------------------------------------------------------------------------------------------------------------

static void a_fault_script_says_who_when_and_what(void **state)
{
    (void)state;
    struct faults f;
    assert_int_equal(faults_parse(&f, "# story\nA03 at 2.5s busy 10s\n\nA*,B07 on shot 3 lose_added 1\n"
                                      "* on op 0x100e#2 stall 200ms # comment\n* on connect * hostile count 4\n"
                                      "A01 on shot * late 3s 2\n",
                                  "script"),
                     0);
    assert_int_equal(f.n, 5);
    assert_int_equal(f.fault[0].kind, FAULT_BUSY);
    assert_int_equal(f.fault[0].at_ns, 2500 * MS);
    assert_int_equal(f.fault[0].ns, 10 * S);
    assert_true(fault_is_for(&f.fault[0], "A03") && !fault_is_for(&f.fault[0], "A04"));
    assert_true(fault_is_for(&f.fault[1], "A19") && fault_is_for(&f.fault[1], "B07") && !fault_is_for(&f.fault[1], "B08"));
    assert_int_equal(f.fault[1].value, 3);
    assert_int_equal(f.fault[2].value, 0x100e);
    assert_int_equal(f.fault[2].nth, 2);
    assert_int_equal(f.fault[2].ns, 200 * MS);
    assert_int_equal(f.fault[3].value, UINT32_MAX);
    assert_int_equal(f.fault[3].n, HOSTILE_COUNT);
    assert_int_equal(f.fault[3].n2, 4);
    assert_int_equal(f.fault[4].ns, 3 * S);
    assert_int_equal(f.fault[4].n, 2);
    faults_free(&f);
    static const struct {
        const char *text, *found;
    } bad[] = {
        { "A03 at 2.5 busy 10s", "script:1: found '2.5'" }, { "A03 at 2s busy", "script:1: found 'end of line'" },
        { "\nA03 at 2s melt", "script:2: found 'melt'" },   { "A03 on moon 3 drop", "script:1: found 'moon'" },
        { "A03 at 2s drop now", "script:1: found 'now'" },  { "A03 at 2s hostile nice 1", "script:1: found 'nice'" },
        { "A03 on op 0x100e#0 drop", "script:1: found" },   { "A03 at 1e9s drop", "script:1: found '1e9s'" },
        { "A03 at 99999999s drop", "script:1: found" },     { "A03", "script:1: found 'end of line'" },
    };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        assert_int_equal(faults_parse(&f, bad[i].text, "script"), -EINVAL);
        assert_non_null(strstr(last_log, bad[i].found));
        assert_null(f.fault);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_packet_survives_writing_and_parsing),
        cmocka_unit_test(hostile_packets_are_refused),
        cmocka_unit_test(strings_and_short_data_sets_are_read_safely),
        cmocka_unit_test(a_file_changes_what_it_names),
        cmocka_unit_test(a_wrong_statement_is_named_by_file_and_line),
        cmocka_unit_test(lag_is_measured_from_the_press_and_differs_per_body_and_shot),
        cmocka_unit_test(half_press_wakes_and_silences),
        cmocka_unit_test(a_press_during_an_exposure_or_with_a_full_card_takes_no_frame),
        cmocka_unit_test(a_card_fills_by_the_bytes_of_its_files_and_empties_by_deletion),
        cmocka_unit_test(raw_and_jpeg_come_as_two_files_one_late),
        cmocka_unit_test(dials_have_labels_and_shutters_powers_of_two),
        cmocka_unit_test(one_setting_shown_twice_moves_together),
        cmocka_unit_test(the_same_seed_gives_the_same_life),
        cmocka_unit_test(faults_lose_delay_and_spoil_what_they_say),
        cmocka_unit_test(the_responder_refuses_what_it_should),
        cmocka_unit_test(device_info_lists_what_the_personality_says),
        cmocka_unit_test(partial_reads_join_to_the_whole_object),
        cmocka_unit_test(vendors_tell_events_their_own_way),
        cmocka_unit_test(a_frame_follows_time_aperture_iso_and_colour),
        cmocka_unit_test(a_raw_clips_at_its_white_level_and_never_wraps),
        cmocka_unit_test(noise_is_named_by_seed_camera_and_shot),
        cmocka_unit_test(a_fault_script_says_who_when_and_what),
    };
    if (scratch_open())
        return 1;
    log_set_level(LOG_SILENT);
    log_set_hook(keep_log, NULL);
    const int failed = cmocka_run_group_tests(tests, NULL, NULL);
    scratch_empty();
    return failed || scratch_close();
}
