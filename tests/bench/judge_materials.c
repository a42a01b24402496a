// tests/bench/judge_materials.c - judge_materials [--csv] SOLVE_DIR TAKE [RELIT_RENDERS]: the textures of a solve beside the truth of its take.
//
// Per region of truth/region_id.exr (or one for all), over texels that are measured and lie amid their region: each parameter's true mean,
// the solve's mean, the RMS error, the median of the standard deviations it claims and the share of texels whose truth lies within 1.645 of
// them, of those that claim one (an infinite deviation claims nothing); the albedo's relative error and share. "In shadow": where more than 30 % of the light that could arrive (solve's lights) is blocked.
// --csv: region, name, texels, of them with a deviation, of those within, true mean, mean, RMS error, median deviation.
// RELIT_RENDERS: what `rigsolve render` made of TAKE/relit's cameras; compared where the object covers the pixel and all around it.
#include "solver/visibility.h"
#include "tests/judgement.h"

struct truth_maps {
    struct image albedo, theta, region; // theta: ten channels, in order; region may be empty
    float id_scale;                     // Cycles writes ids as id / 255
};

static void maps_free(struct truth_maps *t)
{
    image_free(&t->albedo), image_free(&t->theta), image_free(&t->region);
}

static int read_theta(struct image *out, const char *take)
{
    static const char *const cycles[DISNEY_N] = {[DISNEY_ROUGHNESS] = "R", [DISNEY_METALLIC] = "G", [DISNEY_SPECULAR] = "B"};
    char path[PATH_MAX], key[64];
    struct image raw = {0};
    struct json *material = NULL;
    const bool ours = judge_has(path, take, "truth/brdf.exr");
    if (!ours && !judge_has(path, take, "truth/rough_metal_spec.exr"))
        return -ENOENT;
    int err = judge_read_texture(&raw, path);
    if (!err && !ours && judge_has(path, take, "truth/material.json"))
        err = json_read(&material, path);
    if (!err)
        err = image_new(out, raw.width, raw.height, DISNEY_N, disney_parameter_names);
    for (int k = 0; !err && k < DISNEY_N; k++) {
        const char *name = ours ? disney_parameter_names[k] : cycles[k];
        const int channel = name ? image_channel(&raw, name) : -1;
        double constant = NAN;
        snprintf(key, sizeof(key), "constant.%s", disney_parameter_names[k]);
        if (material)
            json_get_number(material, key, &constant);
        for (size_t i = 0; i < (size_t)raw.width * (size_t)raw.height; i++)
            out->data[i * DISNEY_N + (size_t)k] = channel >= 0 ? raw.data[i * (size_t)raw.n_channels + (size_t)channel] : (float)constant;
    }
    json_free(material);
    image_free(&raw);
    return err;
}

static int read_maps(struct truth_maps *t, const char *take)
{
    char path[PATH_MAX];
    int err = judge_has(path, take, "truth/albedo.exr") || judge_has(path, take, "truth/basecolor.exr") ? judge_read_texture(&t->albedo, path) : -ENOENT;
    if (!err)
        err = read_theta(&t->theta, take);
    if (!err && judge_has(path, take, "truth/region_id.exr"))
        err = judge_read_texture(&t->region, path);
    float most = 0;
    for (size_t i = 0; !err && t->region.data && i < (size_t)t->region.width * (size_t)t->region.height; i++)
        most = fmaxf(most, t->region.data[i * (size_t)t->region.n_channels]);
    t->id_scale = most > 0 && most < .5f ? 255 : 1;
    return err;
}

static const float *nearest(const struct image *m, int size, uint32_t pixel, int dx, int dy)
{
    int x = (int)(((double)(pixel % (uint32_t)size) + .5) * m->width / size) + dx, y = (int)(((double)(pixel / (uint32_t)size) + .5) * m->height / size) + dy;
    x = x < 0 ? 0 : x >= m->width ? m->width - 1 : x, y = y < 0 ? 0 : y >= m->height ? m->height - 1 : y;
    return m->data + ((size_t)y * (size_t)m->width + (size_t)x) * (size_t)m->n_channels;
}

enum { RIM = -1, MOST_REGIONS = 16 };

// The region of a texel amid it, else RIM.
static int region_at(const struct truth_maps *t, int size, uint32_t pixel)
{
    if (!t->region.data)
        return 0;
    const int reach = t->region.width / size + 1;
    const long here = lroundf(nearest(&t->region, size, pixel, 0, 0)[0] * t->id_scale);
    for (int k = 0; k < 9; k++)
        if (nearest(&t->region, size, pixel, (k % 3 - 1) * reach, (k / 3 - 1) * reach)[0] * t->id_scale < (float)here - .5f ||
            nearest(&t->region, size, pixel, (k % 3 - 1) * reach, (k / 3 - 1) * reach)[0] * t->id_scale > (float)here + .5f)
            return RIM;
    return here >= 0 && here < MOST_REGIONS ? (int)here : RIM;
}

struct tally {
    int n, n_std, n_claimed, n_within; // claimed: with a standard deviation; an infinite one claims nothing
    double sum, sum_true, squares, squares_true, *std;
};

static void tally_add(struct tally *t, double value, double truth, double std)
{
    t->n++;
    t->sum += value, t->sum_true += truth;
    t->squares += (value - truth) * (value - truth), t->squares_true += truth * truth;
    t->std[t->n_std++] = std;
    t->n_claimed += isfinite(std);
    t->n_within += isfinite(std) && fabs(value - truth) <= 1.645 * std;
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static bool as_csv;

static void tally_print(struct tally *t, int region, const char *name, bool relative)
{
    if (!t->n)
        return;
    qsort(t->std, (size_t)t->n_std, sizeof(double), by_value);
    if (as_csv) {
        printf("%d,%s,%d,%d,%d,%.6f,%.6f,%.6f,%.6f\n", region, name, t->n, t->n_claimed, t->n_within, t->sum_true / t->n, t->sum / t->n,
               sqrt(t->squares / t->n), t->std[t->n_std / 2]);
        return;
    }
    printf("  %-16s true %.4f  found %.4f  RMS error %.4f", name, t->sum_true / t->n, t->sum / t->n, sqrt(t->squares / t->n));
    if (relative)
        printf(" (%.2f %%)", 100 * sqrt(t->squares / t->squares_true));
    printf("  std %.4f", t->std[t->n_std / 2]);
    if (t->n_claimed)
        printf("  within 90 %%: %.1f %%", 100. * t->n_within / t->n_claimed);
    printf("\n");
}

// Share of the light above the horizon that nothing blocks, by luminance.
static int unblocked_shares(float *share, const struct texels *t, const struct rays *rays, const char *solve)
{
    char path[PATH_MAX];
    struct lights l;
    struct light_visibility v = {0};
    int err = judge_path(path, solve, "lights.json");
    if (!err)
        err = lights_read_json(&l, path);
    if (err)
        return err;
    err = light_visibility_trace(&v, rays, t, &l, NULL, 1, 1, 0);
    for (int i = 0; !err && i < t->n; i++) {
        double all = 0, seen = 0;
        for (int k = 0; k < l.n; k++) {
            const double p[3] = {t->position_m[i][0], t->position_m[i][1], t->position_m[i][2]};
            struct light_at at;
            light_at_point(&l, k, p, &at);
            const double cosine = at.l[0] * t->normal[i][0] + at.l[1] * t->normal[i][1] + at.l[2] * t->normal[i][2];
            const double e = cosine > 0 ? cosine * at.weight * judge_light_luminance(&l, k) : 0;
            all += e;
            seen += v.bits[(size_t)i * (size_t)v.words_per_texel + (size_t)k / 16] >> k % 16 & 1 ? e : 0;
        }
        share[i] = (float)(all > 0 ? seen / all : 1);
    }
    light_visibility_free(&v);
    lights_free(&l);
    return err;
}

static int judge_textures(const char *solve, const char *take_dir)
{
    char path[PATH_MAX];
    struct take *take = NULL;
    struct truth_maps truth = {0};
    struct image albedo = {0}, theta = {0}, std = {0}, validity = {0};
    struct mesh mesh = {0};
    struct texels texels = {0};
    struct rays *rays = NULL;
    int err = take_open(&take, take_dir);
    if (!err)
        err = mesh_read(&mesh, NULL, take->mesh_path);
    if (!err)
        err = rays_new(&rays, &mesh);
    if (!err)
        err = read_maps(&truth, take_dir);
    if (!err)
        err = judge_path(path, solve, "albedo.exr") || judge_read_texture(&albedo, path) || judge_path(path, solve, "brdf.exr") ||
              judge_read_texture(&theta, path) || judge_path(path, solve, "std.exr") || judge_read_texture(&std, path) ||
              judge_path(path, solve, "validity.exr") || judge_read_texture(&validity, path);
    if (!err)
        err = texels_rasterise(&texels, &mesh, albedo.width);
    const size_t n = (size_t)texels.n;
    double *scratch = malloc((n + 1) * (DISNEY_N + 5) * 3 * sizeof(double));
    float *share = malloc((n + 1) * sizeof(float));
    if (!err && (!scratch || !share))
        err = -ENOMEM;
    if (!err)
        err = unblocked_shares(share, &texels, rays, solve);
    const int y = err ? 0 : image_channel(&validity, "Y");
    int at[DISNEY_N], at_std[DISNEY_N + 3];
    for (int k = 0; !err && k < DISNEY_N; k++)
        at[k] = image_channel(&theta, disney_parameter_names[k]), at_std[k] = image_channel(&std, disney_parameter_names[k]);
    for (int c = 0; !err && c < 3; c++)
        at_std[DISNEY_N + c] = image_channel(&std, (const char *[]){"albedo_R", "albedo_G", "albedo_B"}[c]);
    for (int region = 0; !err && region < MOST_REGIONS; region++) {
        struct tally p[DISNEY_N] = {{0}}, a = {0}, shadowed = {0}, lit = {0};
        for (int k = 0; k < DISNEY_N; k++)
            p[k].std = scratch + (size_t)k * (n + 1);
        a.std = scratch + DISNEY_N * (n + 1), shadowed.std = a.std + 3 * (n + 1), lit.std = shadowed.std + 3 * (n + 1);
        for (int i = 0; i < texels.n; i++) {
            const size_t pixel = texels.pixel[i];
            double expected[3];
            if (!(validity.data[pixel * (size_t)validity.n_channels + (size_t)y] > 0) || region_at(&truth, albedo.width, texels.pixel[i]) != region)
                continue;
            const float *true_theta = nearest(&truth.theta, albedo.width, texels.pixel[i], 0, 0), *s = std.data + pixel * (size_t)std.n_channels;
            for (int k = 0; k < DISNEY_N; k++)
                if (!isnan(true_theta[k]))
                    tally_add(&p[k], theta.data[pixel * (size_t)theta.n_channels + (size_t)at[k]], true_theta[k], s[at_std[k]]);
            judge_true_albedo(&truth.albedo, albedo.width, texels.pixel[i], expected);
            for (int c = 0; c < 3; c++) {
                const double value = albedo.data[pixel * (size_t)albedo.n_channels + (size_t)c], deviation = s[at_std[DISNEY_N + c]];
                tally_add(&a, value, expected[c], deviation);
                tally_add(share[i] < .7f ? &shadowed : &lit, value, expected[c], deviation);
            }
        }
        if (!a.n)
            continue;
        if (!as_csv)
            printf("region %d: %d texels\n", region, a.n / 3);
        for (int k = 0; k < DISNEY_N; k++)
            tally_print(&p[k], region, disney_parameter_names[k], false);
        tally_print(&a, region, "albedo", true);
        if (shadowed.n) {
            tally_print(&shadowed, region, as_csv ? "albedo in shadow" : "  in shadow", true);
            tally_print(&lit, region, as_csv ? "albedo in light" : "  in light", true);
        }
    }
    free(scratch), free(share);
    texels_free(&texels), rays_free(rays), mesh_free(&mesh), maps_free(&truth), take_close(take);
    image_free(&albedo), image_free(&theta), image_free(&std), image_free(&validity);
    return err;
}

// Where the object covers the pixel and its eight neighbours.
static bool is_amid(const struct image *rendered, int alpha, int x, int y)
{
    for (int k = 0; k < 9; k++) {
        const int px = x + k % 3 - 1, py = y + k / 3 - 1;
        if (px < 0 || py < 0 || px >= rendered->width || py >= rendered->height ||
            !(rendered->data[((size_t)py * (size_t)rendered->width + (size_t)px) * (size_t)rendered->n_channels + (size_t)alpha] > .999f))
            return false;
    }
    return true;
}

static int judge_relit(const char *take_dir, const char *renders)
{
    char dir[PATH_MAX], name[PATH_MAX], path[PATH_MAX];
    struct take *take = NULL;
    double squares = 0, total = 0;
    int err = judge_path(dir, take_dir, "relit");
    if (!err)
        err = take_open(&take, dir);
    for (int v = 0; !err && v < take->n_views; v++) {
        struct image truth = {0}, rendered = {0};
        snprintf(name, sizeof(name), "%s.exr", take->view_names[v]);
        err = judge_path(path, renders, name);
        if (!err)
            err = image_read(&rendered, path);
        if (!err)
            err = image_read(&truth, take->view_paths[v]);
        const int alpha = err ? -1 : image_channel(&rendered, "A");
        if (!err && (alpha < 0 || truth.width != rendered.width || truth.height != rendered.height)) {
            log_error("judge_materials: %s: expected A and the size of %s", path, take->view_paths[v]);
            err = -EINVAL;
        }
        double here = 0, n = 0;
        for (int y = 0; !err && y < truth.height; y++)
            for (int x = 0; x < truth.width; x++) {
                const size_t i = (size_t)y * (size_t)truth.width + (size_t)x;
                if (!is_amid(&rendered, alpha, x, y))
                    continue;
                for (int c = 0; c < 3; c++) {
                    const double a = fmin(fmax(truth.data[i * (size_t)truth.n_channels + (size_t)c], 0), 1);
                    const double b = fmin(fmax(rendered.data[i * (size_t)rendered.n_channels + (size_t)c], 0), 1);
                    here += (a - b) * (a - b);
                }
                n += 3;
            }
        if (!err)
            printf("relit %s: RMSE %.3f %%\n", take->view_names[v], 100 * sqrt(here / fmax(n, 1)));
        squares += here, total += n;
        image_free(&truth), image_free(&rendered);
    }
    if (!err)
        printf("relit: RMSE %.3f %%\n", 100 * sqrt(squares / fmax(total, 1)));
    take_close(take);
    return err;
}

int main(int argc, char **argv)
{
    if (argc > 1 && !strcmp(argv[1], "--csv"))
        as_csv = true, argc--, argv++;
    if ((argc != 3 && argc != 4) || argv[1][0] == '-') {
        fprintf(stderr, "usage: judge_materials [--csv] SOLVE_DIR TAKE [RELIT_RENDERS]\n");
        return 2;
    }
    int err = judge_textures(argv[1], argv[2]);
    if (!err && argc == 4)
        err = judge_relit(argv[2], argv[3]);
    return err || fflush(stdout) ? 1 : 0;
}
