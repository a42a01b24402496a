// tests/test_personality.c - neutral settings mean the right choice on every body whose listing is at hand.
#include "rigd/personality.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <ctype.h>
#include <errno.h>
#include <stdbool.h>
#include <string.h>

static char logged[400];

static void keep_log(void *arg, enum log_level level, const char *message)
{
    (void)arg, (void)level;
    snprintf(logged, sizeof(logged), "%s", message);
}

static struct personality *parse(const char *text)
{
    struct personality *p;
    assert_int_equal(personality_parse(&p, text, strlen(text), "test.conf"), 0);
    return p;
}

static void values_are_compared_by_what_they_mean(void **state)
{
    (void)state;
    struct personality *p = parse("[shutter]\ndriver = shutterspeed2 | shutterspeed\nkind = seconds\nbulb = bulb\n"
                                  "[aperture]\ndriver=f-number\nkind=number\n[focusmode]\ndriver = focusmode\nmanual = MF (fixed) | Manual\n");
    const struct { const char *setting, *wanted, *found; bool same; } cases[] = {
        { "shutter", "1/125", "1/125", true },       { "shutter", "1/125", "0.0080s", true },
        { "shutter", "1/60", "0.0166s", true },      { "shutter", "1/15", "0.0625s", true },
        { "shutter", "0.4", "10/25", true },         { "shutter", "0.4", "4/10", true },
        { "shutter", "120", "2m", true },            { "shutter", "1/125", "1/160", false },
        { "shutter", "1/125", "1/100", false },      { "shutter", "1", "65535/65535", false },
        { "shutter", "1", "65535/65533", false },    { "shutter", "30", "bulb", false },
        { "shutter", "bulb", "bulb", true },         { "shutter", "1/125", "", false },
        { "shutter", "1/125", "1/0", false },        { "shutter", "1/125", "auto", false },
        { "shutter", "1/125", "1/125x", false },     { "aperture", "8", "f/8", true },
        { "aperture", "f/8", "8", true },            { "aperture", "5.6", "5.60", true },
        { "aperture", "5.6", "f/6.3", false },       { "aperture", "8", "-8", false },
        { "aperture", "8", "8e0", false },           { "focusmode", "manual", "Manual", true },
        { "focusmode", "manual", "mf (fixed)", true }, { "focusmode", "manual", "AF-S", false },
        { "focusmode", "AF-S", "AF-S", true },       { "anything", "12", "12", true },
        { "anything", "12", "12.0", false },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
        if (personality_means(p, cases[i].setting, cases[i].wanted, cases[i].found) != cases[i].same)
            fail_msg("%s: wanted %s, found %s", cases[i].setting, cases[i].wanted, cases[i].found);
    personality_free(p);
    assert_true(personality_means(NULL, "iso", "400", "400"));
    assert_false(personality_means(NULL, "iso", "400", "200"));
}

static void the_nearest_choice_is_taken_and_none_that_is_wrong(void **state)
{
    (void)state;
    struct personality *p = parse("[shutter]\ndriver = s\nkind = seconds\n[format]\ndriver = f\nraw = RAW | NEF\nboth = RAW+J\nobjects.both = 2\n");
    const char *const times[] = { "0.0001s", "0.0002s", "0.0040s", "1/125", "0.0080s", "0.0100s", "bulb" };
    const char *const formats[] = { "JPEG", "NEF", "RAW+J" };
    char out[PERSONALITY_NAME];
    assert_int_equal(personality_choose(p, "shutter", "1/125", times, 7), 3);
    assert_int_equal(personality_choose(p, "shutter", "1/250", times, 7), 2);
    assert_int_equal(personality_choose(p, "shutter", "1/8000", times, 7), -1); // 0.0001s is 25 % off: another exposure
    assert_int_equal(personality_choose(p, "shutter", "bulb", times, 7), 6);
    assert_int_equal(personality_choose(p, "format", "raw", formats, 3), 1);
    assert_int_equal(personality_choose(p, "format", "both", formats, 3), 2);
    assert_int_equal(personality_choose(p, "format", "tiff", formats, 3), -1);
    assert_int_equal(personality_choose(p, "format", "driver", formats, 3), -1);
    assert_int_equal(personality_choose(p, "format", "JPEG", formats, 3), 0); // the driver's own word
    personality_neutral(p, "format", "NEF", out, sizeof(out));
    assert_string_equal(out, "raw");
    personality_neutral(p, "format", "JPEG", out, sizeof(out));
    assert_string_equal(out, "JPEG");
    assert_int_equal(personality_objects(p, "format", "RAW+J"), 2);
    assert_int_equal(personality_objects(p, "format", "NEF"), 1);
    assert_int_equal(personality_objects(p, "format", "JPEG"), -1);
    personality_free(p);
}

static void settings_are_written_in_the_order_of_the_file(void **state)
{
    (void)state;
    struct personality *p = parse("[exposuremode]\ndriver = m\n[iso]\ndriver = i\n");
    char name[PERSONALITY_NAME];
    assert_true(personality_order(p, "exposuremode") < personality_order(p, "iso"));
    assert_true(personality_order(p, "iso") < personality_order(p, "own"));
    assert_true(personality_setting_name(p, "own", 0, name));
    assert_string_equal(name, "own");
    assert_false(personality_setting_name(p, "own", 1, name));
    assert_false(personality_body_name(p, "serial", 0, name));
    personality_free(p);
}

static void faults_name_file_and_line(void **state)
{
    (void)state;
    const struct { const char *text, *expect; } cases[] = {
        { "[iso]\ndriver = iso\n\nwhat\n", "test.conf:4" },
        { "x = 1\n", "test.conf:1" },
        { "[iso]\ndriver =\n", "test.conf:2" },
        { "[iso]\ndriver = a | | b\n", "test.conf:2" },
        { "[iso]\ndriver = a | \v | b\n", "test.conf:2" },
        { "[iso]\nkind = number\n", "[iso]" },
        { "[iso]\ndriver = a\n[iso]\ndriver = b\n", "test.conf:3" },
        { "[ISO]\n", "test.conf:1" },
        { "[iso\n", "test.conf:1" },
        { "[\n", "test.conf:1" },
        { "[iso]\ndriver = a\nkind = colour\n", "test.conf:3" },
        { "[iso]\ndriver = a\nobjects.raw = many\n", "test.conf:3" },
        { "[body]\nname = x\n", "test.conf:2" },
        { "[iso]\ndriver = 012345678901234567890123456789012345678901234567\n", "test.conf:2" },
        { "[iso]\n0123456789012345678901234567890123456789012345678 = a\n", "test.conf:2" },
    };
    log_set_hook(keep_log, NULL);
    log_set_level(LOG_SILENT);
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct personality *p = (void *)1;
        logged[0] = 0;
        assert_int_equal(personality_parse(&p, cases[i].text, strlen(cases[i].text), "test.conf"), -EINVAL);
        assert_null(p);
        if (!strstr(logged, cases[i].expect))
            fail_msg("%s\nsaid: %s", cases[i].text, logged);
    }
    struct personality *p;
    assert_int_equal(personality_parse(&p, "[a]\0", 4, "test.conf"), -EINVAL);
    assert_int_equal(personality_read(&p, "no/such.conf"), -ENOENT);
    log_set_level(LOG_INFO);
    log_set_hook(NULL, NULL);
}

// ---- real bodies -------------------------------------------------------------------------------------------------------------

struct listing { // one body, as gphoto2 --list-all-config printed it
    int n;
    struct widget { char name[40], current[64]; int n_choices; char *choice[400]; } widget[700];
};

static void read_listing(struct listing *l, const char *path)
{
    char line[4096];
    FILE *f = fopen(path, "r");
    assert_non_null(f);
    memset(l, 0, sizeof(*l));
    struct widget *w = NULL;
    while (fgets(line, sizeof(line), f)) {
        char *end = line + strlen(line);
        while (end > line && isspace((unsigned char)end[-1]))
            *--end = 0;
        if (!strncmp(line, "/main/", 6) && strrchr(line, '/')[1] && l->n < 700) {
            w = &l->widget[l->n++];
            snprintf(w->name, sizeof(w->name), "%.39s", strrchr(line, '/') + 1);
        } else if (w && !strncmp(line, "Current: ", 9)) {
            snprintf(w->current, sizeof(w->current), "%.63s", line + 9);
        } else if (w && !strncmp(line, "Choice: ", 8) && w->n_choices < 400 && strchr(line + 8, ' ')) {
            w->choice[w->n_choices++] = strdup(strchr(line + 8, ' ') + 1);
        }
    }
    fclose(f);
}

static void free_listing(struct listing *l)
{
    for (int i = 0; i < l->n; i++)
        for (int k = 0; k < l->widget[i].n_choices; k++)
            free(l->widget[i].choice[k]);
}

static struct widget *find(struct listing *l, const struct personality *p, const char *setting)
{
    char name[PERSONALITY_NAME];
    for (int k = 0; personality_setting_name(p, setting, k, name); k++)
        for (int i = 0; i < l->n; i++)
            if (!strcmp(l->widget[i].name, name))
                return &l->widget[i];
    return NULL;
}

static bool has_body(struct listing *l, const struct personality *p, const char *what)
{
    char name[PERSONALITY_NAME];
    for (int k = 0; personality_body_name(p, what, k, name); k++)
        for (int i = 0; i < l->n; i++)
            if (!strcmp(l->widget[i].name, name))
                return true;
    return false;
}

static const char *chosen(struct listing *l, const struct personality *p, const char *setting, const char *wanted)
{
    struct widget *w = find(l, p, setting);
    if (!w)
        return "(no such setting)";
    const int i = personality_choose(p, setting, wanted, (const char *const *)w->choice, w->n_choices);
    return i < 0 ? "(no such choice)" : w->choice[i];
}

static void every_listed_body_is_spoken_to_in_its_own_words(void **state)
{
    (void)state;
    static struct listing l;
    // Bodies whose dial stood elsewhere when they were listed lack what a NULL stands for here.
    static const struct { const char *file, *conf, *raw, *iso, *shutter, *aperture, *manual, *focus, *card, *daylight; int per_shot; } bodies[] = {
        { "canon-eos-700d", "canon-eos", "RAW", "400", NULL, NULL, "Manual", NULL, "Memory card", "Daylight", 1 },
        { "canon-eos-r5", "canon-eos", "RAW", "400", "1/125", "8", "Manual", NULL, "Memory card", "Daylight", 2 },
        { "canon-eos2000d", "canon-eos", "RAW", "400", NULL, "8", "Manual", "Manual", "Memory card", "Daylight", 2 },
        { "canon-eos550d", "canon-eos", "RAW", "400", "1/125", "8", "Manual", "Unknown value 0003", "Memory card", "Daylight", -2 },
        { "canon-eos5dmark3", "canon-eos", "RAW", "400", "1/125", NULL, "Manual", NULL, "Memory card", "Daylight", 1 },
        { "nikon-d3300", "nikon", "NEF (Raw)", "400", "1/125", "f/8", "M", "MF (fixed)", "Memory card", "Daylight", 2 },
        { "nikon-d500", "nikon", "NEF (Raw)", "400", "1/125", "f/8", "M", "MF (fixed)", "Memory card", "Daylight", -2 },
        { "nikon-d7200", "nikon", "NEF (Raw)", "400", "1/125", "f/8", "M", "MF (fixed)", "Memory card", "Daylight", 1 },
        { "nikon-z7", "nikon", "NEF (Raw)", "400", "1/125", "f/8", "M", "Manual", "Memory card", "Daylight", 2 },
        { "sony-a7r3a", "sony", "RAW", "400", "1/125", "f/8", "M", "Manual", "card+sdram", "Daylight", -2 },
        { "fuji-xt3", "fuji", "RAW", "400", "1/125", "f/8", "M", "Manual", NULL, "Daylight", 1 },
    };
    char path[200];
    for (size_t i = 0; i < sizeof(bodies) / sizeof(bodies[0]); i++) {
        struct personality *p;
        snprintf(path, sizeof(path), "config/cameras/%s.conf", bodies[i].conf);
        assert_int_equal(personality_read(&p, path), 0);
        snprintf(path, sizeof(path), "../shared/data/gphoto2-config/%s.txt", bodies[i].file);
        if (access(path, R_OK)) {
            fprintf(stderr, "# %s is not here: its body is not checked\n", path);
            personality_free(p);
            continue;
        }
        read_listing(&l, path);
        const struct { const char *setting, *wanted, *expect; } cases[] = {
            { "imageformat", "raw", bodies[i].raw },       { "iso", "400", bodies[i].iso },
            { "shutter", "1/125", bodies[i].shutter },     { "aperture", "8", bodies[i].aperture },
            { "exposuremode", "manual", bodies[i].manual }, { "focusmode", "manual", bodies[i].focus },
            { "capturetarget", "card", bodies[i].card },   { "whitebalance", "daylight", bodies[i].daylight },
        };
        for (size_t k = 0; k < sizeof(cases) / sizeof(cases[0]); k++) {
            const char *found = chosen(&l, p, cases[k].setting, cases[k].wanted);
            if (cases[k].expect ? strcmp(found, cases[k].expect) != 0 : found[0] != '(')
                fail_msg("%s: %s = %s: expected %s, got %s", bodies[i].file, cases[k].setting, cases[k].wanted,
                         cases[k].expect ? cases[k].expect : "nothing", found);
            if (cases[k].expect)
                assert_true(personality_means(p, cases[k].setting, cases[k].wanted, found));
        }
        // Each of the driver's choices of a number finds itself: no neighbour is mistaken for it.
        const char *const numbers[] = { "iso", "aperture", "shutter", "colortemperature" };
        for (int k = 0; k < 4; k++) {
            struct widget *w = find(&l, p, numbers[k]);
            for (int c = 0; w && c < w->n_choices; c++) {
                const int at = personality_choose(p, numbers[k], w->choice[c], (const char *const *)w->choice, w->n_choices);
                if (at < 0 || strcmp(w->choice[at], w->choice[c]))
                    fail_msg("%s: %s %s became %s", bodies[i].file, numbers[k], w->choice[c], at < 0 ? "nothing" : w->choice[at]);
            }
        }
        assert_true(has_body(&l, p, "serial"));
        assert_true(has_body(&l, p, "model") == (strcmp(bodies[i].file, "canon-eos550d") != 0));
        assert_true(has_body(&l, p, "clock") == (strcmp(bodies[i].conf, "sony") != 0)); // Sony has none
        assert_true(has_body(&l, p, "battery") == (strcmp(bodies[i].conf, "fuji") != 0)); // Fuji has none
        assert_true(has_body(&l, p, "identify") == (strcmp(bodies[i].file, "nikon-d3300") != 0)); // no live view from here
        if (bodies[i].per_shot > 0)
            assert_int_equal(personality_objects(p, "imageformat", find(&l, p, "imageformat")->current), bodies[i].per_shot);
        free_listing(&l);
        personality_free(p);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(values_are_compared_by_what_they_mean),
        cmocka_unit_test(the_nearest_choice_is_taken_and_none_that_is_wrong),
        cmocka_unit_test(settings_are_written_in_the_order_of_the_file),
        cmocka_unit_test(faults_name_file_and_line),
        cmocka_unit_test(every_listed_body_is_spoken_to_in_its_own_words),
    };
    return cmocka_run_group_tests_name("personality", tests, NULL, NULL);
}
