// solver/take/log.h - one line per event, for people or for machines.
//
// Text form, on stderr:  "rigsolve: error: mesh: vase.obj:12: ..." ; JSON form (log_set_json):
// {"level":"error","module":"mesh","message":"..."}. A cause is logged once, where it is known.
// The module is the word before the first ": " of the message. Safe from any thread.
#pragma once
#include <stdbool.h>
#include <stdint.h>

enum log_level { LOG_DEBUG, LOG_INFO, LOG_WARNING, LOG_ERROR, LOG_SILENT }; // LOG_SILENT: only for log_set_level

void log_set_program(const char *name); // kept; a literal
void log_set_level(enum log_level least); // LOG_INFO by default; stderr gets nothing below
void log_set_json(bool json);

// Tests read what was logged: every line of any level also goes to hook(arg, ...) while it is set. NULL ends it. Calls do not
// overlap; hook must not log.
void log_set_hook(void (*hook)(void *arg, enum log_level level, const char *message), void *arg);

void log_line(enum log_level level, const char *format, ...) __attribute__((format(printf, 2, 3)));
#define log_error(...) log_line(LOG_ERROR, __VA_ARGS__)
#define log_warning(...) log_line(LOG_WARNING, __VA_ARGS__)
#define log_info(...) log_line(LOG_INFO, __VA_ARGS__)
#define log_debug(...) log_line(LOG_DEBUG, __VA_ARGS__)
