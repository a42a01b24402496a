// rigd/processing.c - steps, items, slots and ranks.
//
// Every input ends in advance(): steps are brought up to date until nothing changes, then the best candidate is started as long as
// there is room, then what people and take.json should know is told. Nothing else decides.
#include "rigd/processing.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define S INT64_C(1000000000)
enum { TRIES_MAX = 2, KILL_AFTER_S = 5, SETTLED_KEPT = 8 };

enum item_state {
    ITEM_PENDING,
    ITEM_RUNNING,
    ITEM_STOPPING,
    ITEM_ENDED,   // well: to be kept
    ITEM_KEEPING,
    ITEM_DONE,
    ITEM_FAILED,
    ITEM_CANCELLED,
};

struct item {
    struct processing_item what;
    enum item_state state;
    bool paused, too_long;
    int tries;
    int64_t since_ns, ran_ns; // running since, and before that; what is paused does not age
    int64_t kill_ns;          // STOPPING: when it is killed
    char text[PROCESSING_TEXT];
};

struct step {
    enum processing_state state;
    struct item *item;
    int n_items;
    bool waits_for_take;
    char other[96];
    int64_t began_ns, ended_ns; // INT64_MIN: not yet
    bool was_there;
    char text[PROCESSING_TEXT], stage[24];
    int64_t done, total;
};

struct take {
    char id[96];
    bool is_panorama, urgent, cancelled, settled;
    bool dirty, recording;
    unsigned forget;
    int64_t added_ns;
    struct step step[PROCESSING_N_STEPS];
};

struct processing {
    struct processing_settings settings;
    struct take **take;
    int n_takes;
    bool held;
    struct processing_action *action;
    int n_actions, next_action, room_actions;
};

static const char *const step_names[PROCESSING_N_STEPS] = { "sheet", "develop", "panorama", "reconstruct", "preview", "focus", "standard", "final" };
static const char *const state_names[] = { "off", "waiting", "looking", "running", "done", "failed", "missing", "cancelled" };

#define BIT(step) (1u << (step))
static const unsigned needs[PROCESSING_N_STEPS] = {
    [STEP_RECONSTRUCT] = BIT(STEP_DEVELOP),
    [STEP_PREVIEW] = BIT(STEP_DEVELOP) | BIT(STEP_PANORAMA) | BIT(STEP_RECONSTRUCT),
    [STEP_FOCUS] = BIT(STEP_DEVELOP),
    [STEP_STANDARD] = BIT(STEP_DEVELOP) | BIT(STEP_PANORAMA) | BIT(STEP_RECONSTRUCT),
    [STEP_FINAL] = BIT(STEP_DEVELOP) | BIT(STEP_PANORAMA) | BIT(STEP_RECONSTRUCT),
};
// Not needed, but waited for: the quick answer first.
static const unsigned after[PROCESSING_N_STEPS] = {
    [STEP_STANDARD] = BIT(STEP_PREVIEW),
    [STEP_FINAL] = BIT(STEP_PREVIEW) | BIT(STEP_STANDARD),
};

const char *processing_step_name(enum processing_step step)
{
    return (unsigned)step < PROCESSING_N_STEPS ? step_names[step] : "?";
}

int processing_step_named(const char *name)
{
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if (!strcmp(name, step_names[s]))
            return s;
    return -1;
}

const char *processing_state_name(enum processing_state state)
{
    return (unsigned)state < sizeof(state_names) / sizeof(state_names[0]) ? state_names[state] : "?";
}

unsigned processing_followers(enum processing_step step)
{
    unsigned mask = BIT(step);
    for (int s = 0; s < PROCESSING_N_STEPS; s++) // needs come earlier in the list
        if (needs[s] & mask)
            mask |= BIT(s);
    return mask;
}

// ---- small things -------------------------------------------------------------------------------------------------------------

static struct processing_action *act(struct processing *p, enum processing_action_kind kind, const struct take *t, enum processing_step step, int item)
{
    if (p->n_actions == p->room_actions) {
        const int room = p->room_actions ? 2 * p->room_actions : 64;
        struct processing_action *grown = realloc(p->action, (size_t)room * sizeof(*grown));
        if (!grown)
            abort(); // as everywhere in the daemon: systemd starts it again, and what is owed is found again
        p->action = grown;
        p->room_actions = room;
    }
    struct processing_action *a = &p->action[p->n_actions++];
    *a = (struct processing_action){ .kind = kind, .step = step, .item = item };
    memcpy(a->take, t->id, sizeof(a->take));
    return a;
}

bool processing_next(struct processing *p, struct processing_action *out)
{
    if (p->next_action == p->n_actions) {
        p->next_action = p->n_actions = 0;
        return false;
    }
    *out = p->action[p->next_action++];
    return true;
}

static bool is_settled(enum processing_state s)
{
    return s == PROCESSING_OFF || s >= PROCESSING_DONE;
}

static bool is_final(enum item_state s)
{
    return s >= ITEM_DONE;
}

static int count(const struct step *s, enum item_state state)
{
    int n = 0;
    for (int i = 0; i < s->n_items; i++)
        n += s->item[i].state == state;
    return n;
}

// What others may build on: made, not wanted, or - of many - at least one made.
static bool is_met(const struct step *s)
{
    return s->state == PROCESSING_OFF || s->state == PROCESSING_DONE || (s->state == PROCESSING_FAILED && count(s, ITEM_DONE) > 0);
}

static void copy(char *out, size_t room, const char *text)
{
    snprintf(out, room, "%s", text ? text : "");
}

static struct take *find(const struct processing *p, const char *id)
{
    for (int i = 0; i < p->n_takes; i++)
        if (!strcmp(p->take[i]->id, id))
            return p->take[i];
    return NULL;
}

static void free_items(struct step *s)
{
    free(s->item);
    s->item = NULL;
    s->n_items = 0;
}

static void begin_anew(struct step *s)
{
    free_items(s);
    *s = (struct step){ .state = PROCESSING_WAITING, .began_ns = INT64_MIN, .ended_ns = INT64_MIN };
}

static int weight(const struct processing *p, const struct take *t, enum processing_step step)
{
    const bool all = step == STEP_RECONSTRUCT || step == STEP_PREVIEW || step == STEP_STANDARD || step == STEP_FINAL || (step == STEP_PANORAMA && t->is_panorama);
    return all ? p->settings.n_slots : 1;
}

// Who of two goes first: < 0 the first one.
static int rank(const struct take *t, enum processing_step step)
{
    switch (step) {
    case STEP_SHEET:
        return 0;
    case STEP_FOCUS:
        return 3;
    case STEP_STANDARD:
        return 4;
    case STEP_FINAL:
        return 5;
    default:
        return t->is_panorama ? 1 : 2; // others wait for it
    }
}

struct candidate {
    struct take *take;
    enum processing_step step;
    int item;
};

static int order(const struct candidate *a, const struct candidate *b)
{
    const int by_rank = rank(a->take, a->step) - rank(b->take, b->step);
    if (by_rank)
        return by_rank;
    if (a->take->urgent != b->take->urgent)
        return a->take->urgent ? -1 : 1;
    const int by_age = strcmp(b->take->id, a->take->id); // names begin with the time
    if (by_age)
        return by_age;
    return a->step != b->step ? (int)a->step - (int)b->step : a->item - b->item;
}

// ---- steps --------------------------------------------------------------------------------------------------------------------

static void settle(struct processing *p, int64_t now_ns, struct take *t, enum processing_step step, enum processing_state state, const char *text)
{
    struct step *s = &t->step[step];
    s->state = state;
    s->stage[0] = 0;
    if (text)
        copy(s->text, sizeof(s->text), text);
    s->ended_ns = s->was_there ? t->added_ns : now_ns;
    if (s->was_there)
        s->began_ns = t->added_ns;
    t->dirty = true;
    act(p, PROCESSING_STATE, t, step, 0);
}

static void describe_item(char *out, size_t room, const struct item *i)
{
    if (i->what.name[0])
        snprintf(out, room, "camera %.24s%s%.48s%s: %.150s", i->what.name, i->what.slot[0] ? " (" : "", i->what.slot, i->what.slot[0] ? ")" : "", i->text);
    else
        snprintf(out, room, "%s", i->text);
}

static void close_step(struct processing *p, int64_t now_ns, struct take *t, enum processing_step step)
{
    struct step *s = &t->step[step];
    const int n_failed = count(s, ITEM_FAILED);
    char text[PROCESSING_TEXT] = "", first[PROCESSING_TEXT - 24];
    if (count(s, ITEM_CANCELLED)) {
        settle(p, now_ns, t, step, PROCESSING_CANCELLED, "cancelled");
        return;
    }
    for (int i = 0; i < s->n_items && !text[0]; i++)
        if (s->item[i].text[0] && (s->item[i].state == ITEM_FAILED || !n_failed)) {
            describe_item(first, sizeof(first), &s->item[i]);
            if (n_failed > 1)
                snprintf(text, sizeof(text), "%s; and %d more", first, n_failed - 1);
            else
                copy(text, sizeof(text), first);
        }
    settle(p, now_ns, t, step, n_failed ? PROCESSING_FAILED : PROCESSING_DONE, text);
}

// Which of the steps that it needs stand in its way, as "panorama and reconstruct".
static bool is_blocked(const struct take *t, enum processing_step step, char *text, size_t room)
{
    int n = 0;
    size_t used = 0;
    for (int k = 0; k < PROCESSING_N_STEPS; k++) {
        const struct step *other = &t->step[k];
        if (!(needs[step] & BIT(k)) || is_met(other) || !is_settled(other->state))
            continue;
        used += (size_t)snprintf(text + used, room - used, "%s%s", n++ ? " and " : "not started: ", step_names[k]);
        if (used >= room)
            return true;
    }
    if (n)
        snprintf(text + used, room - used, " %s missing", n > 1 ? "are" : "is");
    return n > 0;
}

static void look(struct processing *p, struct take *t, enum processing_step step)
{
    t->step[step].state = PROCESSING_LOOKING;
    t->step[step].waits_for_take = false;
    act(p, PROCESSING_LOOK, t, step, 0);
}

static bool all_settled(const struct take *t, unsigned mask)
{
    for (int k = 0; k < PROCESSING_N_STEPS; k++)
        if ((mask & BIT(k)) && !is_settled(t->step[k].state))
            return false;
    return true;
}

// True: something changed.
static bool update(struct processing *p, int64_t now_ns, struct take *t, enum processing_step step)
{
    struct step *s = &t->step[step];
    char text[PROCESSING_TEXT] = "";
    if (s->state == PROCESSING_OPEN) {
        for (int i = 0; i < s->n_items; i++)
            if (!is_final(s->item[i].state))
                return false;
        close_step(p, now_ns, t, step);
        return true;
    }
    if (s->state != PROCESSING_WAITING)
        return false;
    if (t->cancelled) {
        settle(p, now_ns, t, step, PROCESSING_CANCELLED, "cancelled");
        return true;
    }
    if (!all_settled(t, needs[step] | after[step]))
        return false;
    if (is_blocked(t, step, text, sizeof(text))) {
        settle(p, now_ns, t, step, PROCESSING_MISSING, text);
        return true;
    }
    for (int k = 0; k < PROCESSING_N_STEPS; k++)
        if ((after[step] & BIT(k)) && t->step[k].state == PROCESSING_FAILED) { // the same would happen again, and take longer
            snprintf(text, sizeof(text), "not started: %s failed", step_names[k]);
            settle(p, now_ns, t, step, PROCESSING_MISSING, text);
            return true;
        }
    if (s->waits_for_take) {
        const struct take *other = find(p, s->other);
        if (other && !other->cancelled && !is_settled(other->step[STEP_PANORAMA].state))
            return false;
    }
    if (p->held)
        return false;
    look(p, t, step);
    return true;
}

// ---- slots --------------------------------------------------------------------------------------------------------------------

static struct item *item_of(const struct candidate *c)
{
    return &c->take->step[c->step].item[c->item];
}

static bool runs(const struct item *i)
{
    return (i->state == ITEM_RUNNING && !i->paused) || i->state == ITEM_STOPPING;
}

struct load {
    int slots, develops;
    int64_t memory_bytes;
};

static struct load measure(const struct processing *p)
{
    struct load l = { 0 };
    for (int t = 0; t < p->n_takes; t++)
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const struct item *item = &p->take[t]->step[s].item[i];
                if (s == STEP_DEVELOP && (runs(item) || item->paused)) { // paused ones keep their memory
                    l.develops++;
                    l.memory_bytes += item->what.memory_bytes;
                }
                if (runs(item))
                    l.slots += weight(p, p->take[t], s);
            }
    return l;
}

// The best of what could run; false: nothing.
static bool best(const struct processing *p, struct candidate *out, bool without_develop)
{
    bool any = false;
    for (int t = 0; t < p->n_takes; t++)
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const struct candidate c = { p->take[t], s, i };
                const struct item *item = item_of(&c);
                const bool pending = item->state == ITEM_PENDING, paused = item->state == ITEM_RUNNING && item->paused;
                if ((!pending && !paused) || (without_develop && s == STEP_DEVELOP && pending))
                    continue;
                if (!any || order(&c, out) < 0)
                    *out = c;
                any = true;
            }
    return any;
}

// The worst of what runs and can be paused for c; false: nothing is worse.
static bool worst(const struct processing *p, const struct candidate *c, struct candidate *out)
{
    bool any = false;
    for (int t = 0; t < p->n_takes; t++)
        for (int s = STEP_RECONSTRUCT; s < PROCESSING_N_STEPS; s++) // others are short
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const struct candidate k = { p->take[t], s, i };
                const struct item *item = item_of(&k);
                if (item->state != ITEM_RUNNING || item->paused || order(c, &k) >= 0)
                    continue;
                if (!any || order(&k, out) > 0)
                    *out = k;
                any = true;
            }
    return any;
}

static void pause_item(struct processing *p, int64_t now_ns, const struct candidate *c)
{
    struct item *i = item_of(c);
    i->paused = true;
    i->ran_ns += now_ns - i->since_ns;
    act(p, PROCESSING_PAUSE, c->take, c->step, c->item);
}

static void start(struct processing *p, int64_t now_ns, const struct candidate *c)
{
    struct item *i = item_of(c);
    struct step *s = &c->take->step[c->step];
    if (i->paused) {
        i->paused = false;
        act(p, PROCESSING_CONTINUE, c->take, c->step, c->item);
    } else {
        i->state = ITEM_RUNNING;
        i->ran_ns = 0;
        i->tries++;
        if (s->began_ns == INT64_MIN)
            s->began_ns = now_ns;
        act(p, PROCESSING_START, c->take, c->step, c->item);
    }
    i->since_ns = now_ns;
    act(p, PROCESSING_STATE, c->take, c->step, 0);
}

// Something better is between two steps, with the disk: c does not begin just to be in its way.
static bool better_is_coming(const struct processing *p, const struct candidate *c)
{
    for (int t = 0; t < p->n_takes; t++)
        for (int s = STEP_DEVELOP; s <= STEP_PREVIEW; s++) {
            const struct candidate next = { p->take[t], STEP_PREVIEW, 0 };
            const struct step *step = &p->take[t]->step[s];
            if ((step->state == PROCESSING_LOOKING || count(step, ITEM_ENDED) || count(step, ITEM_KEEPING)) && order(&next, c) < 0)
                return true;
        }
    return false;
}

static void schedule(struct processing *p, int64_t now_ns)
{
    struct candidate c, victim;
    bool develop_is_full = false;
    while (best(p, &c, develop_is_full)) {
        const struct load l = measure(p);
        const struct item *i = item_of(&c);
        if (better_is_coming(p, &c))
            return;
        if (c.step == STEP_DEVELOP && !i->paused && l.develops > 0 &&
            (l.develops >= p->settings.n_develop || l.memory_bytes + i->what.memory_bytes > p->settings.memory_bytes)) {
            develop_is_full = true; // others may use the cores
            continue;
        }
        if (l.slots + weight(p, c.take, c.step) <= p->settings.n_slots) {
            start(p, now_ns, &c);
        } else if (worst(p, &c, &victim)) {
            pause_item(p, now_ns, &victim);
        } else {
            return; // nothing worse is started meanwhile: it would have to wait for that, too
        }
    }
}

// ---- the whole ----------------------------------------------------------------------------------------------------------------

static void keep_what_ended(struct processing *p, struct take *t)
{
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        for (int i = 0; i < t->step[s].n_items; i++)
            if (t->step[s].item[i].state == ITEM_ENDED) {
                t->step[s].item[i].state = ITEM_KEEPING;
                act(p, PROCESSING_KEEP, t, s, i);
            }
}

static void tell(struct processing *p, struct take *t)
{
    if (p->held || t->recording)
        return;
    if (t->dirty) {
        t->dirty = false;
        t->recording = true;
        act(p, PROCESSING_RECORD, t, 0, 0);
    } else if (!t->settled && all_settled(t, ~0u)) {
        t->settled = true;
        t->urgent = false;
        act(p, PROCESSING_SETTLED, t, 0, 0);
    }
}

static void free_take(struct take *t)
{
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        free_items(&t->step[s]);
    free(t);
}

static void forget_old(struct processing *p)
{
    int n_settled = 0;
    for (int i = 0; i < p->n_takes; i++)
        n_settled += p->take[i]->settled;
    for (int i = 0; i < p->n_takes && n_settled > SETTLED_KEPT;)
        if (p->take[i]->settled) {
            free_take(p->take[i]);
            memmove(p->take + i, p->take + i + 1, (size_t)(--p->n_takes - i) * sizeof(*p->take));
            n_settled--;
        } else {
            i++;
        }
}

static void advance(struct processing *p, int64_t now_ns)
{
    for (bool changed = true; changed;) {
        changed = false;
        for (int i = 0; i < p->n_takes; i++) {
            struct take *t = p->take[i];
            if (t->settled)
                continue;
            if (t->forget && !p->held) {
                act(p, PROCESSING_FORGET, t, 0, 0)->mask = t->forget;
                t->forget = 0;
            }
            for (int s = 0; s < PROCESSING_N_STEPS; s++)
                changed |= update(p, now_ns, t, s);
        }
    }
    for (int i = 0; i < p->n_takes && !p->held; i++)
        keep_what_ended(p, p->take[i]);
    if (!p->held)
        schedule(p, now_ns);
    for (int i = 0; i < p->n_takes; i++)
        tell(p, p->take[i]);
    forget_old(p);
}

// ---- what happened ------------------------------------------------------------------------------------------------------------

static void stop_item(struct processing *p, int64_t now_ns, const struct candidate *c)
{
    struct item *i = item_of(c);
    i->state = ITEM_STOPPING;
    i->paused = false; // SIGTERM wakes it, too
    i->kill_ns = now_ns + KILL_AFTER_S * S;
    act(p, PROCESSING_STOP, c->take, c->step, c->item);
}

static int64_t due_ns(const struct processing *p, enum processing_step step, const struct item *i)
{
    if (i->state == ITEM_STOPPING)
        return i->kill_ns;
    if (i->state != ITEM_RUNNING || i->paused || p->settings.timeout_s[step] <= 0)
        return INT64_MAX;
    return i->since_ns + p->settings.timeout_s[step] * S - i->ran_ns;
}

int64_t processing_deadline_ns(const struct processing *p)
{
    int64_t due = INT64_MAX;
    for (int t = 0; t < p->n_takes; t++)
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const int64_t at = due_ns(p, s, &p->take[t]->step[s].item[i]);
                due = at < due ? at : due;
            }
    return due;
}

void processing_time(struct processing *p, int64_t now_ns)
{
    for (int t = 0; t < p->n_takes; t++)
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const struct candidate c = { p->take[t], s, i };
                struct item *item = item_of(&c);
                if (due_ns(p, s, item) > now_ns)
                    continue;
                if (item->state == ITEM_STOPPING) {
                    item->kill_ns = INT64_MAX;
                    act(p, PROCESSING_KILL, c.take, s, i);
                } else {
                    item->too_long = true;
                    stop_item(p, now_ns, &c);
                }
            }
    advance(p, now_ns);
}

void processing_hold(struct processing *p, int64_t now_ns, bool hold)
{
    if (p->held == hold)
        return;
    p->held = hold;
    for (int t = 0; t < p->n_takes && hold; t++)
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            for (int i = 0; i < p->take[t]->step[s].n_items; i++) {
                const struct candidate c = { p->take[t], s, i };
                if (item_of(&c)->state == ITEM_RUNNING && !item_of(&c)->paused)
                    pause_item(p, now_ns, &c);
            }
    advance(p, now_ns);
}

void processing_looked(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, const struct processing_item *items, int n, const char *text)
{
    struct take *t = find(p, take);
    struct step *s = t ? &t->step[step] : NULL;
    if (!t || s->state != PROCESSING_LOOKING)
        return;
    free_items(s);
    s->began_ns = s->ended_ns = INT64_MIN;
    s->was_there = false;
    if (t->cancelled) {
        s->state = PROCESSING_WAITING; // update() settles it
    } else if (text) {
        settle(p, now_ns, t, step, PROCESSING_MISSING, text);
    } else if (n == 1 && items[0].verdict == PRODUCT_WAITS) {
        const struct take *other = find(p, items[0].name);
        char why[PROCESSING_TEXT];
        if (other && !other->cancelled && !is_settled(other->step[STEP_PANORAMA].state)) {
            s->state = PROCESSING_WAITING;
            s->waits_for_take = true;
            copy(s->other, sizeof(s->other), items[0].name);
            snprintf(s->text, sizeof(s->text), "waits for the panorama of take %.95s", items[0].name);
        } else {
            snprintf(why, sizeof(why), "the panorama of take %.95s is not there; rigctl process of that take makes it", items[0].name);
            settle(p, now_ns, t, step, PROCESSING_MISSING, why);
        }
    } else {
        s->item = calloc((size_t)n + 1, sizeof(*s->item));
        if (!s->item)
            abort();
        s->n_items = n;
        s->state = PROCESSING_OPEN;
        s->was_there = true;
        s->text[0] = 0;
        for (int i = 0; i < n; i++) {
            s->item[i].what = items[i];
            s->item[i].state = items[i].verdict == PRODUCT_THERE ? ITEM_DONE : items[i].verdict == PRODUCT_OWED ? ITEM_PENDING : ITEM_FAILED;
            s->was_there &= items[i].verdict == PRODUCT_THERE;
            copy(s->item[i].text, sizeof(s->item[i].text), items[i].text);
        }
    }
    advance(p, now_ns);
}

void processing_progress(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, const char *stage, int64_t done, int64_t total)
{
    struct take *t = find(p, take);
    (void)now_ns;
    if (!t || t->step[step].state != PROCESSING_OPEN)
        return;
    copy(t->step[step].stage, sizeof(t->step[step].stage), stage);
    t->step[step].done = done;
    t->step[step].total = total;
}

static struct item *running_item(struct take *t, enum processing_step step, int item)
{
    if (!t || item < 0 || item >= t->step[step].n_items)
        return NULL;
    struct item *i = &t->step[step].item[item];
    return i->state == ITEM_RUNNING || i->state == ITEM_STOPPING ? i : NULL;
}

void processing_ended(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, int item, enum processing_how how, const char *text)
{
    struct take *t = find(p, take);
    struct item *i = running_item(t, step, item);
    if (!i)
        return;
    const bool stopped = i->state == ITEM_STOPPING;
    i->paused = false;
    if (how == JOB_DONE) {
        i->state = ITEM_ENDED;
    } else if (i->too_long) {
        i->state = ITEM_FAILED;
        snprintf(i->text, sizeof(i->text), "not ready after %d s, and stopped; raise its timeout_s in rigd.conf, or look why (rigctl process --again %s)", p->settings.timeout_s[step],
                 step_names[step]);
    } else if (stopped && t->cancelled) {
        i->state = ITEM_CANCELLED;
    } else if (how == JOB_KILLED && i->tries < TRIES_MAX) {
        i->state = ITEM_PENDING;
    } else {
        i->state = ITEM_FAILED;
        if (how == JOB_KILLED)
            snprintf(i->text, sizeof(i->text), "ended %d times by a signal (%.120s); is there memory enough? rigctl process --again %s tries once more", i->tries, text ? text : "?",
                     step_names[step]);
        else
            copy(i->text, sizeof(i->text), text);
    }
    act(p, PROCESSING_STATE, t, step, 0);
    advance(p, now_ns);
}

void processing_kept(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, int item, bool ok, const char *text)
{
    struct take *t = find(p, take);
    if (!t || item < 0 || item >= t->step[step].n_items || t->step[step].item[item].state != ITEM_KEEPING)
        return;
    struct item *i = &t->step[step].item[item];
    i->state = ok ? ITEM_DONE : ITEM_FAILED;
    copy(i->text, sizeof(i->text), text);
    act(p, PROCESSING_STATE, t, step, 0);
    advance(p, now_ns);
}

void processing_recorded(struct processing *p, int64_t now_ns, const char *take, int err)
{
    struct take *t = find(p, take);
    (void)err; // said where it happened; the next start finds the take owed, and all of it there
    if (!t)
        return;
    t->recording = false;
    advance(p, now_ns);
}

// ---- what is wanted -----------------------------------------------------------------------------------------------------------

static bool is_wanted(const struct processing *p, const struct take *t, const struct processing_take *what, enum processing_step step)
{
    if (t->is_panorama)
        return step == STEP_PANORAMA;
    return ((p->settings.wanted | what->more) & BIT(step)) != 0;
}

int processing_add(struct processing *p, int64_t now_ns, const struct processing_take *what)
{
    struct take *t = find(p, what->id);
    if (!t) {
        struct take **grown = realloc(p->take, ((size_t)p->n_takes + 1) * sizeof(*grown));
        if (grown)
            p->take = grown;
        t = calloc(1, sizeof(*t));
        if (!grown || !t) {
            free(t);
            return -ENOMEM;
        }
        p->take[p->n_takes++] = t;
        copy(t->id, sizeof(t->id), what->id);
        t->settled = true;
        t->added_ns = now_ns;
        for (int s = 0; s < PROCESSING_N_STEPS; s++)
            t->step[s].began_ns = t->step[s].ended_ns = INT64_MIN;
    }
    if (t->settled)
        t->is_panorama = what->is_panorama;
    for (int s = 0; s < PROCESSING_N_STEPS; s++) {
        const enum processing_state state = t->step[s].state;
        const bool again = state == PROCESSING_FAILED || state == PROCESSING_MISSING || state == PROCESSING_CANCELLED;
        if ((state == PROCESSING_OFF && is_wanted(p, t, what, s)) || (again && t->settled))
            begin_anew(&t->step[s]);
    }
    if (t->settled) {
        t->cancelled = t->settled = false;
        t->dirty = !what->is_owed;
    }
    advance(p, now_ns);
    return 0;
}

int processing_again(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, char *why)
{
    struct take *t = find(p, take);
    const unsigned mask = processing_followers(step);
    if (!t)
        return -ENOENT;
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if ((mask & BIT(s)) && (t->step[s].state == PROCESSING_LOOKING || t->step[s].state == PROCESSING_OPEN)) {
            snprintf(why, 200, "%s is under way; wait for it, or stop it: rigctl process --cancel %.95s", step_names[s], take);
            return -EBUSY;
        }
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if (s == (int)step || ((mask & BIT(s)) && t->step[s].state != PROCESSING_OFF))
            begin_anew(&t->step[s]); // what follows is looked at: made anew only if what it was made from is another
    t->forget |= BIT(step);
    t->cancelled = t->settled = false;
    t->dirty = true;
    advance(p, now_ns);
    return 0;
}

int processing_cancel(struct processing *p, int64_t now_ns, const char *take)
{
    struct take *t = find(p, take);
    if (!t)
        return -ENOENT;
    if (t->settled)
        return 0;
    t->cancelled = true;
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        for (int i = 0; i < t->step[s].n_items; i++) {
            const struct candidate c = { t, s, i };
            if (item_of(&c)->state == ITEM_RUNNING)
                stop_item(p, now_ns, &c);
            else if (item_of(&c)->state == ITEM_PENDING)
                item_of(&c)->state = ITEM_CANCELLED;
        }
    advance(p, now_ns);
    return 0;
}

void processing_urge(struct processing *p, int64_t now_ns, const char *take)
{
    struct take *t = find(p, take);
    if (!t || t->settled)
        return;
    t->urgent = true;
    advance(p, now_ns);
}

// ---- what is to be seen -------------------------------------------------------------------------------------------------------

int processing_n_takes(const struct processing *p)
{
    return p->n_takes;
}

const char *processing_take_id(const struct processing *p, int i)
{
    return p->take[i]->id;
}

bool processing_is_settled(const struct processing *p, int i)
{
    return p->take[i]->settled;
}

int processing_find(const struct processing *p, const char *take)
{
    for (int i = 0; i < p->n_takes; i++)
        if (!strcmp(p->take[i]->id, take))
            return i;
    return -1;
}

bool processing_is_idle(const struct processing *p)
{
    for (int i = 0; i < p->n_takes; i++)
        if (!p->take[i]->settled)
            return false;
    return true;
}

struct processing_step_view processing_step(const struct processing *p, int i, enum processing_step step)
{
    const struct take *t = p->take[i];
    const struct step *s = &t->step[step];
    struct processing_step_view v = {
        .state = s->state, .n_items = s->n_items, .text = s->text, .stage = s->stage, .done = s->done, .total = s->total,
        .began_s = s->began_ns == INT64_MIN ? -1 : 1e-9 * (double)(s->began_ns - t->added_ns),
        .ended_s = s->ended_ns == INT64_MIN ? -1 : 1e-9 * (double)(s->ended_ns - t->added_ns),
    };
    v.n_done = count(s, ITEM_DONE);
    v.n_failed = count(s, ITEM_FAILED);
    for (int k = 0; k < s->n_items; k++) {
        v.n_running += runs(&s->item[k]);
        v.n_paused += s->item[k].paused;
    }
    return v;
}

static void add_note(struct processing_record *out, const char *step, const char *text, int *n_more)
{
    if (out->n_notes == PROCESSING_NOTES_MAX - 1) {
        ++*n_more;
        return;
    }
    snprintf(out->note[out->n_notes++], PROCESSING_TEXT, "%s: %.220s", step, text);
}

void processing_record(const struct processing *p, const char *take, struct processing_record *out)
{
    const struct take *t = find(p, take);
    int n_more = 0;
    *out = (struct processing_record){ .state = TAKE_VERIFIED };
    for (int s = 0; s < PROCESSING_N_STEPS; s++) {
        const struct step *step = t ? &t->step[s] : NULL;
        const bool made = step && step->state == PROCESSING_DONE && !step->was_there && step->began_ns != INT64_MIN && step->ended_ns != INT64_MIN;
        out->began_ns[s] = made ? step->began_ns : INT64_MIN;
        out->ended_ns[s] = made ? step->ended_ns : INT64_MIN;
    }
    if (!t)
        return;
    const bool developed = t->step[t->is_panorama ? STEP_PANORAMA : STEP_DEVELOP].state == PROCESSING_DONE;
    const bool solved = t->step[STEP_PREVIEW].state == PROCESSING_DONE || t->step[STEP_STANDARD].state == PROCESSING_DONE || t->step[STEP_FINAL].state == PROCESSING_DONE;
    out->state = solved ? TAKE_SOLVED : developed ? TAKE_DEVELOPED : TAKE_VERIFIED;
    out->processing = all_settled(t, ~0u) ? LEDGER_SETTLED : LEDGER_OWED;
    for (int s = 0; s < PROCESSING_N_STEPS; s++) {
        const struct step *step = &t->step[s];
        if (step->state == PROCESSING_CANCELLED && out->processing == LEDGER_SETTLED)
            out->processing = LEDGER_CANCELLED;
        char text[PROCESSING_TEXT];
        if (s == STEP_SHEET && step->state == PROCESSING_DONE && t->step[STEP_FOCUS].state == PROCESSING_DONE)
            continue; // the developed frames know better
        for (int i = 0; i < step->n_items; i++)
            if (step->item[i].text[0] && (step->item[i].state == ITEM_FAILED || step->item[i].state == ITEM_DONE)) {
                describe_item(text, sizeof(text), &step->item[i]);
                add_note(out, step_names[s], text, &n_more);
            }
        if (step->state == PROCESSING_MISSING)
            add_note(out, step_names[s], step->text, &n_more);
    }
    if (n_more)
        snprintf(out->note[out->n_notes++], PROCESSING_TEXT, "and %d more; rigctl process %.95s lists them", n_more, t->id);
}

// ---- life ---------------------------------------------------------------------------------------------------------------------

int processing_create(struct processing **out, const struct processing_settings *settings)
{
    struct processing *p = calloc(1, sizeof(*p));
    if (!p)
        return -ENOMEM;
    p->settings = *settings;
    if (p->settings.n_slots < 1)
        p->settings.n_slots = 1;
    if (p->settings.n_develop < 1)
        p->settings.n_develop = 1;
    *out = p;
    return 0;
}

void processing_free(struct processing *p)
{
    for (int i = 0; p && i < p->n_takes; i++)
        free_take(p->take[i]);
    if (p)
        free(p->take), free(p->action);
    free(p);
}
