// tests/rigsim/faults.c - see faults.h.
#include "tests/rigsim/faults.h"

#include "solver/take/log.h"

#include <errno.h>
#include <fnmatch.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { FILE_MAX_BYTES = 1 << 20, FAULTS_MAX = 4096, LINE_BYTES = 512 };

// Arguments in order: t duration, n whole number, h name of a hostile kind.
static const struct {
    const char *name;
    enum fault_kind kind;
    const char *arguments;
} kinds[] = {
    { "busy", FAULT_BUSY, "t" }, { "stall", FAULT_STALL, "t" }, { "drop", FAULT_DROP, "" }, { "refuse", FAULT_REFUSE, "t" },
    { "lose_added", FAULT_LOSE_ADDED, "n" }, { "lose_complete", FAULT_LOSE_COMPLETE, "n" }, { "late", FAULT_LATE, "tn" },
    { "flood", FAULT_FLOOD, "nt" }, { "card_full", FAULT_CARD_FULL, "" }, { "card_empty_again", FAULT_CARD_EMPTY_AGAIN, "" },
    { "battery", FAULT_BATTERY, "n" }, { "power_cut", FAULT_POWER_CUT, "t" }, { "drift", FAULT_DRIFT, "nn" },
    { "dial", FAULT_DIAL, "nn" }, { "corrupt", FAULT_CORRUPT, "n" }, { "short", FAULT_SHORT, "n" }, { "slow", FAULT_SLOW, "n" },
    { "flicker", FAULT_FLICKER, "n" }, { "no_shot", FAULT_NO_SHOT, "n" }, { "head_stuck", FAULT_HEAD_STUCK, "n" },
    { "hostile", FAULT_HOSTILE, "hn" },
};
static const char *const hostile[] = { "none", "length", "huge", "tiny", "count", "string", "transaction", "type", "total",
                                       "garbage", "cut" };

static int fail(const char *file, int line, const char *found, const char *expected)
{
    log_error("rigsim: %s:%d: found '%.60s'; expected %s", file, line, found ? found : "end of line", expected);
    return -EINVAL;
}

// "2.5s", "200ms"; at most a day. Digits by hand: no locale.
static bool duration(const char *word, int64_t *ns)
{
    double v = 0, scale = 1;
    bool point = false, digit = false;
    if (!word)
        return false;
    for (; (*word >= '0' && *word <= '9') || (*word == '.' && !point); word++) {
        if (*word == '.') {
            point = true;
            continue;
        }
        digit = true;
        v = v * 10 + (*word - '0');
        scale *= point ? 10 : 1;
    }
    const double unit = !strcmp(word, "s") ? 1e9 : !strcmp(word, "ms") ? 1e6 : 0;
    if (!digit || unit == 0 || v / scale * unit > 86400e9)
        return false;
    *ns = llround(v / scale * unit);
    return true;
}

static bool whole(const char *word, int64_t *out)
{
    char *end;
    if (!word)
        return false;
    errno = 0;
    *out = strtoll(word, &end, 0);
    return *word && !*end && !errno && *out >= 0 && *out <= UINT32_MAX;
}

static int read_when(struct fault *f, char **rest, const char *file)
{
    const char *word = strtok_r(NULL, " \t", rest);
    if (word && !strcmp(word, "at")) {
        const char *t = strtok_r(NULL, " \t", rest);
        f->when = FAULT_AT;
        return duration(t, &f->at_ns) ? 0 : fail(file, f->line, t, "a time such as 2.5s or 200ms");
    }
    if (!word || strcmp(word, "on"))
        return fail(file, f->line, word, "at TIME or on shot | op | connect");
    const char *what = strtok_r(NULL, " \t", rest);
    char *value = strtok_r(NULL, " \t", rest);
    int64_t v = UINT32_MAX, nth = 0;
    if (what && !strcmp(what, "shot"))
        f->when = FAULT_ON_SHOT;
    else if (what && !strcmp(what, "op"))
        f->when = FAULT_ON_OPERATION;
    else if (what && !strcmp(what, "connect"))
        f->when = FAULT_ON_CONNECT;
    else
        return fail(file, f->line, what, "shot, op or connect");
    char *nth_word = value ? strchr(value, '#') : NULL;
    if (nth_word)
        *nth_word++ = 0;
    if (!value || (strcmp(value, "*") && !whole(value, &v)) || (nth_word && (!whole(nth_word, &nth) || !nth)))
        return fail(file, f->line, value, "a number, an operation such as 0x100e or 0x100e#2, or *");
    f->value = (uint32_t)v;
    f->nth = (uint32_t)nth;
    return 0;
}

static int read_fault(struct fault *f, char *text, const char *file)
{
    char *rest = NULL;
    const char *cameras = strtok_r(text, " \t", &rest);
    if (strlen(cameras) >= sizeof(f->cameras))
        return fail(file, f->line, cameras, "at most 63 characters of names; use several lines");
    memcpy(f->cameras, cameras, strlen(cameras) + 1);
    const int err = read_when(f, &rest, file);
    if (err)
        return err;
    const char *name = strtok_r(NULL, " \t", &rest), *arguments = NULL;
    for (size_t i = 0; name && i < sizeof(kinds) / sizeof(kinds[0]); i++)
        if (!strcmp(kinds[i].name, name)) {
            f->kind = kinds[i].kind;
            arguments = kinds[i].arguments;
        }
    if (!arguments)
        return fail(file, f->line, name, "a fault of tests/rigsim/faults.h");
    int64_t *number = &f->n;
    for (; *arguments; arguments++) {
        const char *word = strtok_r(NULL, " \t", &rest);
        if (*arguments == 't') {
            if (!duration(word, &f->ns))
                return fail(file, f->line, word, "a duration such as 5s or 200ms");
        } else if (*arguments == 'n') {
            if (!whole(word, number))
                return fail(file, f->line, word, "a whole number");
            number = &f->n2;
        } else {
            for (size_t i = 1; word && i < sizeof(hostile) / sizeof(hostile[0]); i++)
                if (!strcmp(hostile[i], word))
                    f->n = (int64_t)i;
            if (!f->n)
                return fail(file, f->line, word, "length huge tiny count string transaction type total garbage or cut");
            number = &f->n2;
        }
    }
    const char *more = strtok_r(NULL, " \t", &rest);
    return more ? fail(file, f->line, more, "the end of the line") : 0;
}

int faults_parse(struct faults *out, const char *text, const char *name_for_errors)
{
    struct faults f = { 0 };
    int err = 0;
    *out = f;
    for (int line = 1; !err && *text; line++) {
        char buffer[LINE_BYTES];
        const size_t whole_line = strcspn(text, "\n");
        size_t length = strcspn(text, "#\n");
        while (length < whole_line && length && text[length - 1] != ' ' && text[length - 1] != '\t') // 0x100e#2 is no comment
            length += 1 + strcspn(text + length + 1, "#\n");
        if (length >= sizeof(buffer)) {
            err = fail(name_for_errors, line, "a long line", "less than 512 bytes");
            break;
        }
        memcpy(buffer, text, length);
        buffer[length] = 0;
        size_t n = length;
        while (n && strchr(" \t\r", buffer[n - 1]))
            buffer[--n] = 0;
        text += whole_line + (text[whole_line] == '\n');
        if (!n || !buffer[strspn(buffer, " \t")])
            continue;
        struct fault *more = f.n < FAULTS_MAX ? realloc(f.fault, (size_t)(f.n + 1) * sizeof(*more)) : NULL;
        if (!more) {
            err = f.n < FAULTS_MAX ? -ENOMEM : fail(name_for_errors, line, "another line", "at most 4096 faults");
            break;
        }
        f.fault = more;
        f.fault[f.n] = (struct fault){ .line = line };
        err = read_fault(&f.fault[f.n++], buffer, name_for_errors);
    }
    if (err)
        faults_free(&f);
    *out = f;
    return err;
}

int faults_read(struct faults *out, const char *path)
{
    *out = (struct faults){ 0 };
    FILE *file = fopen(path, "re");
    if (!file) {
        const int err = -errno;
        log_error("rigsim: faults %s: %s", path, strerror(-err));
        return err;
    }
    char *text = malloc(FILE_MAX_BYTES + 1);
    int err = text ? 0 : -ENOMEM;
    if (!err) {
        const size_t n = fread(text, 1, FILE_MAX_BYTES + 1, file);
        if (n > FILE_MAX_BYTES || memchr(text, 0, n)) {
            err = n > FILE_MAX_BYTES ? -EFBIG : -EINVAL;
            log_error("rigsim: faults %s: found %s; expected a text of at most 1 MiB", path,
                      n > FILE_MAX_BYTES ? "more" : "a zero byte");
        } else {
            text[n] = 0;
            err = faults_parse(out, text, path);
        }
    }
    free(text);
    fclose(file);
    return err;
}

void faults_free(struct faults *f)
{
    free(f->fault);
    *f = (struct faults){ 0 };
}

bool fault_is_for(const struct fault *f, const char *camera)
{
    char list[sizeof(f->cameras)], *rest = NULL;
    memcpy(list, f->cameras, sizeof(list));
    for (const char *w = strtok_r(list, ",", &rest); w; w = strtok_r(NULL, ",", &rest))
        if (!fnmatch(w, camera, 0))
            return true;
    return false;
}
