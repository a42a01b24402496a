// tests/bench/true_lights.c - true_lights TAKE N OUT.json: N lights cut from a take's panorama, in the true pose, each as far as the panel
// that its pixels show: what stage 2 can do is then told from what stage 1 did.
#include "tests/judgement.h"

int main(int argc, char **argv)
{
    char path[PATH_MAX];
    struct judge_truth truth;
    struct panorama panorama = {0};
    struct lights l = {0};
    struct take *take = NULL;
    if (argc != 4) {
        fprintf(stderr, "usage: true_lights TAKE N OUT.json\n");
        return 2;
    }
    int err = judge_read_truth(&truth, argv[1]);
    if (!err)
        err = take_open(&take, argv[1]);
    if (!err)
        err = take_require(take, TAKE_PANORAMA);
    if (!err)
        err = panorama_read(&panorama, take->panorama_path);
    if (!err)
        err = lights_median_cut(&l, &panorama, atoi(argv[2]));
    if (!err && judge_has(path, argv[1], "truth/probe.json"))
        err = lights_read_pose(&l, NULL, path);
    for (int i = 0; !err && i < l.n; i++) {
        struct judge_seen seen = {0};
        judge_add_light(&seen, &truth, &panorama, &l, i);
        l.inverse_distance[i] = seen.met > .5 * seen.all ? seen.sum / seen.met : 1. / 3;
    }
    if (!err)
        err = lights_write_json(&l, argv[3]);
    lights_free(&l), panorama_free(&panorama), take_close(take);
    return err != 0;
}
