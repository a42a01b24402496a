// solver/take/json.h - the project's small view of JSON (jansson lives in json.c only).
//
// Documents are trees of struct json. Readers take a path of keys ("stage.joint.wall_s"; an array index is a
// decimal key: "lights.3.dir_probe"). A missing or mistyped value is -ENOENT or -EINVAL and is *not* logged: the caller
// knows whether it was needed; json_require_* log file, key, what was found, what was expected.
// Numbers must be finite, keys unique. Strings are UTF-8 (when writing, a string that is not gets '?' for its high bytes). Limits when reading: 256 MiB, nesting as jansson's (2048).
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct json; // a value; owned by its document

// Read a file. Errors (logged with line and column): -errno of the open, -EFBIG, -EINVAL (not JSON).
int json_read(struct json **out, const char *path);
// name_for_errors NULL: nothing is logged (text from a socket: its sender must not fill the log).
int json_parse(struct json **out, const char *text, size_t n_bytes, const char *name_for_errors);
// Write atomically, indented by 1, keys in the order of insertion, doubles with 17 digits. 0 or -errno (logged).
int json_write(const struct json *doc, const char *path);
char *json_text(const struct json *doc); // one line, malloc'd, NULL without memory
void json_free(struct json *doc);        // NULL allowed

// Reading. path "" is the value itself.
const struct json *json_get(const struct json *v, const char *path); // NULL: not there
int json_length(const struct json *v, const char *path);             // elements of an array, else -ENOENT / -EINVAL
int json_get_number(const struct json *v, const char *path, double *out);
int json_get_int(const struct json *v, const char *path, int64_t *out); // -EINVAL for a fraction
int json_get_bool(const struct json *v, const char *path, bool *out);
int json_get_string(const struct json *v, const char *path, const char **out); // lives as long as the document
// Exactly n numbers, nested arrays flattened row by row (a 3x3 matrix is n = 9); a bare number counts as n = 1.
int json_get_numbers(const struct json *v, const char *path, double *out, int n);

int json_require_numbers(const struct json *v, const char *path, double *out, int n, const char *file);
int json_require_string(const struct json *v, const char *path, const char **out, const char *file);

// Writing. Building a tree never fails half way: out of memory is remembered and json_write returns -ENOMEM
// (every later one of the process too: no half tree is ever written), so that nobody need look at what these return: 0, -ENOMEM, or
// -EINVAL where a document that was read is no object (no array for json_append): it stays as it is.
struct json *json_new_object(void);
struct json *json_new_array(void);
#define json_object() json_new_object() // jansson owns the linker's names json_object and json_array
#define json_array() json_new_array()
int json_set(struct json *object, const char *key, struct json *value); // takes value
int json_set_number(struct json *object, const char *key, double value); // not finite: null
int json_set_int(struct json *object, const char *key, int64_t value);
int json_set_bool(struct json *object, const char *key, bool value);
int json_set_string(struct json *object, const char *key, const char *value);
int json_set_numbers(struct json *object, const char *key, const double *values, int n);
int json_set_matrix3(struct json *object, const char *key, const double rows[9]); // [[..],[..],[..]]
int json_append(struct json *array, struct json *value); // takes value
int json_append_string(struct json *array, const char *value);
