// solver/commands/output.h - how a command hands over what it found.
#pragma once
#include "solver/take/json.h"

// One line on standard output, flushed. Takes doc. 0; -ENOMEM; -errno of writing, logged as
// "COMMAND: cannot print".
int output_json(const char *command, struct json *doc);
// What printf() left to be written, for the same promise about text.
int output_flush(const char *command);

// dir/<view>.<extension>, malloc'd; NULL without memory. The name of a view may hold folders, that
// of a file may not: '/' becomes '_'.
char *output_path(const char *dir, const char *view, const char *extension);

// Seconds since some moment, never set back: differences tell how long something took.
double output_clock_s(void);
