// rigd/personality.c - config/cameras/*.conf: read whole, kept as lines, looked up by name.
#include "rigd/personality.h"
#include "solver/take/log.h"

#include <ctype.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

enum { FILE_MAX = 65536, LINES_MAX = 1024, SECTION_NAME = 24 };

struct line {
    const char *section, *key, *value; // into text
};

struct personality {
    char *text;
    int n_lines, n_settings;
    const char *setting[64];
    struct line line[];
};

static const char *const body_keys[] = { "serial", "model", "firmware", "battery", "lens", "clock", "free_images", "identify" };

// ---- reading -------------------------------------------------------------------------------------------------------------

static const char BLANKS[] = " \t\v\f\r"; // isspace() of the C locale, but for the newline

static char *trim(char *s)
{
    while (isspace((unsigned char)*s))
        s++;
    char *end = s + strlen(s);
    while (end > s && isspace((unsigned char)end[-1]))
        *--end = 0;
    return s;
}

static bool is_one_of(const char *word, const char *const *words, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!strcmp(word, words[i]))
            return true;
    return false;
}

static bool is_neutral_name(const char *s)
{
    return *s && strlen(s) < SECTION_NAME && strspn(s, "abcdefghijklmnopqrstuvwxyz0123456789_") == strlen(s);
}

// Every alternative fits, and there is at least one.
static bool alternatives_are_good(const char *value)
{
    for (const char *s = value;; s++) {
        const size_t n = strcspn(s, "|");
        if (strspn(s, BLANKS) >= n || n >= PERSONALITY_NAME)
            return false;
        s += n;
        if (!*s)
            return true;
    }
}

// What is wrong with key = value of a section; NULL: nothing.
static const char *objection(const char *section, const char *key, const char *value)
{
    if (!*section)
        return "before the first section; expected [body] or [setting]";
    if (strlen(key) >= PERSONALITY_NAME)
        return "a name of more than 47 bytes";
    if (!alternatives_are_good(value))
        return "empty, or a word of more than 47 bytes; expected words separated by |";
    if (!strcmp(section, "body"))
        return is_one_of(key, body_keys, sizeof(body_keys) / sizeof(body_keys[0]))
                   ? NULL
                   : "not a key of [body]: serial, model, firmware, battery, lens, clock, free_images, identify";
    if (!strcmp(key, "kind"))
        return is_one_of(value, (const char *const[]){ "text", "number", "seconds" }, 3) ? NULL
                                                                                         : "expected text, number or seconds";
    if (!strncmp(key, "objects.", 8))
        return value[0] >= '1' && value[0] <= '9' && !value[1] ? NULL : "expected a digit, 1 to 9";
    return NULL;
}

int personality_parse(struct personality **out, const char *text, size_t n_bytes, const char *name)
{
    int err = -EINVAL, number = 0;
    const char *section = "";
    *out = NULL;
    if (n_bytes > FILE_MAX) {
        log_error("personality: %s: %zu bytes; expected at most %d", name, n_bytes, FILE_MAX);
        return -EFBIG;
    }
    if (memchr(text, 0, n_bytes)) {
        log_error("personality: %s: has a NUL byte; expected text", name);
        return -EINVAL;
    }
    struct personality *p = calloc(1, sizeof(*p) + LINES_MAX * sizeof(p->line[0]));
    if (!p || !(p->text = malloc(n_bytes + 1))) {
        err = -ENOMEM;
        goto fail;
    }
    memcpy(p->text, text, n_bytes);
    p->text[n_bytes] = 0;
    for (char *s = p->text, *next; s; s = next) {
        next = strchr(s, '\n');
        if (next)
            *next++ = 0;
        number++;
        s = trim(s);
        if (!*s || *s == '#' || *s == ';')
            continue;
        const size_t n = strlen(s);
        if (*s == '[') {
            s[n - 1] = s[n - 1] == ']' ? 0 : '!';
            section = s + 1;
            if (!is_neutral_name(section)) {
                log_error("personality: %s:%d: section [%s; expected [name] of small letters, digits and _", name, number, section);
                goto fail;
            }
            if (!strcmp(section, "body"))
                continue;
            for (int i = 0; i < p->n_settings; i++)
                if (!strcmp(p->setting[i], section)) {
                    log_error("personality: %s:%d: [%s] stands there twice; join the two", name, number, section);
                    goto fail;
                }
            if (p->n_settings == (int)(sizeof(p->setting) / sizeof(p->setting[0]))) {
                log_error("personality: %s:%d: more than %d settings", name, number, p->n_settings);
                goto fail;
            }
            p->setting[p->n_settings++] = section;
            continue;
        }
        char *equals = strchr(s, '=');
        if (!equals) {
            log_error("personality: %s:%d: '%s'; expected key = value", name, number, s);
            goto fail;
        }
        *equals = 0;
        const char *key = trim(s), *value = trim(equals + 1), *wrong = objection(section, key, value);
        if (wrong) {
            log_error("personality: %s:%d: %s = %s: %s", name, number, key, value, wrong);
            goto fail;
        }
        if (p->n_lines == LINES_MAX) {
            log_error("personality: %s:%d: more than %d lines with a value", name, number, LINES_MAX);
            goto fail;
        }
        p->line[p->n_lines++] = (struct line){ section, key, value };
    }
    for (int i = 0; i < p->n_settings; i++) {
        char driver[PERSONALITY_NAME];
        if (!personality_setting_name(p, p->setting[i], 0, driver)) {
            log_error("personality: %s: [%s] has no line driver = NAME", name, p->setting[i]);
            goto fail;
        }
    }
    struct personality *fitted = realloc(p, sizeof(*p) + (size_t)p->n_lines * sizeof(p->line[0]));
    *out = fitted ? fitted : p;
    return 0;
fail:
    personality_free(p);
    return err;
}

int personality_read(struct personality **out, const char *path)
{
    *out = NULL;
    const int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) {
        const int err = -errno;
        log_error("personality: cannot open %s: %s", path, strerror(-err));
        return err;
    }
    int err = -ENOMEM;
    char *text = malloc(FILE_MAX + 1);
    size_t n = 0;
    ssize_t got = text ? 1 : 0;
    while (text && n <= FILE_MAX && (got = read(fd, text + n, FILE_MAX + 1 - n)) > 0)
        n += (size_t)got;
    if (got < 0) {
        err = -errno;
        log_error("personality: cannot read %s: %s", path, strerror(-err));
    } else if (text) {
        err = personality_parse(out, text, n, path);
    }
    close(fd);
    free(text);
    return err;
}

void personality_free(struct personality *p)
{
    if (!p)
        return;
    free(p->text);
    free(p);
}

// ---- names ---------------------------------------------------------------------------------------------------------------

// The i-th of the words that | separates.
static bool alternative(const char *value, int i, char out[PERSONALITY_NAME])
{
    for (; i > 0 && value; i--) {
        value = strchr(value, '|');
        if (value)
            value++;
    }
    if (!value)
        return false;
    value += strspn(value, BLANKS);
    size_t n = strcspn(value, "|");
    while (n && isspace((unsigned char)value[n - 1]))
        n--;
    memcpy(out, value, n);
    out[n] = 0;
    return true;
}

static const char *value_of(const struct personality *p, const char *section, const char *key)
{
    for (int i = 0; p && i < p->n_lines; i++)
        if (!strcmp(p->line[i].section, section) && !strcasecmp(p->line[i].key, key))
            return p->line[i].value;
    return NULL;
}

// The driver's words for a neutral value; NULL: the value is the driver's own.
static const char *words_for(const struct personality *p, const char *setting, const char *value)
{
    const bool reserved = !strcasecmp(value, "driver") || !strcasecmp(value, "kind") || !strncasecmp(value, "objects.", 8);
    return reserved ? NULL : value_of(p, setting, value);
}

static bool is_setting(const struct personality *p, const char *setting)
{
    for (int i = 0; p && i < p->n_settings; i++)
        if (!strcmp(p->setting[i], setting))
            return true;
    return false;
}

bool personality_setting_name(const struct personality *p, const char *setting, int i, char out[PERSONALITY_NAME])
{
    if (is_setting(p, setting)) {
        const char *value = value_of(p, setting, "driver");
        return value && alternative(value, i, out);
    }
    snprintf(out, PERSONALITY_NAME, "%s", setting); // the driver's own name
    return i == 0;
}

bool personality_body_name(const struct personality *p, const char *what, int i, char out[PERSONALITY_NAME])
{
    const char *value = value_of(p, "body", what);
    return value && alternative(value, i, out);
}

int personality_n_settings(const struct personality *p)
{
    return p ? p->n_settings : 0;
}

const char *personality_setting(const struct personality *p, int i)
{
    return p->setting[i];
}

int personality_order(const struct personality *p, const char *setting)
{
    for (int i = 0; p && i < p->n_settings; i++)
        if (!strcmp(p->setting[i], setting))
            return i;
    return INT_MAX;
}

// ---- values --------------------------------------------------------------------------------------------------------------

enum kind { TEXT, NUMBER, SECONDS };

static enum kind kind_of(const struct personality *p, const char *setting)
{
    const char *value = value_of(p, setting, "kind");
    return !value || !strcmp(value, "text") ? TEXT : !strcmp(value, "number") ? NUMBER : SECONDS;
}

// Digits with at most one point, without sign, exponent or locale. Returns what follows, NULL if there is no number.
static const char *decimal(const char *s, double *out)
{
    double v = 0, scale = 1;
    int n_digits = 0;
    bool point = false;
    for (;; s++) {
        if (isdigit((unsigned char)*s) && n_digits < 18) {
            v = v * 10 + (*s - '0');
            scale *= point ? 10 : 1;
            n_digits++;
        } else if (*s == '.' && !point) {
            point = true;
        } else {
            break;
        }
    }
    *out = v / scale;
    return n_digits ? s : NULL;
}

// "f/5.6", "F8", "1/125", "10/25", "0.0080s", "2m", "5600 K", "ISO 200": a number above 0 and all of the text.
static bool quantity(const char *s, double *out)
{
    double v, below = 1;
    if (!strncasecmp(s, "iso", 3))
        s += 3;
    else if (*s == 'f' || *s == 'F')
        s += s[1] == '/' ? 2 : 1;
    s += strspn(s, " ");
    s = decimal(s, &v);
    if (!s)
        return false;
    if (*s == '/')
        s = decimal(s + 1, &below);
    if (!s || !(below > 0) || !(v > 0))
        return false;
    if (v > 65000 && below > 65000)
        return false; // bulb and time, as Nikon writes them
    s += strspn(s, " ");
    const double unit = *s == 'm' ? 60 : 1;
    s += *s == 's' || *s == 'm' || *s == 'K';
    *out = v / below * unit;
    return !*s;
}

// How far apart two values are: 0 equal, < 1 the same within what drivers round off, else different. Shutter times are
// rounded to 0.1 ms by some drivers and named after powers of two by others (1/15 for 1/16); their steps are 1/3 stop, 26 %.
static double distance(enum kind kind, const char *wanted, const char *found)
{
    double a, b;
    if (!strcasecmp(wanted, found))
        return 0;
    if (kind == TEXT || !quantity(wanted, &a) || !quantity(found, &b))
        return INFINITY;
    return fabs(log(a / b)) / (kind == SECONDS ? 0.08 : 0.005);
}

int personality_choose(const struct personality *p, const char *setting, const char *wanted, const char *const *choice, int n_choices)
{
    const enum kind kind = kind_of(p, setting);
    const char *value = words_for(p, setting, wanted);
    char word[PERSONALITY_NAME];
    for (int i = 0; value && alternative(value, i, word); i++)
        for (int k = 0; k < n_choices; k++)
            if (!strcasecmp(choice[k], word))
                return k;
    int best = -1;
    double least = 1;
    for (int k = 0; !value && k < n_choices; k++) {
        const double d = distance(kind, wanted, choice[k]);
        if (d < least) {
            least = d;
            best = k;
        }
    }
    return best;
}

void personality_driver_value(const struct personality *p, const char *setting, const char *wanted, char out[PERSONALITY_NAME])
{
    const char *value = words_for(p, setting, wanted);
    if (!value || !alternative(value, 0, out))
        snprintf(out, PERSONALITY_NAME, "%s", wanted);
}

bool personality_means(const struct personality *p, const char *setting, const char *wanted, const char *found)
{
    const char *value = words_for(p, setting, wanted);
    char word[PERSONALITY_NAME];
    for (int i = 0; value && alternative(value, i, word); i++)
        if (!strcasecmp(found, word))
            return true;
    return !value && distance(kind_of(p, setting), wanted, found) < 1;
}

// The line of a setting whose value lists what the driver says; NULL.
static const struct line *line_for(const struct personality *p, const char *setting, const char *found)
{
    char word[PERSONALITY_NAME];
    for (int i = 0; p && i < p->n_lines; i++) {
        const struct line *l = &p->line[i];
        if (strcmp(l->section, setting) || !strcmp(l->key, "driver") || !strcmp(l->key, "kind") || !strncmp(l->key, "objects.", 8))
            continue;
        for (int k = 0; alternative(l->value, k, word); k++)
            if (!strcasecmp(word, found))
                return l;
    }
    return NULL;
}

void personality_neutral(const struct personality *p, const char *setting, const char *found, char *out, size_t room)
{
    const struct line *l = line_for(p, setting, found);
    snprintf(out, room, "%s", l ? l->key : found);
}

int personality_objects(const struct personality *p, const char *setting, const char *found)
{
    const struct line *l = line_for(p, setting, found);
    char key[PERSONALITY_NAME + 8];
    if (!l)
        return -1;
    snprintf(key, sizeof(key), "objects.%s", l->key);
    const char *value = value_of(p, setting, key);
    return value ? value[0] - '0' : 1;
}
