// firmware/sequencer.c - which output changes when.
//
// Two pictures of the outputs: `now`, what is (or, where `change` says so, is about to be) latched, and `next`, what the next edge
// of the shot makes of it. An edge is prepared as soon as the one before is done: PLAN chooses it, BUILD makes `next` from `now`,
// SHIFT sends it down the chain, READY waits for the timer. Only then is the latch armed, so that a half-shifted chain is never seen.
// A change outside a shot (an output switched, the guard) is latched by itself where there is room before the next edge, and
// otherwise rides on that edge.
#include "firmware/sequencer.h"
#include "firmware/board.h"

#include <string.h>

enum { CHUNK = 16, SHIFT_CHUNK = 26 }; // channels, registers handled per interrupt

enum step {
    REST,         // nothing is pending; the chain holds `now`
    PLAN,
    BUILD,
    SHIFT,
    READY,        // armed
    SHIFT_CHANGE, // `now` has changed by itself and is on its way
};

struct channel { // ascending
    uint16_t low;  // of the delay: ticks after T0 + lead
    uint8_t high, output;
};

static struct {
    // configured
    struct sequencer_bank bank[PROTO_BANKS_MAX];
    uint8_t n_banks, n_registers;
    uint8_t looks_min; // the fewest looks of the guard that any bank grants
    bool enabled;
    // outputs
    uint8_t now[SEQUENCER_REGISTERS], next[SEQUENCER_REGISTERS], together[SEQUENCER_REGISTERS];
    uint8_t age[PROTO_OUTPUTS_MAX]; // looks of the guard that found it on
    uint8_t change, planned_change, latched_change; // counters: of changes of `now`, those that `next` holds, those latched
    // the shot
    struct channel channel[PROTO_CHANNELS_MAX];
    uint8_t n, n_loaded, flags, state, banks_channels, banks_together; // banks: bit per bank used
    bool any_together;
    uint8_t crowd, edge_first;    // first channel of an edge too close to the one before (UINT8_MAX: none); of the edge loaded last
    uint32_t edge_gap;            // from the one before that
    uint16_t shot;
    uint32_t lead, hold;
    uint64_t t0;                  // state WAITING, RUNNING; ARMED: ticks from the press
    // its progress
    uint8_t step, at;             // at: position in BUILD and SHIFT
    uint8_t pressed, released;    // channels done
    bool together_on, aborted;
    uint8_t next_pressed, next_released; // with the edge in preparation
    bool next_together_on, press_edge;
    bool is_next_used;            // it is not the same as `now`
    uint32_t edge;                // when, after T0
    uint32_t delay;               // of the channels that are pressed, or the longest of those released
    // its report
    bool has_fired;
    struct sequencer_fired fired;
    uint16_t run, n_guarded, guarded_output;
    uint64_t guarded_tick;
    bool has_guarded;
} s;

static const uint8_t bit_of[8] = { 1, 2, 4, 8, 16, 32, 64, 128 };

static uint8_t bank_of(uint16_t output) // s.n_banks: none
{
    uint8_t b = 0;
    while (b < s.n_banks && (uint16_t)(output - s.bank[b].first) >= s.bank[b].n)
        b++;
    return b;
}

static uint32_t delay_of(uint8_t i)
{
    return s.channel[i].low | (uint32_t)s.channel[i].high << 16;
}

static bool same_delay(uint8_t i, uint8_t k)
{
    return s.channel[i].low == s.channel[k].low && s.channel[i].high == s.channel[k].high;
}

static uint32_t gap(uint8_t n_channels)
{
    return BOARD_GAP_BASE + (uint16_t)(BOARD_GAP_REGISTER * s.n_registers) + (uint16_t)(BOARD_GAP_CHANNEL * n_channels);
}

static bool is_committed(void)
{
    return s.state >= PROTO_SHOT_ARMED;
}

// ---- loading a shot -------------------------------------------------------------------------------------------------------------
uint8_t sequencer_begin(uint16_t shot, uint8_t flags, uint8_t n_channels, uint32_t lead, uint32_t hold)
{
    const uint32_t longest = (uint32_t)PROTO_MAX_ON_CEILING_MS * BOARD_TICKS_PER_MS;
    if (!s.enabled)
        return PROTO_ERR_CONFIGURE;
    if (is_committed() || s.has_fired)
        return PROTO_ERR_BUSY;
    if (n_channels > PROTO_CHANNELS_MAX || (flags & ~PROTO_SHOT_ON_BUTTON) || lead > longest || hold > longest || hold < BOARD_TICKS_PER_MS)
        return PROTO_ERR_VALUE;
    memset(s.together, 0, sizeof(s.together));
    s.any_together = false;
    s.banks_channels = s.banks_together = 0;
    s.n = n_channels;
    s.n_loaded = 0;
    s.crowd = UINT8_MAX;
    s.flags = flags;
    s.shot = shot;
    s.lead = lead;
    s.hold = hold;
    s.state = PROTO_SHOT_LOADING;
    return PROTO_OK;
}

uint8_t sequencer_together(uint8_t first_register, const uint8_t *bits, uint8_t n, uint16_t *wrong)
{
    if (s.state != PROTO_SHOT_LOADING)
        return is_committed() ? PROTO_ERR_BUSY : PROTO_ERR_INCOMPLETE;
    if (s.n_loaded > 0)
        return PROTO_ERR_ORDER; // TOGETHER comes before CHANNELS: those are checked against it
    if ((uint16_t)first_register + n > SEQUENCER_REGISTERS)
        return PROTO_ERR_VALUE;
    for (uint8_t r = 0; r < n; r++)
        for (uint8_t b = 0; b < 8; b++) {
            if (!(bits[r] & bit_of[b]))
                continue;
            const uint16_t output = (uint16_t)((first_register + r) * 8 + b);
            const uint8_t bank = bank_of(output);
            if (bank == s.n_banks) {
                *wrong = output;
                return PROTO_ERR_OUTPUT;
            }
            s.banks_together |= bit_of[bank];
            s.together[first_register + r] |= bit_of[b];
            s.any_together = true;
        }
    return PROTO_OK;
}

static bool is_channel(uint16_t output, uint8_t n)
{
    for (uint8_t i = 0; i < n; i++)
        if (s.channel[i].output == output)
            return true;
    return false;
}

// The channel loaded last: is its edge far enough from the one before, with all the channels it has by now? The first edge of all
// has lead_min_ticks instead.
static void check_gap(void)
{
    const uint8_t i = (uint8_t)(s.n_loaded - 1);
    const uint32_t at = s.lead + delay_of(i);
    if (i == 0) {
        s.edge_first = 0;
        s.edge_gap = s.any_together && at > 0 ? at : UINT32_MAX;
    } else if (!same_delay(i, (uint8_t)(i - 1))) {
        s.edge_first = i;
        s.edge_gap = at - (s.lead + delay_of((uint8_t)(i - 1)));
    }
    if (s.crowd == UINT8_MAX && s.edge_gap < gap((uint8_t)(s.n_loaded - s.edge_first)))
        s.crowd = s.edge_first;
}

uint8_t sequencer_channels(uint8_t first_entry, const uint8_t *entries, uint8_t n, uint16_t *wrong)
{
    if (s.state != PROTO_SHOT_LOADING)
        return is_committed() ? PROTO_ERR_BUSY : PROTO_ERR_INCOMPLETE;
    if (first_entry != s.n_loaded || n > s.n - s.n_loaded)
        return PROTO_ERR_VALUE;
    for (uint8_t i = 0; i < n; i++, entries += PROTO_CHANNEL_BYTES) {
        struct channel *c = &s.channel[s.n_loaded];
        const uint8_t output = entries[3];
        const uint8_t bank = bank_of(output);
        if (s.n_loaded > 0 && proto_get_u24(entries) < delay_of((uint8_t)(s.n_loaded - 1))) {
            *wrong = s.n_loaded;
            return PROTO_ERR_ORDER;
        }
        if (bank == s.n_banks || (s.together[output >> 3] & bit_of[output & 7]) || is_channel(output, s.n_loaded)) {
            *wrong = output;
            return PROTO_ERR_OUTPUT;
        }
        c->low = proto_get_u16(entries);
        c->high = entries[2];
        c->output = output;
        s.banks_channels |= bit_of[bank];
        s.n_loaded++;
        check_gap();
    }
    return PROTO_OK;
}

// The guard counts from here, whatever it last saw: all of them are off; unless that is still on its way to the latches.
static void start_ages(void)
{
    if (s.change != s.latched_change)
        return;
    for (uint16_t r = 0; r < s.n_registers; r++)
        for (uint8_t b = 0; s.together[r] && b < 8; b++)
            if (s.together[r] & bit_of[b])
                s.age[r * 8 + b] = 0;
    for (uint8_t i = 0; i < s.n; i++)
        s.age[s.channel[i].output] = 0;
}

static bool is_any_on(void)
{
    for (uint8_t r = 0; r < s.n_registers; r++)
        if (s.now[r] & s.together[r])
            return true;
    for (uint8_t i = 0; i < s.n; i++)
        if (s.now[s.channel[i].output >> 3] & bit_of[s.channel[i].output & 7])
            return true;
    return false;
}

uint8_t sequencer_commit(uint16_t shot, uint64_t when, uint16_t *wrong)
{
    if (is_committed())
        return PROTO_ERR_BUSY;
    if (s.state != PROTO_SHOT_LOADING || shot != s.shot || s.n_loaded != s.n || (s.n == 0 && !s.any_together))
        return PROTO_ERR_INCOMPLETE;
    if (s.crowd < s.n) {
        *wrong = s.crowd;
        return PROTO_ERR_GAP;
    }
    const uint32_t last = s.n ? delay_of((uint8_t)(s.n - 1)) : 0, first = s.n ? delay_of(0) : 0;
    for (uint8_t b = 0; b < s.n_banks; b++) {
        const uint32_t granted = (uint32_t)(s.bank[b].max_on_ms - PROTO_ON_SLACK_MS) * BOARD_TICKS_PER_MS;
        if (((s.banks_together & bit_of[b]) && s.lead + last + s.hold > granted) ||
            ((s.banks_channels & bit_of[b]) && last - first + s.hold > granted)) {
            *wrong = b;
            return PROTO_ERR_ON_TIME;
        }
    }
    if (is_any_on())
        return PROTO_ERR_BUSY;
    start_ages();
    uint8_t err = PROTO_OK;
    const uint8_t lock = board_lock();
    if (s.flags & PROTO_SHOT_ON_BUTTON) {
        if (when < SEQUENCER_LEAD_MIN_TICKS)
            err = PROTO_ERR_PAST;
        else if (when > PROTO_AHEAD_MAX_TICKS)
            err = PROTO_ERR_AHEAD;
        else
            s.state = PROTO_SHOT_ARMED;
    } else {
        const uint64_t now = board_now();
        if (when < now + SEQUENCER_LEAD_MIN_TICKS)
            err = PROTO_ERR_PAST;
        else if (when - now > PROTO_AHEAD_MAX_TICKS)
            err = PROTO_ERR_AHEAD;
        else
            s.state = PROTO_SHOT_WAITING;
    }
    if (err == PROTO_OK) {
        s.t0 = when;
        s.pressed = s.released = 0;
        s.together_on = s.aborted = false;
        memset(&s.fired, 0, sizeof(s.fired));
        s.fired.shot = s.shot;
        if (s.state == PROTO_SHOT_WAITING && s.step == REST) {
            s.step = PLAN;
            board_work_soon();
        }
    }
    board_unlock(lock);
    return err;
}

bool sequencer_button(uint64_t now)
{
    if (s.state != PROTO_SHOT_ARMED)
        return false;
    s.t0 += now;
    s.state = PROTO_SHOT_WAITING;
    if (s.step == REST) {
        s.step = PLAN;
        board_work_soon();
    }
    return true;
}

// ---- running it: all below with interrupts locked, or in one ------------------------------------------------------------------------
static void end_shot(void)
{
    s.state = PROTO_SHOT_IDLE;
    s.has_fired = true;
    s.run++;
}

// Channels from i to before end that share an edge; if there are many, all of them: it need not be exact, but quick.
static uint8_t count_edge(uint8_t i, uint8_t end)
{
    const struct channel *c = &s.channel[i], *last = &s.channel[end];
    uint8_t n = 1;
    for (const struct channel *d = c + 1; d < last && d->low == c->low && d->high == c->high; d++)
        if (++n == CHUNK)
            return (uint8_t)(end - i);
    return n;
}

static uint32_t ticks_since_t0(void) // negative before
{
    return board_now_low() - (uint32_t)s.t0;
}

// The next edge of the shot, into s.edge and the next_... fields. False: there is none, the shot is over (or none is under way).
static bool plan(void)
{
    if (s.state != PROTO_SHOT_WAITING && s.state != PROTO_SHOT_RUNNING)
        return false;
    const uint32_t now = ticks_since_t0();
    const bool together_due = s.any_together && !s.together_on && s.pressed == 0 && !s.aborted && s.state == PROTO_SHOT_WAITING;
    const bool press = together_due || (!s.aborted && s.pressed < s.n);
    const bool release = s.released < s.pressed || (s.together_on && (s.n == 0 || s.aborted));
    if (!press && !release) {
        end_shot();
        return false;
    }
    const uint32_t press_at = together_due ? 0 : press ? s.lead + delay_of(s.pressed) : 0;
    uint32_t release_at = 0;
    if (release && !s.aborted)
        release_at = s.lead + s.hold + (s.n ? delay_of(s.released) : 0);
    if (release && (s.aborted || board_is_before(release_at, now)))
        release_at = now;
    s.next_pressed = s.pressed;
    s.next_released = s.released;
    s.next_together_on = s.together_on;
    s.press_edge = press;
    if (press && release && (int32_t)(press_at - release_at) >= (int32_t)(2 * gap(1))) { // else there is no room, and no time to count
        // What is overdue may be of many delays, and is released all at once.
        const uint8_t n_released = release_at == now ? (uint8_t)(s.pressed - s.released) : count_edge(s.released, s.pressed);
        const uint32_t room = gap(n_released) + gap(count_edge(s.pressed, s.n));
        s.press_edge = (int32_t)(press_at - release_at) < (int32_t)room;
    }
    s.edge = s.press_edge ? press_at : release_at;
    s.delay = s.press_edge ? s.edge - s.lead : s.aborted ? PROTO_DELAY_MAX_TICKS : s.edge - s.lead - s.hold;
    if (!s.press_edge && s.delay > PROTO_DELAY_MAX_TICKS)
        s.delay = PROTO_DELAY_MAX_TICKS;
    s.at = s.press_edge ? s.pressed : s.released;
    if (s.is_next_used) // and never came
        memcpy(s.next, s.now, s.n_registers);
    s.is_next_used = true;
    s.planned_change = s.change;
    if (s.press_edge && together_due) {
        for (uint8_t r = 0; r < s.n_registers; r++)
            s.next[r] |= s.together[r];
        s.next_together_on = true;
    }
    return true;
}

// A piece of BUILD; true: done. This is where a large shot spends its time: 16-bit pointers, no 32-bit sums.
static bool build(void)
{
    const struct channel *c = &s.channel[s.at];
    const struct channel *end = &s.channel[!s.press_edge ? s.pressed : s.delay > PROTO_DELAY_MAX_TICKS ? s.pressed : s.n];
    const struct channel *stop = (size_t)(end - c) > CHUNK ? c + CHUNK : end;
    const uint16_t low = (uint16_t)s.delay;
    const uint8_t high = (uint8_t)(s.delay >> 16);
    bool more = true;
    if (s.press_edge)
        for (; c < stop && (more = c->low == low && c->high == high); c++)
            s.next[c->output >> 3] |= bit_of[c->output & 7];
    else
        for (; c < stop && (more = c->high < high || (c->high == high && c->low <= low)); c++)
            s.next[c->output >> 3] &= (uint8_t)~bit_of[c->output & 7];
    s.at = (uint8_t)(c - s.channel);
    if (more && c < end)
        return false;
    if (s.press_edge) {
        s.next_pressed = s.at;
        return true;
    }
    s.next_released = s.at;
    if (s.together_on && s.at == s.pressed && (s.aborted || s.at == s.n)) {
        for (uint8_t r = 0; r < s.n_registers; r++)
            s.next[r] &= (uint8_t)~s.together[r];
        s.next_together_on = false;
    }
    return true;
}

// A piece of SHIFT, the farthest registers first; true: done.
static bool shift(const uint8_t *image)
{
    const uint8_t left = (uint8_t)(s.n_registers - s.at), n = left < SHIFT_CHUNK ? left : SHIFT_CHUNK;
    board_shift(image + (left - n), n);
    s.at = (uint8_t)(s.at + n);
    return s.at == s.n_registers;
}

static void abort_shot(uint8_t result)
{
    if (!is_committed() || s.aborted)
        return;
    s.fired.result = result;
    if (s.state == PROTO_SHOT_ARMED) {
        end_shot();
        return;
    }
    s.aborted = true;
    if (s.step == READY && !board_latch_cancel())
        return; // it rose just now; the rest follows in sequencer_latched()
    if (s.step != SHIFT_CHANGE)
        s.step = PLAN;
    board_work_soon();
}

// Is there room to latch a change by itself before the edge that is prepared?
static bool has_room(void)
{
    return (int32_t)(s.edge - ticks_since_t0()) > (int32_t)(2 * gap(0) + gap(s.n));
}

static void flush_change(void)
{
    if (s.change == s.latched_change)
        return;
    if (s.step == READY) {
        if (!has_room() || !board_latch_cancel())
            return; // with or after that edge
    } else if (s.step != REST) {
        return; // whoever is at work sees it when he is done
    }
    s.step = SHIFT_CHANGE;
    s.at = 0;
    s.planned_change = s.change;
    board_work_soon();
}

static void latched(uint32_t late)
{
    memcpy(s.now, s.next, s.n_registers); // what changed since `next` was made, it did in both
    s.is_next_used = false;
    if (s.press_edge && s.pressed == 0 && (s.next_pressed > 0 || s.n == 0))
        s.fired.tick = s.t0 + s.edge + late;
    if (s.press_edge && late > s.fired.late_ticks)
        s.fired.late_ticks = late;
    s.latched_change = s.planned_change;
    s.pressed = s.next_pressed;
    s.released = s.next_released;
    s.together_on = s.next_together_on;
    s.fired.n_edges++;
    if (s.state == PROTO_SHOT_WAITING)
        s.state = PROTO_SHOT_RUNNING;
    s.step = PLAN;
    board_work_soon();
}

void sequencer_latched(void)
{
    if (s.step == READY) // else all was released in the meantime
        latched(0);
}

void sequencer_work(void)
{
    uint32_t late;
    switch ((enum step)s.step) {
    case REST:
    case READY:
        return;
    case PLAN:
        if (plan()) {
            s.step = BUILD;
            break;
        }
        s.step = REST;
        flush_change();
        return;
    case BUILD:
        if (build()) {
            s.step = SHIFT;
            s.at = 0;
        }
        break;
    case SHIFT:
        if (!shift(s.next))
            break;
        if (s.aborted && s.press_edge) {
            s.step = PLAN;
            break;
        }
        s.step = READY;
        if (board_latch_at((uint32_t)s.t0 + s.edge)) {
            flush_change();
            return;
        }
        late = ticks_since_t0() - s.edge;
        if ((int32_t)late < 0) { // too near to be armed: again when it is past, rather late than early
            s.step = SHIFT;
            break;
        }
        if (s.press_edge && late > SEQUENCER_LATE_MAX_TICKS) {
            s.fired.result = PROTO_FIRED_LATE;
            s.aborted = true;
            s.step = PLAN;
            break;
        }
        board_latch();
        latched(late);
        return;
    case SHIFT_CHANGE:
        if (!shift(s.now))
            break;
        board_latch();
        s.latched_change = s.planned_change;
        s.step = PLAN;
        break;
    }
    board_work_soon();
}

// ---- outputs by themselves, the guard -------------------------------------------------------------------------------------------
static void set_output(uint16_t output, bool on) // locked
{
    const uint8_t r = (uint8_t)(output >> 3), b = bit_of[output & 7];
    if (on) {
        s.now[r] |= b;
        s.next[r] |= b;
        if (s.change == s.latched_change) // else it may have been off on paper only
            s.age[output] = 0;
    } else {
        s.now[r] &= (uint8_t)~b;
        s.next[r] &= (uint8_t)~b;
    }
    s.change++;
    flush_change();
}

uint8_t sequencer_output(uint16_t output, bool on)
{
    if (!s.enabled)
        return PROTO_ERR_CONFIGURE;
    if (bank_of(output) == s.n_banks)
        return PROTO_ERR_OUTPUT;
    if (is_committed() && ((s.together[output >> 3] & bit_of[output & 7]) || is_channel(output, s.n)))
        return PROTO_ERR_BUSY;
    const uint8_t lock = board_lock();
    if (!!(s.now[output >> 3] & bit_of[output & 7]) != on)
        set_output(output, on);
    board_unlock(lock);
    return PROTO_OK;
}

// Looks at which an output of this bank is cut: what was found on n times has been on for more than n - 1 and at most n
// PROTO_GUARD_MS.
static uint8_t looks_of(const struct sequencer_bank *bank)
{
    return (uint8_t)((bank->max_on_ms - 2) / PROTO_GUARD_MS);
}

static void guard(uint16_t output)
{
    const uint8_t bank = bank_of(output);
    if (bank < s.n_banks && s.age[output] < looks_of(&s.bank[bank]))
        return;
    set_output(output, false);
    s.n_guarded++;
    s.has_guarded = true;
    s.guarded_output = output;
    s.guarded_tick = board_now();
}

// Each register is looked at every PROTO_GUARD_MS, one in a millisecond.
void sequencer_ms(uint8_t ms)
{
    const uint8_t r = ms % PROTO_GUARD_MS;
    if (r >= s.n_registers)
        return;
    uint8_t *age = &s.age[(uint16_t)r * 8];
    uint8_t on = s.now[r];
    for (uint8_t b = 0; b < 8; b++, age++, on >>= 1) {
        if (!(on & 1))
            *age = 0;
        else if (++*age >= s.looks_min) // goes off at 250 at most
            guard((uint16_t)(age - s.age));
    }
}

// Has the guard taken an output that the shot in progress holds?
static bool is_cut(void)
{
    if (s.state != PROTO_SHOT_RUNNING)
        return false;
    for (uint8_t i = s.released; i < s.pressed; i++)
        if (!(s.now[s.channel[i].output >> 3] & bit_of[s.channel[i].output & 7]))
            return true;
    for (uint8_t r = 0; s.together_on && r < s.n_registers; r++)
        if (s.together[r] & ~s.now[r])
            return true;
    return false;
}

void sequencer_release_shot(void)
{
    const uint8_t lock = board_lock();
    if (s.state == PROTO_SHOT_LOADING)
        s.state = PROTO_SHOT_IDLE;
    abort_shot(PROTO_FIRED_RELEASED);
    board_unlock(lock);
}

void sequencer_release_outputs(void)
{
    uint8_t of_shot[SEQUENCER_REGISTERS] = { 0 };
    if (is_committed()) {
        memcpy(of_shot, s.together, sizeof(of_shot));
        for (uint8_t i = 0; i < s.n; i++)
            of_shot[s.channel[i].output >> 3] |= bit_of[s.channel[i].output & 7];
    }
    const uint8_t lock = board_lock();
    for (uint8_t r = 0; r < s.n_registers; r++) {
        s.now[r] &= of_shot[r];
        s.next[r] &= of_shot[r];
    }
    s.change++;
    flush_change();
    board_unlock(lock);
}

void sequencer_release_all(bool enable)
{
    const uint8_t lock = board_lock();
    board_enable(false);
    s.enabled = false;
    board_latch_cancel();
    if (is_committed()) {
        if (!s.aborted)
            s.fired.result = PROTO_FIRED_RELEASED;
        end_shot();
    }
    s.state = PROTO_SHOT_IDLE;
    s.step = REST;
    memset(s.now, 0, sizeof(s.now));
    memset(s.next, 0, sizeof(s.next));
    s.is_next_used = false;
    s.planned_change = s.latched_change = s.change;
    board_unlock(lock);
    for (uint8_t r = 0; r < SEQUENCER_REGISTERS; r = (uint8_t)(r + CHUNK)) { // all there may be, whatever is configured
        const uint8_t piece = board_lock();
        board_shift(s.now, CHUNK);
        board_unlock(piece);
    }
    const uint8_t last = board_lock();
    board_latch();
    if (enable) {
        s.enabled = true;
        board_enable(true);
    }
    board_unlock(last);
}

// ---- the rest ---------------------------------------------------------------------------------------------------------------------
void sequencer_start(void)
{
    memset(&s, 0, sizeof(s));
    sequencer_release_all(false);
}

uint8_t sequencer_configure(uint8_t n_registers, const struct sequencer_bank *bank, uint8_t n_banks)
{
    if (is_committed())
        return PROTO_ERR_BUSY;
    if (n_registers < 1 || n_registers > SEQUENCER_REGISTERS || n_banks > PROTO_BANKS_MAX)
        return PROTO_ERR_VALUE;
    for (uint8_t b = 0; b < n_banks; b++) {
        if (bank[b].n > n_registers * 8 || bank[b].first > n_registers * 8 - bank[b].n || bank[b].max_on_ms < PROTO_MAX_ON_FLOOR_MS ||
            bank[b].max_on_ms > PROTO_MAX_ON_CEILING_MS)
            return PROTO_ERR_VALUE;
        for (uint8_t k = 0; k < b; k++)
            if (bank[b].first < bank[k].first + bank[k].n && bank[k].first < bank[b].first + bank[b].n)
                return PROTO_ERR_VALUE;
    }
    sequencer_release_all(false);
    memcpy(s.bank, bank, n_banks * sizeof(*bank));
    s.n_banks = n_banks;
    s.n_registers = n_registers;
    s.looks_min = UINT8_MAX;
    for (uint8_t b = 0; b < n_banks; b++)
        if (looks_of(&bank[b]) < s.looks_min)
            s.looks_min = looks_of(&bank[b]);
    sequencer_release_all(true);
    return PROTO_OK;
}

enum proto_shot_state sequencer_state(void)
{
    return (enum proto_shot_state)s.state;
}

uint16_t sequencer_shot(void)
{
    return s.shot;
}

bool sequencer_sampling(uint16_t *run)
{
    *run = s.run;
    return s.state == PROTO_SHOT_RUNNING;
}

uint16_t sequencer_n_on(void)
{
    uint16_t n = 0;
    for (uint8_t r = 0; r < s.n_registers; r++)
        for (uint8_t on = s.now[r]; on; on &= (uint8_t)(on - 1))
            n++;
    return n;
}

uint16_t sequencer_n_guarded(void)
{
    const uint8_t lock = board_lock();
    const uint16_t n = s.n_guarded;
    board_unlock(lock);
    return n;
}

bool sequencer_is_enabled(void)
{
    return s.enabled;
}

uint8_t sequencer_n_registers(void)
{
    return s.n_registers;
}

bool sequencer_has_fired(void)
{
    return s.has_fired;
}

bool sequencer_take_fired(struct sequencer_fired *out)
{
    const uint8_t lock = board_lock();
    const bool has = s.has_fired;
    if (has)
        *out = s.fired;
    s.has_fired = false;
    board_unlock(lock);
    return has;
}

bool sequencer_take_guarded(uint16_t *output, uint64_t *tick)
{
    uint8_t lock = board_lock();
    const bool has = s.has_guarded;
    *output = s.guarded_output;
    *tick = s.guarded_tick;
    s.has_guarded = false;
    board_unlock(lock);
    if (has && is_cut()) {
        lock = board_lock();
        abort_shot(PROTO_FIRED_GUARDED);
        board_unlock(lock);
    }
    return has;
}

bool sequencer_sample(uint8_t *inputs, uint8_t n)
{
    if (s.step == READY) {
        // The shift takes 24 ticks a register; the latch must not rise in its middle.
        const uint16_t shifts = n > s.n_registers ? n : s.n_registers;
        if ((int32_t)(s.edge - ticks_since_t0()) < (int32_t)(1000 + 40 * shifts))
            return false;
        board_sample(inputs, n, s.next, s.n_registers);
        return true;
    }
    if (s.step != REST)
        return false;
    board_sample(inputs, n, s.now, s.n_registers);
    return true;
}
