// tests/rigsim/server_head.c - the motorised panorama head: it turns at a head's speed, and may get stuck.
#include "tests/rigsim/server_state.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>

#define SPEED_DEG_S 45.
#define ACCELERATION_DEG_S2 90.
#define LATENCY_S .05 // from the order to the first step, and from the last one to the answer
#define LIMIT_MDEG 720000

static double travel_s(double degrees)
{
    const double ramp = SPEED_DEG_S * SPEED_DEG_S / ACCELERATION_DEG_S2; // both ramps together
    return degrees < ramp ? 2 * sqrt(degrees / ACCELERATION_DEG_S2) : (degrees - ramp) / SPEED_DEG_S + 2 * SPEED_DEG_S / ACCELERATION_DEG_S2;
}

static double travelled_deg(double degrees, double t)
{
    const double whole = travel_s(degrees), ramp_s = fmin(SPEED_DEG_S / ACCELERATION_DEG_S2, .5 * whole);
    t = fmax(0, fmin(whole, t));
    if (t < ramp_s)
        return .5 * ACCELERATION_DEG_S2 * t * t;
    if (t > whole - ramp_s)
        return degrees - .5 * ACCELERATION_DEG_S2 * (whole - t) * (whole - t);
    return .5 * ACCELERATION_DEG_S2 * ramp_s * ramp_s + SPEED_DEG_S * (t - ramp_s);
}

void server_head_aim(void *arg, int64_t at_ns, struct scene_view *out)
{
    const struct head *h = &((struct server *)arg)->head;
    const double way = fmax(fabs(h->to_deg[0] - h->from_deg[0]), fabs(h->to_deg[1] - h->from_deg[1]));
    double part = 1;
    if (h->arrives_ns && way > 0)
        part = travelled_deg(way, 1e-9 * (double)(at_ns - h->began_ns) - LATENCY_S) / way;
    if (h->arrives_ns && h->fails)
        part = fmin(part, .5);
    out->yaw_deg = h->from_deg[0] + part * (h->to_deg[0] - h->from_deg[0]);
    out->pitch_deg = h->from_deg[1] + part * (h->to_deg[1] - h->from_deg[1]);
}

int server_head_move(struct server *s, int client, const struct shutter_line *order)
{
    struct head *h = &s->head;
    if (h->arrives_ns)
        return -EBUSY;
    if (llabs(order->yaw_mdeg) > LIMIT_MDEG || llabs(order->pitch_mdeg) > 90000)
        return -EINVAL;
    h->from_deg[0] = h->to_deg[0], h->from_deg[1] = h->to_deg[1];
    h->to_deg[0] = 1e-3 * (double)order->yaw_mdeg, h->to_deg[1] = 1e-3 * (double)order->pitch_mdeg;
    const double way = fmax(fabs(h->to_deg[0] - h->from_deg[0]), fabs(h->to_deg[1] - h->from_deg[1]));
    h->fails = h->stuck > 0;
    h->stuck -= h->fails;
    h->client = client;
    h->order = *order;
    h->began_ns = s->now_ns;
    h->arrives_ns = s->now_ns + (int64_t)(1e9 * (travel_s(way) + 2 * LATENCY_S));
    return 0;
}

void server_head_step(struct server *s)
{
    struct head *h = &s->head;
    struct scene_view stands;
    if (!h->arrives_ns || h->arrives_ns > s->now_ns)
        return;
    server_head_aim(s, h->arrives_ns, &stands);
    h->to_deg[0] = stands.yaw_deg, h->to_deg[1] = stands.pitch_deg;
    const struct shutter_line r = { .kind = SHUTTER_LINE_ARRIVED, .tag = h->order.tag, .at_ns = h->arrives_ns, .error = h->fails ? ETIME : 0,
                                    .yaw_mdeg = llround(1e3 * stands.yaw_deg), .pitch_mdeg = llround(1e3 * stands.pitch_deg) };
    h->arrives_ns = 0;
    server_shutter_tell(s, h->client, &r);
}

int64_t server_head_next_ns(const struct server *s)
{
    return s->head.arrives_ns ? s->head.arrives_ns : INT64_MAX;
}
