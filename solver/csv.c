// solver/csv.c - reads a table of numbers row by row from one block of text.
//
// Commas and line ends become terminators in place, so nothing is copied and memory is the file and one row of pointers.
#include "solver/csv.h"

#include "solver/take/log.h"

#include <errno.h>
#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_COLUMNS = 4096, SHOWN = 40 };
static const size_t max_bytes = (size_t)256 << 20;

// Cuts the next non-empty line out of the text: its length without the line end, or -1 at the end.
static ptrdiff_t next_line(struct csv *c, char **line)
{
    while (c->next < c->n_bytes) {
        char *begin = c->text + c->next, *end = memchr(begin, '\n', c->n_bytes - c->next);
        if (!end)
            end = c->text + c->n_bytes;
        c->next = (size_t)(end - c->text) + 1;
        c->line++;
        if (end > begin && end[-1] == '\r')
            end--;
        *end = 0;
        if (end > begin) {
            *line = begin;
            return end - begin;
        }
    }
    return -1;
}

// Splits line into fields at the commas; the count, or -EINVAL. fields beyond max are counted, not stored.
static int split(const struct csv *c, char *line, ptrdiff_t length, const char **fields, int max)
{
    if (memchr(line, 0, (size_t)length) || memchr(line, '"', (size_t)length)) {
        log_error("csv: %s:%d: found a %s, expected plain fields separated by commas", c->name, c->line,
                  memchr(line, 0, (size_t)length) ? "zero byte" : "quotation mark");
        return -EINVAL;
    }
    int n = 0;
    for (char *p = line;; p++) {
        char *comma = strchr(p, ',');
        if (comma)
            *comma = 0;
        if (n < max)
            fields[n] = p;
        n++;
        if (!comma)
            return n;
        p = comma;
    }
}

static int read_header(struct csv *c)
{
    char *line;
    if (c->n_bytes >= 3 && !memcmp(c->text, "\xef\xbb\xbf", 3))
        c->next = 3;
    const ptrdiff_t length = next_line(c, &line);
    if (length < 0) {
        log_error("csv: %s: the file is empty, expected a header line with the names of the columns", c->name);
        return -EINVAL;
    }
    c->column = calloc(2 * MAX_COLUMNS, sizeof(*c->column));
    if (!c->column)
        return -ENOMEM;
    c->n_columns = split(c, line, length, c->column, MAX_COLUMNS);
    if (c->n_columns < 0)
        return c->n_columns;
    if (c->n_columns > MAX_COLUMNS) {
        log_error("csv: %s:%d: %d columns, expected at most %d", c->name, c->line, c->n_columns, MAX_COLUMNS);
        return -EINVAL;
    }
    c->field = c->column + MAX_COLUMNS;
    return 0;
}

// Takes text (n_bytes and one more for the terminator), also on failure.
static int open_taking(struct csv *out, char *text, size_t n_bytes, const char *name)
{
    struct csv c = { .text = text, .n_bytes = n_bytes, .name = strdup(name) };
    *out = (struct csv){ 0 };
    c.locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    text[n_bytes] = 0;
    const int err = c.name && c.locale ? read_header(&c) : -ENOMEM;
    if (err) {
        csv_close(&c);
        return err;
    }
    *out = c;
    return 0;
}

int csv_open_text(struct csv *out, const char *text, size_t n_bytes, const char *name_for_errors)
{
    *out = (struct csv){ 0 };
    if (n_bytes > max_bytes) {
        log_error("csv: %s: larger than 256 MiB", name_for_errors);
        return -EFBIG;
    }
    char *copy = malloc(n_bytes + 1);
    if (!copy)
        return -ENOMEM;
    memcpy(copy, text, n_bytes);
    return open_taking(out, copy, n_bytes, name_for_errors);
}

int csv_open(struct csv *out, const char *path)
{
    int err = 0;
    size_t n = 0, capacity = 1 << 16;
    char *text = NULL;
    *out = (struct csv){ 0 };
    FILE *f = fopen(path, "re");
    if (!f) {
        err = -errno;
        log_error("csv: cannot open %s: %s", path, strerror(-err));
        return err;
    }
    for (;;) {
        char *larger = realloc(text, capacity + 1);
        if (!larger) {
            err = -ENOMEM;
            goto fail;
        }
        text = larger;
        n += fread(text + n, 1, capacity - n, f);
        if (n < capacity)
            break;
        if (capacity > max_bytes) {
            log_error("csv: %s: larger than 256 MiB", path);
            err = -EFBIG;
            goto fail;
        }
        capacity *= 2;
    }
    if (ferror(f)) {
        err = -EIO;
        log_error("csv: cannot read %s", path);
        goto fail;
    }
    fclose(f);
    return open_taking(out, text, n, path);
fail:
    fclose(f);
    free(text);
    return err;
}

void csv_close(struct csv *c)
{
    free(c->name);
    free(c->text);
    free(c->column);
    if (c->locale)
        freelocale(c->locale);
    *c = (struct csv){ 0 };
}

int csv_find(const struct csv *c, const char *column)
{
    for (int i = 0; i < c->n_columns; i++)
        if (!strcmp(c->column[i], column))
            return i;
    return -ENOENT;
}

int csv_require(const struct csv *c, const char *column)
{
    const int i = csv_find(c, column);
    if (i >= 0)
        return i;
    log_error("csv: %s:1: there is no column '%s' in the header", c->name, column);
    return -EINVAL;
}

int csv_next_row(struct csv *c)
{
    char *line;
    const ptrdiff_t length = next_line(c, &line);
    if (length < 0)
        return 0;
    const int n = split(c, line, length, c->field, c->n_columns);
    if (n < 0)
        return n;
    if (n != c->n_columns) {
        log_error("csv: %s:%d: found %d fields, expected %d as in the header", c->name, c->line, n, c->n_columns);
        return -EINVAL;
    }
    return 1;
}

int csv_number(const struct csv *c, int column, double *out)
{
    const char *s = c->field[column];
    // strtod would also take hexadecimal, "inf", "nan" and leading spaces.
    if (*s && !s[strspn(s, "+-.0123456789eE")]) {
        char *end;
        const double value = strtod_l(s, &end, c->locale);
        if (end != s && !*end && isfinite(value)) {
            *out = value;
            return 0;
        }
    }
    log_error("csv: %s:%d: column '%s': found '%.*s', expected a number", c->name, c->line, c->column[column], SHOWN, s);
    return -EINVAL;
}
