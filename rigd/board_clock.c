// rigd/board_clock.c - see board_clock.h. Half-planes cut a polygon; nothing else.
#include "rigd/board_clock.h"

#include <assert.h>
#include <math.h>
#include <string.h>

#define DAY_NS INT64_C(86400000000000)

void board_clock_init(struct board_clock *c, double ticks_per_s)
{
    memset(c, 0, sizeof(*c));
    c->ticks_per_s = ticks_per_s;
}

int64_t board_clock_unwrap(int64_t near_ticks, uint32_t low)
{
    return near_ticks + (int32_t)(low - (uint32_t)near_ticks);
}

bool board_clock_is_known(const struct board_clock *c)
{
    return c->n_corners > 0;
}

// ---- the polygon -----------------------------------------------------------------------------------------------------------------

struct corner {
    double offset_ns, drift;
};

struct polygon {
    struct corner corner[BOARD_CLOCK_CORNERS_MAX];
    int n;
};

// Keeps the lines that are, seconds after the reference, at most (sign 1) or at least (sign -1) limit_ns.
static void cut(struct polygon *p, double seconds, double limit_ns, int sign)
{
    struct polygon kept; // filled as far as kept.n says
    double beyond[BOARD_CLOCK_CORNERS_MAX];
    bool any = false;
    for (int i = 0; i < p->n; i++) {
        beyond[i] = sign * (p->corner[i].offset_ns + p->corner[i].drift * seconds - limit_ns);
        any |= beyond[i] > 0;
    }
    if (!any) // most round trips are slow and say nothing new
        return;
    kept.n = 0;
    for (int i = 0, before = p->n - 1; i < p->n; before = i++) {
        const struct corner *from = &p->corner[before], *to = &p->corner[i];
        if ((beyond[before] > 0) != (beyond[i] > 0)) {
            const double share = beyond[before] / (beyond[before] - beyond[i]);
            kept.corner[kept.n++] = (struct corner){ from->offset_ns + share * (to->offset_ns - from->offset_ns),
                from->drift + share * (to->drift - from->drift) };
        }
        if (beyond[i] <= 0)
            kept.corner[kept.n++] = *to;
    }
    p->n = kept.n;
    memcpy(p->corner, kept.corner, (size_t)kept.n * sizeof(kept.corner[0]));
}

static struct corner centroid(const struct polygon *p)
{
    struct corner sum = { 0, 0 }, mean = { 0, 0 };
    const struct corner o = p->corner[0];
    double area = 0;
    for (int i = 0; i < p->n; i++) {
        const struct corner a = p->corner[i], b = p->corner[(i + 1) % p->n];
        const double cross = (a.offset_ns - o.offset_ns) * (b.drift - o.drift) - (b.offset_ns - o.offset_ns) * (a.drift - o.drift);
        area += cross;
        sum.offset_ns += cross * (a.offset_ns + b.offset_ns - 2 * o.offset_ns) / 3;
        sum.drift += cross * (a.drift + b.drift - 2 * o.drift) / 3;
        mean.offset_ns += a.offset_ns / p->n;
        mean.drift += a.drift / p->n;
    }
    if (fabs(area) < 1e-6) // as good as a line or a point
        return mean;
    return (struct corner){ o.offset_ns + sum.offset_ns / area, o.drift + sum.drift / area };
}

static double wander_ns(double seconds)
{
    return .5 * BOARD_CLOCK_WANDER_NS * seconds * seconds;
}

// All lines that no round trip contradicts, about the newest one.
static void fit(const struct board_clock *c, struct polygon *p, int64_t ticks, int64_t ns)
{
    const double most = BOARD_CLOCK_DRIFT_MAX_PPM * 1e3, least_ns = -1e9, most_ns = 6e10; // a round trip of a minute is one no more
    *p = (struct polygon){ .n = 4, .corner = { { least_ns, -most }, { most_ns, -most }, { most_ns, most }, { least_ns, most } } };
    for (int i = 0; i < c->n && p->n; i++) {
        const double seconds = (double)(c->round[i].ticks - ticks) / c->ticks_per_s, slack_ns = wander_ns(seconds);
        const double sent_ns = (double)(c->round[i].sent_ns - ns) - 1e9 * seconds;
        const double received_ns = (double)(c->round[i].received_ns - ns) - 1e9 * seconds;
        cut(p, seconds, sent_ns - slack_ns - 1e9 / c->ticks_per_s, -1); // a count stands for the whole tick that follows
        cut(p, seconds, received_ns + slack_ns, 1);
    }
}

// It contradicts what is known. Several in a row are the truth.
static bool doubt(struct board_clock *c, int64_t sent_ns, int64_t received_ns, int64_t ticks)
{
    if (++c->n_lies >= BOARD_CLOCK_LIES_MAX) {
        board_clock_init(c, c->ticks_per_s);
        board_clock_add(c, sent_ns, received_ns, ticks);
    }
    return false;
}

bool board_clock_add(struct board_clock *c, int64_t sent_ns, int64_t received_ns, int64_t ticks)
{
    struct polygon p;
    if (received_ns < sent_ns || received_ns - sent_ns > INT64_C(60000000000))
        return false;
    if (c->n && sent_ns - c->ns > DAY_NS) // what was known then is worth nothing now
        board_clock_init(c, c->ticks_per_s);
    if (c->n && fabs((double)ticks - (double)c->ticks) > 2e-9 * (double)DAY_NS * c->ticks_per_s)
        return doubt(c, sent_ns, received_ns, ticks);
    const struct board_clock before = *c;
    c->round[c->next].sent_ns = sent_ns;
    c->round[c->next].received_ns = received_ns;
    c->round[c->next].ticks = ticks;
    c->next = (c->next + 1) % BOARD_CLOCK_ROUNDS;
    c->n += c->n < BOARD_CLOCK_ROUNDS;
    fit(c, &p, ticks, sent_ns);
    if (!p.n) {
        *c = before;
        return doubt(c, sent_ns, received_ns, ticks);
    }
    const struct corner middle = centroid(&p);
    c->n_lies = 0;
    c->ticks = ticks;
    c->ns = sent_ns;
    c->offset_ns = middle.offset_ns;
    c->drift = middle.drift;
    c->n_corners = p.n;
    for (int i = 0; i < p.n; i++) {
        c->corner[i].offset_ns = p.corner[i].offset_ns;
        c->corner[i].drift = p.corner[i].drift;
    }
    return true;
}

// ---- questions -------------------------------------------------------------------------------------------------------------------

int64_t board_clock_ns(const struct board_clock *c, int64_t ticks)
{
    assert(c->n_corners);
    const double seconds = (double)(ticks - c->ticks) / c->ticks_per_s;
    return c->ns + (int64_t)llround(c->offset_ns + (1e9 + c->drift) * seconds);
}

int64_t board_clock_ticks(const struct board_clock *c, int64_t ns)
{
    assert(c->n_corners);
    return c->ticks + (int64_t)llround(((double)(ns - c->ns) - c->offset_ns) / (1e9 + c->drift) * c->ticks_per_s);
}

int64_t board_clock_uncertainty_ns(const struct board_clock *c, int64_t at_ns)
{
    assert(c->n_corners);
    const double seconds = 1e-9 * (double)(at_ns - c->ns);
    double worst_ns = 0;
    for (int i = 0; i < c->n_corners; i++)
        worst_ns = fmax(worst_ns, fabs(c->corner[i].offset_ns - c->offset_ns + (c->corner[i].drift - c->drift) * seconds));
    return (int64_t)ceil(worst_ns + wander_ns(seconds) + 1e9 / c->ticks_per_s);
}

double board_clock_fast_ppm(const struct board_clock *c, double *uncertainty_ppm)
{
    assert(c->n_corners);
    double least = 0, most = 0;
    for (int i = 0; i < c->n_corners; i++) {
        least = fmin(least, c->corner[i].drift - c->drift);
        most = fmax(most, c->corner[i].drift - c->drift);
    }
    if (uncertainty_ppm)
        *uncertainty_ppm = 1e-3 * fmax(most, -least);
    return -1e6 * c->drift / (1e9 + c->drift);
}
