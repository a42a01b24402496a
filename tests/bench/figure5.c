// tests/bench/figure5.c - figure5 FOLDER: the paper's Figure 5 as CSV on stdout. D1 (diffuse, centred, known albedo) under N^ true lights
// is solved with 256, by the paper's method with one fixed w_sim from 1e-13 to 1, and by ours, which has no weight to set, from three
// starts. Takes are made in FOLDER once.
//
// N^ = 256 is solved with the very lights that made the pictures; 512 and 65536 with those cut from the panorama, as a studio would.
// Starts: all lights 1 m or 2 m away and the probe's rotation as start.json has it, 2 to 10 degrees off; or everything where it is.
#include "solver/synth.h"
#include "tests/studio.h"

enum { WIDTH_PX = 360, HEIGHT_PX = 240, TEXTURE = 64, N_LIGHTS = 256, HOLD_OUT = 7 };
static const int true_lights[] = { 256, 512, 65536 };
static const char *const start_names[] = { "1 m", "truth", "2 m" };
enum { N_STARTS = 3 };

static int make_take(const char *dir, int n_true)
{
    struct synth_settings synth = synth_defaults(1);
    if (!access(dir, F_OK))
        return 0;
    synth.n_true_lights = n_true, synth.width_px = WIDTH_PX, synth.height_px = HEIGHT_PX, synth.samples = 1;
    return synth_write(&synth, dir);
}

// Where each light is; one that comes from no wall is left at infinity.
static int put_at_truth(struct lights *l, const struct studio *s)
{
    struct judge_truth truth;
    const int err = judge_read_truth(&truth, s->take_dir);
    for (int i = 0; !err && i < l->n; i++) {
        struct judge_seen seen = { 0 };
        judge_add_light(&seen, &truth, &s->panorama, l, i);
        l->inverse_distance[i] = seen.met > 0 ? seen.sum / seen.met : 0;
    }
    memcpy(l->centre_m, truth.centre_m, sizeof(l->centre_m));
    memcpy(l->world_from_probe, truth.world_from_probe, sizeof(l->world_from_probe));
    return err;
}

static int solve_once(const struct studio *s, int n_true, int start, enum method method, double w_sim)
{
    static const double start_m[N_STARTS] = { 1, 0, 2 };
    struct joint_settings set = joint_defaults(method);
    struct joint_result r;
    struct judgement j;
    set.model = REFLECT_LAMBERT, set.albedo = ALBEDO_GIVEN, set.visibility = false;
    set.given_albedo[0] = set.given_albedo[1] = set.given_albedo[2] = .5;
    set.start_distance_m = start_m[start];
    if (method == METHOD_ALTERNATING)
        set.w_sim = w_sim;
    int err = studio_solve(&r, s, &set);
    if (err)
        return err;
    err = studio_judge(&j, s, &r);
    if (!err)
        printf("%d,%s,%s,%.3g,%.3g,%.4f,%.4f,%.4f,%.4f,%.4f,%.5f,%.5f,%d,%s\n", n_true, method_names[method], start_names[start], r.w_sim,
               r.w_sim_sum, j.distance_percent, j.distance_median_percent, j.position_cm, j.centre_cm, j.rotation_deg,
               r.rmse_fit_percent, r.rmse_held_out_percent, r.n_jacobians, r.stop_reason);
    fflush(stdout);
    joint_result_free(&r);
    return err;
}

static int sweep(const char *folder, int n_true)
{
    char dir[PATH_MAX - 64];
    struct studio s;
    struct lights rough, truth;
    snprintf(dir, sizeof(dir), "%s/D1-%d", folder, n_true);
    int err = make_take(dir, n_true);
    if (err)
        return err;
    err = studio_open(&s, dir, TEXTURE, n_true == N_LIGHTS ? 0 : N_LIGHTS, 1, HOLD_OUT);
    truth = rough = s.lights;
    if (!err) {
        truth.inverse_distance = calloc((size_t)rough.n, sizeof(double));
        err = truth.inverse_distance ? put_at_truth(&truth, &s) : -ENOMEM;
    }
    for (int start = 0; !err && start < N_STARTS; start++) {
        s.lights = start == 1 ? truth : rough;
        for (int k = -26; !err && k <= 0; k++)
            err = solve_once(&s, n_true, start, METHOD_ALTERNATING, pow(10, .5 * k));
    }
    s.lights = rough;
    if (truth.inverse_distance != rough.inverse_distance)
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
    puts("true_lights,method,start,w_sim_mean,w_sim_sum,distance_percent,distance_median_percent,position_cm,centre_cm,rotation_deg,"
         "rmse_fit_percent,rmse_held_out_percent,jacobians,stop");
    for (int i = 0; i < 3; i++)
        if (sweep(argv[1], true_lights[i]))
            return 1;
    return 0;
}
