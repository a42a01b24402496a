// rigd/trigger_usb.c - the trigger board on USB. The only file that knows libusb.
//
// The board executes what firmware/protocol.h lets us plan: a whole shot is loaded, checked by the board, and committed for a tick of its clock;
// from then on nothing that this host does or fails to do moves an edge. A thread keeps the session alive (PING: a host that
// dies is silent, and the board releases everything), relates the clocks (GET_TIME) and hears what the board says; the loop gives commands,
// one at a time, and waits for each answer: milliseconds. Whatever goes wrong on the link ends it (`broken`): the daemon opens it anew.
#include "rigd/board.h"
#include "rigd/board_clock.h"
#include "rigd/trigger.h"
#include "solver/take/log.h"

#include <errno.h>
#include <libusb-1.0/libusb.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

enum {
    SILENCE_MS = 500,          // the board lets go when it hears nothing for so long
    PING_MS = 100,
    ANSWER_MS = 300,           // a board that needs longer has hung: of time in which this process ran, for one that stood still finds the answer waiting
    SLICE_MS = 20,             // at most so much of it is counted at once
    FEEDBACK_MS = 2000,        // flash-sync contacts are listened to so long after the last release
    CLOCK_ROUNDS = 12,         // before open returns
    CLOCK_FAST_MS = 20, CLOCK_MS = 50, // between round trips: until the window is full; then
    REPORT_MS = 1000,          // after its end a shot must have been reported
    HEARD_MAX = 256,           // said by the board and not yet seen by the loop
    READS = 2,                 // waiting at the bulk endpoint
    HOMING_PART = 4,           // of the head's speed
};
#define MS INT64_C(1000000)
#define PLAUSIBLE_NS (60000 * MS) // a stamp further from now is no stamp

struct talk { // a command under way
    struct libusb_transfer *out;
    uint8_t bytes[PROTO_FRAME_MAX];
    bool asked, flies, waits; // by the loop, to be sent; on its way; for its answer
    uint8_t sequence, type, n_payload;
    int64_t since_ns, since_awake_ns;
    struct board_said answer;
};

struct heard {
    struct board_said said;
    int64_t at_ns;
};

struct board {
    const struct config *config;
    const struct trigger_host *host;
    libusb_context *context;
    libusb_device_handle *device;
    bool claimed;
    char where[120]; // "trigger board 8532... at 1-4.3"
    struct proto_capabilities can;
    pthread_t thread;
    bool has_lock, started;
    atomic_bool quit;
    int event_fd;
    // The loop's own.
    struct edges edges;
    _Atomic int64_t limit_ns[EDGES_WIRES_MAX];
    bool pending, waits, released, told_broken;
    uint16_t shot;
    int64_t due_ns;
    bool head_moves, head_homes;
    int32_t head_to[2];
    int camera_of[PROTO_INPUTS_MAX], capture_camera;
    // Under the lock.
    pthread_mutex_t lock;
    pthread_cond_t changed;
    struct board_clock clock;
    int broken;
    bool session;            // HELLO was answered: what comes is meant for us
    uint8_t sequence, event_sequence;
    struct talk command, ping;
    struct libusb_transfer *read[READS], *time;
    uint8_t packet[READS][PROTO_PACKET_BYTES], time_bytes[LIBUSB_CONTROL_SETUP_SIZE + 16];
    bool reads[READS], times;
    int64_t time_sent_ns, time_awake_ns, time_next_ns, report_ns; // report: of a shot; INT64_MAX
    int64_t awake_ns;        // how long the thread has run
    int n_rounds;
    unsigned seed;           // of the pauses between round trips: USB's frames must not beat with them
    struct heard heard[HEARD_MAX];
    int n_heard;
};

static int64_t clock_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void tell_loop(struct board *b)
{
    const uint64_t one = 1;
    if (write(b->event_fd, &one, sizeof(one)) < 0)
        log_error("trigger: eventfd: %s", strerror(errno));
}

// Under the lock. The first cause counts and is logged.
__attribute__((format(printf, 2, 3))) static void fail(struct board *b, const char *format, ...)
{
    char text[300];
    va_list args;
    if (b->broken)
        return;
    va_start(args, format);
    vsnprintf(text, sizeof(text), format, args);
    va_end(args);
    log_error("trigger: %s: %s", b->where, text);
    b->broken = -EIO;
    pthread_cond_broadcast(&b->changed);
    tell_loop(b);
}

static const char unplugged[] = "it is unplugged; it has released everything";

static void fail_call(struct board *b, const char *what, int error)
{
    fail(b, "%s: %s", what, error == LIBUSB_ERROR_NO_DEVICE ? unplugged : libusb_strerror(error));
}

static void fail_transfer(struct board *b, const char *what, const struct libusb_transfer *t)
{
    static const char *const texts[] = { [LIBUSB_TRANSFER_ERROR] = "the link failed; look at cable and hub", [LIBUSB_TRANSFER_TIMED_OUT] = "no answer: it hangs; unplug it and plug it in again",
        [LIBUSB_TRANSFER_CANCELLED] = "cancelled", [LIBUSB_TRANSFER_STALL] = "it refuses; is this its firmware?", [LIBUSB_TRANSFER_NO_DEVICE] = unplugged,
        [LIBUSB_TRANSFER_OVERFLOW] = "it sends more than it may; is this its firmware?" };
    fail(b, "%s: %s", what, t->status < sizeof(texts) / sizeof(texts[0]) && texts[t->status] ? texts[t->status] : "failed");
}

// ---- what the board says: the thread, under the lock ---------------------------------------------------------------------------------

static bool stamp_ns(struct board *b, int64_t ticks, int64_t *out)
{
    const int64_t now_ns = clock_ns();
    if (llabs(ticks - board_clock_ticks(&b->clock, now_ns)) < (int64_t)(1e-9 * PLAUSIBLE_NS * b->can.ticks_per_s)) {
        *out = board_clock_ns(&b->clock, ticks);
        return true;
    }
    fail(b, "a stamp of its clock is %.0f s off; it is opened anew", (double)(ticks - board_clock_ticks(&b->clock, now_ns)) / b->can.ticks_per_s);
    return false;
}

static void hear_event(struct board *b, const struct board_said *s)
{
    struct heard *h = &b->heard[b->n_heard];
    if (s->sequence != b->event_sequence)
        log_warning("trigger: %s: %d of its messages were lost: this host read too late", b->where, (uint8_t)(s->sequence - b->event_sequence));
    b->event_sequence = (uint8_t)(s->sequence + 1);
    if (b->n_heard == HEARD_MAX) {
        fail(b, "it sends more than can be heard");
        return;
    }
    *h = (struct heard){ *s, 0 };
    const int64_t half_sample = b->can.input_sample_ticks / 2;
    switch (s->type) {
    case PROTO_FIRED:
        b->report_ns = INT64_MAX;
        if (s->fired.first_ticks && !stamp_ns(b, s->fired.first_ticks, &h->at_ns))
            return;
        break;
    case PROTO_BUTTON:
        if (!stamp_ns(b, s->button.ticks, &h->at_ns))
            return;
        break;
    case PROTO_CAPTURE:
        if (!stamp_ns(b, s->capture.ticks, &h->at_ns))
            return;
        break;
    case PROTO_INPUTS:
        if (!stamp_ns(b, s->inputs.ticks - half_sample, &h->at_ns))
            return;
        break;
    case PROTO_FAULT:
        if (s->fault.fault == PROTO_FAULT_SILENCE) {
            fail(b, "it heard nothing from this host for %d ms and released everything", SILENCE_MS);
            return;
        }
        break;
    default:
        break;
    }
    b->n_heard++;
    tell_loop(b);
}

static void forget_head(struct board *b)
{
    int n = 0;
    for (int i = 0; i < b->n_heard; i++)
        if (b->heard[i].said.type != PROTO_HEAD)
            b->heard[n++] = b->heard[i];
    b->n_heard = n;
}

static void hear(struct board *b, const uint8_t *bytes, size_t n)
{
    struct board_said s;
    const char *why;
    if (!n)
        return;
    if (board_decode(&s, bytes, n, &why)) {
        if (b->session) // before, it may be the rest of another program's conversation
            fail(b, "what it says %s; is this its firmware?", why);
        return;
    }
    struct talk *const talks[] = { &b->command, &b->ping };
    for (int i = 0; i < 2 && s.type <= PROTO_EVENT; i++) {
        struct talk *k = talks[i];
        if (!k->waits || s.type != (PROTO_REPLY | k->type) || s.sequence != k->sequence)
            continue;
        k->waits = false;
        k->answer = s;
        if (k->type == PROTO_HELLO) {
            b->session = true;
            b->event_sequence = 0;
        }
        if (k->type == PROTO_HEAD_MOVE || k->type == PROTO_HEAD_HOME)
            forget_head(b); // what was said of it before this command began
        if (k == &b->ping && s.reply.error)
            fail(b, "%s", board_error_text(s.reply.error));
        pthread_cond_broadcast(&b->changed);
        return;
    }
    if (!b->session)
        return;
    if (s.type > PROTO_EVENT)
        hear_event(b, &s);
    else
        fail(b, "it answers what was not asked (type 0x%02x)", s.type);
}

static void LIBUSB_CALL on_read(struct libusb_transfer *t)
{
    struct board *b = t->user_data;
    const int i = t == b->read[0] ? 0 : 1;
    pthread_mutex_lock(&b->lock);
    b->reads[i] = false;
    if (t->status == LIBUSB_TRANSFER_COMPLETED)
        hear(b, b->packet[i], (size_t)t->actual_length);
    else if (t->status != LIBUSB_TRANSFER_CANCELLED)
        fail_transfer(b, "reading", t);
    if (!b->broken && !b->quit) {
        const int err = libusb_submit_transfer(t);
        b->reads[i] = !err;
        if (err)
            fail_call(b, "reading", err);
    }
    pthread_mutex_unlock(&b->lock);
}

static void LIBUSB_CALL on_written(struct libusb_transfer *t)
{
    struct board *b = t->user_data;
    struct talk *k = t == b->command.out ? &b->command : &b->ping;
    pthread_mutex_lock(&b->lock);
    k->flies = false;
    if (t->status != LIBUSB_TRANSFER_COMPLETED && t->status != LIBUSB_TRANSFER_CANCELLED)
        fail_transfer(b, "a command", t);
    pthread_cond_broadcast(&b->changed);
    pthread_mutex_unlock(&b->lock);
}

static void LIBUSB_CALL on_time(struct libusb_transfer *t)
{
    const int64_t now_ns = clock_ns();
    struct board *b = t->user_data;
    pthread_mutex_lock(&b->lock);
    b->times = false;
    if (t->status == LIBUSB_TRANSFER_COMPLETED && t->actual_length == 16) {
        const uint64_t ticks = proto_get_u64(libusb_control_transfer_get_data(t));
        if (ticks >= UINT64_C(1) << 62)
            fail(b, "its clock shows what cannot be; is this its firmware?");
        else
            b->n_rounds += board_clock_add(&b->clock, b->time_sent_ns, now_ns, (int64_t)ticks);
        pthread_cond_broadcast(&b->changed);
    } else if (t->status == LIBUSB_TRANSFER_COMPLETED) {
        fail(b, "asked for the time it sends %d bytes, expected 16; is this its firmware?", t->actual_length);
    } else if (t->status != LIBUSB_TRANSFER_CANCELLED) {
        fail_transfer(b, "asking for the time", t);
    }
    pthread_mutex_unlock(&b->lock);
}

// ---- what is said to the board: the thread, under the lock ------------------------------------------------------------------------------

static void say(struct board *b, struct talk *k)
{
    k->asked = false;
    k->sequence = ++b->sequence;
    k->since_ns = clock_ns();
    k->since_awake_ns = b->awake_ns;
    k->out->length = proto_seal(k->bytes, k->type, k->sequence, k->n_payload);
    const int err = libusb_submit_transfer(k->out);
    k->flies = k->waits = !err;
    if (err)
        fail_call(b, "a command", err);
}

static void ask_time(struct board *b, int64_t now_ns)
{
    const int64_t pause_ns = (b->n_rounds < CLOCK_ROUNDS ? 1 : b->n_rounds < BOARD_CLOCK_ROUNDS ? CLOCK_FAST_MS : CLOCK_MS) * MS;
    b->time_next_ns = now_ns + pause_ns / 2 + (int64_t)((double)rand_r(&b->seed) / RAND_MAX * (double)pause_ns);
    b->time_awake_ns = b->awake_ns;
    b->time_sent_ns = clock_ns();
    const int err = libusb_submit_transfer(b->time);
    b->times = !err;
    if (err)
        fail_call(b, "asking for the time", err);
}

static int64_t at_most_a_slice(int64_t ns)
{
    return ns < SLICE_MS * MS ? ns : SLICE_MS * MS;
}

static void keep_up(struct board *b)
{
    const int64_t now_ns = clock_ns();
    if (b->ping.waits && b->awake_ns - b->ping.since_awake_ns > ANSWER_MS * MS)
        fail(b, "it does not answer any more: unplug it and plug it in again");
    if (b->times && b->awake_ns - b->time_awake_ns > ANSWER_MS * MS)
        fail(b, "asked for the time it does not answer: it hangs; unplug it and plug it in again");
    if (now_ns > b->report_ns)
        fail(b, "it did not report the shot");
    if (!b->broken && b->command.asked)
        say(b, &b->command);
    if (b->broken)
        return;
    if (b->session && !b->ping.waits && !b->ping.flies && now_ns - b->ping.since_ns >= PING_MS * MS)
        say(b, &b->ping);
    if (!b->times && now_ns >= b->time_next_ns)
        ask_time(b, now_ns);
}

static void *run(void *arg)
{
    struct board *b = arg;
    prctl(PR_SET_NAME, "rigd-board");
    for (int64_t last_ns = clock_ns(); !b->quit;) {
        const int64_t now_ns = clock_ns();
        pthread_mutex_lock(&b->lock);
        b->awake_ns += at_most_a_slice(now_ns - last_ns);
        last_ns = now_ns;
        keep_up(b);
        int64_t pause_ns = b->times || b->broken ? SLICE_MS * MS : at_most_a_slice(b->time_next_ns - clock_ns());
        pthread_mutex_unlock(&b->lock);
        pause_ns = pause_ns < 0 ? 0 : pause_ns;
        struct timeval t = { 0, (suseconds_t)(pause_ns / 1000) };
        const int err = libusb_handle_events_timeout_completed(b->context, &t, NULL);
        if (err && err != LIBUSB_ERROR_INTERRUPTED) {
            pthread_mutex_lock(&b->lock);
            fail_call(b, "waiting", err);
            pthread_mutex_unlock(&b->lock);
            break;
        }
    }
    return NULL;
}

// Under the lock, until something changes. False: that was all the patience there was.
static bool wait_a_little(struct board *b, int64_t *patience_ns)
{
    const int64_t now_ns = clock_ns(), until_ns = now_ns + at_most_a_slice(*patience_ns);
    const struct timespec until = { .tv_sec = until_ns / 1000000000, .tv_nsec = until_ns % 1000000000 }; // the condition counts with CLOCK_MONOTONIC
    if (*patience_ns <= 0)
        return false;
    pthread_cond_timedwait(&b->changed, &b->lock, &until);
    *patience_ns -= at_most_a_slice(clock_ns() - now_ns);
    return true;
}

// The loop: one command and its answer. enum proto_error, or -EIO: the link is broken.
static int ask(struct board *b, uint8_t type, const uint8_t *payload, int n, struct board_said *answer)
{
    pthread_mutex_lock(&b->lock);
    int64_t patience_ns = ANSWER_MS * MS;
    while (!b->broken && b->command.flies && wait_a_little(b, &patience_ns))
        ;
    if (b->command.flies)
        fail(b, "it does not take commands: unplug it and plug it in again");
    if (!b->broken) {
        b->command.type = type;
        b->command.n_payload = (uint8_t)n;
        if (n)
            memcpy(b->command.bytes + PROTO_HEADER_BYTES, payload, (size_t)n);
        b->command.asked = true;
        libusb_interrupt_event_handler(b->context);
    }
    while (!b->broken && (b->command.asked || b->command.waits) && wait_a_little(b, &patience_ns))
        ;
    if (b->command.asked || b->command.waits)
        fail(b, "it does not answer: unplug it and plug it in again");
    const int result = b->broken ? -EIO : b->command.answer.reply.error;
    if (answer)
        *answer = b->command.answer;
    pthread_mutex_unlock(&b->lock);
    return result;
}

// The same where an error is nobody's fault but ours or the board's. 0 or -errno, logged.
static int tell(struct board *b, uint8_t type, const uint8_t *payload, int n, const char *what)
{
    const int result = ask(b, type, payload, n, NULL);
    if (result > 0)
        log_error("trigger: %s: %s: %s", b->where, what, board_error_text((uint8_t)result));
    return result > 0 ? (result == PROTO_ERR_BUSY ? -EBUSY : -EINVAL) : result;
}

// ---- shots and relays ----------------------------------------------------------------------------------------------------------------

static int64_t ticks_of(const void *arg, int64_t ns)
{
    return board_clock_ticks(arg, ns);
}

static int load_and_commit(struct board *b, struct board_shot *s, bool on_button)
{
    uint8_t type, payload[PROTO_PAYLOAD_MAX];
    b->shot++;
    for (int i = 0, n; (n = board_shot_frame(s, i, b->shot, on_button, &type, payload)) >= 0; i++) {
        const int result = ask(b, type, payload, n, NULL);
        if (result == -EIO && type == PROTO_SHOT_COMMIT)
            return 0; // perhaps it heard, and fires before it misses us: fired() comes with -EIO
        if (result == PROTO_ERR_PAST)
            return -ETIME;
        if (result == PROTO_ERR_BUSY)
            return -EBUSY;
        if (result > 0)
            log_error("trigger: %s: it refuses a shot of %d lines: %s", b->where, s->n_channels, board_error_text((uint8_t)result));
        if (result)
            return result > 0 ? -EINVAL : result;
    }
    return 0;
}

static int usb_fire(void *self, const struct trigger_shot *shot)
{
    struct board *b = self;
    struct board_shot plan;
    struct trigger_shot timed = *shot;
    pthread_mutex_lock(&b->lock);
    const int broken = b->broken;
    static struct board_clock clock; // the loop's; a window of round trips
    clock = b->clock;
    pthread_mutex_unlock(&b->lock);
    if (broken)
        return -EIO;
    if (b->pending || b->head_moves)
        return -EBUSY;
    const int64_t now_ns = clock_ns();
    if (shot->on_button)
        timed.at_ns = now_ns + shot->half_ms * MS;
    int err = edges_plan(&b->edges, &timed, now_ns);
    if (!err)
        err = board_shot_plan(&plan, &b->edges, &b->can, b->config->trigger.output_registers, ticks_of, &clock);
    if (!err && shot->on_button)
        plan.at_ticks = b->can.lead_min_ticks;
    if (err)
        return err;
    pthread_mutex_lock(&b->lock); // before COMMIT's answer the shot may be over
    b->report_ns = shot->on_button ? INT64_MAX : plan.end_ns + REPORT_MS * MS;
    pthread_mutex_unlock(&b->lock);
    err = load_and_commit(b, &plan, shot->on_button);
    b->pending = !err;
    b->waits = shot->on_button;
    b->released = false;
    b->due_ns = plan.first_ns;
    if (err) {
        pthread_mutex_lock(&b->lock);
        b->report_ns = INT64_MAX;
        pthread_mutex_unlock(&b->lock);
    }
    return err;
}

static void usb_release(void *self)
{
    struct board *b = self;
    const uint8_t what = PROTO_RELEASE_SHOT;
    b->released = b->pending;
    pthread_mutex_lock(&b->lock);
    if (b->pending)
        b->report_ns = clock_ns() + REPORT_MS * MS;
    pthread_mutex_unlock(&b->lock);
    tell(b, PROTO_RELEASE, &what, 1, "releasing");
}

static int usb_relay(void *self, int camera, bool cut)
{
    struct board *b = self;
    const int wire = b->edges.relay_of[camera];
    uint8_t payload[3] = { 0, 0, cut };
    if (wire == CONFIG_NONE)
        return -ENOTSUP;
    proto_put_u16(payload, (uint16_t)b->edges.line[wire].line);
    const int err = tell(b, PROTO_OUTPUT, payload, sizeof(payload), b->edges.line[wire].what);
    return err ? -EIO : 0;
}

static int usb_identify(void *self, int ms)
{
    uint8_t payload[2];
    proto_put_u16(payload, (uint16_t)ms);
    return tell(self, PROTO_IDENTIFY, payload, sizeof(payload), "identify") ? -EIO : 0;
}

// ---- the head ------------------------------------------------------------------------------------------------------------------------

static bool has_head(const struct board *b)
{
    const int *steps = b->config->trigger.head_steps_per_turn;
    return (b->can.can & PROTO_CAN_HEAD) && (steps[0] || steps[1]);
}

static int32_t steps_of(const struct board *b, int axis, double deg)
{
    const double steps = abs(b->config->trigger.head_steps_per_turn[axis]) * deg / 360;
    return (int32_t)(steps < 0 ? steps - .5 : steps + .5);
}

static int configure_head(struct board *b)
{
    const struct trigger_config *c = &b->config->trigger;
    uint8_t axes = 0;
    for (int axis = 0; axis < PROTO_AXES; axis++) {
        uint8_t p[PROTO_HEAD_CONFIGURE_BYTES] = { (uint8_t)axis, c->head_steps_per_turn[axis] < 0 ? PROTO_HEAD_REVERSED : 0 };
        const int32_t speed = steps_of(b, axis, c->head_deg_per_s), acceleration = steps_of(b, axis, c->head_deg_per_s2), limit = steps_of(b, axis, c->head_limit_deg[axis]);
        if (!c->head_steps_per_turn[axis])
            continue;
        if (axis >= b->can.n_axes || speed < 1 || speed > b->can.steps_per_s_max || acceleration < 1 || (uint32_t)acceleration > PROTO_HEAD_ACCELERATION_MAX) {
            log_error("trigger: %s: the head's %s axis would run at %d steps/s, the board can do %d axes at 1 to %d: change head_deg_per_s, or its gear", b->where, axis ? "pitch" : "yaw",
                speed, b->can.n_axes, b->can.steps_per_s_max);
            return -EINVAL;
        }
        proto_put_u16(p + 2, (uint16_t)speed);
        proto_put_u32(p + 4, (uint32_t)acceleration);
        proto_put_u16(p + 8, (uint16_t)(speed / HOMING_PART > 0 ? speed / HOMING_PART : 1));
        proto_put_u32(p + 12, (uint32_t)-limit);
        proto_put_u32(p + 16, (uint32_t)limit);
        const int err = tell(b, PROTO_HEAD_CONFIGURE, p, sizeof(p), "the head");
        if (err)
            return err;
        axes |= (uint8_t)(1 << axis);
    }
    b->head_homes = c->head_home_switch && axes;
    const uint8_t here[2] = { axes, 1 };
    return axes && !c->head_home_switch ? tell(b, PROTO_HEAD_HOME, here, sizeof(here), "the head's home") : 0;
}

static int move_head(struct board *b)
{
    uint8_t p[8];
    proto_put_u32(p, (uint32_t)b->head_to[0]);
    proto_put_u32(p + 4, (uint32_t)b->head_to[1]);
    return tell(b, PROTO_HEAD_MOVE, p, sizeof(p), "turning the head");
}

static int usb_head(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg)
{
    struct board *b = self;
    const int32_t to_mdeg[2] = { yaw_mdeg, pitch_mdeg };
    if (!has_head(b))
        return -ENOTSUP;
    if (b->pending || b->head_moves)
        return -EBUSY;
    for (int axis = 0; axis < 2; axis++) {
        const double limit_deg = b->config->trigger.head_steps_per_turn[axis] ? b->config->trigger.head_limit_deg[axis] : 0;
        if (to_mdeg[axis] < -1e3 * limit_deg || to_mdeg[axis] > 1e3 * limit_deg)
            return -EINVAL;
        b->head_to[axis] = steps_of(b, axis, 1e-3 * to_mdeg[axis]);
    }
    const uint8_t axes = (uint8_t)((b->config->trigger.head_steps_per_turn[0] ? 1 : 0) | (b->config->trigger.head_steps_per_turn[1] ? 2 : 0)), home[2] = { axes, 0 };
    const int err = b->head_homes ? tell(b, PROTO_HEAD_HOME, home, sizeof(home), "homing the head") : move_head(b);
    b->head_moves = !err;
    return err;
}

static void head_stands(struct board *b, const struct board_said *s)
{
    int err = s->head.how == PROTO_HEAD_ARRIVED ? 0 : s->head.how == PROTO_HEAD_STOPPED ? -ECANCELED : -ETIME;
    if (!b->head_moves)
        return;
    if (err == -ETIME)
        log_error("trigger: %s: the head met its switch, or never: look at its way, motors and switches", b->where);
    if (!err && b->head_homes) {
        b->head_homes = false;
        err = move_head(b);
        if (!err)
            return;
        err = -EIO;
    }
    b->head_moves = false;
    if (b->host->head_arrived)
        b->host->head_arrived(b->host->arg, err);
}

// ---- the loop --------------------------------------------------------------------------------------------------------------------------

static void shot_is_over(struct board *b, const struct heard *h)
{
    const struct board_said *s = &h->said;
    if (!b->pending || s->fired.shot != b->shot)
        return; // one that was refused after all, or of another session
    b->pending = false;
    const int err = s->fired.how == PROTO_FIRED_DONE ? 0 : s->fired.how == PROTO_FIRED_RELEASED && b->released ? -ECANCELED : -EIO;
    const int64_t late_ns = (int64_t)(1e9 * (double)s->fired.late_ticks / b->can.ticks_per_s);
    if (s->fired.how == PROTO_FIRED_LATE)
        log_error("trigger: %s: an edge would have come too late: the shot was given up", b->where);
    if (s->fired.how == PROTO_FIRED_GUARDED)
        log_error("trigger: %s: an output reached its limit of %u ms and was cut", b->where, b->config->trigger.max_hold_ms);
    if (s->fired.n_lost)
        log_warning("trigger: %s: %u flash-sync contacts were lost: this host read too late", b->where, s->fired.n_lost);
    // What the clocks have learnt about each other since the shot was committed counts as lateness, too.
    b->host->fired(b->host->arg, err, h->at_ns, h->at_ns && !b->waits ? h->at_ns - b->due_ns : late_ns);
}

static void obey(struct board *b, const struct heard *h)
{
    const struct trigger_host *host = b->host;
    const struct board_said *s = &h->said;
    switch (s->type) {
    case PROTO_FIRED:
        shot_is_over(b, h);
        return;
    case PROTO_BUTTON:
        if (s->button.down && !s->button.fires)
            host->button(host->arg, h->at_ns);
        return;
    case PROTO_CAPTURE:
        if (b->capture_camera != CONFIG_NONE)
            host->feedback(host->arg, b->capture_camera, h->at_ns);
        return;
    case PROTO_INPUTS:
        for (int i = 0; i < s->inputs.n; i++)
            if (s->inputs.input[i] < PROTO_INPUTS_MAX && b->camera_of[s->inputs.input[i]] != CONFIG_NONE)
                host->feedback(host->arg, b->camera_of[s->inputs.input[i]], h->at_ns);
        return;
    case PROTO_FAULT:
        if (s->fault.fault == PROTO_FAULT_ON_TIME)
            log_warning("trigger: %s: output %u was on for its limit of %u ms and was cut", b->where, s->fault.what, b->config->trigger.max_hold_ms);
        else if (s->fault.fault == PROTO_FAULT_BAD_FRAMES)
            log_warning("trigger: %s: %u commands arrived damaged", b->where, s->fault.what);
        return;
    case PROTO_HEAD:
        head_stands(b, s);
        return;
    default:
        return;
    }
}

static void usb_dispatch(void *self)
{
    static struct heard heard[HEARD_MAX]; // the loop's
    struct board *b = self;
    uint64_t count;
    if (read(b->event_fd, &count, sizeof(count)) < 0 && errno != EAGAIN)
        log_error("trigger: eventfd: %s", strerror(errno));
    pthread_mutex_lock(&b->lock);
    const int n = b->n_heard;
    const bool broken = b->broken && !b->told_broken;
    memcpy(heard, b->heard, (size_t)n * sizeof(heard[0]));
    b->n_heard = 0;
    pthread_mutex_unlock(&b->lock);
    for (int i = 0; i < n; i++)
        obey(b, &heard[i]);
    if (!broken)
        return;
    b->told_broken = true;
    if (b->pending)
        b->host->fired(b->host->arg, -EIO, 0, 0);
    if (b->head_moves && b->host->head_arrived)
        b->host->head_arrived(b->host->arg, -EIO);
    b->pending = b->head_moves = false;
    b->host->broken(b->host->arg, -EIO); // last: the host may close us
}

static int usb_fd(const void *self)
{
    return ((const struct board *)self)->event_fd;
}

static unsigned usb_abilities(const void *self)
{
    const struct board *b = self;
    bool feedback = b->capture_camera != CONFIG_NONE;
    for (int i = 0; i < PROTO_INPUTS_MAX; i++)
        feedback |= b->camera_of[i] != CONFIG_NONE;
    return TRIGGER_SYNCHRONISED | edges_abilities(&b->edges) | (feedback ? TRIGGER_FEEDBACK : 0) |
        (b->can.can & PROTO_CAN_BUTTON ? TRIGGER_BUTTON | TRIGGER_WAITS : 0) | (has_head(b) ? TRIGGER_HEAD : 0);
}

// ---- finding it ------------------------------------------------------------------------------------------------------------------------

static void slot_of(libusb_device *device, char *out, size_t room)
{
    uint8_t ports[8];
    const int n = libusb_get_port_numbers(device, ports, sizeof(ports));
    int at = snprintf(out, room, "%d", libusb_get_bus_number(device));
    for (int i = 0; i < n; i++)
        at += snprintf(out + at, room - (size_t)at, "%c%d", i ? '.' : '-', ports[i]);
}

static void read_string(libusb_device_handle *h, uint8_t index, char *out, int room)
{
    const int n = index ? libusb_get_string_descriptor_ascii(h, index, (unsigned char *)out, room - 1) : 0;
    out[n > 0 ? n : 0] = 0;
}

// A device with our numbers: opened and left open if it is the one, *err says what is in the way of one that might be.
static bool is_it(struct board *b, libusb_device *device, const struct libusb_device_descriptor *d, char *others, size_t room, int *err)
{
    char slot[40], maker[40], product[40], serial[40];
    const char *wanted = b->config->trigger.serial;
    libusb_device_handle *h;
    slot_of(device, slot, sizeof(slot));
    const int result = libusb_open(device, &h);
    if (result) {
        *err = result == LIBUSB_ERROR_ACCESS ? -EACCES : -ENODEV;
        log_error("trigger: the board at USB %s (/dev/bus/usb/%03d/%03d) cannot be opened: %s%s", slot, libusb_get_bus_number(device), libusb_get_device_address(device), libusb_strerror(result),
            result == LIBUSB_ERROR_ACCESS ? ": install config/systemd/71-rigd.rules, let rigd's user be in group plugdev, and plug it in again" : "");
        return false;
    }
    read_string(h, d->iManufacturer, maker, sizeof(maker));
    read_string(h, d->iProduct, product, sizeof(product));
    read_string(h, d->iSerialNumber, serial, sizeof(serial));
    const bool ours = !strcmp(maker, PROTO_MANUFACTURER) && !strcmp(product, PROTO_PRODUCT);
    if (ours && (!wanted[0] || !strcmp(serial, wanted))) {
        if (!b->device) {
            b->device = h;
            snprintf(b->where, sizeof(b->where), "board %s at USB %s", serial, slot);
            return true;
        }
        log_error("trigger: %s and board %s at USB %s: name one in rigd.conf, [trigger] serial = ...", b->where, serial, slot);
        *err = -EINVAL;
    } else {
        const size_t at = strlen(others);
        snprintf(others + at, room - at, "%s%s \"%s %s\" %s", at ? "; " : "", slot, maker, product, serial);
    }
    libusb_close(h);
    return false;
}

static int find_board(struct board *b)
{
    libusb_device **list;
    char others[300] = "";
    int err = 0;
    const ssize_t n = libusb_get_device_list(b->context, &list);
    for (ssize_t i = 0; i < n; i++) {
        struct libusb_device_descriptor d;
        if (!libusb_get_device_descriptor(list[i], &d) && d.idVendor == PROTO_VENDOR_ID && d.idProduct == PROTO_PRODUCT_ID)
            is_it(b, list[i], &d, others, sizeof(others), &err);
    }
    if (n >= 0)
        libusb_free_device_list(list, 1);
    if (err || b->device)
        return err;
    if (others[0])
        log_error("trigger: no board %s; with its USB number (%04x:%04x) there is: %s: correct [trigger] serial", b->config->trigger.serial, PROTO_VENDOR_ID, PROTO_PRODUCT_ID, others);
    else
        log_error("trigger: no trigger board is plugged in (USB %04x:%04x): look at its cable and its LED", PROTO_VENDOR_ID, PROTO_PRODUCT_ID);
    return -ENODEV;
}

static int claim(struct board *b)
{
    uint8_t bytes[PROTO_CAPABILITIES_BYTES];
    const char *why;
    int result = libusb_claim_interface(b->device, 0);
    if (result) {
        log_error("trigger: %s: %s%s", b->where, libusb_strerror(result), result == LIBUSB_ERROR_BUSY ? ": another program holds it: a second rigd?" : "");
        return result == LIBUSB_ERROR_BUSY ? -EBUSY : -ENODEV;
    }
    b->claimed = true;
    for (int tries = 0; tries < 2 && (tries == 0 || result == LIBUSB_ERROR_TIMEOUT); tries++)
        result = libusb_control_transfer(b->device, LIBUSB_ENDPOINT_IN | LIBUSB_REQUEST_TYPE_VENDOR | LIBUSB_RECIPIENT_DEVICE, PROTO_GET_CAPABILITIES, 0, 0, bytes, sizeof(bytes), ANSWER_MS);
    if (result < 0) {
        log_error("trigger: %s: asked what it can do: %s: flash its firmware again (firmware/README.md)", b->where, libusb_strerror(result));
        return -ENODEV;
    }
    const int err = board_capabilities(&b->can, bytes, (size_t)result, &why);
    if (err)
        log_error("trigger: %s: %s", b->where, why);
    return err ? -ENODEV : 0;
}

// ---- life ------------------------------------------------------------------------------------------------------------------------------

static int begin_thread(struct board *b)
{
    b->command.out = libusb_alloc_transfer(0);
    b->ping.out = libusb_alloc_transfer(0);
    b->time = libusb_alloc_transfer(0);
    if (!b->command.out || !b->ping.out || !b->time)
        return -ENOMEM;
    libusb_fill_bulk_transfer(b->command.out, b->device, PROTO_ENDPOINT_OUT, b->command.bytes, 0, on_written, b, 0); // no limit of libusb's: keep_up() has one
    libusb_fill_bulk_transfer(b->ping.out, b->device, PROTO_ENDPOINT_OUT, b->ping.bytes, 0, on_written, b, 0);
    libusb_fill_control_setup(b->time_bytes, LIBUSB_ENDPOINT_IN | LIBUSB_REQUEST_TYPE_VENDOR | LIBUSB_RECIPIENT_DEVICE, PROTO_GET_TIME, 0, 0, 16);
    libusb_fill_control_transfer(b->time, b->device, b->time_bytes, on_time, b, 0);
    libusb_clear_halt(b->device, PROTO_ENDPOINT_OUT); // and both ends begin with the same data toggle
    libusb_clear_halt(b->device, PROTO_ENDPOINT_IN);
    pthread_mutex_lock(&b->lock);
    for (int i = 0; i < READS && !b->broken; i++) {
        b->read[i] = libusb_alloc_transfer(0);
        if (!b->read[i]) {
            pthread_mutex_unlock(&b->lock);
            return -ENOMEM;
        }
        libusb_fill_bulk_transfer(b->read[i], b->device, PROTO_ENDPOINT_IN, b->packet[i], PROTO_PACKET_BYTES, on_read, b, 0);
        const int err = libusb_submit_transfer(b->read[i]);
        b->reads[i] = !err;
        if (err)
            fail_call(b, "reading", err);
    }
    pthread_mutex_unlock(&b->lock);
    const int err = -pthread_create(&b->thread, NULL, run, b);
    b->started = !err;
    if (err)
        log_error("trigger: cannot start the board's thread: %s", strerror(-err));
    return err;
}

static int configure(struct board *b)
{
    const struct trigger_config *c = &b->config->trigger;
    uint8_t hello[2], p[PROTO_CONFIGURE_BYTES + PROTO_BANK_BYTES] = { (uint8_t)c->output_registers };
    struct board_said answer;
    int n_inputs = 0;
    for (int i = 0; i < PROTO_INPUTS_MAX; i++)
        n_inputs = b->camera_of[i] == CONFIG_NONE ? n_inputs : i + 1;
    if (n_inputs > b->can.n_inputs || 8 * c->output_registers > b->can.n_outputs || (b->capture_camera != CONFIG_NONE && !b->can.n_captures)) {
        log_error("trigger: %s has %u outputs, %u inputs and %u capture inputs, rigd.conf wants %d, %d and %d: correct output_registers and feedback_line", b->where, b->can.n_outputs,
            b->can.n_inputs, b->can.n_captures, 8 * c->output_registers, n_inputs, b->capture_camera != CONFIG_NONE);
        return -EINVAL;
    }
    proto_put_u16(hello, PROTO_VERSION);
    int result = ask(b, PROTO_HELLO, hello, sizeof(hello), &answer);
    if (result > 0)
        log_error("trigger: %s: it does not begin: %s", b->where, board_error_text((uint8_t)result));
    if (result)
        return result > 0 ? -ENODEV : result;
    // The board grants a little less than a bank's limit, so that its guard cuts nothing it has granted: max_hold_ms may be used in full.
    const uint32_t max_on_ms = c->max_hold_ms + PROTO_ON_SLACK_MS;
    p[1] = (uint8_t)((n_inputs + 7) / 8);
    proto_put_u16(p + 2, (uint16_t)c->button_debounce_ms);
    proto_put_u16(p + 4, SILENCE_MS);
    p[6] = (uint8_t)((c->button_active_low ? 0 : PROTO_BUTTON_ACTIVE_HIGH) | (c->feedback_active_low ? 0 : PROTO_INPUTS_ACTIVE_HIGH | PROTO_CAPTURE_RISING));
    proto_put_u16(p + 8, FEEDBACK_MS);
    proto_put_u16(p + 10, 0);
    proto_put_u16(p + 12, (uint16_t)(8 * c->output_registers));
    proto_put_u16(p + 14, (uint16_t)(max_on_ms < b->can.max_on_ceiling_ms ? max_on_ms : b->can.max_on_ceiling_ms));
    result = tell(b, PROTO_CONFIGURE, p, sizeof(p), "setting it up");
    return result || !has_head(b) ? result : configure_head(b);
}

static int relate_clocks(struct board *b)
{
    int64_t patience_ns = 2 * ANSWER_MS * MS;
    pthread_mutex_lock(&b->lock);
    while (!b->broken && b->n_rounds < CLOCK_ROUNDS && wait_a_little(b, &patience_ns))
        ;
    if (!b->broken && b->n_rounds < CLOCK_ROUNDS)
        fail(b, "its clock cannot be made out: %d of %d round trips fit together", b->n_rounds, CLOCK_ROUNDS);
    const int err = b->broken;
    if (!err)
        log_info("trigger: %s: firmware's protocol %d.%d, %u outputs, clocks related within %.0f us", b->where, b->can.version >> 8, b->can.version & 255, 8 * b->config->trigger.output_registers,
            1e-3 * (double)board_clock_uncertainty_ns(&b->clock, clock_ns()));
    pthread_mutex_unlock(&b->lock);
    return err;
}

static void map_inputs(struct board *b)
{
    b->capture_camera = CONFIG_NONE;
    for (int i = 0; i < PROTO_INPUTS_MAX; i++)
        b->camera_of[i] = CONFIG_NONE;
    for (int i = 0; i < b->config->n_cameras; i++) {
        const int line = b->config->camera[i].feedback_line;
        if (line == CONFIG_CAPTURE)
            b->capture_camera = i;
        else if (line >= 0 && line < PROTO_INPUTS_MAX)
            b->camera_of[line] = i;
    }
}

// What still flies must come down before its memory goes.
static void land(struct board *b)
{
    struct libusb_transfer *const all[] = { b->read[0], b->read[1], b->command.out, b->ping.out, b->time };
    const bool *const flies[] = { &b->reads[0], &b->reads[1], &b->command.flies, &b->ping.flies, &b->times };
    const int64_t until_ns = clock_ns() + 1000 * MS;
    bool any = true;
    for (int i = 0; i < 5; i++)
        if (all[i] && *flies[i])
            libusb_cancel_transfer(all[i]);
    while (any && clock_ns() < until_ns) {
        struct timeval t = { 0, 10000 };
        any = false;
        for (int i = 0; i < 5; i++)
            any |= all[i] && *flies[i];
        if (any)
            libusb_handle_events_timeout_completed(b->context, &t, NULL);
    }
    for (int i = 0; i < 5; i++)
        if (!*flies[i])
            libusb_free_transfer(all[i]);
}

static void usb_close(void *self)
{
    struct board *b = self;
    if (!b)
        return;
    b->quit = true;
    if (b->started) {
        libusb_interrupt_event_handler(b->context);
        pthread_join(b->thread, NULL);
    }
    if (b->device) {
        land(b);
        if (b->claimed)
            libusb_control_transfer(b->device, LIBUSB_ENDPOINT_OUT | LIBUSB_REQUEST_TYPE_VENDOR | LIBUSB_RECIPIENT_DEVICE, PROTO_RELEASE_ALL, 0, 0, NULL, 0, ANSWER_MS);
        if (b->claimed)
            libusb_release_interface(b->device, 0);
        libusb_close(b->device);
    }
    if (b->context)
        libusb_exit(b->context);
    if (b->event_fd >= 0)
        close(b->event_fd);
    if (b->has_lock) {
        pthread_mutex_destroy(&b->lock);
        pthread_cond_destroy(&b->changed);
    }
    free(b);
}

static int usb_open(void **self, const struct config *config, const struct trigger_host *host)
{
    pthread_condattr_t monotonic;
    struct board *b = calloc(1, sizeof(*b));
    *self = NULL;
    if (!b)
        return -ENOMEM;
    b->config = config;
    b->host = host;
    b->report_ns = INT64_MAX;
    b->sequence = (uint8_t)clock_ns(); // not the one of an earlier conversation, whose rest may still come
    b->seed = (unsigned)clock_ns();
    b->ping.type = PROTO_PING;
    pthread_condattr_init(&monotonic);
    pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
    pthread_cond_init(&b->changed, &monotonic);
    pthread_mutex_init(&b->lock, NULL);
    b->has_lock = true;
    map_inputs(b);
    b->event_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    int err = b->event_fd < 0 ? -errno : 0;
    if (err)
        log_error("trigger: eventfd: %s", strerror(-err));
    if (!err)
        err = edges_init(&b->edges, config, false, b->limit_ns);
    if (!err) {
        const int result = libusb_init(&b->context);
        if (result) {
            b->context = NULL;
            log_error("trigger: libusb: %s", libusb_strerror(result));
            err = -ENODEV;
        }
    }
    if (!err)
        err = find_board(b);
    if (!err)
        err = claim(b);
    if (!err) {
        board_clock_init(&b->clock, b->can.ticks_per_s);
        err = begin_thread(b);
    }
    if (!err)
        err = relate_clocks(b);
    if (!err)
        err = configure(b);
    if (err) {
        usb_close(b);
        return err == -EIO ? -ENODEV : err;
    }
    *self = b;
    return 0;
}

const struct trigger_ops trigger_usb = { .open = usb_open, .abilities = usb_abilities, .fire = usb_fire, .release = usb_release, .relay = usb_relay, .head = usb_head,
    .identify = usb_identify, .fd = usb_fd, .dispatch = usb_dispatch, .close = usb_close };
