// tests/bench/figure5.c - figure5 FOLDER: the paper's Figure 5 as CSV on stdout. D1 (diffuse, centred, known albedo) under N^ true lights
// is solved with 256, by the paper's method with one fixed w_sim from 1e-14 to 1, and by ours, which has no weight to set, from three
// starts. Takes are made in FOLDER once.
//
// N^ = 256 is solved with the very lights that made the pictures; 512 and 65536 with those cut from the panorama, as a studio would, and
// by ours with its four sub-lights each. Starts: all lights 1 m or 2 m away and the probe's rotation as start.json has it, 2 to 10 degrees
// off; or everything where it is (ours then takes centre and rotation, and finds the distances' start itself).
#include "solver/synth.h"
#include "tests/studio.h"

enum { WIDTH_PX = 360, HEIGHT_PX = 240, TEXTURE = 64, N_LIGHTS = 256, N_SUB = 4, HOLD_OUT = 7 };
static const int true_lights[] = { 256, 512, 65536 };
enum { N_STARTS = 3, FROM_TRUTH = 1 };
static const char *const start_names[N_STARTS] = { "1 m", "truth", "2 m" };

static int make_take(const char *dir, int n_true)
{
    struct synth_settings synth = synth_defaults(1);
    if (!access(dir, F_OK))
        return 0;
    synth.n_true_lights = n_true, synth.width_px = WIDTH_PX, synth.height_px = HEIGHT_PX, synth.samples = 1;
    return synth_write(&synth, dir);
}

// Where each light is; one that comes from no wall stays at infinity.
static int put_at_truth(struct lights *l, const struct studio *s)
{
    struct judge_truth truth;
    const int err = judge_read_truth(&truth, s->take_dir);
    if (err)
        return err;
    for (int i = 0; i < l->n; i++) {
        struct judge_seen seen = { 0 };
        judge_add_light(&seen, &truth, &s->panorama, l, i);
        l->inverse_distance[i] = seen.met > 0 ? seen.sum / seen.met : 0;
    }
    memcpy(l->centre_m, truth.centre_m, sizeof(l->centre_m));
    memcpy(l->world_from_probe, truth.world_from_probe, sizeof(l->world_from_probe));
    return 0;
}

// w_sim < 0: the method's own.
static int solve_once(const struct studio *s, int n_true, int start, enum method method, double w_sim)
{
    static const double start_m[N_STARTS] = { 1, 0, 2 };
    struct joint_settings set = joint_defaults(method);
    struct joint_result r;
    struct judgement j;
    set.model = REFLECT_LAMBERT, set.albedo = ALBEDO_GIVEN;
    set.given_albedo[0] = set.given_albedo[1] = set.given_albedo[2] = .5;
    set.start_distance_m = start_m[start];
    if (w_sim >= 0)
        set.w_sim = w_sim;
    int err = studio_solve(&r, s, &set);
    if (err)
        return err;
    err = studio_judge(&j, s, &r);
    if (!err)
        printf("%d,%s,%s,%.3g,%.3g,%.3f,%.3f,%.3f,%.3f,%.3f,%.3f,%.4f,%.4f,%d,%s\n", n_true, method_names[method], start_names[start],
               r.w_sim, r.w_sim_sum, j.distance_weighted_percent, j.distance_percent, j.distance_median_percent, j.position_cm, j.centre_cm,
               j.rotation_deg, r.rmse_fit_percent, r.rmse_held_out_percent, r.n_jacobians, r.stop_reason);
    joint_result_free(&r);
    return fflush(stdout) ? -EIO : err;
}

// From every start: by the paper's method over all weights, or by ours.
static int solve_all(const char *take_dir, int n_true, enum method method)
{
    const bool exact = n_true == N_LIGHTS;
    struct studio s;
    struct lights rough, truth;
    int err = studio_open(&s, take_dir, TEXTURE, exact ? 0 : N_LIGHTS, !exact && method == METHOD_JOINT ? N_SUB : 1, HOLD_OUT);
    rough = truth = s.lights;
    truth.inverse_distance = NULL;
    if (!err) {
        truth.inverse_distance = calloc((size_t)rough.n, sizeof(double));
        err = truth.inverse_distance ? put_at_truth(&truth, &s) : -ENOMEM;
    }
    for (int start = 0; !err && start < N_STARTS; start++) {
        s.lights = start == FROM_TRUTH ? truth : rough;
        if (method == METHOD_JOINT)
            err = solve_once(&s, n_true, start, method, -1);
        for (int k = -14; !err && method == METHOD_ALTERNATING && k <= 0; k++)
            err = solve_once(&s, n_true, start, method, pow(10, k));
    }
    s.lights = rough;
    free(truth.inverse_distance);
    studio_close(&s);
    return err;
}

int main(int argc, char **argv)
{
    if (argc != 2) {
        fprintf(stderr, "usage: figure5 FOLDER\n");
        return 2;
    }
    puts("true_lights,method,start,w_sim_mean,w_sim_sum,distance_weighted_percent,distance_percent,distance_median_percent,position_cm,"
         "centre_cm,rotation_deg,rmse_fit_percent,rmse_held_out_percent,jacobians,stop");
    for (int i = 0; i < 3; i++) {
        char name[32], dir[PATH_MAX];
        snprintf(name, sizeof(name), "D1-%d", true_lights[i]);
        if (judge_path(dir, argv[1], name) || make_take(dir, true_lights[i]) || solve_all(dir, true_lights[i], METHOD_ALTERNATING) ||
            solve_all(dir, true_lights[i], METHOD_JOINT))
            return 1;
    }
    return 0;
}
