// rigd/edges.c - the plan of one shot, wire by wire.
//
// A release follows from the real press, not from the planned one: a host that was late shifts a pulse, it does not cut it short. A
// press follows from its plan alone, so that one late body does not move the others.
#include "rigd/edges.h"
#include "solver/take/log.h"

#include <errno.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>

static int add_wire(struct edges *e, enum edges_role role, int line, const char *camera, const char *key)
{
    const int w = e->n_wires++;
    e->wire[w] = (struct edges_wire){ .role = role, .press_ns = EDGES_NEVER, .release_ns = EDGES_NEVER };
    e->line[w] = (struct lines_wire){ .line = line, .active_low = e->config->trigger.active_low };
    if (camera)
        snprintf(e->line[w].what, sizeof(e->line[w].what), "camera %s: %s", camera, key);
    else
        snprintf(e->line[w].what, sizeof(e->line[w].what), "trigger: %s", key);
    return w;
}

// Wires of one kind: the common one first, then those of single bodies; bodies without one of their own hang on the common one.
static void add_wires(struct edges *e, enum edges_role role, bool of_cameras)
{
    const struct config *c = e->config;
    const char *key = role == EDGES_FULL ? "full_line" : "half_line";
    int *wire_of = role == EDGES_FULL ? e->full_of : e->half_of;
    const int common_line = of_cameras ? CONFIG_NONE : role == EDGES_FULL ? c->trigger.full_line : c->trigger.half_line;
    const int common = common_line == CONFIG_NONE ? CONFIG_NONE : add_wire(e, role, common_line, NULL, key);
    for (int i = 0; i < c->n_cameras; i++) {
        const int own = role == EDGES_FULL ? c->camera[i].full_line : c->camera[i].half_line;
        const int line = of_cameras ? EDGES_LINE_OF(i, role) : own;
        wire_of[i] = line == CONFIG_NONE ? common : add_wire(e, role, line, c->camera[i].name, key);
    }
}

int edges_init(struct edges *e, const struct config *config, bool of_cameras, _Atomic int64_t *limit_ns)
{
    memset(e, 0, sizeof(*e));
    e->config = config;
    e->limit_ns = limit_ns;
    e->max_hold_ns = config->trigger.max_hold_ms * INT64_C(1000000);
    add_wires(e, EDGES_FULL, of_cameras);
    add_wires(e, EDGES_HALF, of_cameras);
    for (int i = 0; i < config->n_cameras; i++) {
        const int line = of_cameras ? EDGES_LINE_OF(i, EDGES_RELAY) : config->camera[i].relay_line;
        e->relay_of[i] = line == CONFIG_NONE ? CONFIG_NONE : add_wire(e, EDGES_RELAY, line, config->camera[i].name, "relay_line");
        if (e->full_of[i] == CONFIG_NONE && i != config_panorama_camera(config)) { // that one its driver can press
            log_error("trigger: camera %s has no full_line and [trigger] has none for all: give it one, or use kind = software",
                config->camera[i].name);
            return -EINVAL;
        }
    }
    return 0;
}

unsigned edges_abilities(const struct edges *e)
{
    unsigned abilities = 0;
    int n_full = 0;
    for (int w = 0; w < e->n_wires; w++) {
        n_full += e->wire[w].role == EDGES_FULL;
        abilities |= e->wire[w].role == EDGES_HALF ? TRIGGER_HALF_PRESS : 0;
        abilities |= e->wire[w].role == EDGES_RELAY ? TRIGGER_RELAYS : 0;
    }
    return abilities | (n_full >= e->config->n_cameras ? TRIGGER_DELAYS : 0);
}

static bool is_skipped(const struct trigger_shot *shot, int camera)
{
    return shot->skip && shot->skip[camera / 64] >> camera % 64 & 1;
}

int edges_plan(struct edges *e, const struct trigger_shot *shot, int64_t now_ns)
{
    const int n_cameras = e->config->n_cameras;
    const int64_t hold_ns = shot->hold_ms * INT64_C(1000000), half_ns = shot->half_ms * INT64_C(1000000);
    int64_t delay_ns[EDGES_WIRES_MAX] = { 0 }, longest_ns = 0;
    int n_bodies[EDGES_WIRES_MAX] = { 0 }, n_pressed = 0;
    bool half = false;
    if (e->pending)
        return -EBUSY;
    for (int i = 0; i < n_cameras; i++) {
        const int64_t us = shot->delay_us ? shot->delay_us[i] : 0;
        if (is_skipped(shot, i) || e->full_of[i] == CONFIG_NONE)
            continue;
        if (us >= 1000000)
            return -EINVAL;
        delay_ns[e->full_of[i]] += us * 1000;
        n_bodies[e->full_of[i]]++;
        half |= half_ns > 0 && e->half_of[i] != CONFIG_NONE;
        n_pressed++;
        longest_ns = us * 1000 > longest_ns ? us * 1000 : longest_ns;
    }
    if (!n_pressed || hold_ns <= 0 || hold_ns + (half ? half_ns + longest_ns : 0) > e->max_hold_ns)
        return -EINVAL;
    if (shot->at_ns - (half ? half_ns : 0) < now_ns)
        return -ETIME;

    e->pending = true;
    e->hold_ns = hold_ns;
    e->due_ns = EDGES_NEVER;
    memset(e->in_shot, 0, sizeof(e->in_shot));
    for (int w = 0; w < e->n_wires; w++) {
        if (!n_bodies[w])
            continue;
        e->wire[w].press_ns = shot->at_ns + delay_ns[w] / n_bodies[w];
        e->due_ns = e->wire[w].press_ns < e->due_ns ? e->wire[w].press_ns : e->due_ns;
    }
    for (int i = 0; half && i < n_cameras; i++) {
        if (is_skipped(shot, i) || e->full_of[i] == CONFIG_NONE || e->half_of[i] == CONFIG_NONE)
            continue;
        e->in_shot[i] = true;
        e->wire[e->half_of[i]].press_ns = shot->at_ns - half_ns;
        e->wire[e->half_of[i]].n_needed++;
    }
    return 0;
}

// The earlier of its limit and its release; 0 when somebody else has cut it already.
static int64_t end_ns(const struct edges *e, int w)
{
    const int64_t limit_ns = atomic_load(&e->limit_ns[w]);
    return limit_ns < e->wire[w].release_ns ? limit_ns : e->wire[w].release_ns;
}

int64_t edges_next_ns(const struct edges *e)
{
    int64_t next_ns = EDGES_NEVER;
    for (int w = 0; w < e->n_wires; w++) {
        const int64_t t = e->wire[w].pressed ? end_ns(e, w) : e->wire[w].press_ns;
        next_ns = t < next_ns ? t : next_ns;
    }
    return next_ns;
}

static void change(struct edges *e, int w, bool active, int64_t now_ns, struct edges_step *out)
{
    struct edges_wire *wire = &e->wire[w];
    wire->pressed = active;
    wire->press_ns = EDGES_NEVER;
    wire->release_ns = active && wire->role == EDGES_FULL ? now_ns + e->hold_ns : EDGES_NEVER;
    atomic_store(&e->limit_ns[w], active ? now_ns + e->max_hold_ns : 0);
    out->changed[w / 64] |= UINT64_C(1) << w % 64;
    out->any = true;
}

static void finish(struct edges *e, struct edges_step *out)
{
    bool busy = false;
    for (int w = 0; w < e->n_wires; w++) {
        if (e->wire[w].pressed)
            out->active[w / 64] |= UINT64_C(1) << w % 64;
        busy |= e->wire[w].role != EDGES_RELAY && (e->wire[w].pressed || e->wire[w].press_ns != EDGES_NEVER);
    }
    out->done = e->pending && !busy;
    e->pending = e->pending && busy;
}

void edges_step(struct edges *e, int64_t now_ns, struct edges_step *out)
{
    memset(out, 0, sizeof(*out));
    for (int w = 0; w < e->n_wires; w++)
        out->too_late |= e->wire[w].press_ns < now_ns - EDGES_LATE_MAX_NS;
    if (out->too_late) {
        edges_give_up(e, false, out);
        out->too_late = out->done = true;
        return;
    }
    for (int w = 0; w < e->n_wires; w++) { // full-presses come first: a half-press sees that it is not needed any more
        struct edges_wire *wire = &e->wire[w];
        if (wire->pressed && end_ns(e, w) <= now_ns) {
            out->cut |= atomic_load(&e->limit_ns[w]) == 0;
            change(e, w, false, now_ns, out);
            for (int i = 0; wire->role == EDGES_FULL && i < e->config->n_cameras; i++) {
                struct edges_wire *half = e->in_shot[i] && e->full_of[i] == w ? &e->wire[e->half_of[i]] : NULL;
                if (half && --half->n_needed == 0)
                    half->release_ns = now_ns;
            }
        } else if (!wire->pressed && wire->press_ns <= now_ns) {
            out->first |= wire->role == EDGES_FULL && wire->press_ns == e->due_ns;
            change(e, w, true, now_ns, out);
        }
    }
    finish(e, out);
}

void edges_set(struct edges *e, const struct edges_step *step, int64_t now_ns)
{
    for (int w = 0; w < e->n_wires; w++)
        if (e->wire[w].role == EDGES_FULL && e->wire[w].pressed && step->changed[w / 64] >> w % 64 & 1)
            e->wire[w].release_ns = now_ns + e->hold_ns;
}

void edges_give_up(struct edges *e, bool relays, struct edges_step *out)
{
    const bool pending = e->pending;
    memset(out, 0, sizeof(*out));
    for (int w = 0; w < e->n_wires; w++)
        if (relays || e->wire[w].role != EDGES_RELAY) {
            change(e, w, false, 0, out);
            e->wire[w].n_needed = 0;
        }
    finish(e, out);
    out->done = pending;
}

void edges_relay(struct edges *e, int wire, bool cut, int64_t now_ns, struct edges_step *out)
{
    memset(out, 0, sizeof(*out));
    if (e->wire[wire].pressed != cut) // cutting again does not move the limit
        change(e, wire, cut, now_ns, out);
    finish(e, out);
}
