// tests/test_config.c - a configuration is right, or its faults are named with file, line and remedy.
#include "rigd/config.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#define HEAD "[rig]\ntakes = /t\n[trigger]\nkind = software\n"     // lines 1-4
#define A01 "[camera \"A01\"]\nport = usb:1-1\n"                    // two lines

#define P01 "[camera \"P01\"]\nport = usb:1-2\n"                    // two lines more, then
#define PANORAMA "[panorama]\ncamera = P01\nlens = equisolid\nwidth_px = 6000\nheight_px = 4000\nfocal_px = 1414.2\n" // six

static char said[8000];

static void listen(void *arg, enum log_level level, const char *message)
{
    (void)arg, (void)level;
    strncat(said, message, sizeof(said) - strlen(said) - 2);
    strcat(said, "\n");
}

static int parse(struct config *c, const char *text)
{
    said[0] = 0;
    log_set_level(LOG_SILENT);
    log_set_hook(listen, NULL);
    const int err = config_parse(c, text, strlen(text), "rigd.conf");
    log_set_hook(NULL, NULL);
    log_set_level(LOG_INFO);
    return err;
}

static void a_whole_configuration_is_read(void **state)
{
    (void)state;
    struct config c;
    char *text;
    size_t n;
    assert_int_equal(file_read(&text, &n, "tests/fuzz/seeds/config/small.conf", 1 << 20), 0);
    assert_int_equal(parse(&c, text), 0);
    free(text);
    assert_int_equal(c.n_cameras, 2);
    assert_string_equal(c.camera[0].name, "A01");
    assert_string_equal(c.camera[0].serial, "6001234");
    assert_int_equal(c.camera[0].controller, 2);
    assert_int_equal(c.camera[1].controller, 0);
    assert_int_equal(c.camera[0].relay_line, 23);
    assert_int_equal(c.camera[1].relay_line, CONFIG_NONE);
    assert_int_equal(c.camera[0].n_settings, 2);
    assert_string_equal(c.camera[0].setting[0].value, "200"); // its own on top of all cameras'
    assert_string_equal(c.camera[1].setting[0].value, "100");
    assert_int_equal(c.trigger.kind, TRIGGER_GPIO);
    assert_int_equal(c.trigger.full_line, 17);
    assert_int_equal(c.trigger.button_line, CONFIG_NONE);
    assert_true(c.clock_max_s == 2.5);
    assert_true(c.lag_within_ms == .1); // unasked
    config_free(&c);
}

static void each_fault_is_named_with_its_line_and_a_remedy(void **state)
{
    (void)state;
    static char long_line[300] = HEAD A01 "lens = ", long_section[200] = HEAD "[camera \"";
    memset(long_line + strlen(long_line), 'x', 200);
    strcat(long_line, "\n");
    memset(long_section + strlen(long_section), 'x', 50);
    strcat(long_section, "\"]\n");
    static const struct {
        const char *text, *where, *what;
    } cases[] = {
        { HEAD A01 "colour = red\n", "rigd.conf:7:", "knows no 'colour'" },
        { HEAD A01 "[camera \"A02\"]\nport = usb:1-1\n", "rigd.conf:7:", "port usb:1-1 is camera \"A01\"'s already (line 5)" },
        { HEAD A01 "serial = 7\n[camera \"A02\"]\nport = usb:1-2\nserial = 7\n", "rigd.conf:8:", "serial 7" },
        { HEAD A01 "[camera \"a01\"]\nport = usb:1-2\n", "rigd.conf:7:", "name of its own" },
        { HEAD "[camera \"A01\"]\nserial = 7\n", "rigd.conf:5:", "has no 'port'" },
        { HEAD "[camera \"A01\"]\n", "rigd.conf:5:", "has no 'port'" },
        { HEAD "[camera \"../etc\"]\nport = usb:1-1\n", "rigd.conf:5:", "file names" },
        { HEAD "[camera A01]\nport = usb:1-1\n", "rigd.conf:5:", "[camera \"NAME\"]" },
        { HEAD A01 "port = usb:1-2\n", "rigd.conf:7:", "twice" },
        { HEAD A01 "[rig]\ntakes = /u\n", "rigd.conf:7:", "twice" },
        { HEAD A01 "[lamp]\non = 1\n", "rigd.conf:7:", "[lamp]" },
        { HEAD, "rigd.conf: ", "no [camera" },
        { "[trigger]\nkind = software\n" A01, "rigd.conf: ", "[rig] is missing" },
        { "[rig]\ntakes = /t\n" A01, "rigd.conf: ", "[trigger] is missing" },
        { "[rig]\nname = x\n[trigger]\nkind = software\n" A01, "rigd.conf:1:", "no 'takes'" },
        { "[rig]\ntakes = t\n[trigger]\nkind = software\n" A01, "rigd.conf:2:", "begins with /" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = magic\n" A01, "rigd.conf:4:", "software, gpio" },
        { "[rig]\ntakes = /t\nraw_mb = 60.5\n[trigger]\nkind = software\n" A01, "rigd.conf:3:", "whole number from 1 to 4096" },
        { "[rig]\ntakes = /t\nraw_mb = 1e3\n[trigger]\nkind = software\n" A01, "rigd.conf:3:", "found '1e3'" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nchip = c\n" A01, "rigd.conf:6:", "nothing would press it" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nfull_line = 1\n" A01, "rigd.conf:3:", "chip" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = simulated\n" A01, "rigd.conf:3:", "address" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nchip = c\nfull_line = 4\n" A01 "feedback_line = 4\n", "rigd.conf:7:", "line 4 is [trigger] full_line already" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = software\nhold_ms = 500\nmax_hold_ms = 100\n" A01, "rigd.conf:6:", "longer than max_hold_ms = 100; raise that to 500" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nchip = c\nfull_line = 4\nhalf_line = 5\nhold_ms = 500\nmax_hold_ms = 900\n" A01, "rigd.conf:9:", "raise that to 1000" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nchip = c\nfull_line = 4\nmax_hold_ms = 600\n" A01 "half_line = 5\n", "rigd.conf:7:", "half_press_ms and hold_ms hold a line for 650 ms" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = simulated\naddress = @wires\nhalf_press_ms = 2000\n" A01, "rigd.conf:6:", "raise that to 2150" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = simulated\naddress = @\n" A01, "rigd.conf:5:", "begins with /" },
        { HEAD "[camera \"A01\"]\nport = usb:1,17\n", "rigd.conf:6:", "usb:BUS-PORT" },
        { HEAD "[camera \"A01\"]\nport = ptpip:localhost:1:2\n", "rigd.conf:6:", "IPV4" },
        { HEAD "[camera \"A01\"]\nport = ptpip:127.0.0.1:15740\n", "rigd.conf:6:", "EVENTPORT" },
        { HEAD "[camera \"A01\"]\nport = ptpip:127.0.0.1:15740:70000\n", "rigd.conf:6:", "EVENTPORT" },
        { HEAD A01 "power = 1-4\n", "rigd.conf:7:", "HUB:PORT" },
        { "takes = /t\n" HEAD A01, "rigd.conf:1:", "in no section" },
        { HEAD A01 "what is this\n", "rigd.conf:7:", "neither" },
        { HEAD A01 "  lens = x\n", "rigd.conf:7:", "first column" },
        { HEAD A01 "[settings]\nISO = 100\n", "rigd.conf:8:", "neutral name" },
        { HEAD A01 "[settings]\niso = 100\niso = 200\n", "rigd.conf:9:", "twice" },
        { HEAD A01 "[develop]\nafter = yes\n", "rigd.conf:8:", "on or off" },
        { HEAD A01 "[develop]\ndemosaic = vng\n", "rigd.conf:8:", "ahd, bilinear or half" },
        { HEAD A01 "[develop]\nflat = frames\n", "rigd.conf:8:", "begins with /" },
        { HEAD A01 "[solve]\nthen = soon\n", "rigd.conf:8:", "off, standard or final" },
        { HEAD A01 "[solve]\nthreads = 1000\n", "rigd.conf:8:", "0 to 256" },
        { HEAD A01 "[reconstruct]\nprogram = x\n", "rigd.conf:8:", "it knows command, calibrated" },
        { HEAD A01 PANORAMA, "rigd.conf:7:", "no [camera \"P01\"]" },
        { HEAD P01 PANORAMA, "rigd.conf:7:", "the only camera" },
        { HEAD A01 P01 "[panorama]\ncamera = P01\n", "rigd.conf:9:", "has no 'lens'" },
        { HEAD A01 P01 PANORAMA "stops = 0,0; 90\n", "rigd.conf:15:", "yaw,pitch" },
        { HEAD A01 P01 PANORAMA "stops = 0,0; 90,100\n", "rigd.conf:15:", "yaw,pitch" },
        { HEAD A01 P01 PANORAMA "stops = 0,0; 90,0\n", "rigd.conf:9:", "head = manual" },
        { HEAD A01 P01 PANORAMA "head = board\n", "rigd.conf:9:", "kind = usb" },
        { HEAD A01 P01 PANORAMA "head = crane\n", "rigd.conf:15:", "none, manual or board" },
        { HEAD A01 P01 PANORAMA "shortest = 1/4\nlongest = 1/8\n", "rigd.conf:9:", "shortest <= meter" },
        { HEAD A01 P01 PANORAMA "meter = 1/0\n", "rigd.conf:15:", "exposure time" },
        { HEAD A01 P01 PANORAMA "distortion = 0.1, 0.2, 0.3\n", "rigd.conf:15:", "5 numbers" },
        { HEAD A01 P01 PANORAMA "centre_px = 1,2,3\n", "rigd.conf:15:", "2 numbers" },
        { HEAD A01 P01 "[panorama]\ncamera = P01\nlens = pinhole\n", "rigd.conf:11:", "equisolid" },
        { HEAD A01 P01 PANORAMA "head = manual\nmax_angle_deg = 10\n", "rigd.conf:9:", "more than 64 stops" },
        { long_line, "rigd.conf:7:", "at most 196" },
        { long_section, "rigd.conf:5:", "section name of" },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct config c;
        const int err = parse(&c, cases[i].text);
        const char *line = strstr(said, cases[i].where);
        if (err != -EINVAL || !line || !strstr(line, cases[i].what))
            fail_msg("case %zu: %d, said: %s", i, err, said);
        assert_null(c.camera);
    }
}

static void a_panorama_camera_is_known_by_its_section(void **state)
{
    (void)state;
    struct config c;
    assert_int_equal(parse(&c, HEAD A01), 0);
    assert_int_equal(config_panorama_camera(&c), CONFIG_NONE);
    config_free(&c);
    assert_int_equal(parse(&c, PANORAMA "head = manual\nstops = 0,0; -120.5,10 ; 240, -90\nmeter = 1/30\nlongest = 2.5\ndistortion = 0.01, -0.02, 0, 0.001, -0.002\n"
                                        "nodal_offset_m = -0.01\nneutral_density_ev = 6\n" HEAD P01 A01), 0); // in any order
    const struct panorama_config *p = &c.panorama;
    assert_int_equal(config_panorama_camera(&c), 0);
    assert_int_equal(p->head, HEAD_MANUAL);
    assert_int_equal(p->n_stops, 3);
    assert_true(p->stop[1].yaw_deg == -120.5 && p->stop[1].pitch_deg == 10 && p->stop[2].pitch_deg == -90);
    assert_true(p->meter_s == 1. / 30 && p->longest_s == 2.5);
    assert_int_equal(p->lens.model, LENS_EQUISOLID);
    assert_true(p->lens.k[1] == -.02 && p->lens.p[1] == -.002 && p->lens.centre_px[0] == 3000 && p->lens.max_r > 0);
    assert_true(p->nodal_offset_m == -.01 && p->neutral_density_ev == 6);
    config_free(&c);
    assert_int_equal(parse(&c, HEAD A01 P01 PANORAMA "head = manual\ncircle_px = 2000\nmax_angle_deg = 90\n"), 0); // stops as the lens needs them
    assert_true(c.panorama.n_stops >= 2 && c.panorama.n_stops <= 4);
    config_free(&c);
    assert_int_equal(parse(&c, HEAD A01 P01 PANORAMA), 0); // a camera that cannot turn
    assert_int_equal(c.panorama.n_stops, 1);
    config_free(&c);
}

// It needs no line of its own, and is not told to get one because something else is wrong.
static void one_fault_is_not_told_as_two(void **state)
{
    (void)state;
    struct config c;
    assert_int_equal(parse(&c, "[rig]\ntakes = t\n[trigger]\nkind = gpio\nchip = c\n" A01 "full_line = 4\n" P01 PANORAMA), -EINVAL);
    assert_non_null(strstr(said, "rigd.conf:2:"));
    assert_null(strstr(said, "P01"));
}

static void a_line_without_half_press_may_be_held_for_all_of_its_limit(void **state)
{
    (void)state;
    struct config c;
    assert_int_equal(parse(&c, "[rig]\ntakes = /t\n[trigger]\nkind = gpio\nchip = c\nfull_line = 4\nhold_ms = 600\nmax_hold_ms = 600\n" A01), 0);
    config_free(&c);
}

static void what_rigsim_lists_is_accepted_as_it_stands(void **state)
{
    (void)state;
    static const char *const wires[] = { "", "--trigger-socket=@wires", "--trigger-socket=/run/wires" };
    static const char *const kinds[][2] = { { "generic", "generic" }, { "nikon", "nikon" }, { "canon", "canon-eos" } };
    const char *bin = getenv("BIN");
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++) {
            static char text[100000];
            char command[300];
            struct config c;
            snprintf(command, sizeof(command), "%s/rigsim --list --cameras %d --personality %s %s", bin ? bin : "build/bin", CONFIG_CAMERAS_MAX, kinds[k][0], wires[i]);
            strcpy(text, i ? "[rig]\ntakes = /t\n" : "[rig]\ntakes = /t\n[trigger]\nkind = software\n");
            FILE *f = popen(command, "r");
            assert_non_null(f);
            const size_t n = strlen(text), got = fread(text + n, 1, sizeof(text) - n - 1, f);
            text[n + got] = 0;
            assert_int_equal(pclose(f), 0);
            if (parse(&c, text))
                fail_msg("%s: %s", command, said);
            assert_int_equal(c.n_cameras, CONFIG_CAMERAS_MAX);
            assert_string_equal(c.camera[255].personality, kinds[k][1]);
            assert_string_equal(c.trigger.address, wires[i][0] ? strchr(wires[i], '=') + 1 : "");
            config_free(&c);
        }
}

#define BOARD(more) "[rig]\ntakes = /t\n[trigger]\nkind = usb\noutput_registers = 3\n" more A01 // A01 from line 6 on
static void the_lines_of_a_board_are_outputs_and_inputs(void **state)
{
    (void)state;
    static const struct {
        const char *text, *where, *what;
    } cases[] = {
        { "[rig]\ntakes = /t\n[trigger]\nkind = usb\n" A01 "full_line = 0\n", "rigd.conf:3:", "needs 'output_registers = '" },
        { BOARD("") "", "rigd.conf:6:", "has no full_line" },
        { BOARD("") "full_line = 24\n", "rigd.conf:6:", "found 24, expected 0 to 23: output_registers = 3 is 24 outputs" },
        { BOARD("") "full_line = 3\nhalf_line = 3\n", "rigd.conf:6:", "line 3 is camera A01's full_line already" },
        { BOARD("") "full_line = 3\nrelay_line = 24\n", "rigd.conf:6:", "relay_line: found 24" },
        { BOARD("") "full_line = 3\nfeedback_line = 200\n", "rigd.conf:6:", "feedback_line: found 200, expected 0 to 199 or capture" },
        { BOARD("button_line = 3\n") "full_line = 3\n", "rigd.conf:3:", "remove button_line" },
        { BOARD("active_low = yes\n") "full_line = 3\n", "rigd.conf:3:", "remove active_low" },
        { BOARD("") "full_line = capture\n", "rigd.conf:8:", "a line's number" },
        { BOARD("") "full_line = 0\nfeedback_line = capture\n[camera \"A02\"]\nport = usb:1-2\nfull_line = 1\nfeedback_line = capture\n", "rigd.conf:10:", "the capture input is camera A01's" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = usb\noutput_registers = 52\n" A01 "full_line = 256\nhalf_line = 415\n", "rigd.conf:6:", "full_line: found 256, expected 0 to 255" },
        { "[rig]\ntakes = /t\n[trigger]\nkind = usb\noutput_registers = 53\n" A01 "full_line = 0\n", "rigd.conf:5:", "a whole number from 1 to 52" },
        { HEAD A01 "feedback_line = capture\n", "rigd.conf:5:", "only kind = usb" },
    };
    struct config c;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
        if (parse(&c, cases[i].text) != -EINVAL || !strstr(said, cases[i].where) || !strstr(said, cases[i].what))
            fail_msg("case %zu: expected '%s' '%s', said:\n%s", i, cases[i].where, cases[i].what, said);
    assert_int_equal(parse(&c, BOARD("serial = 85323\nfeedback_active_low = no\nhead_yaw_steps_per_turn = -3200\n") "full_line = 3\nhalf_line = 11\nfeedback_line = 3\n"), 0);
    assert_int_equal(c.trigger.kind, TRIGGER_USB);
    assert_string_equal(c.trigger.serial, "85323");
    assert_int_equal(c.trigger.output_registers, 3);
    assert_int_equal(c.trigger.head_steps_per_turn[0], -3200);
    assert_true(c.trigger.button_active_low && !c.trigger.feedback_active_low); // to ground, unless said otherwise
    config_free(&c);
    assert_int_equal(parse(&c, BOARD("") "full_line = 3\nfeedback_line = capture\n"), 0);
    assert_int_equal(c.camera[0].feedback_line, CONFIG_CAPTURE);
    config_free(&c);
    assert_int_equal(parse(&c, HEAD A01), 0);
    assert_false(c.trigger.button_active_low); // gpio's and others' own rule
    config_free(&c);
}

static void naming_a_section_asks_for_what_it_does(void **state)
{
    (void)state;
    struct config c;
    assert_int_equal(parse(&c, HEAD A01), 0);
    assert_false(c.process.develop || c.process.preview || c.process.then);
    config_free(&c);
    assert_int_equal(parse(&c, HEAD A01 "[develop]\n[reconstruct]\ncommand = hook --fast\n[solve]\n"), 0);
    assert_true(c.process.develop && c.process.preview);
    assert_int_equal(c.process.then, SOLVE_THEN_STANDARD);
    assert_int_equal(c.process.demosaic, DEVELOP_AHD);
    assert_string_equal(c.process.command, "hook --fast");
    config_free(&c);
    assert_int_equal(parse(&c, HEAD A01 "[develop]\nafter = off\ndemosaic = half\n[solve]\npreview = off\nthen = final\noptions = --lights 64\n"), 0);
    assert_false(c.process.develop || c.process.preview);
    assert_int_equal(c.process.then, SOLVE_THEN_FINAL);
    assert_int_equal(c.process.demosaic, DEVELOP_HALF);
    config_free(&c);
}

static void a_thousand_faults_do_not_fill_the_journal(void **state)
{
    (void)state;
    struct config c;
    char *text = calloc(1, 20000);
    strcpy(text, HEAD A01);
    for (int i = 0; i < 1000; i++)
        strcat(text, "x = y\n");
    assert_int_equal(parse(&c, text), -EINVAL);
    int lines = 0;
    for (const char *s = said; *s; s++)
        lines += *s == '\n';
    assert_true(lines <= 21);
    free(text);
}

static void zero_bytes_and_other_line_ends_are_no_trouble(void **state)
{
    (void)state;
    struct config c;
    assert_int_equal(parse(&c, "[rig]\r\ntakes = /t\r\n[trigger]\r\nkind = software\r\n[camera \"A\"]\r\nport = usb:1-1"), 0);
    config_free(&c);
    static const char zero[] = HEAD A01 "lens\0= x\n";
    log_set_level(LOG_SILENT);
    assert_int_equal(config_parse(&c, zero, sizeof(zero) - 1, "rigd.conf"), -EINVAL);
    log_set_level(LOG_INFO);
}

static void the_page_listens_where_it_is_told_and_nowhere_unasked(void **state)
{
    static const char *const right[] = { "127.0.0.1:8420", "0.0.0.0:1", "[::1]:65535", "[::]:0" };
    static const char *const wrong[] = { "8420", ":8420", "localhost:8420", "127.0.0.1", "127.0.0.1:", "127.0.0.1:65536", "127.0.0.1:8420x", "::1:8420", "[::1]", "[127.0.0.1]:1", "127.1:80", "on", "[::1" };
    struct config c;
    char text[300];
    (void)state;
    assert_int_equal(parse(&c, HEAD A01), 0);
    assert_string_equal(c.web.listen, "");
    config_free(&c);
    assert_int_equal(parse(&c, HEAD "[web]\nlisten = off\n" A01), 0);
    assert_string_equal(c.web.listen, "");
    assert_false(c.web.token_always);
    config_free(&c);
    for (size_t i = 0; i < sizeof(right) / sizeof(right[0]); i++) {
        snprintf(text, sizeof(text), HEAD "[web]\nlisten = %s\ntoken_always = yes\n" A01, right[i]);
        assert_int_equal(parse(&c, text), 0);
        assert_string_equal(c.web.listen, right[i]);
        assert_true(c.web.token_always);
        config_free(&c);
    }
    for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++) {
        snprintf(text, sizeof(text), HEAD "[web]\nlisten = %s\n" A01, wrong[i]);
        assert_int_equal(parse(&c, text), -EINVAL);
        assert_non_null(strstr(said, "rigd.conf:6: listen: found"));
    }
    assert_int_equal(parse(&c, HEAD "[web]\n" A01), -EINVAL);
    assert_non_null(strstr(said, "[web] has no 'listen'"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_whole_configuration_is_read),
        cmocka_unit_test(each_fault_is_named_with_its_line_and_a_remedy),
        cmocka_unit_test(a_panorama_camera_is_known_by_its_section),
        cmocka_unit_test(one_fault_is_not_told_as_two),
        cmocka_unit_test(a_line_without_half_press_may_be_held_for_all_of_its_limit),
        cmocka_unit_test(what_rigsim_lists_is_accepted_as_it_stands),
        cmocka_unit_test(the_lines_of_a_board_are_outputs_and_inputs),
        cmocka_unit_test(naming_a_section_asks_for_what_it_does),
        cmocka_unit_test(a_thousand_faults_do_not_fill_the_journal),
        cmocka_unit_test(zero_bytes_and_other_line_ends_are_no_trouble),
        cmocka_unit_test(the_page_listens_where_it_is_told_and_nowhere_unasked),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
