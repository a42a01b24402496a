// solver/labelling.c - mean field over neighbours and over nodes of like colour.
#include "solver/labelling.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_LABELS = 8, LANDMARKS = 512, MOST_SWEEPS = 40 };
static const float agreement = 1.5f;  // nats that a neighbour of the same colour is worth
static const float unlike = .1f;    // share of it that is left across an edge of colour
static const float any_colour = .02f; // a material may have a colour that none of its nodes has so far
static const float least_bandwidth = .02f;
static const float settled = .01f;    // no share moved further

// Luminance and two tints.
static void axes_of(const float colour[3], float axis[3])
{
    axis[0] = (colour[0] + colour[1] + colour[2]) / 3;
    axis[1] = colour[0] - colour[1];
    axis[2] = colour[2] - colour[1];
}

static int by_float(const void *a, const void *b)
{
    const float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

// The median difference of neighbours: most have one colour, so it is what colours are wrong by. step: room for every edge.
static float noise_of(const struct level *l, const float (*colour)[3], int axis, float *step)
{
    int64_t n = 0;
    for (int i = 0; i < l->n; i++)
        for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++) {
            const int j = l->neighbour[m];
            float here[3], there[3];
            if (j < i || isnan(colour[i][0]) || isnan(colour[j][0]))
                continue;
            axes_of(colour[i], here), axes_of(colour[j], there);
            step[n++] = fabsf(here[axis] - there[axis]);
        }
    qsort(step, (size_t)n, sizeof(float), by_float);
    return n ? step[n / 2] : 0;
}

int labelling_bandwidth(float bandwidth[3], const struct level *l, const float (*colour)[3])
{
    float *step = malloc(((size_t)l->first_neighbour[l->n] + 1) * sizeof(*step));
    if (!step)
        return -ENOMEM;
    for (int c = 0; c < 3; c++) {
        double sum = 0, squares = 0;
        int n = 0;
        for (int i = 0; i < l->n; i++) {
            float axis[3];
            if (isnan(colour[i][0]))
                continue;
            axes_of(colour[i], axis);
            sum += (double)axis[c], squares += (double)axis[c] * (double)axis[c], n++;
        }
        const double mean = sum / fmax(n, 1), variance = fmax(squares / fmax(n, 1) - mean * mean, 0);
        const float smooth = (float)(sqrt(variance) * pow(1.25 * fmax(n, 1), -1. / 7)); // ((d + 2) n / 4)^(-1 / (d + 4)), d = 3
        bandwidth[c] = fmaxf(fmaxf(smooth, 3 * noise_of(l, colour, c, step)), least_bandwidth);
    }
    free(step);
    return 0;
}

// 1: the same colour.
static float likeness(const struct labelling *j, int a, int b)
{
    float x[3], y[3], sum = 0;
    if (isnan(j->colour[a][0]) || isnan(j->colour[b][0]))
        return 0;
    axes_of(j->colour[a], x), axes_of(j->colour[b], y);
    for (int c = 0; c < 3; c++)
        sum += (x[c] - y[c]) * (x[c] - y[c]) / (j->bandwidth[c] * j->bandwidth[c]);
    return sum < 50 ? expf(-.5f * sum) : 0;
}

// share[]: of each label, exp(-nats) made to sum to 1.
static void share_out(const float *nats, int n, float *share)
{
    float least = INFINITY, sum = 0;
    for (int r = 0; r < n; r++)
        least = fminf(least, nats[r]);
    for (int r = 0; r < n; r++)
        sum += share[r] = isinf(least) ? 1 : expf(least - nats[r]);
    for (int r = 0; r < n; r++)
        share[r] /= sum;
}

// Of all nodes whose colour is known, evenly spread.
static int choose_landmarks(const struct labelling *j, int *landmark)
{
    int n = 0, kept = 0, seen = 0;
    for (int i = 0; i < j->level->n; i++)
        n += !isnan(j->colour[i][0]);
    const int keep = n < LANDMARKS ? n : LANDMARKS;
    for (int i = 0; i < j->level->n; i++) {
        if (isnan(j->colour[i][0]))
            continue;
        if ((int64_t)(seen + 1) * keep / n > (int64_t)seen * keep / n)
            landmark[kept++] = i;
        seen++;
    }
    return kept;
}

// How often this colour is met with each label, beside how often any is: of nodes of the same colour, by what they are.
static void vote(const struct labelling *j, const float *share, const float *like, const int *landmark, int n_landmarks, const float usual[MOST_LABELS],
                 int i, float nats[MOST_LABELS])
{
    float sum[MOST_LABELS] = { 0 }, all = any_colour;
    for (int k = 0; k < n_landmarks; k++) {
        const float w = landmark[k] == i ? 0 : like[k];
        all += w;
        for (int r = 0; r < j->n_labels; r++)
            sum[r] += w * share[landmark[k] * j->n_labels + r];
    }
    for (int r = 0; r < j->n_labels; r++)
        nats[r] -= logf((sum[r] / all + any_colour * usual[r]) / usual[r]);
}

// Only one label is possible, or none: no company changes it.
static bool is_decided(const struct labelling *j, int i)
{
    int n = 0;
    for (int r = 0; r < j->n_labels; r++)
        n += !isinf(j->evidence[(size_t)i * (size_t)j->stride + (size_t)r]);
    return n < 2;
}

int labelling_find(uint8_t *label, const struct labelling *j)
{
    const struct level *l = j->level;
    const size_t n = (size_t)l->n + 1, n_labels = (size_t)j->n_labels;
    int landmark[LANDMARKS];
    const int n_landmarks = j->votes ? choose_landmarks(j, landmark) : 0;
    float *share = malloc(n * n_labels * sizeof(float)), *next = malloc(n * n_labels * sizeof(float));
    float *like = malloc((n * (size_t)n_landmarks + 1) * sizeof(float));
    float *edge = calloc((size_t)l->first_neighbour[l->n] + 1, sizeof(float));
    uint8_t *decided = malloc(n);
    const int err = share && next && like && edge && decided ? 0 : -ENOMEM;
    assert(j->n_labels <= MOST_LABELS);
    for (int i = 0; !err && i < l->n; i++) {
        share_out(j->evidence + (size_t)i * (size_t)j->stride, j->n_labels, share + (size_t)i * n_labels);
        decided[i] = is_decided(j, i);
        for (int k = 0; k < n_landmarks && !decided[i]; k++)
            like[(size_t)i * (size_t)n_landmarks + (size_t)k] = likeness(j, i, landmark[k]);
        for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1] && !decided[i]; m++)
            edge[m] = agreement * (unlike + (1 - unlike) * likeness(j, i, l->neighbour[m]));
    }
    float moved = INFINITY;
    for (int sweep = 0; !err && sweep < MOST_SWEEPS && moved > settled; sweep++) {
        float usual[MOST_LABELS] = { 0 };
        for (int k = 0; k < n_landmarks; k++)
            for (size_t r = 0; r < n_labels; r++)
                usual[r] += (share[(size_t)landmark[k] * n_labels + r] + 1e-3f) / (float)n_landmarks;
        for (int i = 0; i < l->n; i++) {
            float nats[MOST_LABELS];
            if (decided[i])
                continue;
            for (size_t r = 0; r < n_labels; r++) {
                nats[r] = j->evidence[(size_t)i * (size_t)j->stride + r];
                for (int32_t m = l->first_neighbour[i]; m < l->first_neighbour[i + 1]; m++)
                    nats[r] -= edge[m] * share[(size_t)l->neighbour[m] * n_labels + r];
            }
            if (n_landmarks && !isnan(j->colour[i][0]))
                vote(j, share, like + (size_t)i * (size_t)n_landmarks, landmark, n_landmarks, usual, i, nats);
            share_out(nats, j->n_labels, next + (size_t)i * n_labels);
        }
        moved = 0;
        for (int i = 0; i < l->n; i++) // half way: no node and its neighbour change places for ever
            for (size_t at = (size_t)i * n_labels; !decided[i] && at < ((size_t)i + 1) * n_labels; at++) {
                moved = fmaxf(moved, fabsf(next[at] - share[at]));
                share[at] = .5f * (share[at] + next[at]);
            }
    }
    for (int i = 0; !err && i < l->n; i++) {
        const float *s = share + (size_t)i * n_labels;
        label[i] = 0;
        for (int r = 1; r < j->n_labels; r++)
            label[i] = s[r] > s[label[i]] ? (uint8_t)r : label[i];
    }
    free(share);
    free(next);
    free(like);
    free(edge);
    free(decided);
    return err;
}
