// tests/test_labelling.c - who a node's company is: neighbours as far as its colour goes, and nodes of its colour anywhere.
#include "solver/labelling.h"
#include "solver/random.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>

#include <cmocka.h>

enum { SIDE = 24, N = SIDE * SIDE, LABELS = 2 };

// A square of nodes, each with those beside it; cut along columns of `gap` (never there: none).
static struct {
    struct level level;
    int32_t first[N + 1], neighbour[4 * N];
    float evidence[N][LABELS], colour[N][3];
    uint8_t label[N];
} g;

static void make_square(int gap)
{
    static const int step[4][2] = {{0, -1}, {-1, 0}, {1, 0}, {0, 1}};
    int n = 0;
    memset(&g, 0, sizeof(g));
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < 4; k++) {
            const int x = i % SIDE + step[k][0], y = i / SIDE + step[k][1];
            if (x >= 0 && y >= 0 && x < SIDE && y < SIDE && (x < gap) == (i % SIDE < gap))
                g.neighbour[n++] = y * SIDE + x;
        }
        g.first[i + 1] = n;
    }
    g.level = (struct level){.size = SIDE, .n = N, .first_neighbour = g.first, .neighbour = g.neighbour};
}

static void paint(int i, float luminance, uint64_t seed)
{
    for (int c = 0; c < 3; c++)
        g.colour[i][c] = logf(luminance) + .03f * (float)random_normal(seed, (uint64_t)c, (uint64_t)i);
}

static void find(bool votes)
{
    float bandwidth[3];
    assert_int_equal(labelling_bandwidth(bandwidth, &g.level, (const float(*)[3])g.colour), 0);
    const struct labelling job = {.level = &g.level, .n_labels = LABELS, .stride = LABELS, .evidence = g.evidence[0],
                                  .colour = (const float(*)[3])g.colour, .bandwidth = bandwidth, .votes = votes};
    assert_int_equal(labelling_find(g.label, &job), 0);
}

// Light clay and dark glaze in a chequer of four, each four nodes wide; one in five nodes of glaze shows a highlight. Beyond the gap no node shows any.
static void nodes_that_show_nothing_are_what_their_colour_is_elsewhere(void **state)
{
    (void)state;
    make_square(SIDE / 2);
    for (int i = 0; i < N; i++) {
        const int glaze = (i % SIDE / 4 + i / SIDE / 4) % 2;
        paint(i, glaze ? .03f : .4f, 1);
        if (i % SIDE < SIDE / 2)
            g.evidence[i][0] = glaze ? (random_uniform(2, 0, (uint64_t)i) < .2 ? 6 : 0) : 0, g.evidence[i][1] = glaze ? 0 : 3;
    }
    find(true);
    for (int i = 0; i < N; i++)
        assert_int_equal(g.label[i], (i % SIDE / 4 + i / SIDE / 4) % 2);
}

// Nothing is known of eight columns; the colour changes amid them, off the middle.
static void a_border_lies_where_the_colour_changes(void **state)
{
    (void)state;
    make_square(0);
    for (int i = 0; i < N; i++) {
        paint(i, i % SIDE < SIDE / 3 ? .1f : .5f, 3);
        g.evidence[i][0] = i % SIDE >= SIDE / 3 + 5 ? 4 : 0, g.evidence[i][1] = i % SIDE < SIDE / 3 - 3 ? 4 : 0;
    }
    for (int votes = 0; votes < 2; votes++) {
        find(votes);
        for (int i = 0; i < N; i++)
            assert_int_equal(g.label[i], i % SIDE >= SIDE / 3);
    }
}

static void what_a_node_shows_of_itself_beats_its_company(void **state)
{
    (void)state;
    make_square(0);
    for (int i = 0; i < N; i++) {
        const bool odd = i % SIDE / 3 == 3 && i / SIDE / 3 == 3; // nine nodes of another material, coloured like the rest
        paint(i, .3f, 4);
        g.evidence[i][odd ? 0 : 1] = 15;
    }
    find(true);
    for (int i = 0; i < N; i++)
        assert_int_equal(g.label[i], i % SIDE / 3 == 3 && i / SIDE / 3 == 3);
}

static void a_colour_that_all_materials_have_says_nothing(void **state)
{
    (void)state;
    make_square(0);
    for (int i = 0; i < N; i++) {
        const int label = i % SIDE >= SIDE - SIDE / 4; // the lesser material is a quarter
        paint(i, random_uniform(5, 1, (uint64_t)(i / SIDE / 2)) < .5 ? .05f : .6f, 5);
        g.evidence[i][!label] = 2 + 3 * (float)random_normal(5, 2, (uint64_t)i);
    }
    uint8_t alone[N];
    int other = 0;
    find(false);
    memcpy(alone, g.label, N);
    find(true);
    for (int i = 0; i < N; i++)
        other += g.label[i] != alone[i];
    assert_true(other < N / 100);
}

static void a_colour_that_only_one_node_has_says_nothing(void **state)
{
    (void)state;
    make_square(0);
    for (int i = 0; i < N; i++) {
        paint(i, .2f, 7);
        g.evidence[i][0] = 5;
    }
    const int odd = SIDE * SIDE / 2 + 5;
    paint(odd, .7f, 7);
    g.evidence[odd][0] = 0, g.evidence[odd][1] = .3f; // hardly any: its neighbours are stronger, though of another colour
    find(true);
    assert_int_equal(g.label[odd], 1);
}

static void what_is_out_of_the_question_is_not_chosen(void **state)
{
    (void)state;
    make_square(0);
    for (int i = 0; i < N; i++) {
        paint(i, .2f, 6);
        g.evidence[i][1] = 3;
    }
    g.evidence[N / 2][0] = INFINITY;
    g.colour[N / 2 + 5][0] = NAN; // and a colour nobody knows is no colour
    g.evidence[N / 2 + 9][0] = g.evidence[N / 2 + 9][1] = INFINITY; // nothing is possible: anything goes
    find(true);
    for (int i = 0; i < N; i++)
        assert_int_equal(g.label[i], i == N / 2);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(nodes_that_show_nothing_are_what_their_colour_is_elsewhere),
        cmocka_unit_test(a_border_lies_where_the_colour_changes),
        cmocka_unit_test(what_a_node_shows_of_itself_beats_its_company),
        cmocka_unit_test(a_colour_that_all_materials_have_says_nothing),
        cmocka_unit_test(a_colour_that_only_one_node_has_says_nothing),
        cmocka_unit_test(what_is_out_of_the_question_is_not_chosen),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
