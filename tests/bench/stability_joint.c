// tests/bench/stability_joint.c - `make stability`: where stage 1 finds the lights, where it fails, and whether it says so.
//
// One synthetic studio per set (D2: albedo given; D3), its input made worse along one axis at a time, the rest as it comes from
// a careful operator: 5 degrees and 30 cm off, no noise. Every run is one process's own single thread;
// CSV on stdout, in the order of the plan whatever finished first; progress and a summary on stderr.
#include "solver/commands/arguments.h"
#include "solver/parallel.h"
#include "solver/synth.h"
#include "tests/stability.h"

#include <ctype.h>
#include <stdatomic.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/wait.h>

enum { MAX_VALUES = 10, MAX_SETS = 2, MAX_WORKERS = 64 };

// ---- what is tried ------------------------------------------------------------------------------

enum axis_id {
    AXIS_START, AXIS_W_SIM, AXIS_ROTATION, AXIS_CENTRE, AXIS_NOISE, AXIS_CAMERA, AXIS_BUMPS, AXIS_ROUGHNESS, AXIS_VIEWS, AXIS_GAIN,
    AXIS_GAIN_SOLVED, AXIS_CLIPPED, AXIS_MOVED, AXIS_MISSING, AXIS_MIRRORED, N_SINGLE, AXIS_MAP = N_SINGLE, AXIS_RANDOM, N_AXES
};

static const struct axis {
    const char *name;
    int n;
    double value[MAX_VALUES];
    bool too_alternating;
} axes[N_AXES] = {
    [AXIS_START] = {"start_m", 8, {0, .5, .7, 1, 1.5, 2.5, 4, 6}, false}, // 0: its own sweep
    [AXIS_W_SIM] = {"w_sim", 9, {1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12}, false},
    [AXIS_ROTATION] = {"rotation_deg", 6, {0, 4, 8, 12, 16, 20}, true},
    [AXIS_CENTRE] = {"centre_m", 6, {0, .2, .4, .6, .8, 1}, true},
    [AXIS_NOISE] = {"noise_percent", 6, {0, .3, 1, 2, 3, 5}, false},
    [AXIS_CAMERA] = {"camera_px", 5, {0, .25, .5, 1, 2}, false},
    [AXIS_BUMPS] = {"bumps_mm", 5, {0, .25, .5, 1, 2}, false},
    [AXIS_ROUGHNESS] = {"roughness_mm", 5, {0, .25, .5, 1, 2}, false},
    [AXIS_VIEWS] = {"views", 6, {8, 12, 20, 40, 60, 85}, false},
    [AXIS_GAIN] = {"gain_percent", 5, {0, 1, 2, 5, 10}, false},
    [AXIS_GAIN_SOLVED] = {"gain_solved_percent", 5, {0, 1, 2, 5, 10}, false},
    [AXIS_CLIPPED] = {"clipped_percent", 5, {0, 2, 5, 10, 20}, false},
    [AXIS_MOVED] = {"moved_mm", 6, {0, 1, 2, 5, 10, 20}, false},
    [AXIS_MISSING] = {"missing", 6, {-1, 0, 1, 2, 3, STRONGEST_LIGHT_MISSING}, false}, // -1: none; 100: one light of all
    [AXIS_MIRRORED] = {"mirrored", 2, {0, 1}, false},
    [AXIS_MAP] = {"map", 5, {0, 5, 10, 15, 20}, true},  // rotation; centre_in_map beside it
    [AXIS_RANDOM] = {"random", 1, {0}, true},           // rotation <= 15 degrees, centre <= .6 m, start .7 .. 4 m
};
static const double centre_in_map_m[] = {0, .25, .5, .75, 1};

struct plan {
    int set;
    enum axis_id axis;
    double value, value2;
    struct perturbation p;
};

struct done { // shared by all processes
    _Atomic int state; // 0: waits, 1: begun, 2: done
    struct stability_result r;
};

static struct settings {
    const char *sets, *only, *methods, *take, *takes;
    int n_seeds, n_random, n_workers;
    struct stability_size size;
    struct synth_settings synth;
} settings = {.sets = "D2,D3", .methods = "joint,alternating", .takes = "build/stability/takes", 
              .n_seeds = 2, .n_random = 100,
              .size = {.n_views = 40, .texture = 96, .thin = 3, .n_lights = 256, .n_sub = 4}};

static bool listed(const char *list, const char *name)
{
    const size_t n = strlen(name);
    for (const char *at = list; at; at = strchr(at, ',')) {
        at += *at == ',';
        if (!strncmp(at, name, n) && (at[n] == ',' || !at[n]))
            return true;
    }
    return false;
}

static struct perturbation careful(uint64_t seed, enum method method)
{
    return (struct perturbation){.seed = seed, .method = method, .rotation_deg = 5, .centre_m = .3, .missing = NOTHING_MISSING};
}

static struct perturbation perturbation_of(enum axis_id axis, double v, double v2, uint64_t seed, enum method method)
{
    struct perturbation p = careful(seed, method);
    switch (axis) {
    case AXIS_START: p.start_m = v; break;
    case AXIS_W_SIM: p.w_sim = v; break;
    case AXIS_ROTATION: p.rotation_deg = v; break;
    case AXIS_CENTRE: p.centre_m = v; break;
    case AXIS_NOISE: p.noise = v / 100; break;
    case AXIS_CAMERA: p.camera_px = v; break;
    case AXIS_BUMPS: p.bumps_mm = v; break;
    case AXIS_ROUGHNESS: p.roughness_mm = v; break;
    case AXIS_VIEWS: p.n_views = (int)v; break;
    case AXIS_GAIN: p.gain = v / 100; break;
    case AXIS_GAIN_SOLVED: p.gain = v / 100, p.solve_gain = true; break;
    case AXIS_CLIPPED: p.clipped = v / 100; break;
    case AXIS_MOVED: p.moved_mm = v; break;
    case AXIS_MISSING: p.missing = (int)v; break;
    case AXIS_MIRRORED: p.mirrored = v > 0; break;
    case AXIS_MAP: p.rotation_deg = v, p.centre_m = v2; break;
    case AXIS_RANDOM:
        p.rotation_deg = 15 * random_uniform(seed, 80, 0);
        p.centre_m = .6 * random_uniform(seed, 80, 1);
        // Every other one leaves the first distance to the method.
        p.start_m = seed % 2 || method == METHOD_ALTERNATING ? .7 + 3.3 * random_uniform(seed, 80, 2) : 0;
        break;
    default: break;
    }
    return p;
}

// Seeds outermost: a run that is stopped early has seen every point.
static int make_plan(struct plan *plan)
{
    static const char *const sets[MAX_SETS] = {"D2", "D3"};
    const bool both = !settings.take && listed(settings.sets, sets[0]) && listed(settings.sets, sets[1]);
    const int n_random = both ? (settings.n_random + 1) / 2 : settings.n_random, n_map = (settings.n_seeds + 1) / 2;
    int n = 0;
    for (int seed = 1; seed <= (n_random > settings.n_seeds ? n_random : settings.n_seeds); seed++)
        for (int set = 0; set < MAX_SETS; set++)
            for (int a = 0; a < N_AXES; a++)
                for (int m = METHOD_JOINT; m <= METHOD_ALTERNATING; m++) {
                    const struct axis *axis = &axes[a];
                    if (!(settings.take ? set == 0 : listed(settings.sets, sets[set])) || !listed(settings.methods, method_names[m]) ||
                        (settings.only && !listed(settings.only, axis->name)) || (m == METHOD_ALTERNATING && !axis->too_alternating) ||
                        seed > (a == AXIS_RANDOM ? n_random : a == AXIS_MAP ? n_map : settings.n_seeds))
                        continue;
                    for (int i = 0; i < axis->n; i++)
                        for (int k = 0; k < (a == AXIS_MAP ? 5 : 1); k++) {
                            const double v2 = a == AXIS_MAP ? centre_in_map_m[k] : 0;
                            if (plan)
                                plan[n] = (struct plan){set, (enum axis_id)a, axis->value[i], v2,
                                                        perturbation_of((enum axis_id)a, axis->value[i], v2, (uint64_t)seed, (enum method)m)};
                            n++;
                        }
                }
    return n;
}

// ---- CSV ----------------------------------------------------------------------------------------

static const char *set_name(int set)
{
    return settings.take ? "take" : set ? "D3" : "D2";
}

// What it is worth that it said so.
static const char *outcome_of(const struct stability_result *r)
{
    const bool good = r->success && !r->must_doubt;
    return good ? r->trusted ? "success" : "success_doubted" : r->trusted ? "dishonest" : "honest";
}

static void print_header(void)
{
    printf("set,axis,value,value2,seed,method,outcome,success,trusted,doubts,distance_percent,distance_median_percent,"
           "distance_weighted_percent,distance_weighted_median_percent,centre_cm,rotation_deg,theta_worst,rmse_fit_percent,"
           "rmse_held_out_percent,n_jacobians,seconds,stop,start_m,start_rotation_deg,start_centre_m,clipped_percent,"
           "level_percent,residual_percent,noise_percent,structure_percent,by_view_percent,by_normal_percent,by_mirror_percent,"
           "said_median_percent,said_mean_percent,patches_median_percent,patches_mean_percent,inflation,last_w_sim\n");
}

static void print_row(const struct plan *plan, const struct stability_result *r)
{
    static const char *const doubts[] = {"no_information", "few_views", "mirrored", "uncertain", "poor_fit"};
    printf("%s,%s,%g,%g,%d,%s,%s,%d,%d,", set_name(plan->set), axes[plan->axis].name, plan->value, plan->value2, (int)plan->p.seed,
           method_names[plan->p.method], r->err ? "error" : outcome_of(r), r->success, r->trusted);
    bool more = false;
    for (int bit = 0; bit < 32; bit++)
        if (r->doubts >> bit & 1) {
            if (bit < 5)
                printf("%s%s", more ? "+" : "", doubts[bit]);
            else
                printf("%sdoubt%d", more ? "+" : "", bit);
            more = true;
        }
    printf(",%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%d,%.2f,%s,%.4g,%.4g,%.4g,%.4g", r->distance_percent,
           r->distance_median_percent, r->distance_weighted_percent, r->distance_weighted_median_percent, r->centre_cm,
           r->rotation_deg, r->theta_worst, r->rmse_fit_percent, r->rmse_held_out_percent, r->n_jacobians, r->seconds, r->stop,
           plan->p.start_m, plan->p.rotation_deg, plan->p.centre_m, r->clipped_percent);
    const struct misfit *m = &r->misfit;
    printf(",%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g,%.4g\n", 100 * m->level, 100 * m->residual, 100 * m->noise, 100 * m->structure,
           100 * m->by_view, 100 * m->by_normal, 100 * m->by_mirror, r->said_percent[0],
           r->said_percent[1], r->patches_percent[0], r->patches_percent[1], r->inflation, r->w_sim);
}

// ---- takes and workers --------------------------------------------------------------------------

// In a process of its own: what it leaves behind (threads, Embree) is not inherited by the workers.
static int make_take(char dir[PATH_MAX], int data_set)
{
    struct synth_settings synth = settings.synth;
    synth.data_set = data_set;
    snprintf(dir, PATH_MAX, "%s/D%d-seed%d-%dx%d-%d-views-%d-lights", settings.takes, data_set, (int)synth.seed, synth.width_px,
             synth.height_px, synth.n_views, synth.n_true_lights);
    if (!access(dir, F_OK)) // it has this name only when it is complete
        return 0;
    fprintf(stderr, "stability: making %s\n", dir);
    const pid_t child = fork();
    if (!child)
        _exit(synth_write(&synth, dir) ? EXIT_FAILURE : EXIT_SUCCESS);
    int status;
    return child > 0 && waitpid(child, &status, 0) == child && WIFEXITED(status) && !WEXITSTATUS(status) ? 0 : -EIO;
}

static int work(const struct plan *plan, int n, struct done *done, _Atomic int *next, const char take[MAX_SETS][PATH_MAX], int report)
{
    struct studio studio[MAX_SETS] = {0};
    log_set_level(LOG_ERROR);
    for (int set = 0; set < MAX_SETS; set++)
        if (*take[set] && studio_open(&studio[set], take[set], &settings.size, 1))
            return EXIT_FAILURE;
    for (int i; (i = atomic_fetch_add(next, 1)) < n;) {
        atomic_store(&done[i].state, 1);
        stability_run(&done[i].r, &studio[plan[i].set], &plan[i].p, 1);
        atomic_store(&done[i].state, 2);
        if (write(report, &i, sizeof(i)) != sizeof(i))
            return EXIT_FAILURE;
    }
    for (int set = 0; set < MAX_SETS; set++)
        if (*take[set])
            studio_close(&studio[set]);
    return EXIT_SUCCESS;
}

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// Prints rows as soon as all before them are there.
static void collect(const struct plan *plan, int n, const struct done *done, int report)
{
    const double begin = now_s();
    int n_done = 0, n_printed = 0, which;
    while (read(report, &which, sizeof(which)) == sizeof(which)) {
        n_done++;
        while (n_printed < n && atomic_load(&done[n_printed].state) == 2) {
            print_row(&plan[n_printed], &done[n_printed].r);
            n_printed++;
        }
        fflush(stdout);
        if (n_done % 20 == 0 || n_done == n)
            fprintf(stderr, "stability: %d of %d runs, %.1f min, about %.1f min left\n", n_done, n, (now_s() - begin) / 60,
                    (now_s() - begin) / 60 * (n - n_done) / n_done);
    }
    for (; n_printed < n; n_printed++) // a worker ended with a run in hand
        if (atomic_load(&done[n_printed].state) == 2)
            print_row(&plan[n_printed], &done[n_printed].r);
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void summarise(const struct plan *plan, int n, const struct done *done)
{
    double error[n];
    for (int set = 0; set < MAX_SETS; set++)
        for (int m = METHOD_JOINT; m <= METHOD_ALTERNATING; m++)
            for (int a = 0; a < N_AXES; a++) {
                int count[4] = {0}, runs = 0, broken = 0, near = 0;
                for (int i = 0; i < n; i++) {
                    const struct stability_result *r = &done[i].r;
                    if (plan[i].set != set || (int)plan[i].p.method != m || (int)plan[i].axis != a || atomic_load(&done[i].state) != 2)
                        continue;
                    if (r->err) {
                        broken++;
                        continue;
                    }
                    const bool good = r->success && !r->must_doubt;
                    count[2 * !good + !r->trusted]++;
                    near += r->distance_median_percent < stability_success_percent;
                    error[runs++] = r->distance_percent;
                }
                if (!runs && !broken)
                    continue;
                qsort(error, (size_t)runs, sizeof(double), by_value);
                fprintf(stderr, "%s %-11s %-20s %3d runs: %3d success (%.0f %%), %d success but doubted, %d failed and doubted, %d FAILED AND TRUSTED; "
                        "median light below 5 %%: %d; mean error, median of runs %.1f %%%s\n", set_name(set), method_names[m], axes[a].name, runs, count[0] + count[1],
                        100. * (count[0] + count[1]) / (runs ? runs : 1), count[1], count[3], count[2], near, runs ? error[runs / 2] : NAN,
                        broken ? "; some ended in an error" : "");
            }
}

// ---- options ------------------------------------------------------------------------------------

static const struct argp_option options[] = {
    {"sets", 's', "LIST", 0, "of D2,D3 (both)", 0},
    {"only", 'o', "AXIS,...", 0, "of the axes as they are named in the CSV; also map, random (all)", 0},
    {"methods", 'm', "LIST", 0, "of joint,alternating (both, the latter where it is compared)", 0},
    {"starts", 'n', "N", 0, "random starts, shared by the sets (100)", 0},
    {"seeds", 'k', "N", 0, "per point of the other axes (2; the map: half as many)", 0},
    {"views", 'v', "N", 0, "fitted and held out (40)", 0},
    {"texture", 't', "N", 0, "texels a side (96)", 0},
    {"thin", 'i', "K", 0, "of K x K texels one is looked at (3)", 0},
    {"lights", 'l', "N", 0, "a power of two (256)", 0},
    {"sub-lights", 'u', "K", 0, "each light is K for joint, 1 for alternating (4)", 0},
    {"true-lights", 'T', "N", 0, "of the synthetic studio (4096)", 0},
    {"size", 'z', "WxH", 0, "of its pictures (240x160)", 0},
    {"seed", 'S', "N", 0, "of the synthetic studio (1)", 0},
    {"take", 'd', "DIR", 0, "an existing take instead", 0},
    {"takes", 'D', "DIR", 0, "where synthetic ones are made and kept (build/stability/takes)", 0},
    {"workers", 'j', "N", 0, "processes (all cores)", 0},
    {0},
};

static void check_list(const struct argp_state *state, const char *option, const char *text, const char *const *names, int n)
{
    const char *at = text;
    for (bool last = false; !last;) {
        const size_t length = strcspn(at, ",");
        int k = 0;
        while (k < n && !(strlen(names[k]) == length && !strncmp(names[k], at, length)))
            k++;
        if (k == n)
            argp_error(state, "%s '%s': there is no '%.*s'", option, text, (int)length, at);
        last = !at[length];
        at += length + 1;
    }
}

static error_t parse_option(int key, char *text, struct argp_state *state)
{
    static const char *const sets[] = {"D2", "D3"};
    const char *names[N_AXES];
    for (int a = 0; a < N_AXES; a++)
        names[a] = axes[a].name;
    switch (key) {
    case 's': check_list(state, "--sets", text, sets, 2); settings.sets = text; return 0;
    case 'o': check_list(state, "--only", text, names, N_AXES); settings.only = text; return 0;
    case 'm': check_list(state, "--methods", text, method_names, 2); settings.methods = text; return 0;
    case 'n': settings.n_random = (int)argument_integer(state, "--starts", text, 0, 10000); return 0;
    case 'k': settings.n_seeds = (int)argument_integer(state, "--seeds", text, 0, 1000); return 0;
    case 'v': settings.size.n_views = (int)argument_integer(state, "--views", text, 8, 85); return 0;
    case 't': settings.size.texture = (int)argument_integer(state, "--texture", text, 8, 1024); return 0;
    case 'i': settings.size.thin = (int)argument_integer(state, "--thin", text, 1, 64); return 0;
    case 'l': settings.size.n_lights = argument_power_of_two(state, "--lights", text, 1024); return 0;
    case 'u': settings.size.n_sub = argument_power_of_two(state, "--sub-lights", text, 64); return 0;
    case 'T': settings.synth.n_true_lights = (int)argument_integer(state, "--true-lights", text, 16, 65536); return 0;
    case 'z': argument_size(state, "--size", text, 16, 8192, &settings.synth.width_px, &settings.synth.height_px); return 0;
    case 'S': settings.synth.seed = (uint64_t)argument_integer(state, "--seed", text, 0, INT32_MAX); return 0;
    case 'd': settings.take = text; return 0;
    case 'D': settings.takes = text; return 0;
    case 'j': settings.n_workers = (int)argument_integer(state, "--workers", text, 1, MAX_WORKERS); return 0;
    case ARGP_KEY_ARG: argp_error(state, "'%s': no arguments are expected", text); return 0;
    default: return ARGP_ERR_UNKNOWN;
    }
}

int main(int argc, char **argv)
{
    const struct argp argp = {.options = options, .parser = parse_option,
                              .doc = "Where stage 1 fails, and whether it says so: CSV on stdout, a summary on stderr."};
    char take[MAX_SETS][PATH_MAX] = {{0}};
    settings.synth = synth_defaults(2);
    settings.synth.n_true_lights = 4096, settings.synth.panorama_width_px = 512, settings.synth.texture_size = 128;
    settings.synth.width_px = 240, settings.synth.height_px = 160, settings.synth.samples = 1;
    argp_err_exit_status = 2;
    argp_parse(&argp, argc, argv, 0, NULL, NULL);
    if (settings.n_workers < 1)
        settings.n_workers = parallel_n_cores() < MAX_WORKERS ? parallel_n_cores() : MAX_WORKERS;
    const int n = make_plan(NULL);
    struct plan *plan = calloc((size_t)n + 1, sizeof(*plan));
    const size_t n_bytes = sizeof(_Atomic int) + ((size_t)n + 1) * sizeof(struct done);
    void *shared = mmap(NULL, n_bytes, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    int report[2];
    if (!plan || shared == MAP_FAILED || pipe(report)) {
        perror("stability");
        return EXIT_FAILURE;
    }
    struct done *done = shared;
    _Atomic int *next = (_Atomic int *)(done + n + 1);
    make_plan(plan);
    if (settings.take)
        snprintf(take[0], PATH_MAX, "%s", settings.take);
    for (int set = 0; !settings.take && set < MAX_SETS; set++)
        if (listed(settings.sets, set ? "D3" : "D2") && make_take(take[set], set + 2))
            return EXIT_FAILURE;
    fprintf(stderr, "stability: %d runs of %d views %dx%d, texture %d (one texel of %d x %d), %d lights x %d, %d true lights; %d at a time\n", n,
            settings.size.n_views, settings.synth.width_px, settings.synth.height_px, settings.size.texture, settings.size.thin, settings.size.thin, settings.size.n_lights,
            settings.size.n_sub, settings.synth.n_true_lights, settings.n_workers);
    print_header();
    fflush(stdout);
    for (int w = 0; w < settings.n_workers; w++) {
        const pid_t child = fork();
        if (!child && close(report[0]) == 0)
            _exit(work(plan, n, done, next, take, report[1]));
        if (child < 0)
            perror("stability: fork");
    }
    close(report[1]);
    collect(plan, n, done, report[0]);
    bool well = true;
    for (int status; wait(&status) > 0;)
        well = well && WIFEXITED(status) && !WEXITSTATUS(status);
    summarise(plan, n, done);
    for (int i = 0; i < n; i++)
        if (atomic_load(&done[i].state) != 2 || done[i].r.err) {
            fprintf(stderr, "stability: %s %s %g, seed %d: %s\n", set_name(plan[i].set), axes[plan[i].axis].name, plan[i].value,
                    (int)plan[i].p.seed, atomic_load(&done[i].state) == 2 ? strerror(-done[i].r.err) : "no result");
            well = false;
        }
    if (!well)
        fprintf(stderr, "stability: not all runs came to their end\n");
    free(plan);
    return well && !fflush(stdout) ? EXIT_SUCCESS : EXIT_FAILURE;
}
