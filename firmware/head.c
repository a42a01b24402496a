// firmware/head.c - steps with limited speed and acceleration.
//
// Each beat adds the speed to a phase; where it overflows, a step is made. Speed v in 2^-32 steps per beat, acceleration a in the
// same per beat:  a = steps/s^2 / f^2 2^32,  v = steps/s / f 2^32.  Braking from v takes as many steps as reaching it took, so
// these are counted (`ramp`), and braking begins when no more are left. Braking never ends below the speed of the first step,
// sqrt(2 a): so that the last one is made.
#include "firmware/head.h"
#include "firmware/board.h"

#include <string.h>

enum phase { STILL, MOVE, SEEK, BRAKE, BACK, CLEAR };
enum { CLEAR_STEPS = 16 }; // home is so far from where the switch opens, so that standing there does not meet it

struct axis {
    bool configured, homed, positive;
    uint8_t phase, result;
    struct head_axis_config c;
    int32_t position;
    uint32_t left;              // steps to go
    uint32_t ramp, v, fraction; // fraction: phase of the step
    uint32_t v_max, v_home, v_creep, a;
};

static struct axis axis[PROTO_AXES];
static bool has_moved;

static uint32_t root(uint64_t x) // floor of the square root
{
    uint32_t r = 0;
    for (uint32_t bit = UINT32_C(1) << 31; bit; bit >>= 1) {
        const uint32_t t = r | bit;
        if ((uint64_t)t * t <= x)
            r = t;
    }
    return r;
}

static uint32_t speed_of(uint16_t steps_per_s)
{
    return (uint32_t)(((uint64_t)steps_per_s << 32) / BOARD_HEAD_HZ);
}

void head_start(void)
{
    memset(axis, 0, sizeof(axis));
    has_moved = false;
    board_head_run(false);
}

uint8_t head_configure(uint8_t i, const struct head_axis_config *c)
{
    if (i >= PROTO_AXES || c->speed < 1 || c->speed > PROTO_HEAD_SPEED_MAX || c->homing_speed < 1 || c->homing_speed > c->speed ||
        c->acceleration < 1 || c->acceleration > PROTO_HEAD_ACCELERATION_MAX || c->lowest > c->highest ||
        c->lowest < -PROTO_HEAD_POSITION_MAX || c->highest > PROTO_HEAD_POSITION_MAX)
        return PROTO_ERR_VALUE;
    if (head_is_moving())
        return PROTO_ERR_BUSY;
    struct axis *a = &axis[i];
    memset(a, 0, sizeof(*a));
    a->configured = true;
    a->c = *c;
    a->a = (uint32_t)(((uint64_t)c->acceleration << 32) / ((uint64_t)BOARD_HEAD_HZ * BOARD_HEAD_HZ));
    if (a->a == 0)
        a->a = 1;
    a->v_max = speed_of(c->speed);
    a->v_home = speed_of(c->homing_speed);
    a->v_creep = root((uint64_t)a->a << 33);
    if (a->v_creep > a->v_max)
        a->v_creep = a->v_max;
    return PROTO_OK;
}

static bool is_met(uint8_t i)
{
    return board_home_high(i) == !!(axis[i].c.flags & PROTO_HEAD_HOME_ACTIVE_HIGH);
}

static bool is_homeward(const struct axis *a)
{
    return a->positive == !!(a->c.flags & PROTO_HEAD_HOME_POSITIVE);
}

static void set_off(uint8_t i, uint8_t phase, bool positive, uint32_t steps) // locked
{
    struct axis *a = &axis[i];
    a->phase = phase;
    a->positive = positive;
    a->left = steps;
    a->ramp = a->v = a->fraction = 0;
    board_head_direction(i, positive != !!(a->c.flags & PROTO_HEAD_REVERSED));
}

static bool is_configured(uint8_t axes)
{
    for (uint8_t i = 0; i < PROTO_AXES; i++)
        if ((axes & 1 << i) && !axis[i].configured)
            return false;
    return true;
}

uint8_t head_move(const int32_t target[PROTO_AXES])
{
    if (!axis[0].configured && !axis[1].configured)
        return PROTO_ERR_CONFIGURE;
    if (head_is_moving())
        return PROTO_ERR_BUSY;
    for (uint8_t i = 0; i < PROTO_AXES; i++) {
        if (!axis[i].configured && target[i] == 0)
            continue; // a head of one axis
        if (!axis[i].configured)
            return PROTO_ERR_CONFIGURE;
        if (!axis[i].homed)
            return PROTO_ERR_NOT_HOMED;
        if (target[i] < axis[i].c.lowest || target[i] > axis[i].c.highest)
            return PROTO_ERR_LIMIT;
    }
    const uint8_t lock = board_lock();
    for (uint8_t i = 0; i < PROTO_AXES; i++) {
        axis[i].result = PROTO_HEAD_ARRIVED;
        if (axis[i].configured && target[i] != axis[i].position)
            set_off(i, MOVE, target[i] > axis[i].position,
                    (uint32_t)(target[i] > axis[i].position ? target[i] - axis[i].position : axis[i].position - target[i]));
    }
    has_moved = true;
    board_head_run(head_is_moving());
    board_unlock(lock);
    return PROTO_OK;
}

uint8_t head_home(uint8_t axes, bool here)
{
    if (axes == 0 || axes >= 1 << PROTO_AXES)
        return PROTO_ERR_VALUE;
    if (!is_configured(axes))
        return PROTO_ERR_CONFIGURE;
    if (head_is_moving())
        return PROTO_ERR_BUSY;
    const uint8_t lock = board_lock();
    for (uint8_t i = 0; i < PROTO_AXES; i++) {
        struct axis *a = &axis[i];
        a->result = PROTO_HEAD_ARRIVED;
        if (!(axes & 1 << i))
            continue;
        a->homed = here;
        if (here)
            a->position = 0;
        else if (is_met(i))
            set_off(i, BACK, !(a->c.flags & PROTO_HEAD_HOME_POSITIVE), PROTO_HEAD_HOMING_STEPS_MAX);
        else
            set_off(i, SEEK, !!(a->c.flags & PROTO_HEAD_HOME_POSITIVE), PROTO_HEAD_HOMING_STEPS_MAX);
    }
    has_moved = true;
    board_head_run(head_is_moving());
    board_unlock(lock);
    return PROTO_OK;
}

void head_stop(void)
{
    const uint8_t lock = board_lock();
    for (uint8_t i = 0; i < PROTO_AXES; i++) {
        struct axis *a = &axis[i];
        if (a->phase == STILL)
            continue;
        a->result = PROTO_HEAD_STOPPED;
        if (a->left > a->ramp)
            a->left = a->ramp;
        a->phase = a->left == 0 ? STILL : MOVE;
    }
    board_unlock(lock);
}

void head_forget(void)
{
    const uint8_t lock = board_lock();
    for (uint8_t i = 0; i < PROTO_AXES; i++) {
        if (axis[i].phase != STILL)
            axis[i].homed = false;
        axis[i].phase = STILL;
    }
    has_moved = false;
    board_head_run(false);
    board_unlock(lock);
}

bool head_is_moving(void)
{
    return axis[0].phase != STILL || axis[1].phase != STILL;
}

bool head_take_still(uint8_t *result)
{
    const uint8_t lock = board_lock();
    const bool still = has_moved && !head_is_moving();
    if (still) {
        has_moved = false;
        board_head_run(false);
        *result = axis[0].result > axis[1].result ? axis[0].result : axis[1].result;
    }
    board_unlock(lock);
    return still;
}

int32_t head_position(uint8_t i)
{
    const uint8_t lock = board_lock();
    const int32_t position = axis[i].position;
    board_unlock(lock);
    return position;
}

uint8_t head_homed(void)
{
    return (uint8_t)(axis[0].homed | axis[1].homed << 1);
}

uint8_t head_moving(void)
{
    return (uint8_t)((axis[0].phase != STILL) | (axis[1].phase != STILL) << 1);
}

uint8_t head_switches(void)
{
    return (uint8_t)((axis[0].configured && is_met(0)) | (axis[1].configured && is_met(1)) << 1);
}

static void halt(struct axis *a, uint8_t result)
{
    a->phase = STILL;
    a->v = 0;
    if (result != PROTO_HEAD_ARRIVED)
        a->result = result;
}

static void beat(uint8_t i)
{
    struct axis *a = &axis[i];
    switch ((enum phase)a->phase) {
    case STILL:
        return;
    case MOVE:
        if (!(a->c.flags & PROTO_HEAD_HOME_IS_INDEX) && a->homed && is_homeward(a) && is_met(i)) {
            a->homed = false; // steps were lost, or the limits are wrong
            halt(a, PROTO_HEAD_BLOCKED);
            return;
        }
        break;
    case SEEK:
        if (is_met(i)) {
            a->left = a->ramp ? a->ramp : 1;
            a->phase = BRAKE;
        }
        break;
    case BACK:
        if (!is_met(i)) {
            a->phase = CLEAR;
            a->left = CLEAR_STEPS;
        }
        break;
    case BRAKE:
    case CLEAR:
        break;
    }
    // Back from the switch at the creeping speed only: what is counted there is the reference of all positions.
    const uint32_t v_max = a->phase == MOVE ? a->v_max : a->phase == SEEK || a->phase == BRAKE ? a->v_home :
                           a->v_creep < a->v_home ? a->v_creep : a->v_home;
    const bool braking = a->left <= a->ramp;
    const bool accelerating = !braking && a->v < v_max;
    if (braking)
        a->v = a->v > a->a + a->v_creep ? a->v - a->a : a->v_creep;
    else if (accelerating)
        a->v = v_max - a->v > a->a ? a->v + a->a : v_max;
    const uint32_t before = a->fraction;
    a->fraction += a->v;
    if (a->fraction >= before)
        return;
    board_head_step(i);
    a->position += a->positive ? 1 : -1;
    if (accelerating)
        a->ramp++;
    else if (braking && a->ramp > 0)
        a->ramp--;
    if (--a->left > 0)
        return;
    switch ((enum phase)a->phase) {
    case BRAKE: // beyond the switch, or still on it
        if (is_met(i)) {
            set_off(i, BACK, !a->positive, PROTO_HEAD_HOMING_STEPS_MAX);
            return;
        }
        halt(a, PROTO_HEAD_BLOCKED); // it went off again: too fast for this switch
        return;
    case CLEAR:
        a->position = 0;
        a->homed = true;
        halt(a, PROTO_HEAD_ARRIVED);
        return;
    case SEEK: // never met
    case BACK: // never left
        halt(a, PROTO_HEAD_BLOCKED);
        return;
    case MOVE:
    case STILL:
        halt(a, PROTO_HEAD_ARRIVED);
        return;
    }
}

void head_beat(void)
{
    beat(0);
    beat(1);
}
