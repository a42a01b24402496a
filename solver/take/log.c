// solver/take/log.c - one line per event: stderr in text or JSON, and a hook for tests.
//
// A line is made whole in memory and written by one call, so lines of several threads never mix.
// File names come from outside: bytes that would break a line or a terminal are replaced.
#include "solver/take/log.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static const char *program = "studiorig";
static enum log_level least_level = LOG_INFO;
static bool as_json;
static void (*hook_function)(void *arg, enum log_level level, const char *message);
static void *hook_arg;

static const char *const level_names[] = { "debug", "info", "warning", "error" };

void log_set_program(const char *name)
{
    pthread_mutex_lock(&lock);
    program = name;
    pthread_mutex_unlock(&lock);
}

void log_set_level(enum log_level least)
{
    pthread_mutex_lock(&lock);
    least_level = least;
    pthread_mutex_unlock(&lock);
}

void log_set_json(bool json)
{
    pthread_mutex_lock(&lock);
    as_json = json;
    pthread_mutex_unlock(&lock);
}

void log_set_hook(void (*hook)(void *arg, enum log_level level, const char *message), void *arg)
{
    pthread_mutex_lock(&lock);
    hook_function = hook;
    hook_arg = arg;
    pthread_mutex_unlock(&lock);
}

// Length of the well-formed UTF-8 sequence at s, 0 if there is none.
static int utf8_length(const unsigned char *s)
{
    int n;
    uint32_t code, least;
    if (s[0] < 0x80)
        return 1;
    if (s[0] >= 0xc2 && s[0] < 0xe0)
        n = 2, code = s[0] & 0x1f, least = 0x80;
    else if (s[0] >= 0xe0 && s[0] < 0xf0)
        n = 3, code = s[0] & 0x0f, least = 0x800;
    else if (s[0] >= 0xf0 && s[0] < 0xf5)
        n = 4, code = s[0] & 0x07, least = 0x10000;
    else
        return 0;
    for (int i = 1; i < n; i++) { // a NUL ends here as well: it is no continuation byte
        if ((s[i] & 0xc0) != 0x80)
            return 0;
        code = code << 6 | (s[i] & 0x3f);
    }
    return code < least || code > 0x10ffff || (code >= 0xd800 && code < 0xe000) ? 0 : n;
}

static void put_json_string(FILE *out, const char *text, size_t n)
{
    fputc('"', out);
    for (const unsigned char *s = (const unsigned char *)text, *end = s + n; s < end;) {
        const int length = utf8_length(s);
        if (*s == '"' || *s == '\\')
            fprintf(out, "\\%c", *s);
        else if (*s < 0x20 || *s == 0x7f)
            fprintf(out, "\\u%04x", *s);
        else if (length == 0)
            fputs("\\ufffd", out);
        else
            fwrite(s, 1, (size_t)length, out);
        s += length ? length : 1;
    }
    fputc('"', out);
}

static void make_safe(char *message)
{
    for (unsigned char *s = (unsigned char *)message; *s; s++)
        if (*s < 0x20 || *s == 0x7f)
            *s = '?';
}

static void write_stderr(const char *line, size_t n)
{
    while (n) {
        const ssize_t done = write(STDERR_FILENO, line, n);
        if (done <= 0)
            return;
        line += done, n -= (size_t)done;
    }
}

void log_line(enum log_level level, const char *format, ...)
{
    va_list args;
    char *message = NULL, *line = NULL;
    size_t n_line = 0;
    char spare[] = "log: out of memory";

    va_start(args, format);
    if (vasprintf(&message, format, args) < 0)
        message = NULL;
    va_end(args);
    char *const text = message ? message : spare;

    pthread_mutex_lock(&lock);
    if (level >= least_level) {
        FILE *out = open_memstream(&line, &n_line);
        if (out && as_json) {
            const char *colon = strstr(text, ": ");
            const size_t n_module = colon ? (size_t)(colon - text) : 0;
            fprintf(out, "{\"level\":\"%s\",\"module\":", level_names[level]);
            put_json_string(out, text, n_module);
            fputs(",\"message\":", out);
            const char *rest = colon ? colon + 2 : text;
            put_json_string(out, rest, strlen(rest));
            fputs("}\n", out);
        } else if (out) {
            make_safe(text);
            // A progress bar may stand on this line of the terminal: wipe it.
            fprintf(out, "%s%s: %s: %s\n", isatty(STDERR_FILENO) ? "\r\033[K" : "", program,
                    level_names[level], text);
        }
        if (out && fclose(out) == 0)
            write_stderr(line, n_line);
    }
    if (hook_function)
        hook_function(hook_arg, level, text);
    pthread_mutex_unlock(&lock);
    free(line);
    free(message);
}
