// tests/test_plateau.c - sensors that are full below what their files call white, and light that only looks so.
#include "rigd/plateau.h"
#include "solver/random.h"
#include "tests/scratch.h"

#include <math.h>

static int dn_of(const struct raw_frame *f)
{
    struct plateau p;
    assert_int_equal(plateau_find(&p, f), 0);
    assert_true(!p.dn || (p.top >= p.dn && p.reached >= p.dn && p.reached <= p.top));
    return p.dn;
}

enum { W = 240, H = 160 };

struct sensor {
    double black, white;
    double full, spread;  // DN above black at which a well is full, and by how much wells differ; 0: the converter ends first
    double electrons;     // at white
    double response[3];
};
// As measured on the raws of a Canon EOS D30: 12 bits, black 0, white 4095, wells full at 3817 +- 9.
static const struct sensor old_canon = { 0, 4095, 3817, 9, 50000, { .5, 1, .625 } };
static const struct sensor of_today = { 512, 16383, 0, 0, 60000, { .5, 1, .625 } };

// value: light at x, y, before the sensor's response.
static struct raw_frame expose(const struct sensor *s, double (*value)(int x, int y), double h)
{
    struct raw_frame f = { .width = W, .height = H, .cfa = { { 0, 1 }, { 1, 2 } }, .black = { { s->black, s->black }, { s->black, s->black } },
                           .white = s->white, .saturation = s->white };
    f.site = malloc(W * H * sizeof(*f.site));
    assert_non_null(f.site);
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++) {
            const uint64_t i = (uint64_t)(y * W + x);
            const double e = value(x, y) * h * s->response[f.cfa[y & 1][x & 1]] * s->electrons;
            double dn = (e + sqrt(e) * random_normal(1, 1, i)) * (s->white - s->black) / s->electrons;
            if (s->full > 0)
                dn = fmin(dn, s->full + s->spread * random_normal(1, 2, i));
            f.site[i] = (uint16_t)fmin(fmax(floor(s->black + dn + 3 * random_normal(1, 3, i) + .5), 0), s->white);
        }
    return f;
}

// Three decades of scattered light, and a lamp that thins out around its disc.
static double room(int x, int y)
{
    return .001 * pow(1000, random_uniform(2, (uint64_t)x / 2, (uint64_t)y / 2));
}

static double lamp(int x, int y)
{
    const double r = hypot(x - 60, y - 70);
    return room(x, y) + (r < 12 ? 40 : 40 * exp(-(r - 12) / 3));
}

// Evenly lit, brightest of all: a soft box, straight on.
static double panel(int x, int y)
{
    return x > 40 && x < 160 && y > 30 && y < 110 ? .8 : .1 * room(x, y);
}

static double even(int x, int y)
{
    (void)x, (void)y;
    return .8;
}

static int found_in(const struct sensor *s, double (*value)(int x, int y), double h)
{
    struct raw_frame f = expose(s, value, h);
    const int found = dn_of(&f);
    free(f.site);
    return found;
}

static void a_converter_that_ends_early_piles_up_at_one_value(void **state)
{
    (void)state;
    struct raw_frame f = expose(&of_today, lamp, 1);
    assert_int_equal(dn_of(&f), 0); // at white: as the file says
    for (int i = 0; i < W * H; i++)
        f.site[i] = f.site[i] > 13000 ? 13000 : f.site[i];
    assert_int_equal(dn_of(&f), 13000);
    f.saturation = 13000; // as it is told
    assert_int_equal(dn_of(&f), 0);
    free(f.site);
}

static void full_wells_are_a_hump_whose_foot_is_found(void **state)
{
    (void)state;
    const int found = found_in(&old_canon, lamp, 1);
    assert_true(found > 3817 - 7 * 9 && found < 3817 - 2 * 9);
    struct sensor s = of_today; // the same of 14 bits, around white: half of the full ones lie below it
    s.full = s.white - s.black, s.spread = 30;
    const int at_white = found_in(&s, lamp, 1);
    assert_true(at_white > s.white - 8 * 30 && at_white < s.white - 30);
}

// Sites that the found level leaves unmarked although they are full, and marks although they are not.
static void nearly_every_full_site_is_marked_and_hardly_another(void **state)
{
    (void)state;
    struct raw_frame f = expose(&old_canon, lamp, 1);
    const int found = dn_of(&f);
    int n_full = 0, n_missed = 0, n_wrong = 0;
    for (int y = 0; y < H; y++)
        for (int x = 0; x < W; x++) {
            const double dn = lamp(x, y) * old_canon.response[f.cfa[y & 1][x & 1]] * old_canon.white;
            const bool full = dn > 3817 + 100, free_of_it = dn < 3817 - 250, marked = f.site[y * W + x] >= found;
            n_full += full, n_missed += full && !marked, n_wrong += free_of_it && marked;
        }
    assert_true(n_full > 500);
    assert_true(n_missed <= n_full / 200);
    assert_int_equal(n_wrong, 0);
    free(f.site);
}

static void light_that_ends_or_is_even_is_no_plateau(void **state)
{
    (void)state;
    assert_int_equal(found_in(&old_canon, room, .7), 0);
    assert_int_equal(found_in(&of_today, room, .7), 0);
    assert_int_equal(found_in(&of_today, room, 1e-6), 0);
    for (double h = .5; h < 1.2; h += .1) { // the sensor's colours see it each at its own place
        assert_int_equal(found_in(&of_today, panel, h), 0);
        assert_int_equal(found_in(&of_today, even, h), 0);
    }
}

static void a_few_hot_sites_above_do_not_hide_it(void **state)
{
    (void)state;
    struct raw_frame f = expose(&old_canon, lamp, 1);
    for (int i = 0; i < 2; i++)
        f.site[7001 * i + 13] = 4095;
    assert_true(dn_of(&f) > 3817 - 7 * 9);
    free(f.site);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_converter_that_ends_early_piles_up_at_one_value),
        cmocka_unit_test(full_wells_are_a_hump_whose_foot_is_found),
        cmocka_unit_test(nearly_every_full_site_is_marked_and_hardly_another),
        cmocka_unit_test(light_that_ends_or_is_even_is_no_plateau),
        cmocka_unit_test(a_few_hot_sites_above_do_not_hide_it),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
