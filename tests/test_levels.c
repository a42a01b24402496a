// tests/test_levels.c - the pyramid: whose child a texel is, who its neighbours are across seams, and what a level costs.
#include "solver/levels.h"
#include "solver/shapes.h"
#include "tests/scratch.h"

#include <math.h>
#include <string.h>

static const struct levels_settings usual = {.seams = true, .cap = 128, .most_views = 32};

// A cube of side 1 whose six faces are charts, 2 x 3 in the atlas with a gap around each.
static void make_cube(struct mesh *mesh)
{
    float(*position)[3] = malloc(24 * sizeof(*position)), (*uv)[2] = malloc(24 * sizeof(*uv));
    float(*normal)[3] = calloc(24, sizeof(*normal));
    uint32_t(*triangle)[3] = malloc(12 * sizeof(*triangle));
    for (int face = 0; face < 6; face++) {
        const int axis = face / 2, side = face % 2;
        for (int k = 0; k < 4; k++) {
            const int v = 4 * face + k, a = k == 1 || k == 2, b = k >= 2; // counter-clockwise of (axis+1, axis+2)
            position[v][axis] = (float)side;
            normal[v][axis] = side ? 1 : -1;
            position[v][(axis + 1) % 3] = (float)(side ? a : b);
            position[v][(axis + 2) % 3] = (float)(side ? b : a);
            uv[v][0] = (float)(face % 3) / 3 + .02f + (float)a * .2933f, uv[v][1] = (float)(face / 3) / 2 + .02f + (float)b * .2933f;
        }
        for (int k = 0; k < 2; k++)
            triangle[2 * face + k][0] = (uint32_t)(4 * face), triangle[2 * face + k][1] = (uint32_t)(4 * face + k + 1),
                               triangle[2 * face + k][2] = (uint32_t)(4 * face + k + 2);
    }
    assert_int_equal(mesh_from_arrays(mesh, 24, position, normal, uv, 12, triangle), 0);
}

static void make_levels(struct levels *l, struct texels *t, const struct mesh *mesh, int size, int samples, const struct levels_settings *set)
{
    assert_int_equal(texels_rasterise(t, mesh, size), 0);
    int32_t *n = malloc((size_t)t->n * sizeof(*n));
    for (int i = 0; i < t->n; i++)
        n[i] = samples;
    assert_int_equal(levels_new(l, t, n, set), 0);
    free(n);
}

static bool are_neighbours(const struct level *l, int i, int j)
{
    for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++)
        if (l->neighbour[m] == j)
            return true;
    return false;
}

static float distance(const struct level *l, int i, int j)
{
    float sum = 0;
    for (int c = 0; c < 3; c++)
        sum += (l->position_m[i][c] - l->position_m[j][c]) * (l->position_m[i][c] - l->position_m[j][c]);
    return sqrtf(sum);
}

static void every_texel_has_its_parent(void **state)
{
    (void)state;
    struct mesh mesh;
    struct texels t;
    struct levels l;
    assert_int_equal(shape_make(&mesh, SHAPE_VASE, (double[]){0, 0, 0}, .3, 2000), 0);
    make_levels(&l, &t, &mesh, 50, 20, &usual); // not a power of two: 50 25 13 7 4 2 1
    assert_int_equal(l.n, 7);
    assert_int_equal(l.level[0].n, 1);
    assert_null(l.level[0].parent);
    for (int k = 1; k < l.n; k++) {
        const struct level *v = &l.level[k], *coarse = &l.level[k - 1];
        assert_int_equal(coarse->size, (v->size + 1) / 2);
        int *children = calloc((size_t)coarse->n, sizeof(int));
        for (int i = 0; i < v->n; i++) {
            const int p = v->parent[i];
            assert_in_range(p, 0, coarse->n - 1);
            assert_int_equal((int)coarse->pixel[p] % coarse->size, (int)v->pixel[i] % v->size / 2);
            assert_int_equal((int)coarse->pixel[p] / coarse->size, (int)v->pixel[i] / v->size / 2);
            children[p]++;
        }
        for (int i = 0; i < coarse->n; i++)
            assert_in_range(children[i], 1, 4);
        free(children);
    }
    levels_free(&l), texels_free(&t), mesh_free(&mesh);
}

static void neighbourhood_is_mutual_and_without_repetition(void **state)
{
    (void)state;
    for (int shape = 0; shape < SHAPE_N; shape++) {
        struct mesh mesh;
        struct texels t;
        struct levels l;
        assert_int_equal(shape_make(&mesh, (enum shape)shape, (double[]){1, 2, 3}, .3, 2000), 0);
        make_levels(&l, &t, &mesh, 64, 20, &usual);
        for (int k = 0; k < l.n; k++)
            for (int i = 0; i < l.level[k].n; i++)
                for (int32_t m = l.level[k].first_neighbour[i]; m < l.level[k].first_neighbour[i + 1]; m++) {
                    const int j = l.level[k].neighbour[m];
                    assert_int_not_equal(i, j);
                    assert_true(are_neighbours(&l.level[k], j, i));
                    assert_true(m == l.level[k].first_neighbour[i] || l.level[k].neighbour[m - 1] < j);
                }
        levels_free(&l), texels_free(&t), mesh_free(&mesh);
    }
}

// Texels amid a face have the four beside them. At a cube's edges normals turn by 90 degrees, more than the 60 that are allowed: no seam is closed.
static void a_cube_s_faces_know_nothing_of_each_other(void **state)
{
    (void)state;
    struct mesh mesh;
    struct texels t;
    struct levels l;
    make_cube(&mesh);
    make_levels(&l, &t, &mesh, 64, 20, &usual);
    const struct level *v = &l.level[l.n - 1];
    int n_inner = 0;
    for (int i = 0; i < v->n; i++) {
        const int n = v->first_neighbour[i + 1] - v->first_neighbour[i];
        assert_in_range(n, 2, 4);
        n_inner += n == 4;
        for (int32_t m = v->first_neighbour[i]; m < v->first_neighbour[i + 1]; m++)
            assert_int_equal(v->chart[v->neighbour[m]], v->chart[i]);
    }
    assert_true(n_inner > v->n / 2);
    levels_free(&l), texels_free(&t), mesh_free(&mesh);
}

// The pebble is smooth, so every seam between its charts can be closed, and what is across is what brute force finds.
static void seams_are_closed_with_the_nearest_texels_of_other_charts(void **state)
{
    (void)state;
    struct mesh mesh;
    struct texels t;
    struct levels l;
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, (double[]){0, 0, 0}, .3, 5000), 0);
    make_levels(&l, &t, &mesh, 64, 20, &usual);
    const struct level *v = &l.level[l.n - 1];
    int n_boundary = 0, n_closed = 0;
    for (int i = 0; i < v->n; i++) {
        if (!(t.flags[i] & TEXEL_BOUNDARY))
            continue;
        int in_chart = 0, nearest = -1;
        float least = INFINITY;
        for (int32_t m = v->first_neighbour[i]; m < v->first_neighbour[i + 1]; m++)
            in_chart += v->chart[v->neighbour[m]] == v->chart[i];
        for (int j = 0; j < v->n; j++) {
            const float *a = v->normal[i], *b = v->normal[j];
            if (v->chart[j] == v->chart[i] || !(t.flags[j] & TEXEL_BOUNDARY) || a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < .5f)
                continue;
            if (distance(v, i, j) < least)
                least = distance(v, i, j), nearest = j;
        }
        n_boundary++;
        assert_in_range(in_chart, 0, 3);
        if (nearest >= 0 && least <= 2.5f * t.texel_size_m) {
            n_closed++;
            assert_true(are_neighbours(v, i, nearest));
        }
    }
    assert_true(n_boundary > 100);
    assert_true(n_closed > .95 * n_boundary);
    levels_free(&l), texels_free(&t);

    struct levels_settings open = usual;
    open.seams = false;
    make_levels(&l, &t, &mesh, 64, 20, &open);
    v = &l.level[l.n - 1];
    for (int i = 0; i < v->n; i++)
        for (int32_t m = v->first_neighbour[i]; m < v->first_neighbour[i + 1]; m++)
            assert_int_equal(v->chart[v->neighbour[m]], v->chart[i]);
    levels_free(&l), texels_free(&t), mesh_free(&mesh);
}

// A tube in one chart: its seam is with itself.
static void a_chart_that_closes_round_a_tube_meets_itself(void **state)
{
    (void)state;
    enum { AROUND = 48 };
    struct mesh mesh;
    struct texels t;
    struct levels l;
    float(*position)[3] = malloc(2 * (AROUND + 1) * sizeof(*position)), (*uv)[2] = malloc(2 * (AROUND + 1) * sizeof(*uv));
    uint32_t(*triangle)[3] = malloc(2 * AROUND * sizeof(*triangle));
    for (int k = 0; k <= AROUND; k++)
        for (int b = 0; b < 2; b++) {
            const double phi = 2 * M_PI * (k % AROUND) / AROUND;
            float *p = position[2 * k + b];
            p[0] = (float)cos(phi), p[1] = (float)sin(phi), p[2] = (float)b * 6;
            uv[2 * k + b][0] = .05f + .9f * (float)k / AROUND, uv[2 * k + b][1] = .05f + .9f * (float)b;
        }
    for (int k = 0; k < AROUND; k++) {
        const uint32_t a = (uint32_t)(2 * k);
        memcpy(triangle[2 * k], (uint32_t[]){a, a + 2, a + 3}, sizeof(*triangle));
        memcpy(triangle[2 * k + 1], (uint32_t[]){a, a + 3, a + 1}, sizeof(*triangle));
    }
    assert_int_equal(mesh_from_arrays(&mesh, 2 * (AROUND + 1), position, NULL, uv, 2 * AROUND, triangle), 0);
    make_levels(&l, &t, &mesh, 40, 20, &usual);
    const struct level *v = &l.level[l.n - 1];
    assert_int_equal(mesh.n_charts, 1);
    int n_across = 0, n_rows = 0;
    for (int i = 0; i < v->n; i++) {
        const int x = (int)v->pixel[i] % v->size;
        const bool is_left = i == 0 || v->pixel[i] != v->pixel[i - 1] + 1;
        n_rows += is_left;
        for (int32_t m = v->first_neighbour[i]; is_left && m < v->first_neighbour[i + 1]; m++) {
            const int dx = (int)v->pixel[v->neighbour[m]] % v->size - x;
            n_across += dx > 30;
        }
    }
    assert_true(n_across >= n_rows);
    levels_free(&l), texels_free(&t), mesh_free(&mesh);
}

// All delegates are of the texel; none twice; they have about `cap` samples where there are enough; a level costs what its texel count costs.
static void a_coarse_texel_looks_at_about_cap_samples_beneath_it(void **state)
{
    (void)state;
    enum { SAMPLES = 28 };
    struct mesh mesh;
    struct texels t;
    struct levels l;
    assert_int_equal(shape_make(&mesh, SHAPE_PEBBLE, (double[]){0, 0, 0}, .3, 2000), 0);
    make_levels(&l, &t, &mesh, 128, SAMPLES, &usual);
    uint8_t *seen = calloc((size_t)t.n, 1);
    int64_t all = 0;
    for (int k = 0; k < l.n; k++) {
        const struct level *v = &l.level[k];
        memset(seen, 0, (size_t)t.n);
        for (int i = 0; i < v->n && v->first_delegate; i++) {
            const int n = v->first_delegate[i + 1] - v->first_delegate[i];
            assert_in_range(n, 1, (128 + SAMPLES - 1) / SAMPLES);
            for (int32_t m = v->first_delegate[i]; m < v->first_delegate[i + 1]; m++) {
                int up = v->delegate[m];
                assert_int_equal(seen[up]++, 0);
                for (int q = l.n - 1; q > k; q--)
                    up = l.level[q].parent[up];
                assert_int_equal(up, i);
            }
            all += (int64_t)n * SAMPLES;
        }
        if (k == 0)
            assert_int_equal(v->first_delegate[1], (128 + SAMPLES - 1) / SAMPLES);
    }
    assert_true((double)all < 1.6 * t.n * SAMPLES); // with the finest: 2.6 x, not 8 x
    free(seen);
    levels_free(&l), texels_free(&t), mesh_free(&mesh);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_texel_has_its_parent),
        cmocka_unit_test(neighbourhood_is_mutual_and_without_repetition),
        cmocka_unit_test(a_cube_s_faces_know_nothing_of_each_other),
        cmocka_unit_test(seams_are_closed_with_the_nearest_texels_of_other_charts),
        cmocka_unit_test(a_chart_that_closes_round_a_tube_meets_itself),
        cmocka_unit_test(a_coarse_texel_looks_at_about_cap_samples_beneath_it),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
