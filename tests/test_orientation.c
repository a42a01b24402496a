// tests/test_orientation.c - the rotation is found to rounding, also where the set hardly tells it;
// where it tells nothing, what is there is still mapped.
#include "solver/orientation.h"
#include "solver/random.h"
#include "solver/vec3.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

enum { SEED = 3, MAX_PAIRS = 64, N_TRIALS = 300 };

struct set {
    int n;
    double R[9], a[MAX_PAIRS][3], b[MAX_PAIRS][3];
};

static void random_vector(double out[3], uint64_t stream, uint64_t i)
{
    for (int k = 0; k < 3; k++)
        out[k] = random_normal(SEED, stream, 3 * i + (uint64_t)k);
}

// Any rotation, half turns and tiny ones among them.
static void random_rotation(double R[9], int trial)
{
    double w[3];
    random_vector(w, 1, (uint64_t)trial);
    vec3_normalise(w);
    const double angle = trial % 5 == 0   ? M_PI
                         : trial % 5 == 1 ? 1e-9
                         : trial % 5 == 2 ? M_PI - 1e-9
                                          : 3.2 * random_uniform(SEED, 2, (uint64_t)trial);
    for (int k = 0; k < 3; k++)
        w[k] *= angle;
    mat3_from_rotation_vector(R, w);
}

static void turn_all(struct set *s, int trial)
{
    random_rotation(s->R, trial);
    for (int i = 0; i < s->n; i++)
        mat3_mul_vec(s->b[i], s->R, s->a[i]);
}

static struct set random_set(int n, int trial)
{
    struct set s = {.n = n};
    for (int i = 0; i < n; i++)
        random_vector(s.a[i], 3, (uint64_t)(MAX_PAIRS * trial + i));
    turn_all(&s, trial);
    return s;
}

static void fit(struct orientation *o, const struct set *s)
{
    orientation_fit(o, s->a, s->b, NULL, s->n);
}

static double rotation_error(const double a[9], const double b[9])
{
    double worst = 0;
    for (int k = 0; k < 9; k++)
        worst = fmax(worst, fabs(a[k] - b[k]));
    return worst;
}

static void assert_proper(const double R[9])
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            assert_true(fabs(vec3_dot(R + 3 * i, R + 3 * j) - (i == j)) < 2e-15);
    assert_true(fabs(mat3_det(R) - 1) < 2e-15);
}

// Of the longest vector.
static double mapping_error(const struct orientation *o, const struct set *s)
{
    double worst = 0, longest = 0;
    for (int i = 0; i < s->n; i++) {
        double p[3];
        mat3_mul_vec(p, o->rotation, s->a[i]);
        vec3_sub(p, p, s->b[i]);
        worst = fmax(worst, vec3_norm(p));
        longest = fmax(longest, vec3_norm(s->a[i]));
    }
    return worst / longest;
}

static void random_rotations_are_found_to_rounding(void **state)
{
    (void)state;
    double worst = 0;
    for (int trial = 0; trial < N_TRIALS; trial++) {
        const int n = 3 + trial % (MAX_PAIRS - 2);
        const struct set s = random_set(n, trial);
        struct orientation o, again;
        fit(&o, &s);
        fit(&again, &s);
        assert_memory_equal(o.rotation, again.rotation, sizeof(o.rotation));
        assert_true(o.determined && !o.mirrored);
        assert_proper(o.rotation);
        // Three vectors may lie close to a line; many do not.
        worst = n > 8 ? fmax(worst, rotation_error(o.rotation, s.R)) : worst;
        assert_true(mapping_error(&o, &s) < 3e-15);
    }
    print_message("# rotation of 9 .. %d pairs: worst error %.2g\n", MAX_PAIRS, worst);
    assert_true(worst < 3e-15);
}

// The quaternion of squares alone leaves rounding / e^2.
static void vectors_close_to_a_line_lose_one_power_of_their_angle_only(void **state)
{
    (void)state;
    for (double e = .1; e > 5e-6; e /= 10) {
        double worst = 0, worst_mapping = 0;
        for (int trial = 0; trial < N_TRIALS; trial++) {
            struct set s = {.n = 5};
            double axis[3];
            random_vector(axis, 4, (uint64_t)trial);
            vec3_normalise(axis);
            for (int i = 0; i < s.n; i++) {
                double aside[3];
                random_vector(aside, 5, (uint64_t)(trial * s.n + i));
                vec3_normalise(aside);
                vec3_add_scaled(s.a[i], axis, e, aside);
            }
            turn_all(&s, trial);
            struct orientation o;
            fit(&o, &s);
            assert_true(o.determined && !o.mirrored);
            assert_proper(o.rotation);
            worst = fmax(worst, rotation_error(o.rotation, s.R));
            worst_mapping = fmax(worst_mapping, mapping_error(&o, &s));
        }
        print_message("# within %.0e of a line: rotation off %.2g, mapping %.2g\n", e, worst,
                      worst_mapping);
        assert_true(worst < 1e-15 / e);
        assert_true(worst_mapping < 3e-15);
    }
}

static void a_set_on_a_line_is_mapped_and_said_to_leave_a_turn_free(void **state)
{
    (void)state;
    for (int trial = 0; trial < N_TRIALS; trial++) {
        struct set s = {.n = 1 + trial % 4};
        random_vector(s.a[0], 6, (uint64_t)trial);
        for (int i = 1; i < s.n; i++) // both ways from the origin
            for (int k = 0; k < 3; k++)
                s.a[i][k] = (1.5 * i - 2) * s.a[0][k];
        turn_all(&s, trial);
        struct orientation o;
        fit(&o, &s);
        assert_false(o.determined);
        assert_false(o.mirrored);
        assert_proper(o.rotation);
        assert_true(mapping_error(&o, &s) < 3e-15);
        if (trial % 5 == 1) // and it turns no further than it must
            assert_true(rotation_error(o.rotation, (double[]){1, 0, 0, 0, 1, 0, 0, 0, 1}) < 2e-9);
    }
}

static void no_pairs_and_unmoved_pairs_give_exactly_the_identity(void **state)
{
    (void)state;
    const double identity[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    for (int n = 0; n <= MAX_PAIRS; n++) {
        struct set s = random_set(n, n);
        struct orientation o;
        memcpy(s.b, s.a, sizeof(s.b));
        fit(&o, &s);
        assert_int_equal(o.determined, n > 1);
        assert_true(rotation_error(o.rotation, identity) == 0);
    }
}

static void mirrored_sets_are_told_from_turned_ones(void **state)
{
    (void)state;
    for (int trial = 0; trial < N_TRIALS; trial++) {
        struct set s = random_set(3 + trial % 40, trial);
        const int kind = trial % 3; // flat, mirrored, flat and mirrored: the same as turned
        for (int i = 0; i < s.n; i++)
            s.a[i][2] = kind == 1 ? s.a[i][2] : 0;
        turn_all(&s, trial);
        for (int i = 0; i < s.n && kind; i++)
            for (int k = 0; k < 3; k++)
                s.b[i][k] = -s.b[i][k];
        struct orientation o;
        fit(&o, &s);
        assert_int_equal(o.mirrored, kind == 1);
        assert_true(o.determined);
        assert_proper(o.rotation);
        if (kind != 1)
            assert_true(mapping_error(&o, &s) < 3e-15);
    }
    struct orientation o; // axes: no rotation fits better than any other of three
    const double axes[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}},
                 mirrored[3][3] = {{-1, 0, 0}, {0, -1, 0}, {0, 0, -1}};
    orientation_fit(&o, axes, mirrored, NULL, 3);
    assert_true(o.mirrored);
    assert_proper(o.rotation);
}

static double misfit(const struct set *s, const double *weight, const double R[9])
{
    double sum = 0;
    for (int i = 0; i < s->n; i++) {
        double p[3];
        mat3_mul_vec(p, R, s->a[i]);
        vec3_sub(p, s->b[i], p);
        sum += weight[i] * vec3_dot(p, p);
    }
    return sum;
}

// Also where b has another scale, or next to nothing to do with a.
static void with_noise_no_neighbour_fits_better(void **state)
{
    (void)state;
    for (int trial = 0; trial < N_TRIALS; trial++) {
        struct set s = random_set(3 + trial % 20, trial);
        const double noise = (const double[]){1e-6, .1, 3}[trial % 3],
                     scale = (const double[]){1, 1e3, 1e-3, 1}[trial % 4];
        double weight[MAX_PAIRS];
        for (int i = 0; i < s.n; i++) {
            double off[3];
            random_vector(off, 7, (uint64_t)(trial * MAX_PAIRS + i));
            vec3_add_scaled(s.b[i], s.b[i], noise, off);
            for (int k = 0; k < 3; k++)
                s.b[i][k] *= scale;
            weight[i] = 2 * random_uniform(SEED, 8, (uint64_t)(trial * MAX_PAIRS + i));
        }
        struct orientation o;
        orientation_fit(&o, s.a, s.b, weight, s.n);
        assert_proper(o.rotation);
        const double best = misfit(&s, weight, o.rotation);
        for (int i = 0; i < 30; i++) {
            double w[3], turn[9], R[9];
            random_vector(w, 9, (uint64_t)(30 * trial + i));
            for (int k = 0; k < 3; k++)
                w[k] *= i % 3 ? 1e-3 : 1;
            mat3_from_rotation_vector(turn, w);
            mat3_mul(R, turn, o.rotation);
            assert_true(misfit(&s, weight, R) >= best * (1 - 1e-13));
        }
    }
}

static void a_pair_without_weight_is_not_there(void **state)
{
    (void)state;
    for (int trial = 0; trial < N_TRIALS; trial++) {
        struct set s = random_set(12, trial);
        double weight[MAX_PAIRS];
        for (int i = 0; i < s.n; i++)
            weight[i] = i % 3 ? .5 + i : 0;
        for (int i = 0; i < s.n; i += 3)
            random_vector(s.b[i], 10, (uint64_t)(trial + i));
        struct orientation o;
        orientation_fit(&o, s.a, s.b, weight, s.n);
        assert_true(rotation_error(o.rotation, s.R) < 2e-14);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(random_rotations_are_found_to_rounding),
        cmocka_unit_test(vectors_close_to_a_line_lose_one_power_of_their_angle_only),
        cmocka_unit_test(a_set_on_a_line_is_mapped_and_said_to_leave_a_turn_free),
        cmocka_unit_test(no_pairs_and_unmoved_pairs_give_exactly_the_identity),
        cmocka_unit_test(mirrored_sets_are_told_from_turned_ones),
        cmocka_unit_test(with_noise_no_neighbour_fits_better),
        cmocka_unit_test(a_pair_without_weight_is_not_there),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
