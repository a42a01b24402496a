// rigd/executor.h - processes that do the work: started, heard, paused, ended; nothing of theirs survives the daemon.
//
// Between the daemon and each program stands a keeper (a fork of the daemon, without its descriptors): it has the program's process
// group to itself. However the daemon ends, the kernel tells the keeper, and the keeper kills the whole group - a hook's children,
// too. A keeper that is killed takes its program with it, and the daemon kills the rest of the group. Programs run at nice 10, are the first to go when memory ends, and see no descriptor but 0, 1, 2, if wanted 3, and a lock's.
//
// What they say is heard in bounded pieces: lines of at most EXECUTOR_LINE_MAX bytes, the rest of longer ones is dropped.
// Loop thread only; nothing here waits, but executor_close().
#pragma once
#include <stdbool.h>

enum { EXECUTOR_LOCK_FD = 40, EXECUTOR_JOBS_MAX = 256, EXECUTOR_WORDS_MAX = 96, EXECUTOR_LINE_MAX = 16384 };

struct executor_command {
    char *word[EXECUTOR_WORDS_MAX + 1]; // word[0]: the program; looked for in PATH if it has no slash
    int n_words;
    char dir[700];      // where it runs
    char log_path[800]; // takes what it says on stdout and stderr (truncated first); "": both are heard
    bool progress;      // JSON lines on descriptor 3 are wanted: STUDIORIG_PROGRESS_FD=3
    bool too_many;      // words that did not fit: it cannot be started
};
void executor_add_word(struct executor_command *c, const char *word); // copied
void executor_add_words(struct executor_command *c, const char *text); // split at blanks
void executor_command_free(struct executor_command *c);

struct executor_end {
    bool signalled;
    int code;                // exit status, or signal
    const char *said;        // last line on stdout, "" if none or logged
    const char *complaint;   // last line on stderr that says "error", else the last one; ""
};
struct executor_host {
    void (*line)(void *arg, int job, const char *line); // on descriptor 3
    void (*ended)(void *arg, int job, const struct executor_end *end);
    void *arg;
};

struct executor;
int executor_open(struct executor **out, const struct executor_host *host); // host is copied. 0 or -errno (logged)
// Every keeper and every program (not its children) holds a shared record lock on this file: who can lock it alone knows that nothing
// of an earlier daemon is at work. fd is above 3 and stays the caller's; programs have it as EXECUTOR_LOCK_FD. Before the first start.
void executor_lock(struct executor *e, int fd);
int executor_lock_file(int fd, bool alone); // for this process, at once. 0 or -EAGAIN: others hold it; other -errno
void executor_close(struct executor *e); // kills and reaps what runs, without telling; NULL allowed
int executor_fd(const struct executor *e); // readable: call dispatch
void executor_dispatch(struct executor *e);

// Job number, or -errno (not logged): -E2BIG, -EMFILE (too many jobs), -EAGAIN... A program that cannot be run ends with status 127.
int executor_start(struct executor *e, const struct executor_command *c);
enum executor_signal { EXECUTOR_TERM, EXECUTOR_KILL, EXECUTOR_PAUSE, EXECUTOR_CONTINUE }; // TERM wakes what is paused
void executor_signal(struct executor *e, int job, enum executor_signal signal);
