// tests/test_studios.c - the rigs in config/ are whole: they parse, every body can be pressed, and they keep to the limits they explain.
#include "rigd/edges.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>
#include <cmocka.h>

static const struct {
    const char *path;
    int n_cameras, n_feedback;
    unsigned abilities;
} studios[] = {
    { "config/studio-85.conf", 85, 22, TRIGGER_HALF_PRESS },
    { "config/desk-3.conf", 3, 3, TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_RELAYS },
    { "config/simulated.conf", 6, 0, TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_RELAYS },
    { "config/simulated-board.conf", 6, 6, TRIGGER_HALF_PRESS | TRIGGER_DELAYS | TRIGGER_RELAYS },
};

static void every_shipped_studio_can_shoot(void **state)
{
    (void)state;
    for (size_t i = 0; i < sizeof(studios) / sizeof(studios[0]); i++) {
        static struct edges e;
        static _Atomic int64_t limit[EDGES_WIRES_MAX];
        struct config c;
        uint32_t delay_us[CONFIG_CAMERAS_MAX];
        int n_on_bus[256] = { 0 }, n_feedback = 0;
        assert_int_equal(config_read(&c, studios[i].path), 0);
        assert_int_equal(c.n_cameras, studios[i].n_cameras);
        assert_int_equal(edges_init(&e, &c, c.trigger.kind == TRIGGER_SIMULATED, limit), 0);
        assert_int_equal(edges_abilities(&e), studios[i].abilities);
        for (int k = 0; k < c.n_cameras; k++) {
            assert_true(c.camera[k].personality[0] && c.camera[k].serial[0]);
            n_feedback += c.camera[k].feedback_line != CONFIG_NONE;
            delay_us[k] = 250000; // a dozing body's 200 ms, and more
            if (c.camera[k].controller)
                assert_true(++n_on_bus[c.camera[k].controller] <= 22); // 4 endpoints each, of 96
        }
        assert_int_equal(n_feedback, studios[i].n_feedback);
        const struct trigger_shot shot = { .at_ns = 5000000000, .half_ms = c.trigger.half_press_ms, .hold_ms = c.trigger.hold_ms,
            .delay_us = delay_us };
        assert_int_equal(edges_plan(&e, &shot, 0), 0);
        config_free(&c);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(every_shipped_studio_can_shoot) };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
