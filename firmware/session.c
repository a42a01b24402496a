// firmware/session.c - commands, events, and the end of a session.
//
// One command at a time: it is read only when its answer can be sent. Events are sent when no answer is due.
#include "firmware/session.h"
#include "firmware/board.h"
#include "firmware/button.h"
#include "firmware/feedback.h"
#include "firmware/frame.h"
#include "firmware/head.h"
#include "firmware/sequencer.h"

#include <string.h>

enum { BUTTON_EVENTS = 4, SILENCE_DEFAULT_MS = 2000, BYTES_PER_RUN = PROTO_PACKET_BYTES };

struct button_event {
    uint64_t at;
    bool pressed, fired;
};

static struct {
    bool open;
    uint8_t expected, event_sequence;
    uint16_t silence_ms;
    volatile uint16_t ms;           // counts, wraps
    volatile uint16_t identify_ms;  // left to blink
    volatile bool link_lost;
    uint16_t heard_ms;              // when the last command in sequence came
    struct frame_reader reader;
    uint32_t n_bad_told;
    uint8_t beat, flags;
    struct button button;
    struct button_event button_event[BUTTON_EVENTS];
    uint8_t button_head, n_button;
    uint16_t n_events_lost;
    uint8_t n_lost_untold;
    bool silence_fault;
    uint64_t silence_tick;
} e;

// ---- the end of a session ---------------------------------------------------------------------------------------------------------
static void end_session(void)
{
    e.open = false;
    sequencer_release_all(false);
    head_forget();
}

void session_release_everything(void)
{
    sequencer_release_all(e.open && sequencer_is_enabled());
    head_stop();
}

void session_link_lost(void)
{
    board_enable(false); // now; the rest in session_run()
    e.link_lost = true;
}

static uint16_t now_ms(void)
{
    const uint8_t lock = board_lock();
    const uint16_t ms = e.ms;
    board_unlock(lock);
    return ms;
}

// ---- what is told -------------------------------------------------------------------------------------------------------------------
void session_capabilities(uint8_t out[PROTO_CAPABILITIES_BYTES])
{
    const struct proto_capabilities c = {
        .version = PROTO_VERSION,
        .can = PROTO_CAN_CHANNELS | PROTO_CAN_TOGETHER | PROTO_CAN_BUTTON | PROTO_CAN_CAPTURE | PROTO_CAN_INPUTS | PROTO_CAN_HEAD,
        .ticks_per_s = BOARD_TICKS_PER_S,
        .n_outputs = PROTO_OUTPUTS_MAX,
        .n_inputs = PROTO_INPUTS_MAX,
        .n_channels = PROTO_CHANNELS_MAX,
        .n_banks = PROTO_BANKS_MAX,
        .max_on_ceiling_ms = PROTO_MAX_ON_CEILING_MS,
        .gap_base_ticks = BOARD_GAP_BASE,
        .gap_register_ticks = BOARD_GAP_REGISTER,
        .gap_channel_ticks = BOARD_GAP_CHANNEL,
        .lead_min_ticks = SEQUENCER_LEAD_MIN_TICKS,
        .late_max_ticks = SEQUENCER_LATE_MAX_TICKS,
        .input_sample_ticks = FEEDBACK_TICKS,
        .n_captures = 1,
        .n_axes = PROTO_AXES,
        .steps_per_s_max = PROTO_HEAD_SPEED_MAX,
        .reset_cause = board_reset_cause(),
        .session = e.open,
    };
    proto_put_capabilities(out, &c);
}

void session_status(uint8_t out[PROTO_STATUS_BYTES])
{
    out[0] = (uint8_t)sequencer_state();
    out[1] = (uint8_t)((e.open ? PROTO_IS_SESSION : 0) | (sequencer_n_registers() ? PROTO_IS_CONFIGURED : 0) |
                       (sequencer_is_enabled() ? PROTO_IS_ENABLED : 0) | (e.button.pressed ? PROTO_IS_PRESSED : 0));
    proto_put_u16(out + 2, sequencer_shot());
    proto_put_u64(out + 4, board_now());
    proto_put_u32(out + 12, e.reader.n_bad);
    proto_put_u16(out + 16, sequencer_n_guarded());
    proto_put_u16(out + 18, sequencer_n_on());
    proto_put_u32(out + 20, (uint32_t)head_position(0));
    proto_put_u32(out + 24, (uint32_t)head_position(1));
    out[28] = head_homed();
    out[29] = head_moving();
    out[30] = head_switches();
    out[31] = e.expected;
    const uint8_t lock = board_lock();
    proto_put_u16(out + 32, e.n_events_lost);
    board_unlock(lock);
    proto_put_u16(out + 34, board_unused_ram());
    proto_put_u16(out + 36, e.silence_ms);
    proto_put_u16(out + 38, 0);
}

// ---- commands: each returns the error code, the answer's first byte, and fills what follows it -------------------------------------------
struct command {
    const uint8_t *in; // payload
    uint8_t n_in;
    uint8_t *out;      // after the error code
    uint8_t n_out;
};

static uint8_t hello(struct command *c, uint8_t sequence)
{
    if (c->n_in != 2)
        return PROTO_ERR_LENGTH;
    if ((proto_get_u16(c->in) ^ PROTO_VERSION) & 0xFF00) {
        proto_put_u16(c->out, PROTO_VERSION);
        c->n_out = 2;
        return PROTO_ERR_VERSION;
    }
    end_session();
    struct sequencer_fired fired;
    uint16_t output;
    uint64_t tick;
    uint8_t head;
    sequencer_take_fired(&fired); // what happened before belongs to nobody
    sequencer_take_guarded(&output, &tick);
    head_take_still(&head);
    feedback_start();
    const uint8_t lock = board_lock();
    e.n_button = 0;
    e.link_lost = false;
    board_unlock(lock);
    e.silence_fault = false;
    e.n_events_lost = e.n_lost_untold = 0;
    e.n_bad_told = e.reader.n_bad;
    e.event_sequence = 0;
    e.expected = (uint8_t)(sequence + 1);
    e.silence_ms = SILENCE_DEFAULT_MS;
    e.heard_ms = now_ms();
    e.open = true;
    session_capabilities(c->out);
    c->n_out = PROTO_CAPABILITIES_BYTES;
    return PROTO_OK;
}

static bool button_level(void)
{
    return board_button_high() == !!(e.flags & PROTO_BUTTON_ACTIVE_HIGH);
}

static uint8_t configure(const struct command *c)
{
    if (c->n_in < PROTO_CONFIGURE_BYTES || (c->n_in - PROTO_CONFIGURE_BYTES) % PROTO_BANK_BYTES)
        return PROTO_ERR_LENGTH;
    const uint8_t n_banks = (uint8_t)((c->n_in - PROTO_CONFIGURE_BYTES) / PROTO_BANK_BYTES);
    const uint8_t *in = c->in;
    const uint16_t debounce_ms = proto_get_u16(in + 2), silence_ms = proto_get_u16(in + 4);
    const uint8_t known = PROTO_BUTTON_ACTIVE_HIGH | PROTO_CAPTURE_RISING | PROTO_INPUTS_ACTIVE_HIGH;
    if (n_banks > PROTO_BANKS_MAX || in[1] > FEEDBACK_REGISTERS || debounce_ms > PROTO_DEBOUNCE_MAX_MS || silence_ms < PROTO_SILENCE_MIN_MS ||
        silence_ms > PROTO_SILENCE_MAX_MS || (in[6] & ~known) || in[7])
        return PROTO_ERR_VALUE;
    struct sequencer_bank bank[PROTO_BANKS_MAX];
    for (uint8_t b = 0; b < n_banks; b++) {
        const uint8_t *p = in + PROTO_CONFIGURE_BYTES + b * PROTO_BANK_BYTES;
        bank[b] = (struct sequencer_bank){ proto_get_u16(p), proto_get_u16(p + 2), proto_get_u16(p + 4) };
    }
    if (head_is_moving())
        return PROTO_ERR_BUSY;
    const uint8_t err = sequencer_configure(in[0], bank, n_banks);
    if (err)
        return err;
    feedback_configure(in[1], in[6] & PROTO_INPUTS_ACTIVE_HIGH, proto_get_u16(in + 8));
    board_capture_edge(in[6] & PROTO_CAPTURE_RISING);
    e.silence_ms = silence_ms;
    const uint8_t lock = board_lock();
    e.flags = in[6];
    button_start(&e.button, debounce_ms, button_level());
    board_unlock(lock);
    return PROTO_OK;
}

// What an error is about goes with it.
static uint8_t explain(struct command *c, uint8_t err, const uint16_t *wrong)
{
    if (err == PROTO_ERR_OUTPUT) {
        proto_put_u16(c->out, *wrong);
        c->n_out = 2;
    } else if (err == PROTO_ERR_ORDER || err == PROTO_ERR_GAP || err == PROTO_ERR_ON_TIME) {
        c->out[0] = (uint8_t)*wrong;
        c->n_out = 1;
    } else if (err == PROTO_ERR_PAST) {
        proto_put_u64(c->out, board_now());
        c->n_out = 8;
    }
    return err;
}

static uint8_t head_setup(const struct command *c)
{
    if (c->n_in != PROTO_HEAD_CONFIGURE_BYTES)
        return PROTO_ERR_LENGTH;
    const uint8_t *in = c->in;
    const uint8_t known = PROTO_HEAD_REVERSED | PROTO_HEAD_HOME_POSITIVE | PROTO_HEAD_HOME_ACTIVE_HIGH | PROTO_HEAD_HOME_IS_INDEX;
    const struct head_axis_config config = {
        .flags = in[1],
        .speed = proto_get_u16(in + 2),
        .acceleration = proto_get_u32(in + 4),
        .homing_speed = proto_get_u16(in + 8),
        .lowest = proto_get_i32(in + 12),
        .highest = proto_get_i32(in + 16),
    };
    if ((in[1] & ~known) || proto_get_u16(in + 10))
        return PROTO_ERR_VALUE;
    return head_configure(in[0], &config);
}

static bool is_shot_pending(void)
{
    return sequencer_state() >= PROTO_SHOT_ARMED;
}

static uint8_t execute(uint8_t type, struct command *c)
{
    uint16_t wrong = 0;
    const uint8_t *in = c->in;
    const uint8_t n = c->n_in;
    switch (type) {
    case PROTO_PING:
        if (n != 0)
            return PROTO_ERR_LENGTH;
        proto_put_u64(c->out, board_now());
        c->n_out = 8;
        return PROTO_OK;
    case PROTO_CONFIGURE:
        return configure(c);
    case PROTO_STATUS:
        if (n != 0)
            return PROTO_ERR_LENGTH;
        session_status(c->out);
        c->n_out = PROTO_STATUS_BYTES;
        return PROTO_OK;
    case PROTO_SHOT_BEGIN:
        if (n != PROTO_SHOT_BEGIN_BYTES)
            return PROTO_ERR_LENGTH;
        return sequencer_begin(proto_get_u16(in), in[2], in[3], proto_get_u32(in + 4), proto_get_u32(in + 8));
    case PROTO_SHOT_TOGETHER:
        if (n < 2)
            return PROTO_ERR_LENGTH;
        return explain(c, sequencer_together(in[0], in + 1, (uint8_t)(n - 1), &wrong), &wrong);
    case PROTO_SHOT_CHANNELS:
        if (n < 1 + PROTO_CHANNEL_BYTES || (n - 1) % PROTO_CHANNEL_BYTES)
            return PROTO_ERR_LENGTH;
        return explain(c, sequencer_channels(in[0], in + 1, (uint8_t)((n - 1) / PROTO_CHANNEL_BYTES), &wrong), &wrong);
    case PROTO_SHOT_COMMIT:
        if (n != PROTO_SHOT_COMMIT_BYTES)
            return PROTO_ERR_LENGTH;
        if (head_is_moving())
            return PROTO_ERR_BUSY;
        return explain(c, sequencer_commit(proto_get_u16(in), proto_get_u64(in + 2), &wrong), &wrong);
    case PROTO_RELEASE:
        if (n != 1)
            return PROTO_ERR_LENGTH;
        if (in[0] & ~PROTO_RELEASE_EVERYTHING)
            return PROTO_ERR_VALUE;
        if (in[0] & PROTO_RELEASE_SHOT)
            sequencer_release_shot();
        if (in[0] & PROTO_RELEASE_OUTPUTS)
            sequencer_release_outputs();
        if (in[0] & PROTO_RELEASE_HEAD)
            head_stop();
        return PROTO_OK;
    case PROTO_OUTPUT:
        if (n != 3)
            return PROTO_ERR_LENGTH;
        if (in[2] > 1)
            return PROTO_ERR_VALUE;
        wrong = proto_get_u16(in);
        return explain(c, sequencer_output(wrong, in[2]), &wrong);
    case PROTO_IDENTIFY:
        if (n != 2)
            return PROTO_ERR_LENGTH;
        session_identify(proto_get_u16(in));
        return PROTO_OK;
    case PROTO_HEAD_CONFIGURE:
        return head_setup(c);
    case PROTO_HEAD_MOVE:
        if (n != 8)
            return PROTO_ERR_LENGTH;
        if (is_shot_pending())
            return PROTO_ERR_BUSY;
        return head_move((int32_t[]){ proto_get_i32(in), proto_get_i32(in + 4) });
    case PROTO_HEAD_HOME:
        if (n != 2)
            return PROTO_ERR_LENGTH;
        if (in[1] > 1)
            return PROTO_ERR_VALUE;
        if (is_shot_pending())
            return PROTO_ERR_BUSY;
        return head_home(in[0], in[1]);
    case PROTO_HEAD_STOP:
        if (n != 0)
            return PROTO_ERR_LENGTH;
        head_stop();
        return PROTO_OK;
    }
    return PROTO_ERR_TYPE;
}

static void answer(const uint8_t *frame)
{
    uint8_t reply[PROTO_FRAME_MAX];
    const uint8_t sequence = frame[3], type = frame[4];
    struct command c = { frame + PROTO_HEADER_BYTES, frame[2], reply + PROTO_HEADER_BYTES + 1, 0 };
    uint8_t err;
    if (type == PROTO_HELLO) {
        err = hello(&c, sequence);
    } else if (!e.open) {
        err = PROTO_ERR_SESSION;
    } else if (sequence != e.expected) {
        err = PROTO_ERR_SEQUENCE;
        c.out[0] = e.expected;
        c.n_out = 1;
    } else {
        e.expected++;
        e.heard_ms = now_ms();
        err = execute(type, &c);
    }
    reply[PROTO_HEADER_BYTES] = err;
    board_send(reply, proto_seal(reply, type | PROTO_REPLY, sequence, (uint8_t)(1 + c.n_out)));
}

// ---- events ---------------------------------------------------------------------------------------------------------------------------
static bool take_button(struct button_event *out)
{
    const uint8_t lock = board_lock();
    const bool has = e.n_button > 0;
    if (has) {
        *out = e.button_event[e.button_head];
        e.button_head = (uint8_t)((e.button_head + 1) % BUTTON_EVENTS);
        e.n_button--;
    }
    e.event_sequence = (uint8_t)(e.event_sequence + e.n_lost_untold);
    e.n_lost_untold = 0;
    board_unlock(lock);
    return has;
}

static uint8_t put_inputs(uint8_t *p) // all closings of one sample that fit; 0: none
{
    struct feedback_closing closing;
    uint64_t tick;
    if (!feedback_peek(&closing, &tick))
        return 0;
    proto_put_u64(p, tick);
    uint8_t n = 8;
    while (n + 2 <= PROTO_PAYLOAD_MAX && feedback_take(tick, &closing)) {
        p[n++] = closing.input_register;
        p[n++] = closing.bits;
    }
    return n > 8 ? n : 0; // a shot may have begun since
}

// One event, if there is one. Returns its type, 0: none.
static uint8_t next_event(uint8_t *p, uint8_t *n)
{
    struct button_event button;
    struct sequencer_fired fired;
    uint64_t at;
    uint16_t x;
    uint8_t result;
    if (take_button(&button)) {
        proto_put_u64(p, button.at);
        p[8] = button.pressed;
        p[9] = button.fired;
        *n = PROTO_BUTTON_BYTES;
        return PROTO_BUTTON;
    }
    if (feedback_take_capture(&at, &x)) {
        proto_put_u64(p, at);
        proto_put_u16(p + 8, x);
        *n = PROTO_CAPTURE_BYTES;
        return PROTO_CAPTURE;
    }
    *n = put_inputs(p);
    if (*n)
        return PROTO_INPUTS;
    *n = PROTO_FAULT_BYTES;
    p[1] = 0;
    if (sequencer_take_guarded(&x, &at)) {
        p[0] = PROTO_FAULT_ON_TIME;
        proto_put_u16(p + 2, x);
        proto_put_u64(p + 4, at);
        return PROTO_FAULT;
    }
    if (sequencer_take_fired(&fired)) {
        proto_put_u16(p, fired.shot);
        p[2] = fired.result;
        p[3] = 0;
        proto_put_u64(p + 4, fired.tick);
        proto_put_u32(p + 12, fired.late_ticks);
        proto_put_u16(p + 16, fired.n_edges);
        proto_put_u16(p + 18, feedback_take_lost());
        *n = PROTO_FIRED_BYTES;
        return PROTO_FIRED;
    }
    if (e.silence_fault) {
        e.silence_fault = false;
        p[0] = PROTO_FAULT_SILENCE;
        proto_put_u16(p + 2, 0);
        proto_put_u64(p + 4, e.silence_tick);
        return PROTO_FAULT;
    }
    if (head_take_still(&result)) {
        p[0] = result;
        p[1] = head_homed();
        proto_put_u32(p + 2, (uint32_t)head_position(0));
        proto_put_u32(p + 6, (uint32_t)head_position(1));
        *n = PROTO_HEAD_BYTES;
        return PROTO_HEAD;
    }
    if (e.reader.n_bad != e.n_bad_told) {
        const uint32_t more = e.reader.n_bad - e.n_bad_told;
        e.n_bad_told = e.reader.n_bad;
        p[0] = PROTO_FAULT_BAD_FRAMES;
        proto_put_u16(p + 2, more > UINT16_MAX ? UINT16_MAX : (uint16_t)more);
        proto_put_u64(p + 4, board_now());
        return PROTO_FAULT;
    }
    return 0;
}

// ---- the loop ---------------------------------------------------------------------------------------------------------------------------
void session_run(void)
{
    const uint16_t ms = now_ms();
    if (e.link_lost) {
        e.link_lost = false;
        end_session();
        e.reader.n = e.reader.n_given = 0;
    }
    if (e.open && (uint16_t)(ms - e.heard_ms) >= e.silence_ms) {
        end_session();
        e.silence_fault = true;
        e.silence_tick = board_now();
    }
    frame_idle(&e.reader, ms);
    uint8_t byte;
    for (uint8_t i = 0; i < BYTES_PER_RUN && board_can_send(); i++) {
        if (frame_next(&e.reader, ms))
            answer(e.reader.byte);
        else if (board_receive(&byte))
            frame_push(&e.reader, byte, ms);
        else
            break;
    }
    if (!board_can_send())
        return;
    uint8_t event[PROTO_FRAME_MAX], n;
    const uint8_t type = next_event(event + PROTO_HEADER_BYTES, &n);
    if (type)
        board_send(event, proto_seal(event, type, e.event_sequence++, n));
}

void session_start(void)
{
    memset(&e, 0, sizeof(e));
    e.silence_ms = SILENCE_DEFAULT_MS;
    sequencer_start();
    feedback_start();
    head_start();
}

void session_identify(uint16_t ms)
{
    const uint8_t lock = board_lock();
    e.identify_ms = ms;
    board_unlock(lock);
}

// ---- interrupts -------------------------------------------------------------------------------------------------------------------------
static void each_ms(void)
{
    e.ms++;
    sequencer_ms((uint8_t)e.ms);
    if (e.identify_ms > 0)
        e.identify_ms--;
    board_led(e.identify_ms > 0 ? e.ms & 128 : e.open);
    if (!e.open)
        return;
    const bool level = button_level();
    if (level == e.button.pressed && !e.button.has_first) // nothing happens: do not look at the clock
        return;
    if (!button_ms(&e.button, level, board_now()))
        return;
    const bool fired = e.button.pressed && sequencer_button(board_now());
    if (e.n_button == BUTTON_EVENTS) {
        e.n_lost_untold++;
        e.n_events_lost++;
        return;
    }
    e.button_event[(e.button_head + e.n_button) % BUTTON_EVENTS] = (struct button_event){ e.button.first, e.button.pressed, fired };
    e.n_button++;
}

void session_beat(void)
{
    feedback_beat(e.beat & 1);
    if (e.beat == 0) // not one in which inputs are sampled: that takes long
        each_ms();
    if (++e.beat == BOARD_BEATS_PER_MS)
        e.beat = 0;
}

void session_button_edge(uint64_t now)
{
    if (e.open)
        button_edge(&e.button, now);
}

void session_capture(uint64_t at)
{
    if (e.open)
        feedback_capture(at);
}
