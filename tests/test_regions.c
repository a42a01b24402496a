// tests/test_regions.c - what decides where materials end and what they may be, on a dome of texels under a few lights: by what evidence
// texels are dealt out, when two regions become one, when a region may be metal. The parts are looked at from inside: the file is included.
#include "solver/regions.c"
#include "solver/random.h"
#include "solver/take/half.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

enum { SIDE = 12, N = SIDE * SIDE, VIEWS = 18, LIGHTS = 10 };

static struct {
    int32_t index[N], chart[N], first_neighbour[N + 1], neighbour[4 * N];
    uint32_t pixel[N];
    float position_m[N][3], normal[N][3], tangent[N][3], albedo[N][3];
    uint8_t texel_flags[N], flags[N * VIEWS], use_view[VIEWS], region[N];
    int64_t first[N + 1];
    uint16_t view[N * VIEWS], radiance[N * VIEWS][3], gradient[N * VIEWS];
    double centre_m[VIEWS][3];
    struct texels texels;
    struct samples samples;
    struct lights lights;
    struct level level;
    struct texel_scene scene;
} g;

static void unit(double v[3])
{
    const double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    for (int c = 0; c < 3; c++)
        v[c] /= length;
}

static int build_dome(void **state)
{
    (void)state;
    int n = 0;
    for (int i = 0; i < N; i++) {
        const double x = (i % SIDE + .5) / SIDE - .5, y = (i / SIDE + .5) / SIDE - .5;
        double normal[3] = { x, 1, y }, tangent[3] = { 1, -x, 0 };
        unit(normal), unit(tangent);
        g.index[i] = i, g.pixel[i] = (uint32_t)i;
        for (int c = 0; c < 3; c++) {
            g.normal[i][c] = (float)normal[c], g.tangent[i][c] = (float)tangent[c];
            g.albedo[i][c] = .2f + .1f * (float)c;
        }
        g.position_m[i][0] = .3f * (float)x, g.position_m[i][2] = .3f * (float)y;
        for (int k = 0; k < 4; k++) {
            const int u = i % SIDE + (k == 2) - (k == 1), v = i / SIDE + (k == 3) - (k == 0);
            if (u >= 0 && v >= 0 && u < SIDE && v < SIDE)
                g.neighbour[n++] = v * SIDE + u;
        }
        g.first_neighbour[i + 1] = n;
        g.first[i + 1] = (i + 1) * VIEWS;
        for (int v = 0; v < VIEWS; v++)
            g.view[i * VIEWS + v] = (uint16_t)v;
    }
    for (int v = 0; v < VIEWS; v++) {
        const double turn = 2.4 * v, up = .25 + .7 * v / VIEWS;
        g.centre_m[v][0] = 2 * cos(turn) * sqrt(1 - up * up), g.centre_m[v][1] = 2 * up, g.centre_m[v][2] = 2 * sin(turn) * sqrt(1 - up * up);
    }
    g.texels = (struct texels){ .size = SIDE, .n = N, .index = g.index, .pixel = g.pixel, .position_m = g.position_m, .normal = g.normal,
                                .tangent = g.tangent, .chart = g.chart, .flags = g.texel_flags, .texel_size_m = .3f / SIDE };
    g.samples = (struct samples){ .n_texels = N, .n_views = VIEWS, .n = N * VIEWS, .first = g.first, .view = g.view, .radiance = g.radiance,
                                  .gradient = g.gradient, .flags = g.flags, .centre_m = g.centre_m };
    g.level = (struct level){ .size = SIDE, .n = N, .index = g.index, .pixel = g.pixel, .chart = g.chart, .first_neighbour = g.first_neighbour,
                              .neighbour = g.neighbour };
    if (lights_new(&g.lights, LIGHTS))
        return -1;
    for (int i = 0; i < LIGHTS; i++) {
        const double turn = 1.9 * i, up = .3 + .65 * i / LIGHTS;
        const double d[3] = { cos(turn) * sqrt(1 - up * up), up, sin(turn) * sqrt(1 - up * up) };
        memcpy(g.lights.dir_probe[i], d, sizeof(d));
        for (int c = 0; c < 3; c++)
            g.lights.irradiance[i][c] = .35;
    }
    g.scene = (struct texel_scene){ .texels = &g.texels, .samples = &g.samples, .kernels = kernels_select(KERNELS_ALL), .free_albedo = true };
    return light_arrays_new(&g.scene.lights, &g.lights);
}

static int clear_away(void **state)
{
    (void)state;
    light_arrays_free(&g.scene.lights);
    lights_free(&g.lights);
    return 0;
}

// The pictures of such a material, with noise relative to what is seen.
static void photograph(const float theta[DISNEY_N], double noise)
{
    struct texel_worker *worker;
    const struct texel_row *rows;
    struct texel_scene dark = g.scene;
    memset(g.radiance, 0, sizeof(g.radiance));
    assert_int_equal(texel_worker_new(&worker, &dark), 0);
    for (int t = 0; t < N; t++) {
        const int n = texel_rows(&dark, worker, t, theta, g.albedo[t], &rows); // of a black picture: residuals are what would be seen
        uint16_t seen[VIEWS][3] = { { 0 } };
        for (int k = 0; k < n; k++) {
            const double error = noise * random_normal(5, (uint64_t)t, (uint64_t)k);
            seen[rows[k].view][k % 3] = half_from_float(fmaxf(rows[k].residual * (float)(1 + error), 0));
        }
        memcpy(g.radiance[t * VIEWS], seen, sizeof(seen));
    }
    texel_worker_free(worker);
}

static void open_search(struct search *s, struct regions *out)
{
    static float albedo[N][3];
    memcpy(albedo, g.albedo, sizeof(albedo));
    memset(out, 0, sizeof(*out));
    memset(g.region, 0, sizeof(g.region));
    *s = (struct search){ .albedo = albedo, .n_threads = 1, .region = g.region, .out = out, .hold = first_hold };
    assert_int_equal(search_new(s, &g.scene, &g.level), 0);
    out->n = 1;
}

static const float dull[DISNEY_N] = { [DISNEY_SPECULAR] = .5f, [DISNEY_ROUGHNESS] = .4f, [DISNEY_CLEARCOAT_GLOSS] = .5f };

// An albedo that was fitted to a sample flatters it: of few views, a wrong material's most.
static void texels_are_dealt_out_by_what_each_sample_costs_under_the_albedo_of_the_others(void **state)
{
    (void)state;
    enum { SEEN = 4 };
    struct search s;
    struct regions out;
    photograph(dull, .02);
    memset(g.use_view, 0, sizeof(g.use_view));
    for (int v = 0; v < SEEN; v++)
        g.use_view[4 * v] = 1;
    g.scene.use_view = g.use_view;
    open_search(&s, &out);
    out.n = 2;
    memcpy(out.region[0].theta, dull, sizeof(dull));
    memcpy(out.region[1].theta, dull, sizeof(dull));
    out.region[1].theta[DISNEY_METALLIC] = .7f;
    cost_nodes(&s, 0, N, 0);
    uint8_t others[VIEWS], alone[VIEWS];
    for (int t = 0; t < N; t += 7)
        for (int r = 0; r < 2; r++) {
            double sum = 0, fitted;
            int n = 0;
            struct texel_sums all = { 0 };
            float albedo[3];
            memcpy(albedo, g.albedo[t], sizeof(albedo));
            texel_fit_albedo(&g.scene, s.worker[0], t, 0, out.region[r].theta, albedo, 1, &all);
            fitted = all.cost / all.n;
            for (int v = 0; v < VIEWS; v++) {
                struct texel_scene without = g.scene, with = g.scene;
                struct texel_sums sums = { 0 };
                struct texel_error error = { 0 };
                if (!g.use_view[v])
                    continue;
                memcpy(others, g.use_view, sizeof(others)), memset(alone, 0, sizeof(alone));
                others[v] = 0, alone[v] = 1;
                without.use_view = others, with.use_view = alone;
                memcpy(albedo, g.albedo[t], sizeof(albedo));
                texel_fit_albedo(&without, s.worker[0], t, 0, out.region[r].theta, albedo, 1, &sums);
                texel_measure(&with, s.worker[0], t, out.region[r].theta, albedo, &error);
                sum += error.cost, n += (int)error.n;
            }
            assert_true(n == all.n && n >= 3);
            assert_true(fabs((double)s.cost[t * REGIONS_MAX + r] / (sum / n) - 1) < .02);
            assert_true((double)s.cost[t * REGIONS_MAX + r] > 1.2 * fitted); // which is not the same
        }
    // And where a finer level chooses again.
    struct refinement f = { .r = &out, .scene = &g.scene, .level = &g.level, .albedo = (const float(*)[3])g.albedo, .region = g.region,
                            .candidates = malloc(N), .evidence = malloc(N * REGIONS_MAX * sizeof(float)), .colour = malloc(N * sizeof(*f.colour)),
                            .worker = s.worker };
    assert_true(f.candidates && f.evidence && f.colour);
    memset(f.candidates, 3, N);
    weigh_doubtful(&f, 0, N, 0);
    for (int i = 0; i < N; i++) {
        float evidence[2];
        weigh_evidence(s.cost + i * REGIONS_MAX, 2, s.n_samples[i], evidence);
        assert_true(fabsf(f.evidence[i * REGIONS_MAX] - evidence[0]) < 1e-3f && fabsf(f.evidence[i * REGIONS_MAX + 1] - evidence[1]) < 1e-3f);
    }
    free(f.candidates), free(f.evidence), free(f.colour);
    g.scene.use_view = NULL;
    search_free(&s);
}

// Errors of single texels differ by factors. Chance alone must not keep two pieces of one material apart; a loss that all texels share must.
static void regions_stay_apart_only_by_more_than_chance(void **state)
{
    (void)state;
    enum { ROUNDS = 400 };
    static const int counts[] = { 6, 12, 40, WITNESSES };
    for (size_t k = 0; k < sizeof(counts) / sizeof(*counts); k++) {
        const int n = counts[k];
        int by_chance = 0, seen = 0;
        for (int round = 0; round < ROUNDS; round++) {
            float alone[WITNESSES], same[WITNESSES], worse[WITNESSES];
            for (int i = 0; i < n; i++) {
                const uint64_t at = (uint64_t)(round * WITNESSES + i);
                alone[i] = 1e-4f * (float)exp(.7 * random_normal(1, k, at));
                same[i] = alone[i] * (float)exp(.5 * random_normal(2, k, at));
                worse[i] = 4 * same[i];
            }
            by_chance += how_much_worse(same, alone, n) > worth_a_region;
            seen += how_much_worse(worse, alone, n) > worth_a_doubtful_one;
        }
        assert_true(by_chance <= ROUNDS / 20);
        assert_true(seen >= ROUNDS * 95 / 100);
    }
    const float one = 1e-4f, other = 1;
    assert_true(how_much_worse(&other, &one, 1) <= 1); // one texel says nothing
}

// A little metal explains what lights that are off leave over, and lets every texel choose its own specular colour.
static void a_region_is_metal_only_where_a_dielectric_is_far_worse(void **state)
{
    (void)state;
    static const struct {
        float metallic;
        double noise;
        bool is_metal;
    } cases[] = { { .2f, .02, false }, { .6f, .01, true } };
    for (size_t k = 0; k < sizeof(cases) / sizeof(*cases); k++) {
        struct search s;
        struct regions out;
        struct region full = { 0 };
        struct witnesses w;
        uint16_t frozen = 0;
        double error2, with, without;
        float theta[DISNEY_N], dielectric[DISNEY_N];
        memcpy(theta, dull, sizeof(theta));
        theta[DISNEY_METALLIC] = cases[k].metallic;
        photograph(theta, cases[k].noise);
        open_search(&s, &out);
        call_witnesses(&s, 1, &w);
        memcpy(dielectric, theta, sizeof(dielectric));
        assert_int_equal(fit_shared(&s, &s.inner, &w, 0, false, theta), 0);
        assert_int_equal(fit_shared(&s, &s.inner, &w, 1 << DISNEY_METALLIC, false, dielectric), 0);
        assert_int_equal(test(&s, &w, theta, 0, -1, &with, NULL, NULL), 0);
        assert_int_equal(test(&s, &w, dielectric, 0, -1, &without, NULL, NULL), 0);
        if (cases[k].is_metal)
            assert_true(without > 2 * with);
        else // some gain, which any other layer would be worth
            assert_true(without > 1.03 * with && without < 1.4 * with);
        memcpy(out.region[0].theta, theta, sizeof(theta));
        assert_int_equal(simplify(&s, &w, &out.region[0], 0, &frozen, &error2, &full), 0);
        assert_int_equal(!(frozen >> DISNEY_METALLIC & 1), cases[k].is_metal);
        assert_true(cases[k].is_metal || out.region[0].theta[DISNEY_METALLIC] == 0);
        search_free(&s);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(texels_are_dealt_out_by_what_each_sample_costs_under_the_albedo_of_the_others),
        cmocka_unit_test(regions_stay_apart_only_by_more_than_chance),
        cmocka_unit_test(a_region_is_metal_only_where_a_dielectric_is_far_worse),
    };
    return cmocka_run_group_tests_name("regions", tests, build_dome, clear_away);
}
