// solver/take/progress.h - how far long work has come.
//
// On a terminal: one line on stderr with a bar and the time left, redrawn at most ten times a second.
// Where stderr is a file or a pipe: a plain line whenever two seconds have gone by without one, so that short work says nothing; or instead JSON lines on a descriptor ({"stage":"render","done":12,"total":85,"seconds":3.1}) after
// progress_set_fd(), or where the environment names one (STUDIORIG_PROGRESS_FD=3: rigd does). Safe from any thread; one stage at a time:
// one that begins within another is shown, if it takes a while, until it ends; then the other goes on where it was.
#pragma once
#include <stdint.h>

void progress_set_fd(int fd);                          // -1: none (default). Not closed here.
void progress_begin(const char *stage, int64_t total); // stage is kept: a literal
void progress_add(int64_t done);
void progress_end(void);
