// solver/csv.h - tables of numbers in comma-separated text, columns found by name.
//
// A header line, then one row per line; LF or CRLF; a UTF-8 mark at the start and empty lines are skipped; no quoted fields.
// Numbers are read the same way in every locale. Errors are logged with file, line and column and are -EINVAL unless said.
// Limits: 256 MiB, 4096 columns.
#pragma once
#include <stddef.h>

struct csv {
    char *name, *text; // file name for messages; the whole text, cut up in place
    size_t n_bytes, next;
    int n_columns, line; // line of the current row, from 1
    const char **column; // [n_columns] names
    const char **field;  // [n_columns] the current row
    void *locale;
};

int csv_open(struct csv *out, const char *path); // reads the file and its header. Also -errno of the open, -EFBIG, -ENOMEM
int csv_open_text(struct csv *out, const char *text, size_t n_bytes, const char *name_for_errors); // the same from memory; copied
void csv_close(struct csv *c); // a zeroed one is allowed

int csv_find(const struct csv *c, const char *column);    // index, or -ENOENT (not logged)
int csv_require(const struct csv *c, const char *column); // index, or -EINVAL (logged)
int csv_next_row(struct csv *c);                          // 1: there is one; 0: the end; or an error
int csv_number(const struct csv *c, int column, double *out); // finite
