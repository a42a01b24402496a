// rigd/executor.c - fork, keeper, fork, exec; pipes and pidfds in one epoll set.
//
// PR_SET_PDEATHSIG reaches one process, not its children, and a stopped process only by SIGKILL: hence a keeper that is never
// stopped, and a group of its own for the program. Between fork and exec only async-signal-safe functions are called.
#include "rigd/executor.h"
#include "solver/take/log.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

enum { OUT, ERR, PROGRESS, N_STREAMS, PIDFD = N_STREAMS };
enum { NICENESS = 10, READS_PER_TURN = 16 };

struct stream {
    int fd;
    int n;
    bool too_long; // until the next newline
    char line[EXECUTOR_LINE_MAX];
};

struct running {
    pid_t keeper; // 0: free
    int pidfd;
    struct stream stream[N_STREAMS];
    char said[EXECUTOR_LINE_MAX], complaint[EXECUTOR_LINE_MAX];
    bool is_error; // the complaint is one
};

struct executor {
    struct executor_host host;
    int epoll_fd, lock_fd; // -1: none
    struct running *job[EXECUTOR_JOBS_MAX];
    // Process group of each job's program, written by that program and its keeper in memory that all have; 0: none, or it was seen to.
    volatile pid_t *group;
};

// ---- commands -----------------------------------------------------------------------------------------------------------------

void executor_add_word(struct executor_command *c, const char *word)
{
    if (c->n_words == EXECUTOR_WORDS_MAX) {
        c->too_many = true;
        return;
    }
    c->word[c->n_words] = strdup(word);
    if (!c->word[c->n_words])
        abort();
    c->n_words++;
}

void executor_add_words(struct executor_command *c, const char *text)
{
    char *words = strdup(text), *save = NULL;
    if (!words)
        abort();
    for (char *w = strtok_r(words, " \t", &save); w; w = strtok_r(NULL, " \t", &save))
        executor_add_word(c, w);
    free(words);
}

void executor_command_free(struct executor_command *c)
{
    for (int i = 0; i < c->n_words; i++)
        free(c->word[i]);
    *c = (struct executor_command){ 0 };
}

// ---- the keeper ---------------------------------------------------------------------------------------------------------------

static void write_file(const char *path, const char *text, size_t n)
{
    const int fd = open(path, O_WRONLY | O_CLOEXEC);
    if (fd >= 0 && write(fd, text, n) < 0)
        errno = 0; // a wish
    if (fd >= 0)
        close(fd);
}

// From first on, but for one (-1: none).
static void close_others(int first, int but)
{
    if (but > first)
        syscall(SYS_close_range, (unsigned)first, (unsigned)but - 1, 0);
    syscall(SYS_close_range, (unsigned)(but >= first ? but + 1 : first), ~0U, 0);
}

// Record locks: they end with the process, survive exec, and its children do not have them.
int executor_lock_file(int fd, bool alone)
{
    struct flock lock = { .l_type = (short)(alone ? F_WRLCK : F_RDLCK), .l_whence = SEEK_SET };
    if (!fcntl(fd, F_SETLK, &lock))
        return 0;
    return errno == EACCES || errno == EINTR ? -EAGAIN : -errno;
}

__attribute__((noreturn)) static void become(const struct executor_command *c, char **envp, const int *fd, pid_t keeper, int lock_fd, volatile pid_t *group)
{
    sigset_t none;
    sigemptyset(&none);
    setpgid(0, 0);
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (getppid() != keeper)
        _exit(127);
    *group = getpid(); // by itself, before it can have children: the keeper may be killed at any moment
    if (getpriority(PRIO_PROCESS, 0) < NICENESS)
        setpriority(PRIO_PROCESS, 0, NICENESS);
    write_file("/proc/self/oom_score_adj", "500", 3);
    const int null = open("/dev/null", O_RDONLY);
    if (null != 0)
        dup2(null, 0);
    dup2(fd[OUT], 1);
    dup2(fd[ERR], 2);
    if (fd[PROGRESS] >= 0)
        dup2(fd[PROGRESS], 3);
    if (lock_fd >= 0 && lock_fd != EXECUTOR_LOCK_FD)
        dup2(lock_fd, EXECUTOR_LOCK_FD);
    else if (lock_fd >= 0)
        fcntl(lock_fd, F_SETFD, 0);
    close_others(fd[PROGRESS] >= 0 ? 4 : 3, lock_fd >= 0 ? EXECUTOR_LOCK_FD : -1);
    if (lock_fd >= 0 && executor_lock_file(EXECUTOR_LOCK_FD, false)) // last: closing any descriptor of the file would undo it
        _exit(127);
    for (int s = 1; s < 32; s++)
        signal(s, SIG_DFL);
    sigprocmask(SIG_SETMASK, &none, NULL);
    if (!chdir(c->dir[0] ? c->dir : "/"))
        execvpe(c->word[0], c->word, envp);
    const char *why = strerrordesc_np(errno);
    if (write(2, "error: cannot run ", 18) < 0 || write(2, c->word[0], strlen(c->word[0])) < 0 || write(2, ": ", 2) < 0 || write(2, why, strlen(why)) < 0)
        _exit(126);
    _exit(127);
}

__attribute__((noreturn)) static void keep(const struct executor_command *c, char **envp, const int *fd, pid_t daemon, int lock_fd, volatile pid_t *group)
{
    sigset_t all;
    siginfo_t info;
    int status = 0;
    const pid_t self = getpid();
    sigfillset(&all);
    sigprocmask(SIG_SETMASK, &all, NULL);
    setpgid(0, 0);
    prctl(PR_SET_NAME, "rigd-keeper");
    prctl(PR_SET_PDEATHSIG, SIGHUP);
    setrlimit(RLIMIT_CORE, &(struct rlimit){ 0, 0 });
    if (getppid() != daemon)
        _exit(127);
    if (lock_fd >= 0 && executor_lock_file(lock_fd, false))
        _exit(127); // the daemon has gone, and the next one is there
    const pid_t pid = fork();
    if (pid == 0)
        become(c, envp, fd, self, lock_fd, group);
    close_others(0, lock_fd); // the workers' sockets, the trigger's lines: not ours to hold
    if (pid < 0)
        _exit(127);
    setpgid(pid, pid);
    for (;;) {
        const int s = sigwaitinfo(&all, &info);
        if (s == SIGTERM) {
            kill(-pid, SIGTERM);
            kill(-pid, SIGCONT);
        } else if (s == SIGRTMIN) {
            kill(-pid, info.si_value.sival_int);
        } else if (s == SIGHUP || s == SIGQUIT || s == SIGINT) {
            kill(-pid, SIGKILL);
        } else if (s == SIGCHLD) {
            memset(&info, 0, sizeof(info));
            if (waitid(P_PID, (id_t)pid, &info, WEXITED | WNOHANG | WNOWAIT) || !info.si_pid)
                continue;
            kill(-pid, SIGKILL); // what it left behind; the group's number is not reused before it is waited for
            *group = 0;
            waitpid(pid, &status, 0);
            break;
        }
    }
    if (WIFSIGNALED(status)) { // end as it did
        sigset_t it;
        signal(WTERMSIG(status), SIG_DFL);
        sigemptyset(&it);
        sigaddset(&it, WTERMSIG(status));
        raise(WTERMSIG(status));
        sigprocmask(SIG_UNBLOCK, &it, NULL);
    }
    _exit(WIFEXITED(status) ? WEXITSTATUS(status) : 127);
}

// ---- starting -----------------------------------------------------------------------------------------------------------------

static int watch(struct executor *e, int fd, int job, int kind)
{
    struct epoll_event event = { .events = EPOLLIN, .data.u32 = (uint32_t)(job * 8 + kind) };
    return epoll_ctl(e->epoll_fd, EPOLL_CTL_ADD, fd, &event) ? -errno : 0;
}

static void close_fd(int *fd)
{
    if (*fd >= 0)
        close(*fd);
    *fd = -1;
}

static void forget(struct executor *e, int job)
{
    struct running *r = e->job[job];
    for (int k = 0; k < N_STREAMS; k++)
        close_fd(&r->stream[k].fd);
    close_fd(&r->pidfd);
    free(r);
    e->job[job] = NULL;
}

// environ with what the program should know.
static char **make_environment(bool progress)
{
    int n = 0;
    while (environ[n])
        n++;
    char **envp = calloc((size_t)n + 3, sizeof(*envp));
    int k = 0;
    for (int i = 0; envp && i < n; i++)
        if (strncmp(environ[i], "STUDIORIG_PROGRESS_FD=", 22) && strncmp(environ[i], "NOTIFY_SOCKET=", 14) && strncmp(environ[i], "WATCHDOG_", 9))
            envp[k++] = environ[i];
    if (envp && progress)
        envp[k++] = (char *)(uintptr_t)"STUDIORIG_PROGRESS_FD=3";
    return envp;
}

int executor_start(struct executor *e, const struct executor_command *c)
{
    int job = 0, err = 0, theirs[N_STREAMS] = { -1, -1, -1 }, pair[2];
    if (c->too_many || !c->n_words)
        return c->too_many ? -E2BIG : -EINVAL;
    while (job < EXECUTOR_JOBS_MAX && e->job[job])
        job++;
    if (job == EXECUTOR_JOBS_MAX)
        return -EMFILE;
    struct running *r = calloc(1, sizeof(*r));
    char **envp = make_environment(c->progress);
    if (!r || !envp) {
        free(r);
        free(envp);
        return -ENOMEM;
    }
    e->job[job] = r;
    r->pidfd = -1;
    for (int k = 0; k < N_STREAMS; k++)
        r->stream[k].fd = -1;
    for (int k = 0; k < N_STREAMS && !err; k++) {
        const bool to_log = k != PROGRESS && c->log_path[0];
        if (k == PROGRESS && !c->progress)
            continue;
        if (to_log && k == OUT)
            theirs[k] = open(c->log_path, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC | O_NOFOLLOW, 0644);
        else if (to_log)
            theirs[k] = fcntl(theirs[OUT], F_DUPFD_CLOEXEC, 16);
        if (to_log) {
            err = theirs[k] < 0 ? -errno : 0;
            continue;
        }
        if (pipe2(pair, O_CLOEXEC)) {
            err = -errno;
            break;
        }
        r->stream[k].fd = pair[0];
        theirs[k] = fcntl(pair[1], F_DUPFD_CLOEXEC, 16); // above what dup2 fills
        err = theirs[k] < 0 || fcntl(pair[0], F_SETFL, O_NONBLOCK) ? -errno : 0;
        close(pair[1]);
        if (!err)
            err = watch(e, r->stream[k].fd, job, k);
    }
    for (int k = 0; k < N_STREAMS && !err; k++) // a log may have got a low number
        if (theirs[k] >= 0 && theirs[k] < 16) {
            const int high = fcntl(theirs[k], F_DUPFD_CLOEXEC, 16);
            err = high < 0 ? -errno : 0;
            close(theirs[k]);
            theirs[k] = high;
        }
    if (!err) {
        const pid_t self = getpid();
        sigset_t all, old;
        e->group[job] = 0;
        sigfillset(&all);
        pthread_sigmask(SIG_BLOCK, &all, &old); // nothing of the daemon's is to run in the fork
        r->keeper = fork();
        if (r->keeper == 0)
            keep(c, envp, theirs, self, e->lock_fd, &e->group[job]);
        err = r->keeper < 0 ? -errno : 0;
        pthread_sigmask(SIG_SETMASK, &old, NULL);
    }
    if (!err) {
        r->pidfd = (int)syscall(SYS_pidfd_open, r->keeper, 0);
        err = r->pidfd < 0 ? -errno : watch(e, r->pidfd, job, PIDFD);
        if (err) {
            kill(r->keeper, SIGQUIT);
            waitpid(r->keeper, NULL, 0);
        }
    }
    for (int k = 0; k < N_STREAMS; k++)
        close_fd(&theirs[k]);
    free(envp);
    if (err)
        forget(e, job);
    return err ? err : job;
}

void executor_signal(struct executor *e, int job, enum executor_signal s)
{
    if (job < 0 || job >= EXECUTOR_JOBS_MAX || !e->job[job])
        return;
    const pid_t keeper = e->job[job]->keeper; // TERM and QUIT are its language; the others are queued: the last one asked for is what holds
    if (s == EXECUTOR_TERM || s == EXECUTOR_KILL)
        kill(keeper, s == EXECUTOR_TERM ? SIGTERM : SIGQUIT);
    else if (sigqueue(keeper, SIGRTMIN, (union sigval){ .sival_int = s == EXECUTOR_PAUSE ? SIGSTOP : SIGCONT }))
        log_error("executor: job %d cannot be %s: %s; raise the limit of pending signals (ulimit -i)", job, s == EXECUTOR_PAUSE ? "paused" : "continued", strerror(errno));
}

// ---- hearing ------------------------------------------------------------------------------------------------------------------

static void take_line(struct executor *e, int job, int kind, const char *line)
{
    struct running *r = e->job[job];
    if (!line[0])
        return;
    if (kind == PROGRESS) {
        e->host.line(e->host.arg, job, line);
    } else if (kind == OUT) {
        strcpy(r->said, line);
    } else {
        const bool is_error = strstr(line, "error") != NULL;
        if (is_error || !r->is_error)
            strcpy(r->complaint, line);
        r->is_error |= is_error;
    }
}

static void hear(struct executor *e, int job, int kind, bool all)
{
    struct stream *s = &e->job[job]->stream[kind];
    char bytes[4096];
    for (int turn = 0; s->fd >= 0 && (all || turn < READS_PER_TURN) && turn < 1024; turn++) {
        const ssize_t n = read(s->fd, bytes, sizeof(bytes));
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0)
            return;
        for (ssize_t i = 0; i < n; i++) {
            if (bytes[i] == '\n' || bytes[i] == '\r') {
                s->line[s->n] = 0;
                s->n = 0;
                s->too_long = false;
                take_line(e, job, kind, s->line);
            } else if (s->n == EXECUTOR_LINE_MAX - 1) {
                s->too_long = true;
            } else if (!s->too_long) {
                s->line[s->n++] = bytes[i] ? bytes[i] : ' ';
            }
        }
        if (n == 0) {
            s->line[s->n] = 0;
            s->n = 0;
            take_line(e, job, kind, s->line);
            close_fd(&s->fd); // leaves the epoll set by itself
        }
    }
}

static void end(struct executor *e, int job)
{
    struct running *r = e->job[job];
    int status;
    if (waitpid(r->keeper, &status, WNOHANG) != r->keeper)
        return;
    if (e->group[job] > 0) // the keeper was killed: the kernel ended the program, but not its children
        kill(-e->group[job], SIGKILL);
    for (int k = 0; k < N_STREAMS; k++)
        hear(e, job, k, true);
    for (int k = 0; k < N_STREAMS; k++) // a last line without its end
        if (r->stream[k].n) {
            r->stream[k].line[r->stream[k].n] = 0;
            take_line(e, job, k, r->stream[k].line);
        }
    const struct executor_end how = {
        .signalled = WIFSIGNALED(status), .code = WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status), .said = r->said, .complaint = r->complaint,
    };
    e->job[job] = NULL; // its number is free for what the host starts now
    e->host.ended(e->host.arg, job, &how);
    struct executor only = { .job[0] = r };
    forget(&only, 0);
}

void executor_dispatch(struct executor *e)
{
    struct epoll_event events[32];
    const int n = epoll_wait(e->epoll_fd, events, 32, 0);
    for (int i = 0; i < n; i++) {
        const int job = (int)(events[i].data.u32 / 8), kind = (int)(events[i].data.u32 % 8);
        if (!e->job[job])
            continue;
        if (kind == PIDFD)
            end(e, job);
        else
            hear(e, job, kind, false);
    }
}

// ---- life ---------------------------------------------------------------------------------------------------------------------

int executor_open(struct executor **out, const struct executor_host *host)
{
    struct executor *e = calloc(1, sizeof(*e));
    if (!e)
        return -ENOMEM;
    e->host = *host;
    e->lock_fd = -1;
    e->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    void *shared = mmap(NULL, EXECUTOR_JOBS_MAX * sizeof(pid_t), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (e->epoll_fd < 0 || shared == MAP_FAILED) {
        const int err = -errno;
        log_error("executor: cannot watch processes: %s", strerror(-err));
        if (e->epoll_fd >= 0)
            close(e->epoll_fd);
        free(e);
        return err;
    }
    e->group = shared;
    *out = e;
    return 0;
}

void executor_close(struct executor *e)
{
    if (!e)
        return;
    for (int i = 0; i < EXECUTOR_JOBS_MAX; i++)
        if (e->job[i])
            kill(e->job[i]->keeper, SIGQUIT);
    for (int i = 0; i < EXECUTOR_JOBS_MAX; i++)
        if (e->job[i]) {
            waitpid(e->job[i]->keeper, NULL, 0); // SIGKILL is on its way to all of them
            forget(e, i);
        }
    munmap((void *)(uintptr_t)e->group, EXECUTOR_JOBS_MAX * sizeof(pid_t));
    close(e->epoll_fd);
    free(e);
}

void executor_lock(struct executor *e, int fd)
{
    assert(fd > 3);
    e->lock_fd = fd;
}

int executor_fd(const struct executor *e)
{
    return e->epoll_fd;
}
