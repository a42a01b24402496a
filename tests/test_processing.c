// tests/test_processing.c - from verified to solved, in virtual time: order, room, pauses, faults, new lives.
//
// A small world carries the actions out: jobs take time, some refuse, die or never end; what was kept is still there for the next life.
// What processing.h promises for every moment is checked at every action.
#include "rigd/processing.h"

#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#define S INT64_C(1000000000)
#define BIT(step) (1u << (step))
enum { TAKES = 6, ITEMS = 12, JOBS = 64, LOG = 20000, MB = 1 << 20 };
enum { ALL = (1 << PROCESSING_N_STEPS) - 1, PLAIN = ALL & ~(1 << STEP_FINAL) };

struct place { // one product
    bool made, refuses, hangs; // hangs: ends only when killed
    int dies;                  // so many times
    int n_started;
    bool deaf;                 // SIGTERM does nothing
};

struct study {
    char id[96];
    bool is_panorama, has_thumbnails, has_geometry;
    const char *panorama_of; // NULL: its panorama is there or its own
    bool no_panorama;
    int n_cameras;
    struct place place[PROCESSING_N_STEPS][ITEMS];
    struct processing_record record;
    int n_records, n_settled;
};

struct job {
    bool used, paused, stopping;
    int take;
    enum processing_step step;
    int item;
    int64_t left_ns;
};

struct entry {
    enum processing_action_kind kind;
    int take;
    enum processing_step step;
    int item;
    int64_t at_ns;
};

static struct world {
    struct processing *p;
    struct processing_settings settings;
    int64_t now_ns;
    bool held;
    struct study take[TAKES];
    int n_takes;
    struct job job[JOBS];
    struct entry log[LOG];
    int n_log;
    int64_t duration_ns[PROCESSING_N_STEPS];
} w;

static int seed;

static void new_world(int n_slots, int n_develop)
{
    if (w.p)
        processing_free(w.p);
    memset(&w, 0, sizeof(w));
    w.settings = (struct processing_settings){ .wanted = PLAIN, .n_slots = n_slots, .n_develop = n_develop, .memory_bytes = INT64_MAX };
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        w.duration_ns[s] = s == STEP_STANDARD ? 100 * S : s == STEP_PREVIEW || s == STEP_RECONSTRUCT ? 5 * S : S;
    w.now_ns = 1000 * S;
    assert_int_equal(processing_create(&w.p, &w.settings), 0);
}

static struct study *new_take(const char *id, int n_cameras)
{
    struct study *t = &w.take[w.n_takes++];
    snprintf(t->id, sizeof(t->id), "%s", id);
    t->n_cameras = n_cameras;
    t->has_thumbnails = true;
    return t;
}

static int take_named(const char *id)
{
    for (int i = 0; i < w.n_takes; i++)
        if (!strcmp(w.take[i].id, id))
            return i;
    fail_msg("no take %s", id);
    return -1;
}

static void add(struct study *t)
{
    const struct processing_take what = { .id = t->id, .is_panorama = t->is_panorama, .is_owed = true };
    assert_int_equal(processing_add(w.p, w.now_ns, &what), 0);
}

static int step_state(const struct study *t, enum processing_step step)
{
    return processing_step(w.p, processing_find(w.p, t->id), step).state;
}

// ---- the world ----------------------------------------------------------------------------------------------------------------

static struct job *find_job(int take, enum processing_step step, int item)
{
    for (int i = 0; i < JOBS; i++)
        if (w.job[i].used && w.job[i].take == take && w.job[i].step == step && w.job[i].item == item)
            return &w.job[i];
    return NULL;
}

static int slots_of(const struct job *j)
{
    const bool all = j->step == STEP_RECONSTRUCT || j->step == STEP_PREVIEW || j->step == STEP_STANDARD || j->step == STEP_FINAL ||
                     (j->step == STEP_PANORAMA && w.take[j->take].is_panorama);
    return all ? w.settings.n_slots : 1;
}

static void check_room(void)
{
    int slots = 0, develops = 0;
    for (int i = 0; i < JOBS; i++) {
        if (!w.job[i].used)
            continue;
        develops += w.job[i].step == STEP_DEVELOP;
        if (!w.job[i].paused)
            slots += slots_of(&w.job[i]);
        if (w.held && !w.job[i].paused)
            assert_true(w.job[i].stopping);
    }
    assert_true(slots <= w.settings.n_slots);
    assert_true(develops <= w.settings.n_develop);
    assert_true(develops <= 1 || develops * (100 * (int64_t)MB) <= w.settings.memory_bytes);
}

static void answer_look(int take, enum processing_step step)
{
    struct study *t = &w.take[take];
    struct processing_item item[ITEMS];
    const char *text = NULL;
    int n = 1;
    memset(item, 0, sizeof(item));
    if (step == STEP_DEVELOP)
        n = t->n_cameras;
    if (step == STEP_SHEET && !t->has_thumbnails)
        n = 0;
    for (int i = 0; i < n; i++) {
        item[i].verdict = t->place[step][i].made ? PRODUCT_THERE : PRODUCT_OWED;
        item[i].memory_bytes = 100 * (int64_t)MB;
        if (step == STEP_DEVELOP) {
            snprintf(item[i].name, sizeof(item[i].name), "A%02d", i + 1);
            snprintf(item[i].slot, sizeof(item[i].slot), "usb:1-%d", i + 1);
        }
    }
    if (step == STEP_PANORAMA && t->no_panorama)
        text = "no panorama take; shoot one";
    if (step == STEP_PANORAMA && t->panorama_of && !w.take[take_named(t->panorama_of)].place[STEP_PANORAMA][0].made) {
        item[0].verdict = PRODUCT_WAITS;
        snprintf(item[0].name, sizeof(item[0].name), "%s", t->panorama_of);
    }
    if (step == STEP_RECONSTRUCT && t->has_geometry)
        item[0].verdict = PRODUCT_THERE;
    processing_looked(w.p, w.now_ns, t->id, step, item, n, text);
}

static void start_job(int take, enum processing_step step, int item)
{
    static const unsigned needs[PROCESSING_N_STEPS] = {
        [STEP_RECONSTRUCT] = BIT(STEP_DEVELOP), [STEP_FOCUS] = BIT(STEP_DEVELOP), [STEP_PREVIEW] = BIT(STEP_DEVELOP) | BIT(STEP_PANORAMA) | BIT(STEP_RECONSTRUCT),
        [STEP_STANDARD] = BIT(STEP_DEVELOP) | BIT(STEP_PANORAMA) | BIT(STEP_RECONSTRUCT),
    };
    struct study *t = &w.take[take];
    assert_false(w.held);
    assert_null(find_job(take, step, item));
    assert_false(t->place[step][item].made); // nothing is made twice
    for (int s = 0; s < PROCESSING_N_STEPS; s++) // and nothing before what it is made from
        for (int i = 0; (needs[step] & BIT(s)) && i < (s == STEP_DEVELOP ? t->n_cameras : 1); i++)
            if (!t->place[s][i].made && !t->place[s][i].refuses && !(s == STEP_RECONSTRUCT && t->has_geometry))
                fail_msg("%s: %s without %s %d (seed %d)", t->id, processing_step_name(step), processing_step_name(s), i, seed);
    for (int i = 0; i < JOBS; i++)
        if (!w.job[i].used) {
            w.job[i] = (struct job){ .used = true, .take = take, .step = step, .item = item, .left_ns = w.duration_ns[step] };
            t->place[step][item].n_started++;
            check_room();
            return;
        }
    fail_msg("too many jobs");
}

static void end_job(struct job *j, enum processing_how how, const char *text)
{
    const struct job copy = *j;
    j->used = false;
    processing_ended(w.p, w.now_ns, w.take[copy.take].id, copy.step, copy.item, how, text);
}

static void carry_out(const struct processing_action *a)
{
    const int take = take_named(a->take);
    struct study *t = &w.take[take];
    struct job *j = find_job(take, a->step, a->item);
    assert_true(w.n_log < LOG);
    w.log[w.n_log++] = (struct entry){ a->kind, take, a->step, a->item, w.now_ns };
    if (w.held)
        assert_true(a->kind == PROCESSING_STATE || a->kind == PROCESSING_PAUSE || a->kind == PROCESSING_STOP || a->kind == PROCESSING_KILL);
    switch (a->kind) {
    case PROCESSING_LOOK:
        answer_look(take, a->step);
        return;
    case PROCESSING_START:
        start_job(take, a->step, a->item);
        return;
    case PROCESSING_STOP:
        assert_non_null(j);
        j->stopping = true, j->paused = false;
        if (!t->place[a->step][a->item].deaf)
            end_job(j, JOB_KILLED, "Terminated");
        return;
    case PROCESSING_KILL:
        if (j)
            end_job(j, JOB_KILLED, "Killed");
        return;
    case PROCESSING_PAUSE:
        assert_non_null(j);
        assert_false(j->paused);
        j->paused = true;
        return;
    case PROCESSING_CONTINUE:
        assert_non_null(j);
        assert_true(j->paused);
        j->paused = false;
        check_room();
        return;
    case PROCESSING_KEEP:
        t->place[a->step][a->item].made = true;
        processing_kept(w.p, w.now_ns, t->id, a->step, a->item, true, "");
        return;
    case PROCESSING_FORGET:
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; (a->mask & BIT(s)) && i < ITEMS; i++)
                t->place[s][i].made = false;
        return;
    case PROCESSING_RECORD:
        processing_record(w.p, t->id, &t->record);
        t->n_records++;
        processing_recorded(w.p, w.now_ns, t->id, 0);
        return;
    case PROCESSING_STATE:
        return;
    case PROCESSING_SETTLED:
        t->n_settled++;
        return;
    }
}

static void obey(void)
{
    struct processing_action a;
    while (processing_next(w.p, &a))
        carry_out(&a);
}

static void end_what_is_due(void)
{
    for (int i = 0; i < JOBS; i++) {
        struct job *j = &w.job[i];
        if (!j->used || j->paused || j->left_ns > 0)
            continue;
        struct place *p = &w.take[j->take].place[j->step][j->item];
        if (p->hangs || j->stopping)
            continue;
        if (p->dies > 0) {
            p->dies--;
            end_job(j, JOB_KILLED, "Killed");
        } else {
            end_job(j, p->refuses ? JOB_REFUSED : JOB_DONE, p->refuses ? "raw/X.nef: damaged; fetch it again" : NULL);
        }
        obey();
    }
}

// Until until_ns, or (0) until nothing happens any more.
static void run(int64_t until_ns)
{
    obey();
    for (int turn = 0; turn < 100000; turn++) {
        int64_t next = until_ns ? until_ns : INT64_MAX;
        const int64_t due = processing_deadline_ns(w.p);
        for (int i = 0; i < JOBS; i++) {
            const struct job *j = &w.job[i];
            if (j->used && !j->paused && !j->stopping && !w.take[j->take].place[j->step][j->item].hangs && w.now_ns + j->left_ns < next)
                next = w.now_ns + j->left_ns;
        }
        next = due < next ? due : next;
        if (next == INT64_MAX)
            return;
        const int64_t dt = next > w.now_ns ? next - w.now_ns : 0;
        for (int i = 0; i < JOBS; i++)
            if (w.job[i].used && !w.job[i].paused)
                w.job[i].left_ns -= dt;
        w.now_ns += dt;
        end_what_is_due();
        if (processing_deadline_ns(w.p) <= w.now_ns) {
            processing_time(w.p, w.now_ns);
            obey();
        }
        if (until_ns && w.now_ns >= until_ns)
            return;
    }
    fail_msg("it never ends");
}

// kill -9: what ran is gone, what was kept is there.
static void new_life(void)
{
    processing_free(w.p);
    memset(w.job, 0, sizeof(w.job));
    w.held = false;
    assert_int_equal(processing_create(&w.p, &w.settings), 0);
    for (int i = 0; i < w.n_takes; i++)
        if (!w.take[i].n_settled)
            add(&w.take[i]);
    obey();
}

static void hold(bool on)
{
    w.held = on;
    processing_hold(w.p, w.now_ns, on);
    obey();
    check_room();
}

static int64_t started_at(const struct study *t, enum processing_step step)
{
    for (int i = 0; i < w.n_log; i++)
        if (w.log[i].kind == PROCESSING_START && &w.take[w.log[i].take] == t && w.log[i].step == step)
            return w.log[i].at_ns;
    return -1;
}

static void expect_note(const struct study *t, const char *text)
{
    for (int i = 0; i < t->record.n_notes; i++)
        if (strstr(t->record.note[i], text))
            return;
    for (int i = 0; i < t->record.n_notes; i++)
        print_message("note: %s\n", t->record.note[i]);
    fail_msg("no note says '%s'", text);
}

// ---- stories ------------------------------------------------------------------------------------------------------------------

static void a_take_is_developed_lit_reconstructed_and_solved(void **state)
{
    (void)state;
    new_world(4, 4);
    struct study *t = new_take("20260101_a", 12);
    add(t);
    run(0);
    assert_int_equal(t->n_settled, 1);
    assert_int_equal(t->record.state, TAKE_SOLVED);
    assert_int_equal(t->record.processing, LEDGER_SETTLED);
    assert_int_equal(t->record.n_notes, 0);
    for (int i = 0; i < 12; i++)
        assert_int_equal(t->place[STEP_DEVELOP][i].n_started, 1);
    // 14 one-second jobs on 4 slots, 5 s of geometry, 5 s of preview, then what has time
    assert_int_equal(started_at(t, STEP_PREVIEW) - 1000 * S, 9 * S);
    assert_true(started_at(t, STEP_FOCUS) > started_at(t, STEP_PREVIEW));
    assert_true(started_at(t, STEP_STANDARD) > started_at(t, STEP_FOCUS));
}

static void the_newest_take_comes_first_and_an_old_long_solve_makes_room(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *a = new_take("20260101_a", 4), *b = new_take("20260102_b", 4);
    add(a);
    run(w.now_ns + 40 * S); // a's standard is under way
    assert_int_equal(step_state(a, STEP_STANDARD), PROCESSING_OPEN);
    const int64_t came = w.now_ns;
    add(b);
    run(0);
    assert_int_equal(started_at(b, STEP_DEVELOP), came); // not 80 s later
    assert_true(started_at(b, STEP_PREVIEW) - came <= 9 * S);
    assert_int_equal(a->place[STEP_STANDARD][0].n_started, 1); // paused, not killed
    assert_int_equal(a->record.state, TAKE_SOLVED);
    assert_int_equal(b->record.state, TAKE_SOLVED);
    assert_true(started_at(b, STEP_STANDARD) > came + 10 * S);
}

static void takes_wait_for_the_panorama_that_lights_them(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *light = new_take("20260101_light", 0), *t = new_take("20260102_t", 2);
    light->is_panorama = true;
    t->panorama_of = light->id;
    w.duration_ns[STEP_PANORAMA] = 60 * S;
    add(light);
    add(t);
    run(0);
    assert_int_equal(light->record.state, TAKE_DEVELOPED);
    assert_int_equal(t->record.state, TAKE_SOLVED);
    assert_true(started_at(t, STEP_PREVIEW) >= started_at(light, STEP_PANORAMA) + 60 * S);
    // One whose panorama take failed says so, and is developed all the same.
    new_world(2, 2);
    light = new_take("20260101_light", 0), t = new_take("20260102_t", 2);
    light->is_panorama = true;
    light->place[STEP_PANORAMA][0].refuses = true;
    t->panorama_of = light->id;
    add(light);
    add(t);
    run(0);
    assert_int_equal(light->record.state, TAKE_VERIFIED);
    expect_note(light, "panorama: raw/X.nef: damaged");
    assert_int_equal(t->record.state, TAKE_DEVELOPED);
    expect_note(t, "panorama: the panorama of take 20260101_light is not there");
    expect_note(t, "preview: not started: panorama is missing");
    assert_int_equal(t->place[STEP_PREVIEW][0].n_started, 0);
}

static void what_is_killed_is_started_once_more_what_refuses_is_not(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 5);
    t->place[STEP_DEVELOP][1].dies = 1;
    t->place[STEP_DEVELOP][2].dies = 2;
    t->place[STEP_DEVELOP][3].refuses = true;
    add(t);
    t->place[STEP_DEVELOP][2].refuses = true; // for start_job: others may go on without it
    run(0);
    assert_int_equal(t->place[STEP_DEVELOP][0].n_started, 1);
    assert_int_equal(t->place[STEP_DEVELOP][1].n_started, 2);
    assert_int_equal(t->place[STEP_DEVELOP][2].n_started, 2);
    assert_int_equal(t->place[STEP_DEVELOP][3].n_started, 1);
    expect_note(t, "develop: camera A03 (usb:1-3): ended 2 times by a signal");
    expect_note(t, "develop: camera A04 (usb:1-4): raw/X.nef: damaged; fetch it again");
    assert_int_equal(t->record.n_notes, 2);
    assert_int_equal(t->record.state, TAKE_SOLVED); // from the other three
    assert_true(t->place[STEP_PREVIEW][0].made);
    // Asked again, only these are made.
    t->place[STEP_DEVELOP][2].refuses = t->place[STEP_DEVELOP][3].refuses = false;
    add(t);
    run(0);
    assert_int_equal(t->place[STEP_DEVELOP][0].n_started, 1);
    assert_int_equal(t->place[STEP_DEVELOP][3].n_started, 2);
    assert_int_equal(t->record.n_notes, 0);
    // Nothing developed at all: nothing is solved, and no hook is run.
    new_world(2, 2);
    t = new_take("20260101_a", 1);
    t->place[STEP_DEVELOP][0].refuses = true;
    add(t);
    run(0);
    assert_int_equal(t->record.state, TAKE_VERIFIED);
    assert_int_equal(t->place[STEP_RECONSTRUCT][0].n_started, 0);
    expect_note(t, "preview: not started: develop and reconstruct are missing");
}

static void a_failed_preview_spares_the_long_solve(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 2);
    t->place[STEP_PREVIEW][0].refuses = true;
    add(t);
    run(0);
    assert_int_equal(t->record.state, TAKE_DEVELOPED);
    assert_int_equal(t->place[STEP_STANDARD][0].n_started, 0);
    expect_note(t, "standard: not started: preview failed");
}

static void while_the_rig_shoots_nothing_runs_and_time_does_not_count(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 6);
    w.settings.timeout_s[STEP_PREVIEW] = 8;
    new_life();
    add(t);
    for (int i = 0; i < 40; i++) { // a shot every other half second; carry_out() and check_room() look
        run(w.now_ns + S / 2);
        hold(true);
        run(w.now_ns + S / 2);
        hold(false);
    }
    hold(true);
    const int n = w.n_log;
    run(w.now_ns + 1000 * S);
    assert_int_equal(w.n_log, n);
    hold(false);
    run(0);
    assert_int_equal(t->record.state, TAKE_SOLVED); // the preview took 5 s of its 8, over 10 s of the clock
    assert_int_equal(t->place[STEP_PREVIEW][0].n_started, 1);
    struct study *late = new_take("20260102_b", 2); // one that comes while held waits
    hold(true);
    add(late);
    run(w.now_ns + S);
    assert_int_equal(started_at(late, STEP_DEVELOP), -1);
    hold(false);
    run(0);
    assert_int_equal(late->record.state, TAKE_SOLVED);
}

static void what_hangs_is_stopped_then_killed_and_said(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 3);
    w.settings.timeout_s[STEP_DEVELOP] = 30;
    new_life();
    t->place[STEP_DEVELOP][1].hangs = t->place[STEP_DEVELOP][1].deaf = t->place[STEP_DEVELOP][1].refuses = true;
    add(t);
    run(0);
    int64_t stop = -1, kill = -1, begin = -1;
    for (int i = 0; i < w.n_log; i++) {
        if (w.log[i].item != 1 || w.log[i].step != STEP_DEVELOP)
            continue;
        begin = w.log[i].kind == PROCESSING_START ? w.log[i].at_ns : begin;
        stop = w.log[i].kind == PROCESSING_STOP ? w.log[i].at_ns : stop;
        kill = w.log[i].kind == PROCESSING_KILL ? w.log[i].at_ns : kill;
    }
    assert_int_equal(stop - begin, 30 * S);
    assert_int_equal(kill - stop, 5 * S);
    assert_int_equal(t->place[STEP_DEVELOP][1].n_started, 1); // it would hang again
    expect_note(t, "develop: camera A02 (usb:1-2): not ready after 30 s");
    assert_int_equal(t->record.state, TAKE_SOLVED);
}

static void cancelled_is_cancelled_and_can_be_begun_again(void **state)
{
    (void)state;
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 8), *other = new_take("20260101_b", 1);
    add(t);
    add(other);
    run(w.now_ns + 5 * S / 2);
    assert_int_equal(processing_cancel(w.p, w.now_ns, t->id), 0);
    run(0);
    assert_int_equal(t->record.processing, LEDGER_CANCELLED);
    assert_int_equal(t->record.state, TAKE_VERIFIED);
    assert_int_equal(t->n_settled, 1);
    assert_int_equal(t->place[STEP_PREVIEW][0].n_started, 0);
    assert_int_equal(other->record.state, TAKE_SOLVED);
    int n = 0;
    for (int i = 0; i < 8; i++)
        n += t->place[STEP_DEVELOP][i].n_started;
    assert_true(n > 0 && n < 8);
    assert_int_equal(processing_cancel(w.p, w.now_ns, "20260101_c"), -ENOENT);
    add(t);
    run(0);
    assert_int_equal(t->record.state, TAKE_SOLVED);
    assert_int_equal(t->record.processing, LEDGER_SETTLED);
}

static void again_makes_one_step_anew_and_looks_at_what_follows(void **state)
{
    (void)state;
    char why[200] = "";
    new_world(2, 2);
    struct study *t = new_take("20260101_a", 2);
    add(t);
    run(w.now_ns + 3 * S / 2);
    assert_int_equal(processing_again(w.p, w.now_ns, t->id, STEP_DEVELOP, why), -EBUSY);
    assert_non_null(strstr(why, "under way"));
    run(0);
    const int n_before = w.n_log;
    assert_int_equal(processing_again(w.p, w.now_ns, t->id, STEP_PREVIEW, why), 0);
    run(0);
    assert_int_equal(t->place[STEP_PREVIEW][0].n_started, 2);
    assert_int_equal(t->place[STEP_DEVELOP][0].n_started, 1);
    assert_int_equal(t->place[STEP_STANDARD][0].n_started, 1);
    bool forgot_first = false;
    for (int i = n_before; i < w.n_log; i++) {
        forgot_first |= w.log[i].kind == PROCESSING_FORGET;
        assert_true(w.log[i].kind != PROCESSING_LOOK || forgot_first);
    }
    // A step that is not configured may be asked for.
    assert_int_equal(processing_again(w.p, w.now_ns, t->id, STEP_FINAL, why), 0);
    run(0);
    assert_int_equal(t->place[STEP_FINAL][0].n_started, 1);
    assert_int_equal(processing_again(w.p, w.now_ns, "20260101_b", STEP_FINAL, why), -ENOENT);
}

static void memory_bounds_what_is_developed_at_once(void **state)
{
    (void)state;
    new_world(8, 8);
    w.settings.memory_bytes = 250 * (int64_t)MB; // two frames of 100 MB
    new_life();
    struct study *t = new_take("20260101_a", 6);
    add(t);
    run(0);
    assert_int_equal(t->record.state, TAKE_SOLVED);
    assert_true(started_at(t, STEP_RECONSTRUCT) >= 1000 * S + 3 * S); // check_room() saw the rest
    new_world(8, 8);
    w.settings.memory_bytes = 1; // one always fits
    new_life();
    t = new_take("20260101_a", 3);
    add(t);
    run(0);
    assert_int_equal(t->record.state, TAKE_SOLVED);
}

// A life ends at every moment of a story with faults; the next ones finish it, and make only what was not kept.
static void killed_at_any_moment_the_next_life_finishes(void **state)
{
    (void)state;
    for (int64_t kill_ms = 0; kill_ms < 32000; kill_ms += 250) {
        new_world(3, 2);
        w.duration_ns[STEP_STANDARD] = 7 * S;
        struct study *light = new_take("20260101_light", 0), *a = new_take("20260102_a", 5), *b = new_take("20260103_b", 4);
        light->is_panorama = true;
        a->panorama_of = b->panorama_of = light->id;
        b->place[STEP_DEVELOP][2].refuses = true;
        b->has_geometry = true;
        add(light), add(a), add(b);
        run(w.now_ns + kill_ms * 1000000 + 1);
        int kept[TAKES] = { 0 }, begun[TAKES] = { 0 };
        for (int t = 0; t < w.n_takes; t++)
            for (int s = 0; s < PROCESSING_N_STEPS; s++)
                for (int i = 0; i < ITEMS; i++)
                    kept[t] += w.take[t].place[s][i].made, begun[t] += w.take[t].place[s][i].n_started;
        new_life();
        run(0);
        assert_int_equal(light->record.state, TAKE_DEVELOPED);
        assert_int_equal(a->record.state, TAKE_SOLVED);
        assert_int_equal(b->record.state, TAKE_SOLVED);
        assert_int_equal(a->record.n_notes, 0);
        expect_note(b, "camera A03 (usb:1-3)");
        for (int t = 0; t < w.n_takes; t++) { // start_job() refuses to make what was kept
            assert_int_equal(w.take[t].n_settled, 1);
            int made = 0;
            for (int s = 0; s < PROCESSING_N_STEPS; s++)
                for (int i = 0; i < ITEMS; i++)
                    made += w.take[t].place[s][i].made;
            assert_true(made >= kept[t] && begun[t] >= kept[t]);
        }
    }
}

static uint64_t dice;

static int roll(int n)
{
    dice = dice * 6364136223846793005u + 1442695040888963407u;
    return (int)((dice >> 33) % (unsigned)n);
}

// Faults, shots, cancels and deaths in any order: everything settles, or is said.
static void whatever_happens_every_take_ends_and_says_what_it_lacks(void **state)
{
    (void)state;
    for (seed = 1; seed <= 400; seed++) {
        dice = (uint64_t)seed;
        new_world(1 + roll(4), 1 + roll(3));
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            w.settings.timeout_s[s] = s == STEP_STANDARD ? 300 : 60;
        new_life();
        const int n_takes = 1 + roll(TAKES);
        for (int i = 0; i < n_takes; i++) {
            char id[40];
            snprintf(id, sizeof(id), "2026010%d_t", i + 1);
            struct study *t = new_take(id, roll(ITEMS));
            t->has_thumbnails = roll(2), t->has_geometry = roll(2), t->no_panorama = !roll(4), t->is_panorama = i == 0;
            if (i && roll(2))
                t->panorama_of = w.take[0].id, t->no_panorama = false;
            for (int s = 0; s < PROCESSING_N_STEPS; s++)
                for (int k = 0; k < ITEMS; k++) {
                    struct place *p = &t->place[s][k];
                    p->dies = roll(12) ? 0 : 1 + roll(2);
                    p->hangs = !roll(30);
                    p->deaf = !roll(2);
                    p->refuses = p->hangs || p->dies == 2 || !roll(15);
                }
        }
        for (int turn = 0; turn < 30; turn++) {
            char why[200];
            struct study *t = &w.take[roll(n_takes)];
            switch (roll(7)) {
            case 0:
                hold(!w.held);
                break;
            case 1:
                if (processing_find(w.p, t->id) >= 0)
                    processing_cancel(w.p, w.now_ns, t->id);
                break;
            case 2:
                processing_again(w.p, w.now_ns, t->id, (enum processing_step)(t->is_panorama ? STEP_PANORAMA : roll(PROCESSING_N_STEPS)), why);
                break;
            case 3:
                new_life();
                break;
            case 4:
                processing_urge(w.p, w.now_ns, t->id);
                break;
            default:
                add(t);
            }
            run(w.now_ns + roll(20) * S + 1);
        }
        if (w.held)
            hold(false);
        for (int i = 0; i < n_takes; i++)
            add(&w.take[i]);
        run(0);
        assert_true(processing_is_idle(w.p));
        for (int i = 0; i < n_takes; i++) {
            const struct study *t = &w.take[i];
            assert_int_not_equal(t->record.processing, LEDGER_OWED);
            if (t->record.state != TAKE_SOLVED && !(t->is_panorama && t->record.state == TAKE_DEVELOPED))
                if (!t->record.n_notes && t->record.processing != LEDGER_CANCELLED)
                    fail_msg("%s is %d and does not say why (seed %d)", t->id, t->record.state, seed);
        }
    }
}

static void two_hundred_cameras_are_one_queue_among_others(void **state)
{
    (void)state;
    new_world(16, 16);
    struct processing_item *item = calloc(200, sizeof(*item));
    struct processing_action a;
    int n_started = 0;
    for (int i = 0; i < 200; i++)
        item[i].verdict = PRODUCT_OWED;
    processing_add(w.p, 0, &(struct processing_take){ .id = "20260101_a", .is_owed = true });
    processing_looked(w.p, 0, "20260101_a", STEP_DEVELOP, item, 200, NULL);
    for (int round = 0; round < 1000; round++)
        while (processing_next(w.p, &a)) {
            if (a.kind == PROCESSING_START)
                n_started++, processing_ended(w.p, 0, a.take, a.step, a.item, JOB_DONE, NULL);
            if (a.kind == PROCESSING_KEEP)
                processing_kept(w.p, 0, a.take, a.step, a.item, true, "");
        }
    assert_int_equal(n_started, 200);
    // What comes late, twice, or about nobody changes nothing.
    processing_ended(w.p, 0, "20260101_a", STEP_DEVELOP, 7, JOB_KILLED, "x");
    processing_ended(w.p, 0, "20260101_a", STEP_DEVELOP, 4711, JOB_DONE, NULL);
    processing_kept(w.p, 0, "nobody", STEP_DEVELOP, 0, true, "");
    processing_looked(w.p, 0, "20260101_a", STEP_DEVELOP, NULL, 0, NULL);
    processing_progress(w.p, 0, "nobody", STEP_PREVIEW, "joint", 1, 2);
    const struct processing_step_view v = processing_step(w.p, 0, STEP_DEVELOP);
    assert_int_equal(v.state, PROCESSING_DONE);
    assert_int_equal(v.n_done, 200);
    free(item);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_take_is_developed_lit_reconstructed_and_solved),
        cmocka_unit_test(the_newest_take_comes_first_and_an_old_long_solve_makes_room),
        cmocka_unit_test(takes_wait_for_the_panorama_that_lights_them),
        cmocka_unit_test(what_is_killed_is_started_once_more_what_refuses_is_not),
        cmocka_unit_test(a_failed_preview_spares_the_long_solve),
        cmocka_unit_test(while_the_rig_shoots_nothing_runs_and_time_does_not_count),
        cmocka_unit_test(what_hangs_is_stopped_then_killed_and_said),
        cmocka_unit_test(cancelled_is_cancelled_and_can_be_begun_again),
        cmocka_unit_test(again_makes_one_step_anew_and_looks_at_what_follows),
        cmocka_unit_test(memory_bounds_what_is_developed_at_once),
        cmocka_unit_test(killed_at_any_moment_the_next_life_finishes),
        cmocka_unit_test(whatever_happens_every_take_ends_and_says_what_it_lacks),
        cmocka_unit_test(two_hundred_cameras_are_one_queue_among_others),
    };
    const int failed = cmocka_run_group_tests(tests, NULL, NULL);
    processing_free(w.p);
    return failed;
}
