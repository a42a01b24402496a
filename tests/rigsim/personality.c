// tests/rigsim/personality.c - see personality.h. One table names every key; the rest is three small statements.
#include "tests/rigsim/personality.h"

#include "solver/take/log.h"

#include <errno.h>
#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LINE_MAX_BYTES = 2048, FILE_MAX_BYTES = 1 << 20 };

enum key_kind { KEY_TEXT, KEY_NUMBER, KEY_BOOL, KEY_INT, KEY_U16, KEY_U32, KEY_CODES, KEY_FORMATS, KEY_WB, KEY_VENDOR };
static const struct key {
    const char *name;
    enum key_kind kind;
    size_t at, size; // in struct personality
    double min, max;
} keys[] = {
#define FIELD(f) offsetof(struct personality, f), sizeof(((struct personality *)0)->f)
    { "vendor", KEY_VENDOR, FIELD(vendor), 0, 0 },
    { "manufacturer", KEY_TEXT, FIELD(manufacturer), 0, 0 },
    { "model", KEY_TEXT, FIELD(model), 0, 0 },
    { "firmware", KEY_TEXT, FIELD(firmware), 0, 0 },
    { "lens", KEY_TEXT, FIELD(lens), 0, 0 },
    { "extension", KEY_U32, FIELD(extension), 0, UINT32_MAX },
    { "extension_version", KEY_U16, FIELD(extension_version), 0, 65535 },
    { "extension_text", KEY_TEXT, FIELD(extension_text), 0, 0 },
    { "serial", KEY_TEXT, FIELD(serial), 0, 0 },
    { "file_prefix", KEY_TEXT, FIELD(file_prefix), 0, 0 },
    { "raw_extension", KEY_TEXT, FIELD(raw_extension), 0, 0 },
    { "folder", KEY_TEXT, FIELD(folder), 0, 0 },
    { "older_folders", KEY_INT, FIELD(older_folders), 0, 9000 },
    { "raw_format", KEY_U16, FIELD(raw_format), 0, 65535 },
    { "storage", KEY_U32, FIELD(storage), 1, UINT32_MAX },
    { "lag_ms", KEY_NUMBER, FIELD(lag_ms), 0, 10000 },
    { "lag_spread_ms", KEY_NUMBER, FIELD(lag_spread_ms), 0, 1000 },
    { "lag_jitter_ms", KEY_NUMBER, FIELD(lag_jitter_ms), 0, 1000 },
    { "wire_lag_ms", KEY_NUMBER, FIELD(wire_lag_ms), 0, 10000 },
    { "wire_jitter_ms", KEY_NUMBER, FIELD(wire_jitter_ms), 0, 1000 },
    { "sleep_after_s", KEY_NUMBER, FIELD(sleep_after_s), 0, 1e6 },
    { "sleep_extra_ms", KEY_NUMBER, FIELD(sleep_extra_ms), 0, 10000 },
    { "process_ms", KEY_NUMBER, FIELD(process_ms), 0, 60000 },
    { "second_file_ms", KEY_NUMBER, FIELD(second_file_ms), 0, 60000 },
    { "complete_ms", KEY_NUMBER, FIELD(complete_ms), 0, 60000 },
    { "recycle_ms", KEY_NUMBER, FIELD(recycle_ms), 0, 60000 },
    { "half_press_blocks_usb", KEY_BOOL, FIELD(half_press_blocks_usb), 0, 0 },
    { "battery_percent", KEY_NUMBER, FIELD(battery_percent), 0, 100 },
    { "battery_per_shot", KEY_NUMBER, FIELD(battery_per_shot), 0, 100 },
    { "card_bytes", KEY_NUMBER, FIELD(card_bytes), 0, 1e15 },
    { "black_level", KEY_INT, FIELD(black_level), 0, 8191 },
    { "white_level", KEY_INT, FIELD(white_level), 8192, 16383 },
    { "full_well_e", KEY_NUMBER, FIELD(full_well_e), 100, 1e7 },
    { "read_noise_e", KEY_NUMBER, FIELD(read_noise_e), 0, 1000 },
    { "gain_spread", KEY_NUMBER, FIELD(gain_spread), 0, .5 },
    { "wb", KEY_WB, FIELD(wb), .01, 1 },
    { "t_ref_s", KEY_NUMBER, FIELD(t_ref_s), 1e-6, 1000 },
    { "n_ref", KEY_NUMBER, FIELD(n_ref), .5, 100 },
    { "operations", KEY_CODES, FIELD(operations), 0, 0 },
    { "events", KEY_CODES, FIELD(events), 0, 0 },
    { "capture_formats", KEY_CODES, FIELD(capture_formats), 0, 0 },
    { "object_formats", KEY_CODES, FIELD(object_formats), 0, 0 },
    { "formats", KEY_FORMATS, FIELD(format), 0, 0 },
#undef FIELD
};

static const struct role_name {
    const char *name;
    enum property_role role;
} roles[] = {
    { "none", ROLE_NONE }, { "iso", ROLE_ISO }, { "iso.eos", ROLE_ISO_EOS }, { "shutter.100us", ROLE_SHUTTER_100US },
    { "shutter.ratio", ROLE_SHUTTER_RATIO }, { "shutter.eos", ROLE_SHUTTER_EOS }, { "aperture.100", ROLE_APERTURE_100 },
    { "aperture.eos", ROLE_APERTURE_EOS }, { "format", ROLE_FORMAT }, { "battery", ROLE_BATTERY },
    { "clock.ptp", ROLE_CLOCK_PTP }, { "clock.unix", ROLE_CLOCK_UNIX }, { "free_images", ROLE_FREE_IMAGES },
    { "free_bytes", ROLE_FREE_BYTES }, { "shots", ROLE_SHOTS }, { "serial", ROLE_SERIAL }, { "target", ROLE_TARGET },
    { "focus", ROLE_FOCUS },
};
static const struct {
    const char *name;
    enum property_type type;
} types[] = {
    { "i8", TYPE_I8 }, { "u8", TYPE_U8 }, { "i16", TYPE_I16 }, { "u16", TYPE_U16 }, { "i32", TYPE_I32 }, { "u32", TYPE_U32 },
    { "i64", TYPE_I64 }, { "u64", TYPE_U64 }, { "str", TYPE_STR },
};

// Where a statement stands and what was wrong with it: logged once, by fail().
struct place {
    const char *file;
    int line;
};

static int fail(const struct place *at, const char *found, const char *expected)
{
    log_error("rigsim: %s:%d: found '%.60s'; expected %s", at->file, at->line, found, expected);
    return -EINVAL;
}

// Whole word as a finite number, "C" locale; 0x... too.
static bool number(const char *word, double *out)
{
    static locale_t c;
    if (!c)
        c = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    char *end;
    *out = strtod_l(word, &end, c);
    return *word && !*end && isfinite(*out);
}

static bool integer(const char *word, int64_t *out)
{
    char *end;
    errno = 0;
    *out = strtoll(word, &end, 0);
    return *word && !*end && !errno;
}

static bool code(const char *word, uint16_t *out)
{
    int64_t v;
    if (!integer(word, &v) || v < 0 || v > 0xffff)
        return false;
    *out = (uint16_t)v;
    return true;
}

static int read_codes(struct code_list *list, char *text, const struct place *at)
{
    struct code_list l = { 0 };
    char *rest = NULL;
    for (char *w = strtok_r(text, " \t", &rest); w; w = strtok_r(NULL, " \t", &rest)) {
        if (l.n == PERSONALITY_CODES_MAX)
            return fail(at, w, "at most 128 codes");
        if (!code(w, &l.code[l.n++]))
            return fail(at, w, "codes of 16 bits such as 0x1001");
    }
    *list = l;
    return 0;
}

static int read_formats(struct personality *p, char *text, const struct place *at)
{
    char *rest = NULL;
    p->n_formats = 0;
    for (char *w = strtok_r(text, " \t", &rest); w; w = strtok_r(NULL, " \t", &rest)) {
        char *colon = strchr(w, ':');
        struct format_choice f = { 0 };
        if (colon)
            *colon = 0;
        if (!colon || !integer(w, &f.value) || p->n_formats == 16)
            return fail(at, w, "up to 16 of VALUE:raw, VALUE:jpeg or VALUE:raw+jpeg");
        f.files = !strcmp(colon + 1, "raw")        ? FILES_RAW
                  : !strcmp(colon + 1, "jpeg")     ? FILES_JPEG
                  : !strcmp(colon + 1, "raw+jpeg") ? FILES_RAW | FILES_JPEG
                                                   : 0;
        if (!f.files)
            return fail(at, colon + 1, "raw, jpeg or raw+jpeg");
        p->format[p->n_formats++] = f;
    }
    return 0;
}

static int read_key(struct personality *p, const char *name, char *value, const struct place *at)
{
    const struct key *k = NULL;
    for (size_t i = 0; i < sizeof(keys) / sizeof(keys[0]) && !k; i++)
        if (!strcmp(keys[i].name, name))
            k = &keys[i];
    if (!k)
        return fail(at, name, "a key of tests/rigsim/personality.h");
    char *field = (char *)p + k->at, range[80];
    double v;
    switch (k->kind) {
    case KEY_TEXT:
        if (strlen(value) >= k->size)
            return fail(at, value, "a shorter text");
        memset(field, 0, k->size);
        memcpy(field, value, strlen(value));
        return 0;
    case KEY_VENDOR:
        if (!strcmp(value, "generic"))
            p->vendor = VENDOR_GENERIC;
        else if (!strcmp(value, "nikon"))
            p->vendor = VENDOR_NIKON;
        else if (!strcmp(value, "canon"))
            p->vendor = VENDOR_CANON;
        else
            return fail(at, value, "generic, nikon or canon");
        return 0;
    case KEY_BOOL:
        if (strcmp(value, "yes") && strcmp(value, "no"))
            return fail(at, value, "yes or no");
        *(bool *)field = value[0] == 'y';
        return 0;
    case KEY_NUMBER:
    case KEY_INT:
    case KEY_U16:
    case KEY_U32:
        snprintf(range, sizeof(range), "%s %.10g .. %.10g", k->kind == KEY_NUMBER ? "a number" : "a whole number", k->min,
                 k->max);
        if (!number(value, &v) || v < k->min || v > k->max || (k->kind != KEY_NUMBER && v != floor(v)))
            return fail(at, value, range);
        if (k->kind == KEY_NUMBER)
            *(double *)field = v;
        else if (k->kind == KEY_INT)
            *(int *)field = (int)v;
        else if (k->kind == KEY_U16)
            *(uint16_t *)field = (uint16_t)v;
        else
            *(uint32_t *)field = (uint32_t)v;
        return 0;
    case KEY_CODES:
        return read_codes((struct code_list *)(void *)field, value, at);
    case KEY_FORMATS:
        return read_formats(p, value, at);
    case KEY_WB: {
        char *rest = NULL, *w = strtok_r(value, " \t", &rest);
        double wb[3];
        for (int i = 0; i < 3; i++, w = strtok_r(NULL, " \t", &rest))
            if (!w || !number(w, &wb[i]) || wb[i] < k->min || wb[i] > k->max)
                return fail(at, w ? w : "nothing", "three numbers .01 .. 1");
        memcpy(p->wb, wb, sizeof(wb));
        return 0;
    }
    }
    return 0;
}

static int read_choices(struct property *q, char *text, const struct place *at)
{
    char *rest = NULL;
    size_t n_text = 0;
    for (char *w = strtok_r(text, ",", &rest); w; w = strtok_r(NULL, ",", &rest)) {
        if (q->n_choices == PROPERTY_CHOICES_MAX)
            return fail(at, w, "at most 80 choices");
        int64_t *choice = &q->choice[q->n_choices++];
        if (q->type != TYPE_STR) {
            if (!integer(w, choice))
                return fail(at, w, "whole numbers, separated by commas");
            continue;
        }
        if (n_text + strlen(w) + 1 > sizeof(q->texts))
            return fail(at, w, "256 bytes of texts at most");
        *choice = (int64_t)n_text;
        memcpy(q->texts + n_text, w, strlen(w) + 1);
        n_text += strlen(w) + 1;
    }
    return q->n_choices ? 0 : fail(at, "no choice", "at least one");
}

static int read_property(struct personality *p, char *text, const struct place *at)
{
    struct property q = { .step = 1 };
    char *initial = strstr(text, " = "), *rest = NULL;
    if (initial) {
        *initial = 0;
        initial += 3;
        initial += strspn(initial, " \t");
    }
    const char *word[4];
    for (int i = 0; i < 4; i++)
        if (!(word[i] = strtok_r(i ? NULL : text, " \t", &rest)))
            return fail(at, "end of line", "property CODE TYPE ACCESS ROLE FORM [= VALUE]");
    if (!code(word[0], &q.code))
        return fail(at, word[0], "a property code such as 0x5007");
    for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
        if (!strcmp(types[i].name, word[1]))
            q.type = types[i].type;
    if (!q.type)
        return fail(at, word[1], "i8 u8 i16 u16 i32 u32 i64 u64 or str");
    if (strcmp(word[2], "ro") && strcmp(word[2], "rw"))
        return fail(at, word[2], "ro or rw");
    q.writable = word[2][1] == 'w';
    bool known = false;
    for (size_t i = 0; i < sizeof(roles) / sizeof(roles[0]) && !known; i++)
        if ((known = !strcmp(roles[i].name, word[3])))
            q.role = roles[i].role;
    if (!known)
        return fail(at, word[3], "a role of tests/rigsim/personality.h, or none");
    const char *form = strtok_r(NULL, " \t", &rest);
    if (form && !strcmp(form, "range")) {
        q.form = FORM_RANGE;
        int64_t *const to[3] = { &q.min, &q.max, &q.step };
        for (int i = 0; i < 3; i++) {
            const char *w = strtok_r(NULL, " \t", &rest);
            if (!w || !integer(w, to[i]))
                return fail(at, w ? w : "end of line", "range MIN MAX STEP");
        }
        if (q.type == TYPE_STR || q.min > q.max || q.step < 1)
            return fail(at, word[0], "a range of numbers, MIN <= MAX, STEP >= 1");
        q.initial = q.min;
    } else if (form && !strcmp(form, "enum")) {
        q.form = FORM_ENUM;
        char *list = strtok_r(NULL, " \t", &rest);
        const int err = read_choices(&q, list ? list : (char[]){ "" }, at);
        if (err)
            return err;
        if (q.type == TYPE_STR)
            snprintf(q.initial_text, sizeof(q.initial_text), "%.47s", q.texts);
        else
            q.initial = q.choice[0];
    } else if (!form || strcmp(form, "any")) {
        return fail(at, form ? form : "end of line", "any, range or enum");
    }
    if (initial && q.type == TYPE_STR) {
        if (strlen(initial) >= sizeof(q.initial_text))
            return fail(at, initial, "at most 47 bytes");
        snprintf(q.initial_text, sizeof(q.initial_text), "%s", initial);
    } else if (initial && !integer(initial, &q.initial)) {
        return fail(at, initial, "a whole number");
    }
    int i = 0;
    while (i < p->n_properties && p->property[i].code != q.code)
        i++;
    if (i == PERSONALITY_PROPERTIES_MAX)
        return fail(at, word[0], "at most 96 properties");
    p->property[i] = q;
    p->n_properties += i == p->n_properties;
    return 0;
}

static int no_property(struct personality *p, const char *word, const struct place *at)
{
    uint16_t c;
    if (!code(word, &c))
        return fail(at, word, "a property code such as 0x5007");
    int n = 0;
    for (int i = 0; i < p->n_properties; i++)
        if (p->property[i].code != c)
            p->property[n++] = p->property[i];
    p->n_properties = n;
    return 0;
}

static int read_text(struct personality *p, const char *text, const char *file);

int personality_statement(struct personality *p, const char *text, const char *name_for_errors, int line)
{
    const struct place at = { name_for_errors, line };
    char buffer[LINE_MAX_BYTES];
    const size_t length = strcspn(text, "#\n");
    if (length >= sizeof(buffer))
        return fail(&at, "a long line", "less than 2048 bytes");
    memcpy(buffer, text, length);
    buffer[length] = 0;
    size_t n = length;
    while (n && strchr(" \t\r", buffer[n - 1]))
        buffer[--n] = 0;
    char *s = buffer + strspn(buffer, " \t");
    if (!*s)
        return 0;
    if (!strncmp(s, "property ", 9))
        return read_property(p, s + 9, &at);
    if (!strncmp(s, "no_property ", 12))
        return no_property(p, s + 12 + strspn(s + 12, " \t"), &at);
    char *value = strchr(s, '=');
    if (!value)
        return fail(&at, s, "KEY = VALUE, property ... or no_property CODE");
    char *end = value;
    while (end > s && strchr(" \t", end[-1]))
        end--;
    *end = 0;
    value += 1;
    value += strspn(value, " \t");
    if (strcmp(s, "base"))
        return read_key(p, s, value, &at);
    const char *base = personality_builtin(value);
    if (!base || p->n_properties)
        return fail(&at, value, "generic, nikon or canon, as the first statement");
    return read_text(p, base, value);
}

static int read_text(struct personality *p, const char *text, const char *file)
{
    int err = 0;
    for (int line = 1; !err && *text; line++) {
        err = personality_statement(p, text, file, line);
        text += strcspn(text, "\n");
        text += *text == '\n';
    }
    return err;
}

const struct property *personality_property(const struct personality *p, uint16_t c)
{
    for (int i = 0; i < p->n_properties; i++)
        if (p->property[i].code == c)
            return &p->property[i];
    return NULL;
}

int personality_load(struct personality *out, const char *name)
{
    struct personality *p = calloc(1, sizeof(*p));
    char *text = NULL;
    FILE *f = NULL;
    int err = 0;
    if (!p)
        return -ENOMEM;
    const char *builtin = personality_builtin(name);
    if (builtin) {
        err = read_text(p, builtin, name);
    } else {
        f = fopen(name, "re");
        if (!f) {
            err = -errno;
            log_error("rigsim: personality %s: %s; expected generic, nikon, canon or a file", name, strerror(errno));
            goto fail;
        }
        text = malloc(FILE_MAX_BYTES + 1);
        if (!text) {
            err = -ENOMEM;
            goto fail;
        }
        const size_t n = fread(text, 1, FILE_MAX_BYTES + 1, f);
        if (n > FILE_MAX_BYTES || memchr(text, 0, n)) {
            err = n > FILE_MAX_BYTES ? -EFBIG : -EINVAL;
            log_error("rigsim: personality %s: found %s; expected a text of at most 1 MiB", name,
                      n > FILE_MAX_BYTES ? "more" : "a zero byte");
            goto fail;
        }
        text[n] = 0;
        err = read_text(p, text, name);
    }
    if (!err && (!p->operations.n || !p->n_properties || !p->card_bytes)) {
        log_error("rigsim: personality %s: found no operations, properties or card; begin it with 'base = generic'", name);
        err = -EINVAL;
    }
    if (!err)
        *out = *p;
fail:
    if (f)
        fclose(f);
    free(text);
    free(p);
    return err;
}
