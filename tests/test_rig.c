// tests/test_rig.c - stories of a whole rig on virtual time: what the state machine promises, whatever the cameras do.
#include "tests/rig_world.h"

// ---- stories --------------------------------------------------------------------------------------------------------------------------

static void two_hundred_cameras_deliver_every_frame(void **state)
{
    (void)state;
    set_up(200, 1);
    open_all();
    for (int i = 0; i < 200; i++)
        assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(w.n_copies, 200);
    assert_true(l->synchronised);
    assert_int_equal(l->n_measured, 200);
    assert_string_equal(l->camera[7].object[0].file, "raw/A07.nef");
    assert_int_equal(w.n_kills, 0);
    static const char *const stages[] = { "button", "exposed", "thumbnails", "collected", "verified" };
    assert_int_equal(l->n_stages, 5);
    for (int i = 0; i < 5; i++)
        assert_string_equal(l->stage[i].name, stages[i]);
    assert_true(l->stage[2].ended_utc_ms > l->stage[1].ended_utc_ms && l->stage[2].ended_utc_ms < l->stage[3].ended_utc_ms); // pictures to look at come first
    tear_down();
}

static void the_same_inputs_give_the_same_actions(void **state)
{
    (void)state;
    uint64_t trace[2];
    for (int k = 0; k < 2; k++) {
        set_up(30, 5);
        w.camera[3].fault.hang[CAMERA_FETCH] = 1;
        open_all();
        capture();
        trace[k] = w.trace;
        tear_down();
    }
    assert_true(trace[0] == trace[1]);
}

static void a_lost_event_is_found_on_the_card(void **state)
{
    (void)state;
    set_up(6, 2);
    open_all();
    w.camera[1].fault.lost_events = 1;
    w.camera[4].fault.lost_events = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    tear_down();
}

static void a_camera_that_came_back_is_not_waited_for_but_its_card_is_read(void **state)
{
    (void)state;
    set_up(6, 2);
    open_all();
    w.camera[1].fault.crash[CAMERA_COLLECT] = 2; // its events went with the worker
    w.camera[4].fault.hang[CAMERA_COLLECT] = 2;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(w.camera[1].fault.crash[CAMERA_COLLECT], 1);
    assert_int_equal(w.camera[4].fault.hang[CAMERA_COLLECT], 1);
    tear_down();
}

static void a_shutter_that_stays_closed_is_named_with_slot_and_remedy(void **state)
{
    (void)state;
    set_up(6, 3);
    open_all();
    w.camera[2].fault.no_shot = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "A02"));
    bool named = false;
    for (int i = 0; i < w.n_said; i++)
        named |= strstr(w.said[i], "A02") && strstr(w.said[i], "usb:1-1.3") && strstr(w.said[i], "heck");
    assert_true(named);
    tear_down();
}

// Each fault at each command, once: the take is whole, the others are not disturbed.
static void one_fault_at_any_command_costs_no_frame(void **state)
{
    (void)state;
    for (int kind = CAMERA_CONFIGURE; kind <= CAMERA_THUMBNAIL; kind++) {
        for (int fault = 0; fault < 4; fault++) {
            if (kind == CAMERA_TRIGGER)
                continue;
            set_up(5, 100 + (uint64_t)(kind * 8 + fault));
            open_all();
            struct fault *f = &w.camera[2].fault;
            *(fault == 0 ? &f->hang[kind] : fault == 1 ? &f->crash[kind] : fault == 2 ? &f->lost[kind] : &f->busy[kind]) = fault == 3 ? 4 : 1;
            const struct ledger *l = capture();
            check_accounts(l);
            if (l->state != TAKE_VERIFIED)
                fail_msg("%s with fault %d: %s", camera_command_name(kind), fault, l->reason);
            for (int i = 0; i < 5; i++)
                assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
            tear_down();
        }
    }
}

// The world asserts it at each command; here something happens that makes the rig want to send.
static void nothing_is_sent_from_the_last_answer_before_half_press_to_the_end_of_exposure(void **state)
{
    (void)state;
    for (int calibrated = 0; calibrated < 2; calibrated++)
        for (int ms = 0; ms < 3000; ms += 50) {
            const struct rig_take take = { "20261122T090000_story", "story", "2026-11-22T09:00:00Z", 1795338000000, "/takes", NULL, false };
            struct lag lag[5];
            char why[200];
            set_up(5, 200 + (uint64_t)ms);
            w.shutter_s = 1.6;
            for (int i = 0; i < 5; i++) {
                strcpy(w.config.camera[i].setting[0].value, "1.6");
                lag[i] = (struct lag){ .mean_ms = w.camera[i].lag_ms, .std_ms = w.camera[i].jitter_ms, .n = 30 };
                w.camera[i].take_first = w.camera[i].n_card + 1;
            }
            w.config.camera[2].relay_line = 7;
            if (calibrated) {
                rig_set_lag(w.rig, lag);
            } else { // nothing is known, nothing is seen, and a body slept
                w.camera[3].lag_ms += 200;
                w.abilities &= ~TRIGGER_FEEDBACK;
                rig_trigger_is(w.rig, w.now, w.abilities);
            }
            open_all();
            assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
            while (w.silent_until_ns != INT64_MAX)
                run(MS, false);
            run(ms * MS, false);
            const bool silent = w.now < w.silent_until_ns;
            for (int crashes = 0; crashes < 5 && silent && w.now < w.silent_until_ns; crashes++) { // enough for each rung of the ladder
                w.camera[2].worker = w.camera[2].open = w.camera[2].in_flight = false;
                rig_worker_gone(w.rig, w.now, 2, "killed by signal 11");
                run(MS, false);
                assert_false(w.supply_off[2]);
                run(99 * MS, false); // it is back, and could be opened
            }
            run(120 * S, true);
            drain_actions();
            const struct ledger *l = rig_ledger(w.rig);
            check_accounts(l);
            if (l->state != TAKE_VERIFIED)
                fail_msg("crash after %d ms: %s", ms, l->reason);
            assert_true(silent || ms > 1500);
            tear_down();
        }
}

static void others_do_not_wait_for_a_camera_in_trouble(void **state)
{
    (void)state;
    int64_t undisturbed[20];
    for (int run_with_fault = 0; run_with_fault < 2; run_with_fault++) {
        set_up(20, 7);
        w.config.fetch_limit = 20;
        open_all();
        if (run_with_fault)
            w.camera[5].fault.hang[CAMERA_FETCH] = -1;
        const int64_t begin = w.now;
        const struct ledger *l = capture();
        check_accounts(l);
        for (int i = 0; i < 20; i++) {
            if (!run_with_fault)
                undisturbed[i] = w.last_copy_ns[i] - begin;
            else if (i != 5) // the random numbers are drawn in another order: only by that may it differ
                assert_true(w.last_copy_ns[i] - begin < undisturbed[i] + 900 * MS);
        }
        if (run_with_fault) {
            assert_int_equal(l->state, TAKE_FAILED);
            assert_int_equal(l->camera[5].debt, DEBT_MISSED);
            assert_int_equal(rig_camera(w.rig, 5).condition, RIG_QUARANTINED);
        }
        tear_down();
    }
}

static void a_camera_is_recovered_or_quarantined_within_15_s(void **state)
{
    (void)state;
    for (int story = 0; story < 5; story++) {
        set_up(4, 40 + (uint64_t)story);
        strcpy(w.config.camera[1].power, "1-4:3");
        w.config.camera[1].relay_line = 9;
        if (story == 4)
            w.config.camera[1].power[0] = 0, w.config.camera[1].relay_line = CONFIG_NONE;
        open_all();
        struct fault *f = &w.camera[1].fault;
        f->dead = true;
        f->reset_heals = story == 1, f->power_heals = story == 2, f->relay_heals = story == 3;
        w.camera[1].open = false;
        run(26 * S, false); // a heartbeat notices
        const int64_t noticed = w.now;
        run(60 * S, false);
        if (story == 0 || story == 4) {
            assert_true(w.quarantined_ns[1] > 0);
            assert_true(w.quarantined_ns[1] - noticed <= 15 * S);
        } else {
            assert_true(w.ready_again_ns[1] > 0);
            assert_int_equal(rig_camera(w.rig, 1).condition, RIG_READY);
            assert_true(w.quarantined_ns[1] == 0);
        }
        assert_false(w.supply_off[1]);
        if (story == 0) { // comes back by itself, when somebody plugged it in
            f->dead = false;
            run(90 * S, false);
            assert_int_equal(rig_camera(w.rig, 1).condition, RIG_READY);
        }
        tear_down();
    }
}

static void a_camera_that_stays_busy_is_quarantined_after_5_s(void **state)
{
    (void)state;
    set_up(4, 8);
    open_all();
    w.camera[1].fault.busy[CAMERA_COLLECT] = -1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->camera[1].debt, DEBT_MISSED);
    assert_int_equal(rig_camera(w.rig, 1).condition, RIG_QUARANTINED);
    assert_non_null(strstr(rig_camera(w.rig, 1).note, "busy"));
    tear_down();
}

// No memory for a process, or no program: other cameras and clients are heard meanwhile.
static void a_worker_that_cannot_be_started_is_not_tried_without_end(void **state)
{
    (void)state;
    set_up(4, 9);
    w.camera[1].fault.no_start = 1000;
    open_all();
    run(60 * S, false);
    assert_true(w.quarantined_ns[1] > 0);
    assert_in_range(w.n_not_started, 3, 60); // at most twenty in each of three troubles
    w.camera[1].fault.no_start = 0;
    run(90 * S, false);
    assert_int_equal(rig_camera(w.rig, 1).condition, RIG_READY);
    tear_down();
}

// Whatever becomes of the camera: who waits for the answer gets it, once.
static void who_asks_which_camera_it_is_gets_an_answer(void **state)
{
    (void)state;
    for (int story = 0; story < 7; story++) {
        char why[200];
        set_up(4, 70 + (uint64_t)story);
        open_all();
        run(S, false);
        struct fault *f = &w.camera[1].fault;
        f->hang[CAMERA_IDENTIFY] = story == 1;
        f->crash[CAMERA_IDENTIFY] = story == 2;
        f->lost[CAMERA_IDENTIFY] = story == 3;
        f->busy[CAMERA_IDENTIFY] = story == 4 ? 2 : story == 5 ? -1 : 0;
        f->fails[CAMERA_IDENTIFY] = story == 6;
        f->trouble = CAMERA_REFUSED;
        assert_int_equal(rig_identify(w.rig, w.now, 1, why), 0);
        run(30 * S, false);
        assert_int_equal(w.n_identified[1], 1);
        if (story == 0 || story == 4) // it was busy for a moment
            assert_string_equal(w.identified, "");
        else
            assert_true(w.identified[0]);
        tear_down();
    }
}

static void an_unfit_camera_stops_the_take_unless_it_may_be_left_out(void **state)
{
    (void)state;
    for (int story = 0; story < 6; story++) {
        set_up(5, 50 + (uint64_t)story);
        open_all();
        struct fault *f = &w.camera[3].fault;
        f->wrong_setting = story == 0, f->low_battery = story == 1, f->autofocus = story == 2, f->no_card = story == 3;
        f->busy[CAMERA_DRAIN] = story == 4 ? -1 : 0;
        if (story == 5)
            w.config.camera[3].lens[0] = 'x';
        const struct ledger *l = capture();
        assert_int_equal(l->state, TAKE_FAILED);
        assert_int_equal(w.n_fired, 0);
        assert_non_null(strstr(l->reason, "A03"));
        f->busy[CAMERA_DRAIN] = story == 4 ? -1 : 0;
        l = capture_as("20261122T090001_story", true);
        check_accounts(l);
        assert_int_equal(l->state, TAKE_VERIFIED);
        assert_false(l->camera[3].expected);
        assert_int_equal(w.n_copies, 4);
        tear_down();
    }
}

static void a_full_disk_stops_before_the_shutters(void **state)
{
    (void)state;
    set_up(5, 9);
    open_all();
    w.free_bytes = INT64_C(1000) << 20;
    const struct ledger *l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "free"));
    w.free_bytes = INT64_C(1) << 42;
    w.create_err = -ENOSPC;
    l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_int_equal(w.n_fired, 0);
    assert_non_null(strstr(l->reason, "No space"));
    tear_down();
}

static void a_ledger_that_cannot_be_written_leaves_the_frames_on_the_cards(void **state)
{
    (void)state;
    set_up(5, 10);
    open_all();
    w.n_commit_fails = -1, w.commit_err = -EIO;
    const struct ledger *l = capture();
    assert_int_equal(l->state, TAKE_FAILED);
    assert_int_equal(w.n_copies, 0);
    w.n_commit_fails = 3; // and one that can again, after a while
    run(60 * S, false);
    l = capture_as("20261122T090002_story", false);
    w.n_commit_fails = 0;
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    tear_down();
}

static void a_copy_that_fails_is_tried_again_then_left_on_the_card(void **state)
{
    (void)state;
    for (int story = 0; story < 4; story++) {
        set_up(5, 60 + (uint64_t)story);
        open_all();
        w.camera[0].fault.fails[CAMERA_FETCH] = story & 1 ? -1 : 2;
        w.camera[0].fault.trouble = story & 2 ? CAMERA_DISK : CAMERA_CORRUPT;
        const struct ledger *l = capture();
        check_accounts(l);
        assert_int_equal(l->state, story & 1 ? TAKE_FAILED : TAKE_VERIFIED);
        if (story & 1) {
            assert_true(w.camera[0].on_card[w.camera[0].n_card]);
            assert_non_null(strstr(l->camera[0].note, "rigctl resume"));
        }
        tear_down();
    }
}

static void frames_are_deleted_only_after_verified_is_durable(void **state)
{
    (void)state;
    set_up(5, 11);
    w.config.delete_after_verify = true;
    open_all();
    const struct ledger *l = capture(); // the world checks each DELETE
    check_accounts(l);
    for (int i = 0; i < 5; i++) {
        assert_int_equal(l->camera[i].object[0].state, OBJECT_DELETED);
        assert_false(w.camera[i].on_card[w.camera[i].n_card]);
    }
    w.camera[2].fault.no_shot = 1; // a take that is not whole deletes nothing
    l = capture_as("20261122T090001_story", false);
    check_accounts(l);
    for (int i = 0; i < 5; i++)
        for (int k = 0; k < l->camera[i].n_objects; k++)
            assert_int_equal(l->camera[i].object[k].state, OBJECT_COPIED);
    tear_down();
}

static void extra_files_and_pairs_are_fetched_under_names_of_their_own(void **state)
{
    (void)state;
    set_up(4, 12);
    w.config.objects_per_shot = 2;
    open_all();
    w.camera[1].fault.extra = 1;
    w.camera[2].fault.lost_events = 1;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_int_equal(l->camera[1].n_objects, 3);
    assert_string_equal(l->camera[1].object[2].file, "raw/A01_3.nef");
    assert_int_equal(w.n_copies, 9);
    tear_down();
}

static void a_trigger_that_fails_is_survived(void **state)
{
    (void)state;
    set_up(4, 13);
    open_all();
    w.n_fire_refusals = 2; // too late twice, then it works
    assert_int_equal(capture()->state, TAKE_VERIFIED);
    w.n_fire_refusals = 9;
    const struct ledger *l = capture_as("20261122T090001_story", false);
    assert_int_equal(l->state, TAKE_FAILED);
    assert_non_null(strstr(l->reason, "no shutter was pressed"));
    w.n_fire_refusals = 0;
    w.fire_err = -EIO; // broke in the middle: what was exposed is collected
    l = capture_as("20261122T090002_story", false);
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    rig_trigger_is(w.rig, w.now, -1);
    char why[200];
    const struct rig_take take = { "x", "x", "", 0, "/takes", NULL, false };
    assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), -ENOTCONN);
    tear_down();
}

static void the_software_trigger_asks_each_camera(void **state)
{
    (void)state;
    set_up(6, 14);
    w.abilities = 0;
    rig_trigger_is(w.rig, w.now, 0);
    open_all();
    w.camera[3].fault.busy[CAMERA_TRIGGER] = 2;
    const struct ledger *l = capture();
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    assert_false(l->synchronised);
    tear_down();
}

static void lag_is_measured_and_compensated(void **state)
{
    (void)state;
    set_up(100, 15);
    open_all();
    const struct ledger *l = capture();
    const int64_t spread_before = l->spread_ns, sigma_before = l->sigma_ns;
    char why[200];
    const int64_t begin = w.now;
    assert_int_equal(rig_calibrate(w.rig, w.now, 40, why), 0);
    w.calibrating = true;
    run(4000 * S, true);
    w.calibrating = false;
    drain_actions();
    assert_int_equal(w.n_lags_done, 1);
    for (int i = 0; i < 100; i++) {
        const struct lag lag = rig_camera(w.rig, i).lag;
        assert_true(lag.n + lag.n_rejected == 40);
        assert_true(fabs(lag.mean_ms - w.camera[i].lag_ms) < 4.5 * w.camera[i].jitter_ms / sqrt(lag.n));
    }
    assert_true(w.now - begin < 300 * S);
    l = capture_as("20261122T090001_story", false);
    check_accounts(l);
    assert_true(l->sigma_ns < sigma_before * 2 / 3);
    assert_true(l->spread_ns < spread_before);
    w.config.trigger.max_hold_ms = 510; // leaves 10 ms of the 20 that are needed
    w.n_said = 0;
    l = capture_as("20261122T090002_story", false);
    check_accounts(l);
    assert_int_equal(l->state, TAKE_VERIFIED);
    bool told = false;
    for (int i = 0; i < w.n_said; i++)
        told |= strstr(w.said[i], "max_hold_ms = 510 leaves 10 ms") != NULL;
    assert_true(told);
    tear_down();
}

static void a_take_is_resumed_from_its_ledger(void **state)
{
    (void)state;
    for (int story = 0; story < 3; story++) {
        set_up(8, 70 + (uint64_t)story);
        open_all();
        w.camera[4].fault.fails[CAMERA_FETCH] = -1;
        w.camera[4].fault.trouble = CAMERA_DISK;
        assert_int_equal(capture()->state, TAKE_FAILED);
        // A new life of the daemon, with the ledger from disk.
        char *text = ledger_text(&w.durable);
        struct ledger old;
        assert_int_equal(ledger_parse(&old, text, strlen(text), "old"), 0);
        free(text);
        w.camera[4].fault.fails[CAMERA_FETCH] = 0;
        if (story == 1) // somebody took another picture with it meanwhile, in a later take: not ours
            expose(4);
        if (story == 2) // and this body does not come back
            w.camera[4].fault.dead = true, w.camera[4].open = false;
        rig_free(w.rig);
        w.n_heap = 0;
        for (int i = 0; i < 8; i++) {
            w.camera[i].worker = false;
            w.camera[i].n_thumbnails = 0;
        }
        assert_int_equal(rig_create(&w.rig, &w.config), 0);
        rig_start(w.rig, w.now);
        if (story == 1) {
            old.camera[4].has_until = true;
            old.camera[4].n_until = 1;
            name_object(&old.camera[4].until[0], w.camera[4].n_card - 1);
        }
        char why[200];
        assert_int_equal(rig_resume(w.rig, w.now, &old, "/takes", true, why), 0);
        run(120 * S, true);
        drain_actions();
        const struct ledger *l = rig_ledger(w.rig);
        assert_int_equal(l->state, story == 2 ? TAKE_FAILED : TAKE_VERIFIED);
        for (int i = 0; i < 8; i++) // of those whose frames are still to come: the contact sheet shows them
            assert_int_equal(w.camera[i].n_thumbnails, i == 4 && story != 2);
        if (story == 1)
            assert_int_equal(l->camera[4].n_objects, 1);
        else
            check_accounts(l);
        tear_down();
    }
}

static void a_take_that_was_never_exposed_says_so(void **state)
{
    (void)state;
    set_up(4, 16);
    open_all();
    struct ledger old;
    char why[200];
    ledger_init(&old, &w.config);
    strcpy(old.id, "20261122T080000_x");
    old.state = TAKE_ARMED;
    for (int i = 0; i < 4; i++)
        if (w.camera[i].n_card) {
            old.camera[i].n_before = 1;
            name_object(&old.camera[i].before[0], w.camera[i].n_card);
        }
    assert_int_equal(rig_resume(w.rig, w.now, &old, "/takes", true, why), 0);
    run(60 * S, true);
    drain_actions();
    assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
    assert_non_null(strstr(rig_ledger(w.rig)->reason, "never pressed"));
    tear_down();
}

static void cancelling_before_the_shot_costs_nothing_after_it_no_frame(void **state)
{
    (void)state;
    for (int ms = 0; ms < 3000; ms += 100) {
        char why[200];
        set_up(4, 80);
        open_all();
        const struct rig_take take = { "20261122T090000_c", "c", "", 0, "/takes", NULL, false };
        for (int i = 0; i < 4; i++)
            w.camera[i].take_first = w.camera[i].n_card + 1;
        assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
        run(ms * MS, true);
        rig_cancel(w.rig, w.now, why);
        run(60 * S, true);
        drain_actions();
        assert_int_equal(w.n_takes_done, 1);
        if (w.n_fired)
            check_accounts(rig_ledger(w.rig));
        else
            assert_int_equal(rig_ledger(w.rig)->state, TAKE_FAILED);
        tear_down();
    }
}

// Armed is armed: minutes later a press fires, no camera hears anything meanwhile, and who cancels has pressed nothing.
static void armed_it_waits_for_the_button(void **state)
{
    (void)state;
    for (int story = 0; story < 3; story++) {
        char why[200];
        set_up(4, 90 + (uint64_t)story);
        open_all();
        const struct rig_take take = { "20261122T090000_c", "c", "", 0, "/takes", NULL, true };
        assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), -EINVAL); // this trigger's button only tells us
        assert_non_null(strstr(why, "trigger board"));
        w.abilities |= TRIGGER_BUTTON | TRIGGER_WAITS;
        rig_trigger_is(w.rig, w.now, w.abilities);
        for (int i = 0; i < 4; i++)
            w.camera[i].take_first = w.camera[i].n_card + 1;
        assert_int_equal(rig_capture(w.rig, w.now, &take, false, why), 0);
        assert_false(rig_waits_for_button(w.rig));
        run(300 * S, true);
        assert_true(w.waits_for_button);
        assert_true(rig_waits_for_button(w.rig));
        assert_int_equal(rig_state(w.rig), TAKE_ARMED);
        assert_int_equal(rig_deadline_ns(w.rig), INT64_MAX);
        if (story == 0) {
            press_button();
        } else if (story == 1) {
            assert_int_equal(rig_cancel(w.rig, w.now, why), 0);
        } else { // the link breaks: perhaps it was pressed, the cards will tell
            w.waits_for_button = false;
            w.silent_until_ns = 0;
            rig_fired(w.rig, w.now, -EIO, 0, 0);
        }
        drain_actions();
        run(60 * S, true);
        drain_actions();
        assert_int_equal(w.n_takes_done, 1);
        assert_int_equal(w.n_fired, story == 0);
        assert_int_equal(rig_ledger(w.rig)->state, story == 0 ? TAKE_VERIFIED : TAKE_FAILED);
        if (story == 0)
            check_accounts(rig_ledger(w.rig));
        if (story == 1)
            assert_string_equal(rig_ledger(w.rig)->reason, "cancelled; the button was not pressed");
        assert_false(rig_waits_for_button(w.rig));
        assert_int_equal(capture_as("20261122T090001_d", false)->state, TAKE_VERIFIED); // and the next one is as ever
        tear_down();
    }
}

// Five thousand takes with every fault there is, unattended.
static void five_thousand_takes_lose_nothing(void **state)
{
    (void)state;
    enum { N = 12, TAKES = 5000 };
    int n_verified = 0, n_failed = 0;
    set_up(N, 99);
    w.config.may_miss = N - 1;
    open_all();
    for (int t = 0; t < TAKES; t++) {
        char id[40];
        snprintf(id, sizeof(id), "take%06d", t);
        if (random_bits() % 3 == 0) {
            struct fault *f = &w.camera[random_bits() % N].fault;
            const int kind = (int)(random_bits() % CAMERA_N_COMMANDS);
            switch (random_bits() % 8) {
            case 0: f->hang[kind] = 1; break;
            case 1: f->crash[kind] = 1; break;
            case 2: f->lost[kind] = 1; break;
            case 3: f->busy[kind] = (int)(random_bits() % 8); break;
            case 4: f->lost_events = 1; break;
            case 5: f->no_shot = 1; break;
            case 6: f->fails[kind] = (int)(random_bits() % 4), f->trouble = random_bits() % CAMERA_N_TROUBLES; break;
            case 7: f->extra = 1; break;
            }
        }
        const struct ledger *l = capture_as(id, false);
        check_accounts(l);
        n_verified += l->state == TAKE_VERIFIED;
        n_failed += l->state == TAKE_FAILED;
        if (t % 100 == 99)
            run(100 * S, false); // a pause: quarantined bodies come back
        for (int i = 0; i < N; i++)
            if (w.camera[i].n_card > CARD_MAX * 100 - 10) { // a new card
                memset(w.camera[i].on_card, 0, sizeof(w.camera[i].on_card));
                w.camera[i].n_card = 0;
            }
    }
    assert_int_equal(n_verified + n_failed, TAKES);
    assert_true(n_verified > TAKES * 3 / 4);
    run(200 * S, false);
    for (int i = 0; i < N; i++)
        assert_int_equal(rig_camera(w.rig, i).condition, RIG_READY);
    tear_down();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(two_hundred_cameras_deliver_every_frame),
        cmocka_unit_test(the_same_inputs_give_the_same_actions),
        cmocka_unit_test(a_lost_event_is_found_on_the_card),
        cmocka_unit_test(a_camera_that_came_back_is_not_waited_for_but_its_card_is_read),
        cmocka_unit_test(a_shutter_that_stays_closed_is_named_with_slot_and_remedy),
        cmocka_unit_test(one_fault_at_any_command_costs_no_frame),
        cmocka_unit_test(nothing_is_sent_from_the_last_answer_before_half_press_to_the_end_of_exposure),
        cmocka_unit_test(others_do_not_wait_for_a_camera_in_trouble),
        cmocka_unit_test(a_camera_is_recovered_or_quarantined_within_15_s),
        cmocka_unit_test(a_camera_that_stays_busy_is_quarantined_after_5_s),
        cmocka_unit_test(a_worker_that_cannot_be_started_is_not_tried_without_end),
        cmocka_unit_test(who_asks_which_camera_it_is_gets_an_answer),
        cmocka_unit_test(an_unfit_camera_stops_the_take_unless_it_may_be_left_out),
        cmocka_unit_test(a_full_disk_stops_before_the_shutters),
        cmocka_unit_test(a_ledger_that_cannot_be_written_leaves_the_frames_on_the_cards),
        cmocka_unit_test(a_copy_that_fails_is_tried_again_then_left_on_the_card),
        cmocka_unit_test(frames_are_deleted_only_after_verified_is_durable),
        cmocka_unit_test(extra_files_and_pairs_are_fetched_under_names_of_their_own),
        cmocka_unit_test(a_trigger_that_fails_is_survived),
        cmocka_unit_test(the_software_trigger_asks_each_camera),
        cmocka_unit_test(lag_is_measured_and_compensated),
        cmocka_unit_test(a_take_is_resumed_from_its_ledger),
        cmocka_unit_test(a_take_that_was_never_exposed_says_so),
        cmocka_unit_test(cancelling_before_the_shot_costs_nothing_after_it_no_frame),
        cmocka_unit_test(armed_it_waits_for_the_button),
        cmocka_unit_test(five_thousand_takes_lose_nothing),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
