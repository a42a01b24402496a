// solver/commands/brdf.c - `rigsolve brdf CASES.csv`: the Disney BRDF with its derivatives for a table of cases.
//
// The reference prints what disney.c gives. A float kernel is shown one light of irradiance 1, in the surface's own frame (so that
// directions are rounded once), and its L = f <n,l> is divided by <n,l>.
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/csv.h"
#include "solver/disney.h"
#include "solver/kernels/kernels.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <argp.h>
#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct settings {
    const char *cases, *out, *kernel;
    enum disney_variant variant;
    bool check, json;
};

static const struct argp_option options[] = {
    { "kernel", 'k', "NAME", 0, "reference (double, default), portable, avx2 or avx512 (float)", 0 },
    { "variant", 'v', "YEAR", 0, "form of the masking term G: 2017 (default) or 2012", 0 },
    { "output", 'o', "FILE", 0, "write the table to FILE instead of standard output", 0 },
    { "check", 'c', NULL, 0,
      "compare with the f_ and df_ columns of CASES.csv and print the errors instead of the table; exit code 1 above the bound", 0 },
    { "json", 'j', NULL, 0, "print the errors as JSON (implies --check)", 0 },
    { 0 },
};
static const char doc[] =
    "Evaluate the Disney BRDF f (no cosine, per steradian) and its analytic derivatives for a table of cases.\v"
    "CASES.csv has a header line; columns are found by name, others are ignored: n_x n_y n_z (normal), tx_x .. (tangent), "
    "ty_x .. (bitangent), v_x .. (to the camera), l_x .. (to the light), albedo_r albedo_g albedo_b, and metallic subsurface "
    "specular roughness specularTint anisotropic sheen sheenTint clearcoat clearcoatGloss, each in [0,1].\n\n"
    "The table printed has f_r f_g f_b, df_C_dPARAMETER, df_C_dalbedo_C and, from the reference, df_C_dl_x .. (l stays a unit "
    "vector: across l) and df_C_dn_x .. (n turns and takes the tangents along), 17 digits, one row per case, in order.\n\n"
    "Bounds of --check: reference, 1e-9 of each value; float kernels, RMS 1e-6 and maximum 1e-4 of the larger of the arriving "
    "light and the case's largest entry, both as radiance (f <n,l>).";

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
    static const char *const kernels[] = { "reference", "portable", "avx2", "avx512" }, *const variants[] = { "2017", "2012" };
    struct settings *s = state->input;
    switch (key) {
    case 'k':
        s->kernel = kernels[argument_choice(state, "--kernel", arg, kernels, 4)];
        return 0;
    case 'v':
        s->variant = argument_choice(state, "--variant", arg, variants, 2) ? DISNEY_2012 : DISNEY_2017;
        return 0;
    case 'o':
        s->out = arg;
        return 0;
    case 'j':
        s->json = true;
        s->check = true;
        return 0;
    case 'c':
        s->check = true;
        return 0;
    case ARGP_KEY_ARG:
        if (s->cases)
            argp_error(state, "one table of cases at a time: '%s' is one too many", arg);
        s->cases = arg;
        return 0;
    case ARGP_KEY_END:
        if (!s->cases)
            argp_error(state, "expected a table of cases");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

// What is printed, in order: f, theta, albedo, light, normal. Kernels give the first N_SHADED.
enum { N_SHADED = 3 + 3 * DISNEY_N + 9, N_VALUES = N_SHADED + 18, NAME_LENGTH = 40 };
static_assert(sizeof(struct disney_gradient) == N_VALUES * sizeof(double), "the names below follow the struct");
static_assert(offsetof(struct shade_jacobian, own) == N_SHADED * sizeof(float), "the names below follow the struct");

static void name_values(char names[N_VALUES][NAME_LENGTH])
{
    static const char rgb[] = "rgb", xyz[] = "xyz";
    int n = 0;
    for (int k = 0; k < 3; k++)
        snprintf(names[n++], NAME_LENGTH, "f_%c", rgb[k]);
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < DISNEY_N; i++)
            snprintf(names[n++], NAME_LENGTH, "df_%c_d%s", rgb[k], disney_parameter_names[i]);
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++)
            snprintf(names[n++], NAME_LENGTH, "df_%c_dalbedo_%c", rgb[k], rgb[i]);
    for (int which = 0; which < 2; which++)
        for (int k = 0; k < 3; k++)
            for (int i = 0; i < 3; i++)
                snprintf(names[n++], NAME_LENGTH, "df_%c_d%c_%c", rgb[k], "ln"[which], xyz[i]);
}

enum { N, TX, TY, V, L, ALBEDO, N_VECTORS };
static const char *const vector_names[N_VECTORS] = { "n_", "tx_", "ty_", "v_", "l_", "albedo_" };

struct columns {
    int vector[N_VECTORS][3], theta[DISNEY_N];
    int expected[N_VALUES]; // -ENOENT where the table has none
};

struct one_case {
    double vector[N_VECTORS][3];
    struct disney material;
    double expected[N_VALUES]; // NaN where the table has none
};

static int find_columns(struct columns *c, const struct csv *csv, char names[N_VALUES][NAME_LENGTH])
{
    for (int i = 0; i < N_VECTORS; i++)
        for (int j = 0; j < 3; j++) {
            char name[NAME_LENGTH];
            snprintf(name, sizeof(name), "%s%c", vector_names[i], i == ALBEDO ? "rgb"[j] : "xyz"[j]);
            c->vector[i][j] = csv_require(csv, name);
            if (c->vector[i][j] < 0)
                return c->vector[i][j];
        }
    for (int i = 0; i < DISNEY_N; i++) {
        c->theta[i] = csv_require(csv, disney_parameter_names[i]);
        if (c->theta[i] < 0)
            return c->theta[i];
    }
    for (int i = 0; i < N_VALUES; i++)
        c->expected[i] = csv_find(csv, names[i]);
    return 0;
}

// Directions are unit, and the frame orthonormal, to this much.
static const double unit_tolerance = 1e-6;

static int check_directions(const struct one_case *c, const struct csv *csv)
{
    for (int i = 0; i < ALBEDO; i++) {
        const double length = vec3_norm(c->vector[i]);
        if (fabs(length - 1) > unit_tolerance) {
            log_error("brdf: %s:%d: columns '%sx' to '%sz': a vector of length %.9g, expected 1 to within %g", csv->name,
                      csv->line, vector_names[i], vector_names[i], length, unit_tolerance);
            return -EINVAL;
        }
    }
    for (int i = N; i <= TY; i++)
        for (int j = i + 1; j <= TY; j++) {
            const double dot = vec3_dot(c->vector[i], c->vector[j]);
            if (fabs(dot) > unit_tolerance) {
                log_error("brdf: %s:%d: columns '%sx' and '%sx': their scalar product is %.3g, expected an orthonormal frame",
                          csv->name, csv->line, vector_names[i], vector_names[j], dot);
                return -EINVAL;
            }
        }
    return 0;
}

static int read_case(struct one_case *c, const struct columns *columns, const struct csv *csv, bool with_expected)
{
    int err;
    for (int i = 0; i < N_VECTORS; i++)
        for (int j = 0; j < 3; j++) {
            err = csv_number(csv, columns->vector[i][j], &c->vector[i][j]);
            if (err)
                return err;
        }
    for (int i = 0; i < 3; i++) {
        c->material.albedo[i] = c->vector[ALBEDO][i];
        if (!(c->material.albedo[i] >= 0 && c->material.albedo[i] <= 1e6)) {
            log_error("brdf: %s:%d: column 'albedo_%c': found %g, expected 0 or more", csv->name, csv->line, "rgb"[i],
                      c->material.albedo[i]);
            return -EINVAL;
        }
    }
    for (int i = 0; i < DISNEY_N; i++) {
        double *value = &c->material.theta[i];
        err = csv_number(csv, columns->theta[i], value);
        if (err)
            return err;
        if (!(*value >= 0 && *value <= 1)) {
            log_error("brdf: %s:%d: column '%s': found %g, expected a number in [0,1]", csv->name, csv->line,
                      disney_parameter_names[i], *value);
            return -EINVAL;
        }
    }
    for (int i = 0; i < N_VALUES; i++) {
        c->expected[i] = NAN;
        if (!with_expected || columns->expected[i] < 0)
            continue;
        err = csv_number(csv, columns->expected[i], &c->expected[i]);
        if (err)
            return err;
    }
    return check_directions(c, csv);
}

// A light of irradiance 1, one metre from its centre, and the arrays that a kernel wants; it moves from case to case.
struct bench {
    const struct kernels *kernels;
    struct light_arrays light;
    struct lit lit;
};

static int bench_new(struct bench *b, const struct kernels *kernels)
{
    double direction[1][3] = { { 0, 0, 1 } }, irradiance[1][3] = { { 1, 1, 1 } }, inverse_distance[1] = { 1 };
    const struct lights light = { .n = 1, .dir_probe = direction, .irradiance = irradiance,
                                  .inverse_distance = inverse_distance, .world_from_probe = { 1, 0, 0, 0, 1, 0, 0, 0, 1 } };
    *b = (struct bench){ .kernels = kernels };
    const int err = light_arrays_new(&b->light, &light);
    return err ? err : lit_new(&b->lit, 1);
}

static void bench_free(struct bench *b)
{
    light_arrays_free(&b->light);
    lit_free(&b->lit);
}

// Puts the light where a float view sees the case's own half vector: a sharp lobe would show the 6e-8 that v is rounded by. l is
// the unit vector sigma s - v with s = l+v of the case; a float direction holds it and a centre off by its remainder. Not at
// grazing angles, where nl and nv are to keep their digits instead.
static void place_light(struct light_arrays *light, const double l_exact[3], const double v_exact[3], const float v[3])
{
    double l[3] = { l_exact[0], l_exact[1], l_exact[2] };
    const double grazing = .01;
    if (l[2] > grazing && v_exact[2] > grazing) {
        const double rounded[3] = { (double)v[0], (double)v[1], (double)v[2] };
        double s[3];
        vec3_add_scaled(s, l, 1, v_exact);
        const double a = vec3_dot(s, s), b = vec3_dot(s, rounded), c = vec3_dot(rounded, rounded) - 1;
        const double sigma = (b + sqrt(b * b - a * c)) / a;
        for (int i = 0; i < 3; i++)
            l[i] = sigma * s[i] - rounded[i];
    }
    light->dx[0] = (float)l[0], light->dy[0] = (float)l[1], light->dz[0] = (float)l[2];
    light->centre_m[0] = (float)(l[0] - (double)light->dx[0]);
    light->centre_m[1] = (float)(l[1] - (double)light->dy[0]);
    light->centre_m[2] = (float)(l[2] - (double)light->dz[0]);
}

static void evaluate_kernel(struct bench *b, const struct one_case *c, double values[N_VALUES])
{
    static const struct surface_point surface = { .normal = { 0, 0, 1 }, .tangent = { 1, 0, 0 }, .bitangent = { 0, 1, 0 } };
    static const int axes[3] = { TX, TY, N };
    double l[3], view[3];
    float v[3];
    for (int i = 0; i < 3; i++) {
        l[i] = vec3_dot(c->vector[axes[i]], c->vector[L]);
        view[i] = vec3_dot(c->vector[axes[i]], c->vector[V]);
        v[i] = (float)view[i];
    }
    place_light(&b->light, l, view, v);
    struct shade_material m = { .variant = c->material.variant };
    for (int i = 0; i < DISNEY_N; i++)
        m.theta[i] = (float)c->material.theta[i];
    for (int i = 0; i < 3; i++)
        m.albedo[i] = (float)c->material.albedo[i];
    struct shade_jacobian out;
    b->kernels->gather(&b->lit, &b->light, &surface, NULL, NULL);
    b->kernels->shade_jacobian(&out, &b->lit, &surface, v, &m);
    float shaded[N_SHADED];
    memcpy(shaded, &out, sizeof(shaded));
    const double nl = l[2];
    for (int i = 0; i < N_SHADED; i++)
        values[i] = nl > 0 ? (double)shaded[i] / nl : 0;
}

static void evaluate_reference(const struct one_case *c, double values[N_VALUES])
{
    struct disney_frame frame;
    struct disney_gradient g;
    memcpy(frame.n, c->vector[N], sizeof(frame.n));
    memcpy(frame.x, c->vector[TX], sizeof(frame.x));
    memcpy(frame.y, c->vector[TY], sizeof(frame.y));
    disney_eval_gradient(&c->material, &frame, c->vector[L], c->vector[V], &g);
    memcpy(values, &g, sizeof(g));
}

struct errors {
    long n_cases, n_compared;
    double max, sum_of_squares;
    int worst_line, worst_value;
    double max_of_arriving; // float kernels: of the arriving light alone, which a lobe can exceed by 1e6
    bool relative;          // each to its own value
};

static void add_errors(struct errors *e, const struct one_case *c, const double values[N_VALUES], int n_values, int line)
{
    const double nl = fmax(vec3_dot(c->vector[N], c->vector[L]), 0);
    double scale = 1;
    for (int i = 0; i < n_values; i++)
        if (nl * fabs(c->expected[i]) > scale)
            scale = nl * fabs(c->expected[i]);
    e->n_cases++;
    for (int i = 0; i < n_values; i++) {
        const double expected = c->expected[i], difference = fabs(values[i] - expected);
        if (isnan(expected))
            continue;
        const double error = !e->relative          ? nl * difference / scale
                             : expected == 0       ? difference
                                                   : difference / fabs(expected);
        e->n_compared++;
        e->sum_of_squares += error * error;
        if (!e->relative)
            e->max_of_arriving = fmax(e->max_of_arriving, nl * difference);
        if (!(error <= e->max)) // NaN counts as the worst
            e->max = error, e->worst_line = line, e->worst_value = i;
    }
}

static int report(const struct errors *e, const struct settings *s, char names[N_VALUES][NAME_LENGTH])
{
    const double rms = sqrt(e->sum_of_squares / (double)e->n_compared);
    const double max_bound = e->relative ? 1e-9 : 1e-4, rms_bound = e->relative ? 1e-9 : 1e-6;
    const bool good = e->max <= max_bound && rms <= rms_bound;
    const char *of = e->relative ? "each value" : "the larger of arriving light and the case's largest entry";
    if (s->json) {
        struct json *doc_json = json_object();
        json_set_string(doc_json, "kernel", s->kernel);
        json_set_string(doc_json, "variant", disney_variant_name(s->variant));
        json_set_int(doc_json, "cases", e->n_cases);
        json_set_int(doc_json, "values", e->n_compared);
        json_set_string(doc_json, "relative_to", of);
        json_set_number(doc_json, "max_error", e->max);
        json_set_number(doc_json, "rms_error", rms);
        json_set_number(doc_json, "max_bound", max_bound);
        json_set_number(doc_json, "rms_bound", rms_bound);
        if (!e->relative)
            json_set_number(doc_json, "max_error_of_arriving_light", e->max_of_arriving);
        json_set_int(doc_json, "worst_line", e->worst_line);
        json_set_string(doc_json, "worst_column", e->worst_line ? names[e->worst_value] : "");
        json_set_bool(doc_json, "within_bounds", good);
        if (output_json("brdf", doc_json))
            return EXIT_FAILED;
    } else {
        printf("%s, %s: %ld values in %ld cases, relative to %s:\n", s->kernel, disney_variant_name(s->variant),
               e->n_compared, e->n_cases, of);
        printf("max %.3g (bound %g), RMS %.3g (bound %g)", e->max, max_bound, rms, rms_bound);
        if (e->worst_line)
            printf("; worst: line %d, %s", e->worst_line, names[e->worst_value]);
        if (!e->relative)
            printf("; max of the arriving light alone: %.3g", e->max_of_arriving);
        putchar('\n');
    }
    if (!good)
        log_error("brdf: %s: the %s is outside the bounds: max %.3g, RMS %.3g", s->cases, s->kernel, e->max, rms);
    return good ? EXIT_DONE : EXIT_FAILED;
}

// Prints one line per case to out, or adds up errors where out is NULL.
static int run(const struct settings *s, struct csv *csv, struct bench *bench, FILE *out, struct errors *errors,
               char names[N_VALUES][NAME_LENGTH])
{
    const bool reference = !bench->kernels;
    const int n_values = reference ? N_VALUES : N_SHADED;
    struct columns columns;
    int err = find_columns(&columns, csv, names);
    if (err)
        return err;
    for (int i = 0; out && i < n_values; i++)
        fprintf(out, "%s%s", i ? "," : "", names[i]);
    if (out)
        fputc('\n', out);
    for (;;) {
        struct one_case c = { .material.variant = s->variant };
        double values[N_VALUES];
        const int more = csv_next_row(csv);
        if (more <= 0)
            return more;
        err = read_case(&c, &columns, csv, errors != NULL);
        if (err)
            return err;
        if (reference)
            evaluate_reference(&c, values);
        else
            evaluate_kernel(bench, &c, values);
        for (int i = 0; out && i < n_values; i++)
            fprintf(out, "%s%.17g", i ? "," : "", values[i]);
        if (out)
            fputc('\n', out);
        if (errors)
            add_errors(errors, &c, values, n_values, csv->line);
    }
}

int command_brdf(int argc, char **argv)
{
    static const struct argp argp = { options, parse_option, "CASES.csv", doc, NULL, NULL, NULL };
    struct settings s = { .kernel = "reference", .variant = DISNEY_2017 };
    struct csv csv = { 0 };
    struct bench bench = { 0 };
    struct atomic_file file = { 0 };
    struct errors errors = { 0 };
    char names[N_VALUES][NAME_LENGTH];
    int result = EXIT_FAILED;

    if (argp_parse(&argp, argc, argv, 0, NULL, &s))
        return EXIT_USAGE;
    name_values(names);
    if (strcmp(s.kernel, "reference")) {
        const struct kernels *kernels = kernels_by_name(s.kernel);
        if (!kernels) {
            log_error("brdf: this CPU or this build lacks the kernel '%s': try portable", s.kernel);
            return EXIT_FAILED;
        }
        if (bench_new(&bench, kernels))
            goto done;
    }
    errors.relative = !bench.kernels;
    if (csv_open(&csv, s.cases) || (s.out && atomic_file_open(&file, s.out)))
        goto done;
    FILE *out = s.out ? file.stream : s.check ? NULL : stdout;
    if (run(&s, &csv, &bench, out, s.check ? &errors : NULL, names))
        goto done;
    if (s.check && !errors.n_compared) {
        log_error("brdf: %s: nothing to compare: no rows, or none of the columns f_r, df_r_dmetallic, ...", s.cases);
        goto done;
    }
    if (s.out && atomic_file_commit(&file))
        goto done;
    if (!s.out && out && (fflush(out) || ferror(out))) {
        log_error("brdf: cannot write the table to standard output");
        goto done;
    }
    result = s.check ? report(&errors, &s, names) : EXIT_DONE;
done:
    atomic_file_abandon(&file);
    csv_close(&csv);
    bench_free(&bench);
    return result;
}
