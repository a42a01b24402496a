// tests/test_rig_panorama.c - stories of panoramas on virtual time: whatever goes wrong, each stop ends with the frames it needs, or the
// take says what is missing.
#include "tests/rig_world.h"

enum { N = 3, CAMERA = N - 1, N_STOPS = 3 };

static enum head_kind head;

static void add_panorama(struct config *c)
{
    struct panorama_config *p = &c->panorama;
    snprintf(p->camera_name, sizeof(p->camera_name), "%s", c->camera[CAMERA].name);
    p->camera = CAMERA;
    p->head = head;
    p->lens = (struct lens){ .model = LENS_EQUISOLID, .width_px = 600, .height_px = 400, .focal_px = 141, .centre_px = { 300, 200 }, .circle_px = 200 };
    assert_int_equal(lens_init(&p->lens, "test"), 0);
    p->n_stops = N_STOPS;
    for (int i = 0; i < N_STOPS; i++)
        p->stop[i] = (struct config_stop){ 120 * i, i == 2 ? 10 : 0 };
    p->meter_s = 1. / 60;
    p->shortest_s = 1. / 8000;
    p->longest_s = 15;
    p->frames_max = 14;
    p->settle_ms = 800;
    c->trigger.kind = TRIGGER_SIMULATED;
}

static void begin(enum head_kind kind, uint64_t seed)
{
    head = kind;
    set_up_with(N, seed, add_panorama);
    w.abilities |= kind == HEAD_BOARD ? TRIGGER_HEAD : 0;
    rig_trigger_is(w.rig, w.now, w.abilities);
    w.shortest_s = 0x1p-13, w.longest_s = 32, w.f_number = 8;
    w.brightest = .8 * 0x1p12; // clips down to 1/4000 s
    w.darkest = .01;           // of white in a second
    open_all();
}

static int panorama_as(const char *id, char *why)
{
    const struct rig_take take = { id, "story", "2026-11-22T09:00:00Z", 1795338000000, "/takes", NULL, false };
    w.n_copies = 0;
    w.has_durable = false;
    for (int i = 0; i < N; i++)
        w.camera[i].take_first = w.camera[i].n_card + 1;
    return rig_panorama(w.rig, w.now, &take, why);
}

static const struct ledger *panorama(void)
{
    char why[200] = "";
    const int done = w.n_takes_done;
    if (panorama_as("20261122T090000_story", why))
        fail_msg("refused: %s", why);
    run(3600 * S, true);
    drain_actions();
    assert_false(rig_is_busy(w.rig));
    assert_int_equal(w.n_takes_done, done + 1);
    return rig_ledger(w.rig);
}

// Each frame of the plan was shot where and as the ledger says, its copy is here, and the ledger on disk is the rig's.
static void check(const struct ledger *l)
{
    int n_copied = 0;
    for (int e = 0; e < l->n_cameras; e++) {
        const struct ledger_camera *c = &l->camera[e];
        const struct ledger_exposure *x = &c->exposure;
        assert_true(c->is_exposure);
        for (int other = 0; other < e; other++)
            assert_string_not_equal(c->name, l->camera[other].name);
        for (int k = 0; k < c->n_objects; k++)
            n_copied += c->object[k].state == OBJECT_COPIED || c->object[k].state == OBJECT_DELETED;
        if (!c->expected || c->debt != DEBT_PAID || x->rejected) {
            assert_true(c->note[0] || l->state == TAKE_FAILED);
            continue;
        }
        const struct ledger_object *o = &c->object[x->object];
        const struct picture *p = &w.picture[object_number(&o->object)];
        char hex[33];
        hash_of(hex, CAMERA, object_number(&o->object));
        assert_string_equal(o->xxh128, hex);
        assert_true(!strncmp(o->file, "panorama/raw/", 13) && !strncmp(o->file + 13, c->name, strlen(c->name)));
        assert_true(p->exposure_s == x->wanted_s && p->exposure_s == x->facts.light.exposure_s);
        assert_true(p->yaw_deg == l->stop[x->stop].yaw_deg && p->pitch_deg == l->stop[x->stop].pitch_deg);
        assert_false(p->head_moved);
    }
    assert_int_equal(n_copied, w.n_copies);
    for (int a = 0; a < w.n_copies; a++)
        for (int b = 0; b < a; b++) {
            assert_int_not_equal(w.copy[a].object, w.copy[b].object);
            assert_string_not_equal(w.copy[a].file, w.copy[b].file);
        }
    if (!w.n_commit_fails) {
        assert_int_equal(l->state, w.durable.state);
        assert_int_equal(l->n_cameras, w.durable.n_cameras);
        assert_memory_equal(l->camera, w.durable.camera, (size_t)l->n_cameras * sizeof(*l->camera));
    }
}

// Nothing clips in the shortest of each stop, the longest is long enough, no step is missing, the shortest is there twice.
static void check_brackets(const struct ledger *l)
{
    for (int stop = 0; stop < l->n_stops; stop++) {
        double times[100] = { 0 };
        int n = 0;
        for (int e = 0; e < l->n_cameras; e++) {
            const struct ledger_camera *c = &l->camera[e];
            if (c->exposure.stop != stop || c->debt != DEBT_PAID || c->exposure.rejected)
                continue;
            int at = n++;
            for (; at > 0 && times[at - 1] > c->exposure.wanted_s; at--)
                times[at] = times[at - 1];
            times[at] = c->exposure.wanted_s;
        }
        assert_true(n >= 4);
        assert_true(w.brightest * times[0] <= .9);
        assert_true(times[0] == times[1]);
        for (int i = 2; i < n; i++)
            assert_true(times[i] > times[i - 1] && times[i] < 4.1 * times[i - 1]);
        const double e = w.darkest * times[n - 1] * 20000; // bracket.h's careful guess of a sensor
        assert_true(e / sqrt(e + 64) >= 10);
    }
}

// ---- stories --------------------------------------------------------------------------------------------------------------------------

static void every_stop_gets_the_exposures_it_needs(void **state)
{
    (void)state;
    static const enum head_kind heads[] = { HEAD_BOARD, HEAD_MANUAL };
    for (int k = 0; k < 2; k++) {
        begin(heads[k], 1);
        const struct ledger *l = panorama();
        check(l);
        if (l->state != TAKE_VERIFIED)
            fail_msg("%s", l->reason);
        check_brackets(l);
        assert_int_equal(l->kind, LEDGER_PANORAMA);
        assert_int_equal(w.n_head_moves, k ? 0 : N_STOPS);
        assert_int_equal(w.n_prompts, k ? N_STOPS : 0);
        assert_int_equal(w.n_steps[RIG_STEP_STOP_DONE], N_STOPS);
        assert_int_equal(w.n_steps[RIG_STEP_EXPOSE], l->n_cameras);
        assert_int_equal(w.camera[0].n_card, 0 % 3); // nobody else was pressed
        assert_int_equal(w.camera[1].n_card, 1 % 3);
        tear_down();
    }
}

static void in_a_dim_room_exposures_last_as_long_as_they_have_to(void **state)
{
    (void)state;
    begin(HEAD_BOARD, 1);
    w.brightest = .1;
    w.darkest = .0006; // the world checks that nobody speaks to the camera before the shutter, "15" on the dial, closes after 16 s
    const struct ledger *l = panorama();
    check(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    check_brackets(l);
    bool longest = false;
    for (int e = 0; e < l->n_cameras; e++)
        longest |= l->camera[e].exposure.wanted_s == 16;
    assert_true(longest);
    tear_down();
}

static void an_ordinary_take_does_without_the_panorama_camera(void **state)
{
    (void)state;
    begin(HEAD_BOARD, 2);
    w.camera[CAMERA].fault.dead = true;
    w.camera[CAMERA].open = false;
    const int n_before = w.camera[CAMERA].n_card;
    char why[200];
    const struct rig_take take = { "20261122T100000_x", "x", "", 0, "/takes", "20261122T090000_story", false };
    assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
    run(60 * S, true);
    drain_actions();
    const struct ledger *l = rig_ledger(w.rig);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_false(l->camera[CAMERA].expected);
    assert_int_equal(w.n_copies, N - 1);
    assert_int_equal(w.camera[CAMERA].n_card, n_before);
    assert_string_equal(l->panorama_take, "20261122T090000_story");
    tear_down();
}

// A camera whose dial ends sooner than the configuration: what it has is used, and what still clips is said.
static void a_light_that_clips_in_the_shortest_is_declared(void **state)
{
    (void)state;
    begin(HEAD_BOARD, 3);
    w.shortest_s = 0x1p-11;
    const struct ledger *l = panorama();
    check(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    bool declared = false;
    for (int i = 0; i < w.n_said; i++)
        declared |= strstr(w.said[i], "clip") && strstr(w.said[i], "neutral-density") && strstr(w.said[i], "stop 3 of 3");
    assert_true(declared);
    int n_noted = 0;
    for (int e = 0; e < l->n_cameras; e++)
        n_noted += strstr(l->camera[e].note, "clip") != NULL;
    assert_int_equal(n_noted, N_STOPS);
    tear_down();
}

// Each fault at each command, once.
static void one_fault_at_any_command_costs_no_stop(void **state)
{
    (void)state;
    for (int kind = CAMERA_CONFIGURE; kind <= CAMERA_FETCH; kind++)
        for (int fault = 0; fault < 5; fault++) {
            if (kind == CAMERA_TRIGGER)
                continue;
            begin(HEAD_BOARD, 100 + (uint64_t)(kind * 8 + fault));
            struct fault *f = &w.camera[CAMERA].fault;
            char why[200];
            assert_int_equal(panorama_as("20261122T090000_story", why), 0);
            run((int64_t)(uniform(0, 20) * S), true); // somewhere
            int *const which[] = { &f->hang[kind], &f->crash[kind], &f->lost[kind], &f->busy[kind], &f->fails[kind] };
            *which[fault] = fault >= 3 ? 2 : 1;
            f->trouble = CAMERA_CORRUPT;
            run(3600 * S, true);
            drain_actions();
            const struct ledger *l = rig_ledger(w.rig);
            check(l);
            if (l->state != TAKE_VERIFIED)
                fail_msg("%s with fault %d: %s", camera_command_name(kind), fault, l->reason);
            check_brackets(l);
            tear_down();
        }
}

static void without_a_line_of_its_own_its_driver_presses_it(void **state)
{
    (void)state;
    for (int fault = 0; fault < 6; fault++) {
        begin(HEAD_MANUAL, 70 + (uint64_t)fault);
        w.config.trigger.kind = TRIGGER_GPIO; // a common line for the others
        struct fault *f = &w.camera[CAMERA].fault;
        int *const which[] = { &f->hang[CAMERA_TRIGGER], &f->crash[CAMERA_TRIGGER], &f->lost[CAMERA_TRIGGER], &f->busy[CAMERA_TRIGGER], &f->fails[CAMERA_TRIGGER] };
        f->trouble = CAMERA_REFUSED;
        if (fault < 5)
            *which[fault] = 2;
        const struct ledger *l = panorama();
        check(l);
        if (l->state != TAKE_VERIFIED)
            fail_msg("fault %d: %s", fault, l->reason);
        check_brackets(l);
        assert_int_equal(w.n_fired, 0);
        assert_int_equal(w.camera[0].n_card, 0);
        tear_down();
    }
}

static void a_frame_that_is_missing_is_exposed_again(void **state)
{
    (void)state;
    for (int n_lost = 0; n_lost < 3; n_lost++)
        for (int n_closed = 0; n_closed < 3; n_closed++) {
            begin(HEAD_BOARD, 10);
            char why[200];
            assert_int_equal(panorama_as("20261122T090000_story", why), 0);
            run(9 * S, true);
            w.camera[CAMERA].fault.no_shot = n_closed;
            w.camera[CAMERA].fault.lost_events = n_lost;
            run(3600 * S, true);
            drain_actions();
            check(rig_ledger(w.rig));
            assert_int_equal(rig_ledger(w.rig)->state, TAKE_VERIFIED);
            check_brackets(rig_ledger(w.rig));
            tear_down();
        }
    begin(HEAD_BOARD, 11); // and one that never comes is named with its stop
    w.camera[CAMERA].fault.no_shot = -1;
    const struct ledger *l = panorama();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "stop 1 of 3"));
    assert_non_null(strstr(l->reason, "shutter"));
    tear_down();
}

static void a_turned_aperture_and_a_frame_of_another_time_are_not_used(void **state)
{
    (void)state;
    for (int story = 0; story < 2; story++) {
        begin(HEAD_BOARD, 12);
        char why[200];
        assert_int_equal(panorama_as("20261122T090000_story", why), 0);
        run(6 * S, true);
        const int n = w.camera[CAMERA].n_card;
        bool held = false;
        while (w.camera[CAMERA].n_card < n + 2) { // two exposures
            w.f_number = story ? 8 : 5.6;
            if (story && w.shutters_held && !held)
                w.shutter_set_s /= 4;
            held = w.shutters_held;
            run(10 * MS, true);
        }
        w.f_number = 8;
        run(3600 * S, true);
        drain_actions();
        const struct ledger *l = rig_ledger(w.rig);
        assert_int_equal(l->state, TAKE_VERIFIED);
        int n_rejected = 0;
        for (int e = 0; e < l->n_cameras; e++) {
            n_rejected += l->camera[e].exposure.rejected;
            if (l->camera[e].exposure.rejected)
                assert_non_null(strstr(l->camera[e].note, story ? "exposed for" : "aperture is f/5.6, f/8 before"));
        }
        assert_true(n_rejected >= 1);
        check_brackets(l);
        tear_down();
    }
    begin(HEAD_BOARD, 13); // who holds on to it is told, and the take can go on later
    char why[200];
    assert_int_equal(panorama_as("20261122T090000_story", why), 0);
    run(9 * S, true);
    w.f_number = 11;
    run(3600 * S, true);
    drain_actions();
    assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
    assert_non_null(strstr(rig_ledger(w.rig)->reason, "aperture"));
    tear_down();
}

static void a_head_that_sticks_is_asked_again_then_named(void **state)
{
    (void)state;
    for (int story = 0; story < 4; story++) {
        begin(HEAD_BOARD, 20 + (uint64_t)story);
        w.n_head_fails = story == 1 ? 2 : story == 2 ? 99 : 0;
        w.n_head_silent = story == 3 ? 2 : 0;
        const struct ledger *l = panorama();
        check(l);
        assert_int_equal(l->state, story == 2 ? TAKE_FAILED : TAKE_VERIFIED);
        if (story == 2)
            assert_non_null(strstr(l->reason, "head"));
        tear_down();
    }
}

static void raws_that_nobody_can_judge_end_it(void **state)
{
    (void)state;
    begin(HEAD_BOARD, 30);
    w.camera[CAMERA].fault.unreadable = -1;
    const struct ledger *l = panorama();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "LibRaw"));
    tear_down();
}

static void it_is_refused_where_it_cannot_work(void **state)
{
    (void)state;
    char why[200];
    begin(HEAD_BOARD, 31);
    rig_trigger_is(w.rig, w.now, w.abilities & ~TRIGGER_HEAD);
    assert_int_equal(panorama_as("x", why), -ENOTCONN);
    assert_non_null(strstr(why, "head"));
    rig_trigger_is(w.rig, w.now, -1);
    assert_int_equal(panorama_as("x", why), -ENOTCONN);
    assert_int_equal(rig_continue(w.rig, w.now, why), -EINVAL);
    tear_down();
    set_up(N, 32);
    assert_int_equal(panorama_as("x", why), -EINVAL);
    assert_non_null(strstr(why, "[panorama]"));
    tear_down();
}

static void cancelling_ends_it_with_what_is_here(void **state)
{
    (void)state;
    for (int t = 0; t < 200; t++) {
        begin(t & 1 ? HEAD_MANUAL : HEAD_BOARD, 40 + (uint64_t)t);
        char why[200];
        assert_int_equal(panorama_as("20261122T090000_story", why), 0);
        run((int64_t)(uniform(0, 30) * S), true);
        if (!rig_is_busy(w.rig)) {
            tear_down();
            continue;
        }
        rig_cancel(w.rig, w.now, why);
        run(100 * S, true);
        drain_actions();
        assert_false(rig_is_busy(w.rig));
        assert_int_equal(w.n_takes_done, 1);
        assert_string_equal(rig_prompt(w.rig), "");
        const struct ledger *l = rig_ledger(w.rig);
        assert_true(l->state == TAKE_FAILED || l->state == TAKE_VERIFIED);
        if (w.has_durable)
            check(l);
        tear_down();
    }
}

// ---- kill -9 ----------------------------------------------------------------------------------------------------------------------------

// As ledger_reconcile() does: what is here and whole is noted.
static void reconcile(struct ledger *l)
{
    for (int e = 0; e < l->n_cameras; e++)
        for (int k = 0; k < l->camera[e].n_objects; k++) {
            struct ledger_object *o = &l->camera[e].object[k];
            for (int n = 0; n < w.n_copies; n++)
                if (!strcmp(w.copy[n].file, o->file)) {
                    o->state = OBJECT_COPIED;
                    hash_of(o->xxh128, CAMERA, w.copy[n].object);
                }
        }
}

// The daemon dies; cameras, card, head and disk stay as they are. The next one opens the cameras.
static void die_and_rise(void)
{
    rig_free(w.rig);
    w.n_heap = 0;
    w.shutters_held = false;
    if (w.head_moves) // it still obeys
        later((int64_t)(uniform(500, 4000) * MS + 30 * (double)S), W_HEAD, -1, 0);
    w.silent_until_ns = 0;
    w.n_to_open = 0;
    for (int i = 0; i < N; i++)
        w.camera[i].worker = w.camera[i].open = w.camera[i].in_flight = false;
    w.n_head_silent = w.head_moves; // to one who is dead
    w.head_yaw_deg = 77; // somebody has moved it
    assert_int_equal(rig_create(&w.rig, &w.config), 0);
    rig_trigger_is(w.rig, w.now, w.abilities);
    rig_start(w.rig, w.now);
    run(30 * S, false);
}

static void killed_at_any_time_it_goes_on_where_it_was(void **state)
{
    (void)state;
    int n_killed = 0, n_adopted = 0;
    for (int ms = 0; ms < 60000; ms += 150) {
        begin(ms / 150 % 2 ? HEAD_MANUAL : HEAD_BOARD, 1000 + (uint64_t)ms);
        char why[200] = "";
        assert_int_equal(panorama_as("20261122T090000_story", why), 0);
        run(ms * MS, true);
        if (!w.has_durable || !rig_is_busy(w.rig)) { // no folder yet; or done
            tear_down();
            continue;
        }
        n_killed++;
        char *text = ledger_text(&w.durable);
        struct ledger old;
        assert_int_equal(ledger_parse(&old, text, strlen(text), "old"), 0);
        free(text);
        reconcile(&old);
        const int n_here = w.n_copies;
        if (ms / 150 % 3 == 0) { // and somebody uses the camera in between
            old.camera[old.n_cameras - 1].has_until = true;
            old.camera[old.n_cameras - 1].n_until = 1;
            name_object(&old.camera[old.n_cameras - 1].until[0], w.camera[CAMERA].n_card);
            w.camera[CAMERA].n_card++;
            w.camera[CAMERA].on_card[w.camera[CAMERA].n_card] = true;
            w.picture[w.camera[CAMERA].n_card] = (struct picture){ 1, 4, 5, 5, false };
        }
        die_and_rise();
        if (rig_resume(w.rig, w.now, &old, "/takes", true, why))
            fail_msg("after %d ms: %s", ms, why);
        run(3600 * S, true);
        drain_actions();
        const struct ledger *l = rig_ledger(w.rig);
        if (l->state != TAKE_VERIFIED)
            fail_msg("after %d ms: %s", ms, l->reason);
        check(l);
        check_brackets(l);
        n_adopted += n_here;
        int n_rejected = 0;
        for (int e = 0; e < l->n_cameras; e++)
            n_rejected += l->camera[e].exposure.rejected || !l->camera[e].expected;
        assert_int_equal(n_rejected, 0);
        for (int number = w.camera[CAMERA].take_first; number <= w.camera[CAMERA].n_card; number++) { // nothing that was exposed stays on the card
            bool known = w.picture[number].f_number == 4;                                               // but somebody else's
            for (int n = 0; n < w.n_copies; n++)
                known |= w.copy[n].object == number;
            assert_true(known);
        }
        tear_down();
    }
    assert_true(n_killed > 100 && n_adopted > 100);
}

static const struct ledger *resume(struct ledger *old)
{
    char why[200];
    if (rig_resume(w.rig, w.now, old, "/takes", true, why))
        fail_msg("%s", why);
    run(3600 * S, true);
    drain_actions();
    return rig_ledger(w.rig);
}

static void read_durable(struct ledger *out)
{
    char *text = ledger_text(&w.durable);
    assert_int_equal(ledger_parse(out, text, strlen(text), "old"), 0);
    free(text);
}

static void what_failed_goes_on_when_it_is_mended(void **state)
{
    (void)state;
    struct ledger old;
    begin(HEAD_BOARD, 60);
    char why[200];
    assert_int_equal(panorama_as("20261122T090000_story", why), 0);
    run(12 * S, true); // in the first stop
    w.n_head_fails = 99;
    run(3600 * S, true);
    drain_actions();
    assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
    assert_non_null(strstr(rig_ledger(w.rig)->reason, "stop 2 of 3"));
    const int n_copies = w.n_copies;
    assert_true(n_copies >= 4);
    w.n_head_fails = 0;
    read_durable(&old);
    const struct ledger *l = resume(&old);
    check(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    check_brackets(l);
    tear_down();
}

// As after ledger_reconcile() found a copy that is not what was written.
static void a_copy_that_rotted_is_fetched_again_and_nothing_else(void **state)
{
    (void)state;
    struct ledger old;
    begin(HEAD_BOARD, 61);
    const struct ledger *l = panorama();
    const int n_frames = w.n_copies, n_exposures = l->n_cameras;
    assert_int_equal(l->state, TAKE_VERIFIED);
    read_durable(&old);
    struct ledger_object *o = &old.camera[2].object[0];
    o->state = OBJECT_FOUND;
    o->xxh128[0] = 0;
    old.camera[2].debt = DEBT_OPEN;
    for (int n = 0; n < w.n_copies; n++)
        if (!strcmp(w.copy[n].file, o->file))
            w.copy[n] = w.copy[--w.n_copies];
    l = resume(&old);
    check(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(w.n_copies, n_frames);
    assert_int_equal(l->n_cameras, n_exposures);
    for (int e = 0; e < l->n_cameras; e++)
        assert_int_equal(l->camera[e].n_objects, 1);
    tear_down();
}

static void without_anybody_there_a_head_that_is_turned_by_hand_waits_for_a_person(void **state)
{
    (void)state;
    begin(HEAD_MANUAL, 50);
    char why[200];
    assert_int_equal(panorama_as("20261122T090000_story", why), 0);
    w.nobody_there = true;
    run(60 * S, true);
    const uint32_t seq = w.camera[CAMERA].seq;
    run(600 * S, true);
    assert_true(rig_is_busy(w.rig));
    assert_non_null(strstr(rig_prompt(w.rig), "stop 1 of 3"));
    assert_true(w.camera[CAMERA].seq >= seq + 20); // it is kept awake meanwhile
    char *text = ledger_text(&w.durable);
    struct ledger old;
    assert_int_equal(ledger_parse(&old, text, strlen(text), "old"), 0);
    free(text);
    die_and_rise();
    assert_int_equal(rig_resume(w.rig, w.now, &old, "/takes", false, why), 0);
    run(600 * S, true);
    drain_actions();
    assert_false(rig_is_busy(w.rig)); // the studio can go on
    assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
    assert_non_null(strstr(rig_ledger(w.rig)->reason, "rigctl resume"));
    tear_down();
}

// Five hundred panoramas with every fault there is: each ends, and its ledger is true.
static void five_hundred_panoramas_lose_nothing(void **state)
{
    (void)state;
    int n_verified = 0;
    for (int t = 0; t < 500; t++) {
        begin(HEAD_BOARD, 5000 + (uint64_t)t);
        char why[200];
        assert_int_equal(panorama_as("20261122T090000_story", why), 0);
        for (int k = 0; k < 3; k++) {
            run((int64_t)(uniform(0, 20) * S), true);
            struct fault *f = &w.camera[CAMERA].fault;
            const int kind = (int)(random_bits() % CAMERA_N_COMMANDS);
            switch (random_bits() % 9) {
            case 0: f->hang[kind] = 1; break;
            case 1: f->crash[kind] = 1; break;
            case 2: f->lost[kind] = 1; break;
            case 3: f->busy[kind] = (int)(random_bits() % 8); break;
            case 4: f->lost_events = 1; break;
            case 5: f->no_shot = 1; break;
            case 6: f->fails[kind] = (int)(random_bits() % 4), f->trouble = random_bits() % CAMERA_N_TROUBLES; break;
            case 7: f->extra = 1; break;
            case 8: w.n_head_fails = 1; break;
            }
        }
        run(3600 * S, true);
        drain_actions();
        assert_false(rig_is_busy(w.rig));
        const struct ledger *l = rig_ledger(w.rig);
        assert_true(l->state == TAKE_VERIFIED || l->reason[0]);
        if (w.has_durable)
            check(l);
        if (l->state == TAKE_VERIFIED)
            check_brackets(l);
        n_verified += l->state == TAKE_VERIFIED;
        tear_down();
    }
    assert_true(n_verified > 400);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_stop_gets_the_exposures_it_needs),
        cmocka_unit_test(in_a_dim_room_exposures_last_as_long_as_they_have_to),
        cmocka_unit_test(an_ordinary_take_does_without_the_panorama_camera),
        cmocka_unit_test(a_light_that_clips_in_the_shortest_is_declared),
        cmocka_unit_test(one_fault_at_any_command_costs_no_stop),
        cmocka_unit_test(without_a_line_of_its_own_its_driver_presses_it),
        cmocka_unit_test(a_frame_that_is_missing_is_exposed_again),
        cmocka_unit_test(a_turned_aperture_and_a_frame_of_another_time_are_not_used),
        cmocka_unit_test(a_head_that_sticks_is_asked_again_then_named),
        cmocka_unit_test(raws_that_nobody_can_judge_end_it),
        cmocka_unit_test(it_is_refused_where_it_cannot_work),
        cmocka_unit_test(cancelling_ends_it_with_what_is_here),
        cmocka_unit_test(killed_at_any_time_it_goes_on_where_it_was),
        cmocka_unit_test(what_failed_goes_on_when_it_is_mended),
        cmocka_unit_test(a_copy_that_rotted_is_fetched_again_and_nothing_else),
        cmocka_unit_test(without_anybody_there_a_head_that_is_turned_by_hand_waits_for_a_person),
        cmocka_unit_test(five_hundred_panoramas_lose_nothing),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
