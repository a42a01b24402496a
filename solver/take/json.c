// solver/take/json.c - struct json is jansson's json_t under another name; only this file knows.
#include <jansson.h> // before json.h, whose macros it must not see

#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_FILE_BYTES = 256 << 20, MAX_INDEX_DIGITS = 9 };

// A tree that lost a part for want of memory must never reach the disk. Which tree it was cannot be
// noted in the tree, so from then on none is written.
static atomic_bool out_of_memory;

static json_t *value_of(const struct json *v)
{
    return (json_t *)(uintptr_t)v;
}

static struct json *json_of(const json_t *v)
{
    return (struct json *)(uintptr_t)v;
}

int json_parse(struct json **out, const char *text, size_t n_bytes, const char *name_for_errors)
{
    json_error_t error;
    *out = NULL;
    if (n_bytes > MAX_FILE_BYTES) {
        if (name_for_errors)
            log_error("json: %s: %zu bytes, at most %d are read", name_for_errors, n_bytes,
                      MAX_FILE_BYTES);
        return -EFBIG;
    }
    json_t *v = json_loadb(text, n_bytes, JSON_REJECT_DUPLICATES, &error);
    if (!v) {
        const bool no_memory = json_error_code(&error) == json_error_out_of_memory;
        if (name_for_errors)
            log_error("json: %s:%d:%d: %s", name_for_errors, error.line, error.column, error.text);
        return no_memory ? -ENOMEM : -EINVAL;
    }
    *out = json_of(v);
    return 0;
}

int json_read(struct json **out, const char *path)
{
    char *text;
    size_t n;
    *out = NULL;
    int err = file_read(&text, &n, path, MAX_FILE_BYTES);
    if (!err)
        err = json_parse(out, text, n, path);
    free(text);
    return err;
}

int json_write(const struct json *doc, const char *path)
{
    struct atomic_file f;
    if (!doc || atomic_load(&out_of_memory)) {
        log_error("json: %s not written: out of memory while it was put together", path);
        return -ENOMEM;
    }
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    if (json_dumpf(value_of(doc), f.stream, JSON_INDENT(1) | JSON_REAL_PRECISION(17)) ||
        fputc('\n', f.stream) == EOF) {
        // A full disk is named by commit; anything else is memory or a value that JSON cannot hold.
        if (!ferror(f.stream)) {
            log_error("json: cannot write %s: out of memory", path);
            atomic_file_abandon(&f);
            return -ENOMEM;
        }
    }
    return atomic_file_commit(&f);
}

char *json_text(const struct json *doc)
{
    if (!doc || atomic_load(&out_of_memory))
        return NULL;
    return json_dumps(value_of(doc), JSON_COMPACT | JSON_ENCODE_ANY | JSON_REAL_PRECISION(17));
}

void json_free(struct json *doc)
{
    json_decref(value_of(doc));
}

static const json_t *element(const json_t *v, const char *key, size_t n)
{
    if (json_is_array(v)) {
        size_t index = 0;
        if (n == 0 || n > MAX_INDEX_DIGITS)
            return NULL;
        for (size_t i = 0; i < n; i++) {
            if (key[i] < '0' || key[i] > '9')
                return NULL;
            index = index * 10 + (size_t)(key[i] - '0');
        }
        return json_array_get(v, index);
    }
    return json_object_getn(v, key, n); // NULL for what is no object
}

const struct json *json_get(const struct json *doc, const char *path)
{
    const json_t *v = value_of(doc);
    while (v && *path) {
        const size_t n = strcspn(path, ".");
        v = element(v, path, n);
        path += n + (path[n] == '.');
    }
    return json_of(v);
}

int json_length(const struct json *doc, const char *path)
{
    const json_t *v = value_of(json_get(doc, path));
    if (!v)
        return -ENOENT;
    return json_is_array(v) ? (int)json_array_size(v) : -EINVAL;
}

int json_get_number(const struct json *doc, const char *path, double *out)
{
    const json_t *v = value_of(json_get(doc, path));
    if (!v)
        return -ENOENT;
    if (!json_is_number(v))
        return -EINVAL;
    *out = json_number_value(v);
    return 0;
}

int json_get_int(const struct json *doc, const char *path, int64_t *out)
{
    const json_t *v = value_of(json_get(doc, path));
    if (!v)
        return -ENOENT;
    if (json_is_integer(v)) {
        *out = json_integer_value(v);
        return 0;
    }
    const double x = json_number_value(v); // 0 for what is no number
    if (!json_is_real(v) || x != floor(x) || fabs(x) > 0x1p53)
        return -EINVAL;
    *out = (int64_t)x;
    return 0;
}

int json_get_bool(const struct json *doc, const char *path, bool *out)
{
    const json_t *v = value_of(json_get(doc, path));
    if (!v)
        return -ENOENT;
    if (!json_is_boolean(v))
        return -EINVAL;
    *out = json_is_true(v);
    return 0;
}

int json_get_string(const struct json *doc, const char *path, const char **out)
{
    const json_t *v = value_of(json_get(doc, path));
    if (!v)
        return -ENOENT;
    if (!json_is_string(v))
        return -EINVAL;
    *out = json_string_value(v);
    return 0;
}

// Appends v's numbers; -EINVAL for another type or more than n.
static int flatten(const json_t *v, double *out, int n, int *used)
{
    if (json_is_number(v)) {
        if (*used == n)
            return -EINVAL;
        out[(*used)++] = json_number_value(v);
        return 0;
    }
    if (!json_is_array(v))
        return -EINVAL;
    for (size_t i = 0; i < json_array_size(v); i++)
        if (flatten(json_array_get(v, i), out, n, used))
            return -EINVAL;
    return 0;
}

int json_get_numbers(const struct json *doc, const char *path, double *out, int n)
{
    const json_t *v = value_of(json_get(doc, path));
    int used = 0;
    if (!v)
        return -ENOENT;
    double *values = malloc((size_t)(n > 0 ? n : 1) * sizeof(*values));
    if (!values)
        return -ENOMEM;
    int err = flatten(v, values, n, &used);
    if (!err && used != n)
        err = -EINVAL;
    if (!err)
        memcpy(out, values, (size_t)n * sizeof(*values));
    free(values);
    return err;
}

static int complain(const struct json *doc, const char *path, const char *file,
                    const char *expected, int err)
{
    const json_t *v = value_of(json_get(doc, path));
    char *found = v ? json_dumps(v, JSON_COMPACT | JSON_ENCODE_ANY) : NULL;
    const size_t n = found ? strlen(found) : 0;
    log_error("json: %s: \"%s\": found %.60s%s, expected %s", file, path,
              v ? (found ? found : "?") : "nothing", n > 60 ? "..." : "", expected);
    free(found);
    return err;
}

int json_require_numbers(const struct json *doc, const char *path, double *out, int n,
                         const char *file)
{
    const int err = json_get_numbers(doc, path, out, n);
    if (!err)
        return 0;
    char expected[48];
    snprintf(expected, sizeof(expected), n == 1 ? "a number" : "%d numbers", n);
    return complain(doc, path, file, expected, err);
}

int json_require_string(const struct json *doc, const char *path, const char **out,
                        const char *file)
{
    const int err = json_get_string(doc, path, out);
    return err ? complain(doc, path, file, "a string", err) : 0;
}

// Names of files may hold any bytes; JSON holds only UTF-8. Other bytes become '?'.
static char *ascii_of(const char *text)
{
    char *copy = strdup(text);
    for (char *s = copy; s && *s; s++)
        if ((unsigned char)*s >= 0x80)
            *s = '?';
    return copy;
}

static json_t *string_of(const char *text)
{
    if (!text)
        return json_null();
    json_t *v = json_string(text);
    if (v)
        return v;
    char *ascii = ascii_of(text);
    v = ascii ? json_string(ascii) : NULL;
    free(ascii);
    return v;
}

// Out of memory, here or when object or value was made.
static int poison(void)
{
    atomic_store(&out_of_memory, true);
    return -ENOMEM;
}

static int set_value(struct json *object, const char *key, json_t *value)
{
    int err = 0;
    if (!object || !value) {
        err = poison();
    } else if (!json_is_object(value_of(object))) {
        err = -EINVAL; // a document of others is what it is
    } else if (json_object_set(value_of(object), key, value)) {
        char *ascii = ascii_of(key);
        if (!ascii || json_object_set(value_of(object), ascii, value))
            err = poison();
        free(ascii);
    }
    json_decref(value);
    return err;
}

static struct json *built(json_t *v)
{
    if (!v)
        (void)poison();
    return json_of(v);
}

struct json *json_new_object(void)
{
    return built((json_object)()); // the parentheses: jansson's function, not our macro
}

struct json *json_new_array(void)
{
    return built((json_array)());
}

int json_set(struct json *object, const char *key, struct json *value)
{
    return set_value(object, key, value_of(value));
}

int json_set_number(struct json *object, const char *key, double value)
{
    return set_value(object, key, isfinite(value) ? json_real(value) : json_null());
}

int json_set_int(struct json *object, const char *key, int64_t value)
{
    return set_value(object, key, json_integer(value));
}

int json_set_bool(struct json *object, const char *key, bool value)
{
    return set_value(object, key, json_boolean(value));
}

int json_set_string(struct json *object, const char *key, const char *value)
{
    return set_value(object, key, string_of(value));
}

static int append_value(struct json *array, json_t *value)
{
    int err = 0;
    if (!array || !value)
        err = poison();
    else if (!json_is_array(value_of(array)))
        err = -EINVAL;
    else if (json_array_append(value_of(array), value))
        err = poison();
    json_decref(value);
    return err;
}

static struct json *array_of_numbers(const double *values, int n)
{
    struct json *array = json_new_array();
    for (int i = 0; i < n; i++)
        append_value(array, isfinite(values[i]) ? json_real(values[i]) : json_null());
    return array;
}

int json_set_numbers(struct json *object, const char *key, const double *values, int n)
{
    return json_set(object, key, array_of_numbers(values, n));
}

int json_set_matrix3(struct json *object, const char *key, const double rows[9])
{
    struct json *matrix = json_new_array();
    for (int row = 0; row < 3; row++)
        json_append(matrix, array_of_numbers(rows + 3 * row, 3));
    return json_set(object, key, matrix);
}

int json_append(struct json *array, struct json *value)
{
    return append_value(array, value_of(value));
}

int json_append_string(struct json *array, const char *value)
{
    return append_value(array, string_of(value));
}
