// tests/bench/bench_panorama.c - how near the merged panorama comes to the one that was photographed, beside other ways to merge.
//
//   bench_panorama figures PANORAMA...   each through a fisheye of 1, 2, 3, 4 stops and a rectilinear head of 12 stops, CSV on standard output
//   bench_panorama variance PANORAMA...  of one fisheye stop: error^2 over the Poisson bound and over the bound with read noise, by electrons
//   bench_panorama frames DIR            24-megapixel frames of one stop and plans of 3 x 7 (fisheye) and 12 x 7 (rectilinear) frames that use them
//   bench_panorama take PANORAMA DIR     the whole chain: raws of a fisheye of 3 stops and their plan, for rigd-panorama; true.exr: what was photographed
#include "rigd/stitch.h"
#include "solver/lights.h"
#include "solver/take/log.h"
#include "tests/panorama_camera.h"

#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>

enum { OUT_WIDTH = 512, LIGHTS = 64, FRAMES_MAX = 15 };
enum method { POISSON, HAT, SINGLE, METHODS };
static const char *const method_name[METHODS] = { "poisson", "hat", "single" };
static const double deg = M_PI / 180;

static int compare(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double quantile(double *v, int n, double q)
{
    qsort(v, (size_t)n, sizeof(*v), compare);
    return n ? v[(int)(q * (n - 1))] : NAN;
}

// ---- rigs -------------------------------------------------------------------------------------------------------------------------

struct rig {
    const char *name;
    int n_stops;
    double yaw_deg[16], pitch_deg[16];
    struct sim_camera camera;
};

static struct rig fisheye(int n_stops, int size_px)
{
    static const double half_deg[5] = { 0, 92, 95, 92, 92 };
    struct rig r = { .name = "fisheye", .n_stops = n_stops, .camera = sim_usual };
    const double half = half_deg[n_stops] * deg;
    r.camera.f_number = 1;
    r.camera.lens = (struct lens){ .model = LENS_EQUISOLID, .width_px = size_px, .height_px = size_px, .centre_px = { size_px * .5 + 2.5, size_px * .5 - 3.25 },
                                   .focal_px = .485 * size_px / (2 * sin(.5 * half)), .max_angle_rad = half };
    for (int i = 0; i < n_stops; i++)
        r.yaw_deg[i] = 360. * i / n_stops;
    lens_init(&r.camera.lens, "fisheye");
    return r;
}

// Two rings of five, the zenith and the nadir: 87 x 65 degrees.
static struct rig rectilinear(int width_px)
{
    struct rig r = { .name = "rectilinear", .n_stops = 12, .camera = sim_usual };
    r.camera.f_number = 1;
    r.camera.lens = (struct lens){ .model = LENS_RECTILINEAR, .width_px = width_px, .height_px = width_px * 2 / 3, .centre_px = { width_px * .5 - 1.5, width_px / 3. + 2 },
                                   .focal_px = .5 * width_px / tan(43.5 * deg), .k = { -.06, .012, 0 }, .p = { 3e-4, -2e-4 } };
    for (int i = 0; i < 10; i++) {
        r.yaw_deg[i] = 72 * (i % 5) + (i < 5 ? 0 : 36);
        r.pitch_deg[i] = i < 5 ? 27 : -27;
    }
    r.pitch_deg[10] = 90, r.pitch_deg[11] = -90;
    lens_init(&r.camera.lens, "rectilinear");
    return r;
}

// ---- merging in other ways ------------------------------------------------------------------------------------------------------

// Debevec and Malik's triangle (on linear signals), and one exposure alone: what is clipped stays clipped.
static void merge_otherwise(struct merged *m, const struct raw_frame *f, int n, enum method method, int single)
{
    for (int y = 0; y < m->height; y++)
        for (int x = 0; x < m->width; x++) {
            const size_t i = (size_t)y * (size_t)m->width + (size_t)x;
            double sum = 0, weight = 0;
            for (int k = 0; k < n; k++) {
                const double s = (f[k].site[i] - f[k].black[0][0]) / (f[k].white - f[k].black[0][0]), h = bracket_exposure(f + k);
                const double w = method == SINGLE ? k == single : fmax(fmin(s, 1 - s), 0);
                sum += w * s / h, weight += w;
            }
            m->radiance[i] = (float)(weight > 0 ? sum / weight : (f[n - 1].site[i] - f[n - 1].black[0][0]) / (f[n - 1].white - f[n - 1].black[0][0]) / bracket_exposure(f + n - 1));
            m->variance[i] = 0;
            m->quality[i] = BRACKET_GOOD;
        }
}

// ---- figures ------------------------------------------------------------------------------------------------------------------------

struct figures {
    // light_max: of one light; light_moved: the lights' errors by their energy (sum of differences over sum). A median cut lays the borders
    // between lights along the hard edges of lamps, so what a photosite on such an edge holds lands half in the next light: light_max is that of
    // a dim light all along a lamp, goes with the size of a photosite (half the size, half the error) and is there without noise, with one stop.
    double median, p95, total[3], light_median, light_max, light_moved, coverage;
    double bound; // variance over the Poisson bound, of sites with more than 1,000 electrons
    int n_frames;
    bool needs_nd;
    double see_s, merge_s, stitch_s;
};

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int shoot_stop(struct raw_frame *f, const float *seen, const struct sim_camera *c, double metered_s, uint64_t stop, bool *needs_nd, int *metered)
{
    const struct bracket_plan plan = { .metered_s = metered_s, .shortest_s = metered_s * 0x1p-24, .longest_s = metered_s * 0x1p8, .max_frames = FRAMES_MAX,
                                       .noise = { c->electrons_at_white, c->read_noise_e } };
    struct bracket_statistics s[FRAMES_MAX];
    struct bracket_next next;
    int n = 0;
    for (;;) {
        if (bracket_next(&next, &plan, s, n) || next.is_done)
            break;
        if (sim_expose(f + n, seen, c, next.exposure_s, 1, stop * 64 + (uint64_t)n) || bracket_measure(s + n, f + n, &c->lens))
            exit(1);
        n++;
    }
    *needs_nd = *needs_nd || next.needs_nd;
    for (int i = 1; i < n; i++) // longest first
        for (int k = i; k > 0 && f[k].exposure_s > f[k - 1].exposure_s; k--) {
            const struct raw_frame t = f[k];
            f[k] = f[k - 1];
            f[k - 1] = t;
        }
    for (int i = 0; i < n; i++)
        if (f[i].exposure_s == metered_s)
            *metered = i;
    return n;
}

static double poisson_ratio(const struct merged *m, const float *seen, const struct raw_frame *f, int n, double w)
{
    double sum = 0;
    int64_t count = 0;
    const size_t sites = (size_t)m->width * (size_t)m->height;
    for (size_t i = 0; i < sites; i++) {
        double exposure = 0;
        const double X = (double)seen[i];
        bool is_plain = true; // not near the edge of being usable, where it is chance which frames count
        for (int k = 0; k < n; k++) {
            const double y = X * bracket_exposure(f + k);
            exposure += y <= .9 ? bracket_exposure(f + k) : 0;
            is_plain = is_plain && !(y > .87 && y < .93);
        }
        if (!is_plain || m->quality[i] != BRACKET_GOOD || X * exposure * w < 1000)
            continue;
        const double e = (double)m->radiance[i] - X;
        sum += e * e * exposure * w / X;
        count++;
    }
    return sum / (double)count;
}

static void judge(struct figures *out, const struct image *p, const struct image *truth, const struct lights *lights, const struct image *snr)
{
    static double error[OUT_WIDTH * OUT_WIDTH / 2], light_error[LIGHTS];
    struct image small;
    double real[3], moved = 0, light_total = 0;
    int n = 0, n_lights = 0;
    const int coverage = image_channel(p, "coverage"), variance = image_channel(snr, "variance.G"), k = truth->width / OUT_WIDTH;
    if (sim_shrink(&small, truth, k))
        exit(1);
    panorama_total(&(struct panorama){ *truth }, real);
    memset(out->total, 0, sizeof(out->total));
    out->coverage = 0;
    for (int i = 0; i < OUT_WIDTH * OUT_WIDTH / 2; i++) {
        const float *v = p->data + (size_t)i * (size_t)p->n_channels, *q = snr->data + (size_t)i * (size_t)snr->n_channels;
        const double area = panorama_solid_angle(OUT_WIDTH, OUT_WIDTH / 2, i / OUT_WIDTH);
        out->coverage += area * (double)v[coverage] / (4 * M_PI);
        for (int c = 0; c < 3; c++)
            out->total[c] += area * ((double)v[c] - (v[coverage] > 0 ? (double)small.data[3 * i + c] : 0)) / real[c];
        if (v[coverage] > .999f && q[1] > 10 * sqrtf(q[variance]) && small.data[3 * i + 1] > 0)
            error[n++] = fabs((double)v[1] / (double)small.data[3 * i + 1] - 1);
    }
    for (int i = 0; i < lights->n; i++) { // the lights' regions, in texels of the truth: whole ones of ours, as near as they lie
        const struct light_region *r = lights->region + i;
        const int x0 = (r->x0 + k / 2) / k, x1 = (r->x1 + k / 2) / k, y0 = (r->y0 + k / 2) / k, y1 = (r->y1 + k / 2) / k;
        double ours = 0, theirs = 0, seen = 1;
        for (int y = y0; y < y1; y++)
            for (int x = x0; x < x1; x++) {
                const float *v = p->data + ((size_t)y * OUT_WIDTH + (size_t)x) * (size_t)p->n_channels;
                const double area = panorama_solid_angle(OUT_WIDTH, OUT_WIDTH / 2, y);
                seen = fmin(seen, (double)v[coverage]);
                ours += area * ((double)v[0] + (double)v[1] + (double)v[2]);
                for (int c = 0; c < 3; c++)
                    theirs += area * (double)small.data[3 * ((size_t)y * OUT_WIDTH + (size_t)x) + (size_t)c];
            }
        if (!(theirs > 0) || seen <= .999)
            continue;
        light_error[n_lights++] = fabs(ours / theirs - 1);
        moved += fabs(ours - theirs), light_total += theirs;
    }
    out->median = quantile(error, n, .5), out->p95 = quantile(error, n, .95);
    out->light_median = quantile(light_error, n_lights, .5), out->light_max = quantile(light_error, n_lights, 1);
    out->light_moved = moved / light_total;
    image_free(&small);
}

static void photograph(struct figures out[METHODS], const struct rig *rig, const struct image *truth, const struct lights *lights, double metered_s)
{
    struct stitch *stitch[METHODS];
    struct image p[METHODS];
    struct panorama_report whole;
    struct stitch_stop_report r;
    const double M[9] = { 1 / rig->camera.response[0], 0, 0, 0, 1 / rig->camera.response[1], 0, 0, 0, 1 / rig->camera.response[2] };
    const double dn_e = rig->camera.electrons_at_white / (rig->camera.white - rig->camera.black);
    const struct bracket_options options = { .noise = { rig->camera.electrons_at_white, sqrt(rig->camera.read_noise_e * rig->camera.read_noise_e + dn_e * dn_e / 12) } };
    memset(out, 0, METHODS * sizeof(*out));
    for (int k = 0; k < METHODS; k++)
        if (stitch_new(stitch + k, OUT_WIDTH))
            exit(1);
    for (int s = 0; s < rig->n_stops; s++) {
        struct raw_frame f[FRAMES_MAX];
        struct sim_camera c = rig->camera;
        struct bracket *b;
        struct merged m;
        int64_t n_clipped, n_defects;
        double R[9], start = now_s();
        int metered = 0;
        c.yaw_deg = rig->yaw_deg[s], c.pitch_deg = rig->pitch_deg[s];
        float *seen = sim_see(truth, &c, 4);
        const int n = shoot_stop(f, seen, &c, metered_s, (uint64_t)s, &out[POISSON].needs_nd, &metered);
        out->see_s += now_s() - start;
        start = now_s();
        if (bracket_new(&b, f, &options))
            exit(1);
        for (int i = 0; i < n; i++) {
            struct bracket_frame_report report;
            if (bracket_add(b, f + i, i + 1 < n ? f + i + 1 : NULL, &report) || report.fault != BRACKET_FITS)
                fprintf(stderr, "frame %d of stop %d: %s\n", i, s, bracket_fault_text(report.fault));
        }
        if (bracket_finish(&m, b, &n_clipped, &n_defects))
            exit(1);
        out->merge_s += now_s() - start;
        out->n_frames += n;
        out->bound += poisson_ratio(&m, seen, f, n, c.electrons_at_white) / rig->n_stops;
        lens_head(R, c.yaw_deg * deg, c.pitch_deg * deg, 0);
        for (int k = 0; k < METHODS; k++) {
            if (k != POISSON)
                merge_otherwise(&m, f, n, (enum method)k, metered);
            start = now_s();
            if (stitch_add(stitch[k], &c.lens, R, &m, &r))
                exit(1);
            out->stitch_s += k == POISSON ? now_s() - start : 0;
        }
        for (int i = 0; i < n; i++)
            free(f[i].site);
        merged_free(&m);
        free(seen);
    }
    for (int k = 0; k < METHODS; k++)
        if (stitch_finish(p + k, stitch[k], M, &whole))
            exit(1);
    for (int k = 0; k < METHODS; k++) {
        judge(out + k, p + k, truth, lights, p + POISSON);
        stitch_free(stitch[k]);
    }
    for (int k = 0; k < METHODS; k++)
        image_free(p + k);
}

// A synthetic studio's panorama is of point lights, a texel each: no camera resolves that, nor do photosites of a colour add up to it. They
// are spread over blocks of texels until nearly every block is lit.
static void spread_points(struct image *p)
{
    for (int side = 1; side <= 64; side *= 2) {
        const int nx = p->width / side, ny = p->height / side;
        int lit = 0;
        for (int b = 0; b < nx * ny; b++) {
            double sum[3] = { 0 }, area = 0;
            for (int pass = 0; pass < 2; pass++)
                for (int k = 0; k < side * side; k++) {
                    const int y = b / nx * side + k / side, x = b % nx * side + k % side;
                    float *v = p->data + 3 * ((size_t)y * (size_t)p->width + (size_t)x);
                    const double w = panorama_solid_angle(p->width, p->height, y);
                    area += pass ? 0 : w;
                    for (int c = 0; c < 3; c++)
                        if (pass)
                            v[c] = (float)(sum[c] / area);
                        else
                            sum[c] += w * (double)v[c];
                }
            lit += sum[1] > 0;
        }
        if (lit > .95 * nx * ny)
            return;
    }
}

static double metered_time(const struct image *p)
{
    const int n = p->width * p->height;
    double *v = malloc((size_t)n * sizeof(*v));
    int lit = 0; // synthetic rooms have black walls
    for (int i = 0; i < n; i++)
        if (p->data[3 * i + 1] > 0)
            v[lit++] = (double)p->data[3 * i + 1];
    const double t = exp2(round(log2(.18 / quantile(v, lit, .5))));
    free(v);
    return t;
}

static int figures(int n, char **paths)
{
    printf("panorama,rig,stops,megapixels,frames,method,median_error,p95_error,total_r,total_g,total_b,light_median_error,light_max_error,light_moved,coverage,variance_over_poisson,merge_s,stitch_s\n");
    for (int i = 0; i < n; i++) {
        struct panorama p;
        struct lights lights;
        const char *name = strrchr(paths[i], '/') ? strrchr(paths[i], '/') + 1 : paths[i];
        if (panorama_read(&p, paths[i]))
            return 1;
        spread_points(&p.image);
        if (lights_median_cut(&lights, &p, LIGHTS))
            return 1;
        for (int k = 1; k <= 5; k++) {
            const struct rig rig = k < 5 ? fisheye(k, 1400) : rectilinear(900);
            struct figures f[METHODS];
            photograph(f, &rig, &p.image, &lights, metered_time(&p.image));
            for (int m = 0; m < METHODS; m++)
                printf("%s,%s,%d,%.1f,%d,%s,%.5f,%.4f,%+.4f,%+.4f,%+.4f,%.5f,%.4f,%.5f,%.4f,%.4f,%.1f,%.1f\n", name, rig.name, rig.n_stops,
                       rig.camera.lens.width_px * rig.camera.lens.height_px * 1e-6, f[0].n_frames, method_name[m], f[m].median, f[m].p95, f[m].total[0], f[m].total[1],
                       f[m].total[2], f[m].light_median, f[m].light_max, f[m].light_moved, f[m].coverage, m == POISSON ? f[m].bound : NAN, f[0].merge_s, f[0].stitch_s);
            fflush(stdout);
        }
        lights_free(&lights);
        panorama_free(&p);
    }
    return 0;
}

// By the electrons that the usable frames have of a site together.
static int variances(int n_paths, char **paths)
{
    enum { CLASSES = 5 };
    static const double from[CLASSES + 1] = { 100, 300, 1000, 3000, 10000, INFINITY };
    printf("panorama,electrons_from,sites,over_poisson,over_bound,bias\n");
    for (int i = 0; i < n_paths; i++) {
        struct panorama p;
        const struct rig rig = fisheye(1, 1400);
        const struct sim_camera *c = &rig.camera;
        const double w = c->electrons_at_white, dn_e = w / (c->white - c->black), s2 = c->read_noise_e * c->read_noise_e + dn_e * dn_e / 12;
        const struct bracket_options options = { .noise = { w, sqrt(s2) } };
        struct raw_frame f[FRAMES_MAX];
        struct bracket_frame_report report;
        struct bracket *b;
        struct merged m;
        int64_t n_clipped, n_defects;
        bool needs_nd = false;
        int metered;
        if (panorama_read(&p, paths[i]))
            return 1;
        spread_points(&p.image);
        float *seen = sim_see(&p.image, c, 4);
        const int n = shoot_stop(f, seen, c, metered_time(&p.image), 0, &needs_nd, &metered);
        if (bracket_new(&b, f, &options))
            return 1;
        for (int k = 0; k < n; k++)
            if (bracket_add(b, f + k, k + 1 < n ? f + k + 1 : NULL, &report))
                return 1;
        if (bracket_finish(&m, b, &n_clipped, &n_defects))
            return 1;
        double poisson[CLASSES] = { 0 }, bound[CLASSES] = { 0 }, bias[CLASSES] = { 0 };
        int64_t count[CLASSES] = { 0 };
        for (int k = 0; k < m.width * m.height; k++) {
            double exposure = 0, information = 0;
            const double X = (double)seen[k], e = (double)m.radiance[k] - X;
            for (int q = 0; q < n; q++) {
                const double h = bracket_exposure(f + q);
                if (X * h <= .9)
                    exposure += h, information += w * w * h * h / (w * X * h + s2);
            }
            int class = -1;
            while (class + 1 < CLASSES && X * exposure * w >= from[class + 1])
                class++;
            if (class < 0 || m.quality[k] != BRACKET_GOOD)
                continue;
            count[class]++;
            poisson[class] += e * e * exposure * w / X, bound[class] += e * e * information, bias[class] += e / X;
        }
        for (int k = 0; k < CLASSES; k++)
            printf("%s,%g,%lld,%.4f,%.4f,%+.5f\n", strrchr(paths[i], '/') ? strrchr(paths[i], '/') + 1 : paths[i], from[k], (long long)count[k],
                   poisson[k] / (double)count[k], bound[k] / (double)count[k], bias[k] / (double)count[k]);
        for (int k = 0; k < n; k++)
            free(f[k].site);
        merged_free(&m);
        free(seen);
        panorama_free(&p);
    }
    return 0;
}

// ---- files for the program --------------------------------------------------------------------------------------------------------

static void write_lens(FILE *to, const struct lens *l)
{
    fprintf(to, "{\"lens\": {\"model\": \"%s\", \"width_px\": %d, \"height_px\": %d, \"focal_px\": %.17g, \"centre_px\": [%.17g, %.17g], \"max_angle_deg\": %.17g, "
            "\"distortion\": [%.17g, %.17g, %.17g, %.17g, %.17g]},\n \"colour\": {\"gains\": [1, 1, 1], \"scale\": 1}, \"srgb_from_camera\": [1, 0, 0, 0, 1, 0, 0, 0, 1], \"stops\": [",
            lens_model_name(l->model), l->width_px, l->height_px, l->focal_px, l->centre_px[0], l->centre_px[1], l->max_angle_rad / deg, l->k[0], l->k[1], l->k[2], l->p[0], l->p[1]);
}

static FILE *open_plan(const char *dir, const char *name)
{
    char path[1024];
    snprintf(path, sizeof(path), "%s/%s", dir, name);
    FILE *f = fopen(path, "w");
    if (!f) {
        perror(path);
        exit(1);
    }
    return f;
}

// Time and memory do not depend on what is in the frames: all stops of a plan use the same seven.
static int frames(const char *dir)
{
    struct image studio;
    struct rig rigs[2] = { fisheye(3, 4900), rectilinear(6000) };
    mkdir(dir, 0777);
    if (sim_studio(&studio, 1024))
        return 1;
    for (int k = 0; k < 2; k++) {
        struct rig *rig = rigs + k;
        FILE *plan = open_plan(dir, k ? "rectilinear.json" : "fisheye.json");
        float *seen = sim_see(&studio, &rig->camera, 1);
        write_lens(plan, &rig->camera.lens);
        for (int i = 0; i < 7; i++) {
            char path[1024];
            struct raw_frame f;
            snprintf(path, sizeof(path), "%s/%s_%d.dng", dir, rig->name, i);
            if (!seen || sim_expose(&f, seen, &rig->camera, 2 * pow(.25, i), 1, (uint64_t)i) || sim_write_dng(&f, &rig->camera, path, 2 * pow(.25, i), "1", 1700000000000000000))
                return 1;
            free(f.site);
        }
        for (int s = 0; s < rig->n_stops; s++) {
            fprintf(plan, "%s\n  {\"name\": \"s%d\", \"yaw_deg\": %g, \"pitch_deg\": %g, \"frames\": [", s ? "," : "", s, rig->yaw_deg[s], rig->pitch_deg[s]);
            for (int i = 0; i < 7; i++)
                fprintf(plan, "%s{\"file\": \"%s_%d.dng\", \"exposure_s\": %.17g}", i ? ", " : "", rig->name, i, 2 * pow(.25, i));
            fprintf(plan, "]}");
        }
        fprintf(plan, "]}\n");
        fclose(plan);
        free(seen);
    }
    image_free(&studio);
    return 0;
}

static int take(const char *panorama, const char *dir)
{
    struct panorama p;
    struct rig rig = fisheye(3, 1400);
    mkdir(dir, 0777);
    char path_true[1024];
    if (panorama_read(&p, panorama))
        return 1;
    spread_points(&p.image);
    snprintf(path_true, sizeof(path_true), "%s/true.exr", dir);
    if (image_write_exr(&p.image, path_true, IMAGE_FLOAT, IMAGE_ZIP))
        return 1;
    const double metered_s = metered_time(&p.image);
    FILE *plan = open_plan(dir, "panorama.json");
    write_lens(plan, &rig.camera.lens);
    for (int s = 0; s < rig.n_stops; s++) {
        struct raw_frame f[FRAMES_MAX];
        struct sim_camera c = rig.camera;
        bool needs_nd = false;
        int metered;
        c.yaw_deg = rig.yaw_deg[s], c.pitch_deg = rig.pitch_deg[s];
        float *seen = sim_see(&p.image, &c, 4);
        const int n = shoot_stop(f, seen, &c, metered_s, (uint64_t)s, &needs_nd, &metered);
        fprintf(plan, "%s\n  {\"name\": \"s%d\", \"yaw_deg\": %g, \"pitch_deg\": %g, \"frames\": [", s ? "," : "", s, c.yaw_deg, c.pitch_deg);
        for (int i = 0; i < n; i++) {
            char path[1024];
            snprintf(path, sizeof(path), "%s/s%d_%d.dng", dir, s, i);
            if (sim_write_dng(f + i, &c, path, f[i].exposure_s, "1", 1700000000000000000 + (s * 100 + i) * 1000000000ll))
                return 1;
            fprintf(plan, "%s{\"file\": \"s%d_%d.dng\", \"exposure_s\": %.17g}", i ? ", " : "", s, i, f[i].exposure_s);
            free(f[i].site);
        }
        fprintf(plan, "]}");
        free(seen);
    }
    fprintf(plan, "]}\n");
    fclose(plan);
    panorama_free(&p);
    return 0;
}

int main(int argc, char **argv)
{
    log_set_level(LOG_ERROR);
    if (argc >= 3 && strcmp(argv[1], "figures") == 0)
        return figures(argc - 2, argv + 2);
    if (argc >= 3 && strcmp(argv[1], "variance") == 0)
        return variances(argc - 2, argv + 2);
    if (argc == 3 && strcmp(argv[1], "frames") == 0)
        return frames(argv[2]);
    if (argc == 4 && strcmp(argv[1], "take") == 0)
        return take(argv[2], argv[3]);
    fprintf(stderr, "usage: bench_panorama figures PANORAMA... | variance PANORAMA... | frames DIR | take PANORAMA DIR\n");
    return 2;
}
