// rigd/workshop.c - carries out what processing.c decides.
//
// Tasks that touch a take's files go to one thread, in order; their answers come back through an eventfd. A take's struct products is
// the thread's alone: the loop only passes the pointer on.
#include "rigd/workshop.h"
#include "rigd/executor.h"
#include "rigd/products.h"
#include "solver/take/log.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum task_kind { TASK_OPEN, TASK_JOIN, TASK_LOOK, TASK_BEGIN, TASK_KEEP, TASK_COMPLAIN, TASK_FORGET, TASK_CLOSE };

struct task {
    struct task *next;
    enum task_kind kind;
    struct bench *bench;
    enum processing_step step;
    int item, code, err;
    unsigned mask;
    double seconds;
    struct workshop_request request;
    struct products_facts facts;
    struct processing_item *items;
    int n_items;
    struct executor_command command;
    char said[EXECUTOR_LINE_MAX], text[PROCESSING_TEXT];
};

struct bench { // one take
    char id[96];
    struct products *products; // the thread's
    bool is_open;
    int n_tasks;
};

struct run { // by the executor's job number
    bool used;
    struct bench *bench;
    enum processing_step step;
    int item;
    int64_t began_ns;
};

struct beginning { // started, but not yet a process
    struct beginning *next;
    struct bench *bench;
    enum processing_step step;
    int item;
    bool stopped, paused;
};

struct workshop {
    struct workshop_host host;
    struct products_site site;
    char takes_dir[300], programs_dir[PATH_MAX];
    struct processing *processing;
    unsigned wanted;
    struct executor *executor;
    struct run run[EXECUTOR_JOBS_MAX];
    struct bench **bench;
    int n_benches;
    int epoll_fd, timer_fd, answer_fd;
    int lock_fd; // takes/.processing.lock
    pthread_t thread;
    bool thread_runs, obeying;
    pthread_mutex_t lock;
    pthread_cond_t wake;
    struct task *todo, *done, *prepared; // prepared: what processes said, until it is kept
    struct beginning *beginning;
    bool ends;
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

// ---- the thread ---------------------------------------------------------------------------------------------------------------

static void work(struct workshop *w, struct task *t)
{
    struct bench *b = t->bench;
    switch (t->kind) {
    case TASK_OPEN:
        products_close(b->products);
        b->products = NULL;
        t->err = products_open(&b->products, &w->site, b->id);
        if (!t->err)
            products_facts(b->products, &t->facts);
        return;
    case TASK_LOOK:
        t->err = products_look(b->products, t->step, &t->items, &t->n_items, t->text);
        if (t->err)
            snprintf(t->text, sizeof(t->text), "the take cannot be read: %s; the journal names the file", strerror(-t->err));
        return;
    case TASK_BEGIN:
        t->err = products_begin(b->products, t->step, t->item, &t->command, t->text);
        return;
    case TASK_KEEP:
        t->err = products_keep(b->products, t->step, t->item, t->said, t->seconds, t->text);
        return;
    case TASK_COMPLAIN:
        products_complaint(b->products, t->step, t->said, t->code, t->text);
        return;
    case TASK_FORGET:
        t->err = products_forget(b->products, t->mask);
        return;
    case TASK_JOIN:
        return;
    case TASK_CLOSE:
        products_close(b->products);
        b->products = NULL;
        return;
    }
}

// However a rigd ends, its programs need a moment to be gone, and a keeper that is stopped keeps its program: as long as any of them
// is there, nothing of ours may touch what it writes. They hold the lock (executor_lock). False: we are to end.
static bool wait_for_predecessors(struct workshop *w)
{
    bool go_on = true;
    int err;
    for (int n = 0; go_on && (err = executor_lock_file(w->lock_fd, true)); n++) {
        if (err != -EAGAIN) {
            log_warning("workshop: %s/.processing.lock: %s; programs of an earlier rigd cannot be waited for", w->takes_dir, strerror(-err));
            return true;
        }
        if (n == 100)
            log_warning("workshop: programs of another rigd are at work in %s: takes are processed when they are gone; find them with fuser %s/.processing.lock", w->takes_dir,
                        w->takes_dir);
        nanosleep(&(struct timespec){ 0, 20000000 }, NULL);
        pthread_mutex_lock(&w->lock);
        go_on = !w->ends;
        pthread_mutex_unlock(&w->lock);
    }
    if (go_on)
        executor_lock_file(w->lock_fd, false); // ours share it
    return go_on;
}

static void append(struct task **list, struct task *t)
{
    t->next = NULL;
    while (*list)
        list = &(*list)->next;
    *list = t;
}

static void *thread(void *arg)
{
    struct workshop *w = arg;
    const uint64_t one = 1;
    if (!wait_for_predecessors(w))
        return NULL;
    pthread_mutex_lock(&w->lock);
    while (!w->ends) {
        struct task *t = w->todo;
        if (!t) {
            pthread_cond_wait(&w->wake, &w->lock);
            continue;
        }
        w->todo = t->next;
        pthread_mutex_unlock(&w->lock);
        work(w, t);
        pthread_mutex_lock(&w->lock);
        append(&w->done, t);
        if (write(w->answer_fd, &one, sizeof(one)) < 0)
            break; // cannot fail: nobody counts to 2^64
    }
    pthread_mutex_unlock(&w->lock);
    return NULL;
}

static struct task *new_task(enum task_kind kind, struct bench *b, enum processing_step step, int item)
{
    struct task *t = calloc(1, sizeof(*t));
    if (!t)
        abort(); // systemd starts us again, and what is owed is found again
    t->kind = kind;
    t->bench = b;
    t->step = step;
    t->item = item;
    b->n_tasks++;
    return t;
}

static void give(struct workshop *w, struct task *t)
{
    pthread_mutex_lock(&w->lock);
    append(&w->todo, t);
    pthread_cond_signal(&w->wake);
    pthread_mutex_unlock(&w->lock);
}

static void free_task(struct task *t)
{
    free(t->items);
    executor_command_free(&t->command);
    free(t);
}

static void obey(struct workshop *w);

// ---- takes --------------------------------------------------------------------------------------------------------------------

static struct bench *find_bench(const struct workshop *w, const char *id)
{
    for (int i = 0; i < w->n_benches; i++)
        if (!strcmp(w->bench[i]->id, id))
            return w->bench[i];
    return NULL;
}

static struct bench *make_bench(struct workshop *w, const char *id)
{
    struct bench *b = find_bench(w, id);
    if (b)
        return b;
    struct bench **grown = realloc(w->bench, ((size_t)w->n_benches + 1) * sizeof(*grown));
    b = calloc(1, sizeof(*b));
    if (!grown || !b)
        abort();
    w->bench = grown;
    snprintf(b->id, sizeof(b->id), "%s", id);
    return w->bench[w->n_benches++] = b;
}

// A take that is settled and that nobody asks about: its products are forgotten.
static void sweep(struct workshop *w)
{
    for (int i = 0; i < w->n_benches; i++) {
        struct bench *b = w->bench[i];
        if (b->n_tasks || !workshop_is_settled(w, b->id))
            continue;
        if (b->is_open) {
            b->is_open = false;
            give(w, new_task(TASK_CLOSE, b, 0, 0));
        } else {
            free(b);
            memmove(w->bench + i, w->bench + i + 1, (size_t)(--w->n_benches - i) * sizeof(*w->bench));
            i--;
        }
    }
}

void workshop_add(struct workshop *w, const char *take, const struct workshop_request *request)
{
    struct bench *b = make_bench(w, take);
    struct task *t = new_task(TASK_OPEN, b, 0, 0);
    t->request = *request;
    if (b->is_open && !workshop_is_settled(w, take)) { // under way: its notes are what they are
        t->kind = TASK_JOIN;
    }
    give(w, t);
}

static void opened(struct workshop *w, struct task *t)
{
    struct bench *b = t->bench;
    const struct workshop_request *r = &t->request;
    char why[200] = "";
    int err = t->err;
    if (!err && t->kind == TASK_OPEN) {
        b->is_open = true;
        const struct processing_take what = {
            .id = b->id, .is_panorama = t->facts.is_panorama, .is_owed = t->facts.processing == LEDGER_OWED, .more = t->facts.noted | r->more,
        };
        err = processing_add(w->processing, now_ns(), &what);
    } else if (!err) {
        const struct processing_take what = { .id = b->id, .is_owed = true, .more = r->more };
        const int i = processing_find(w->processing, b->id);
        if (i >= 0 && r->more)
            err = processing_add(w->processing, now_ns(), &what);
    } else {
        snprintf(why, sizeof(why), "take.json or processing.json cannot be read: %s; the journal names the file", strerror(-err));
    }
    if (!err && r->again >= 0)
        err = processing_again(w->processing, now_ns(), b->id, (enum processing_step)r->again, why);
    if (!err && r->urgent)
        processing_urge(w->processing, now_ns(), b->id);
    w->host.added(w->host.arg, r->token, b->id, err, why);
}

int workshop_cancel(struct workshop *w, const char *take)
{
    if (workshop_is_settled(w, take))
        return -ENOENT;
    const int err = processing_cancel(w->processing, now_ns(), take);
    obey(w);
    return err;
}

// ---- processes ----------------------------------------------------------------------------------------------------------------

static int find_run(const struct workshop *w, const char *take, enum processing_step step, int item)
{
    for (int i = 0; i < EXECUTOR_JOBS_MAX; i++)
        if (w->run[i].used && w->run[i].step == step && w->run[i].item == item && !strcmp(w->run[i].bench->id, take))
            return i;
    return -1;
}

static void prepare_to_keep(struct workshop *w, struct bench *b, enum processing_step step, int item, const char *said, double seconds)
{
    struct task *t = new_task(TASK_KEEP, b, step, item);
    snprintf(t->said, sizeof(t->said), "%s", said);
    t->seconds = seconds;
    append(&w->prepared, t);
}

static void on_line(void *arg, int job, const char *line)
{
    struct workshop *w = arg;
    const struct run *r = &w->run[job];
    struct json *v = NULL;
    const char *stage = "";
    int64_t done = 0, total = 0;
    if (json_parse(&v, line, strlen(line), NULL))
        return; // chatter
    if (json_length(v, "") >= 0) { // an array: it is passed on as an object, and who adds to it would be mistaken
        json_free(v);
        return;
    }
    json_get_string(v, "stage", &stage);
    json_get_int(v, "done", &done);
    json_get_int(v, "total", &total);
    processing_progress(w->processing, now_ns(), r->bench->id, r->step, stage, done, total);
    w->host.progress(w->host.arg, r->bench->id, r->step, line);
    json_free(v);
}

static void on_ended(void *arg, int job, const struct executor_end *end)
{
    struct workshop *w = arg;
    const struct run r = w->run[job];
    w->run[job].used = false;
    if (end->signalled) {
        processing_ended(w->processing, now_ns(), r.bench->id, r.step, r.item, JOB_KILLED, strsignal(end->code));
    } else if (end->code == 0 || (r.step != STEP_RECONSTRUCT && end->code == 3)) { // 3: done, not to be trusted; its report says why
        prepare_to_keep(w, r.bench, r.step, r.item, end->said, 1e-9 * (double)(now_ns() - r.began_ns));
        processing_ended(w->processing, now_ns(), r.bench->id, r.step, r.item, JOB_DONE, NULL);
    } else {
        struct task *t = new_task(TASK_COMPLAIN, r.bench, r.step, r.item);
        snprintf(t->said, sizeof(t->said), "%s", end->complaint);
        t->code = end->code;
        give(w, t);
    }
}

static struct beginning *find_beginning(struct workshop *w, const char *take, enum processing_step step, int item)
{
    for (struct beginning *b = w->beginning; b; b = b->next)
        if (b->step == step && b->item == item && !strcmp(b->bench->id, take))
            return b;
    return NULL;
}

static struct beginning forget_beginning(struct workshop *w, const struct task *t)
{
    struct beginning *b = find_beginning(w, t->bench->id, t->step, t->item), **at = &w->beginning, copy = { 0 };
    if (!b)
        return copy;
    while (*at != b)
        at = &(*at)->next;
    *at = b->next;
    copy = *b;
    free(b);
    return copy;
}

static void begun(struct workshop *w, struct task *t)
{
    struct bench *b = t->bench;
    const struct beginning mark = forget_beginning(w, t);
    if (t->err) {
        processing_ended(w->processing, now_ns(), b->id, t->step, t->item, JOB_REFUSED, t->text);
        return;
    }
    if (!t->command.n_words) { // file work, and done
        prepare_to_keep(w, b, t->step, t->item, "", 0);
        processing_ended(w->processing, now_ns(), b->id, t->step, t->item, JOB_DONE, NULL);
        return;
    }
    if (mark.stopped) {
        processing_ended(w->processing, now_ns(), b->id, t->step, t->item, JOB_KILLED, "stopped before it began");
        return;
    }
    const int job = executor_start(w->executor, &t->command);
    if (job < 0) {
        snprintf(t->text, sizeof(t->text), "cannot start %.120s: %s", t->command.word[0], strerror(-job));
        processing_ended(w->processing, now_ns(), b->id, t->step, t->item, JOB_CANNOT_START, t->text);
        return;
    }
    w->run[job] = (struct run){ .used = true, .bench = b, .step = t->step, .item = t->item, .began_ns = now_ns() };
    if (mark.paused)
        executor_signal(w->executor, job, EXECUTOR_PAUSE);
}

static void send(struct workshop *w, const struct processing_action *a, enum executor_signal signal)
{
    const int job = find_run(w, a->take, a->step, a->item);
    struct beginning *b = find_beginning(w, a->take, a->step, a->item);
    if (job >= 0)
        executor_signal(w->executor, job, signal);
    else if (b && (signal == EXECUTOR_TERM || signal == EXECUTOR_KILL))
        b->stopped = true;
    else if (b)
        b->paused = signal == EXECUTOR_PAUSE;
}

// ---- what processing.c decides --------------------------------------------------------------------------------------------------

static void keep(struct workshop *w, const struct processing_action *a)
{
    for (struct task **at = &w->prepared; *at; at = &(*at)->next) {
        struct task *t = *at;
        if (t->step == a->step && t->item == a->item && !strcmp(t->bench->id, a->take)) {
            *at = t->next;
            give(w, t);
            return;
        }
    }
}

static void carry_out(struct workshop *w, const struct processing_action *a)
{
    static struct processing_record record;
    struct bench *b = find_bench(w, a->take);
    struct beginning *mark;
    struct timespec utc;
    struct task *t;
    if (!b)
        return;
    switch (a->kind) {
    case PROCESSING_LOOK:
        give(w, new_task(TASK_LOOK, b, a->step, 0));
        return;
    case PROCESSING_START:
        mark = calloc(1, sizeof(*mark));
        if (!mark)
            abort();
        *mark = (struct beginning){ .next = w->beginning, .bench = b, .step = a->step, .item = a->item };
        w->beginning = mark;
        give(w, new_task(TASK_BEGIN, b, a->step, a->item));
        return;
    case PROCESSING_STOP:
        send(w, a, EXECUTOR_TERM);
        return;
    case PROCESSING_KILL:
        send(w, a, EXECUTOR_KILL);
        return;
    case PROCESSING_PAUSE:
        send(w, a, EXECUTOR_PAUSE);
        return;
    case PROCESSING_CONTINUE:
        send(w, a, EXECUTOR_CONTINUE);
        return;
    case PROCESSING_KEEP:
        keep(w, a);
        return;
    case PROCESSING_FORGET:
        t = new_task(TASK_FORGET, b, 0, 0);
        t->mask = a->mask;
        give(w, t);
        return;
    case PROCESSING_RECORD:
        processing_record(w->processing, a->take, &record);
        clock_gettime(CLOCK_REALTIME, &utc);
        record.utc_offset_ms = (int64_t)utc.tv_sec * 1000 + utc.tv_nsec / 1000000 - now_ns() / 1000000;
        w->host.record(w->host.arg, a->take, &record);
        return;
    case PROCESSING_STATE:
        w->host.changed(w->host.arg, a->take, a->step);
        return;
    case PROCESSING_SETTLED:
        w->host.settled(w->host.arg, a->take);
        return;
    }
}

static void obey(struct workshop *w)
{
    struct processing_action a;
    if (w->obeying)
        return; // a host that calls back from within: the loop below sees to it
    w->obeying = true;
    while (processing_next(w->processing, &a))
        carry_out(w, &a);
    w->obeying = false;
    sweep(w);
    const int64_t due = processing_deadline_ns(w->processing);
    struct itimerspec when = { 0 }; // disarmed
    if (due != INT64_MAX) {
        when.it_value.tv_sec = due / 1000000000;
        when.it_value.tv_nsec = due % 1000000000 + (due <= 0); // 0, 0 would disarm it
    }
    timerfd_settime(w->timer_fd, TFD_TIMER_ABSTIME, &when, NULL);
}

static void answered(struct workshop *w, struct task *t)
{
    struct bench *b = t->bench;
    const int64_t now = now_ns();
    b->n_tasks--;
    switch (t->kind) {
    case TASK_OPEN:
    case TASK_JOIN:
        opened(w, t);
        return;
    case TASK_LOOK:
        processing_looked(w->processing, now, b->id, t->step, t->items, t->n_items, t->err || t->text[0] ? t->text : NULL);
        return;
    case TASK_BEGIN:
        begun(w, t);
        return;
    case TASK_KEEP:
        processing_kept(w->processing, now, b->id, t->step, t->item, !t->err, t->text);
        return;
    case TASK_COMPLAIN:
        processing_ended(w->processing, now, b->id, t->step, t->item, t->code == 127 ? JOB_CANNOT_START : JOB_REFUSED, t->text);
        return;
    case TASK_FORGET:
    case TASK_CLOSE:
        return;
    }
}

static void take_answers(struct workshop *w)
{
    uint64_t n;
    if (read(w->answer_fd, &n, sizeof(n)) < 0)
        return;
    pthread_mutex_lock(&w->lock);
    struct task *list = w->done;
    w->done = NULL;
    pthread_mutex_unlock(&w->lock);
    while (list) {
        struct task *next = list->next;
        answered(w, list);
        free_task(list);
        list = next;
    }
}

void workshop_dispatch(struct workshop *w)
{
    uint64_t n;
    take_answers(w);
    executor_dispatch(w->executor);
    if (read(w->timer_fd, &n, sizeof(n)) > 0)
        processing_time(w->processing, now_ns());
    obey(w);
}

void workshop_hold(struct workshop *w, bool hold)
{
    processing_hold(w->processing, now_ns(), hold);
    obey(w);
}

void workshop_recorded(struct workshop *w, const char *take, int err)
{
    processing_recorded(w->processing, now_ns(), take, err);
    obey(w);
}

// ---- what is to be seen -------------------------------------------------------------------------------------------------------

unsigned workshop_wanted(const struct workshop *w)
{
    return w->wanted;
}

bool workshop_is_idle(const struct workshop *w)
{
    for (int i = 0; i < w->n_benches; i++)
        if (w->bench[i]->n_tasks)
            return false;
    return processing_is_idle(w->processing);
}

bool workshop_is_settled(const struct workshop *w, const char *take)
{
    const int i = processing_find(w->processing, take);
    return i < 0 || processing_is_settled(w->processing, i);
}

static void put(struct json *o, const char *key, const char *value)
{
    if (value[0])
        json_set_string(o, key, value);
}

static struct json *describe_step(const struct workshop *w, int take, enum processing_step step)
{
    const struct processing_step_view v = processing_step(w->processing, take, step);
    struct json *o = json_new_object();
    json_set_string(o, "step", processing_step_name(step));
    json_set_string(o, "state", v.state == PROCESSING_OPEN && !v.n_running ? v.n_paused ? "paused" : "queued" : processing_state_name(v.state));
    json_set_int(o, "n", v.n_items);
    json_set_int(o, "n_done", v.n_done);
    if (v.n_failed)
        json_set_int(o, "n_failed", v.n_failed);
    if (v.n_running)
        json_set_int(o, "n_running", v.n_running);
    if (v.began_s >= 0)
        json_set_number(o, "began_s", v.began_s);
    if (v.ended_s >= 0)
        json_set_number(o, "ended_s", v.ended_s);
    put(o, "stage", v.stage);
    if (v.total > 0) {
        json_set_int(o, "done", v.done);
        json_set_int(o, "total", v.total);
    }
    put(o, "text", v.text);
    return o;
}

static struct json *describe_number(const struct workshop *w, int i)
{
    struct json *o = json_new_object(), *steps = json_new_array();
    json_set_string(o, "take", processing_take_id(w->processing, i));
    json_set_bool(o, "settled", processing_is_settled(w->processing, i));
    for (int s = 0; s < PROCESSING_N_STEPS; s++)
        if (processing_step(w->processing, i, s).state != PROCESSING_OFF)
            json_append(steps, describe_step(w, i, s));
    json_set(o, "steps", steps);
    return o;
}

struct json *workshop_describe(const struct workshop *w, const char *take)
{
    const int i = processing_find(w->processing, take);
    return i < 0 ? NULL : describe_number(w, i);
}

struct json *workshop_describe_all(const struct workshop *w)
{
    struct json *list = json_new_array();
    for (int i = 0; i < processing_n_takes(w->processing); i++)
        json_append(list, describe_number(w, i));
    return list;
}

// ---- life ---------------------------------------------------------------------------------------------------------------------

static int n_cores(void)
{
    cpu_set_t set;
    return sched_getaffinity(0, sizeof(set), &set) ? 1 : CPU_COUNT(&set);
}

// RIGD_TOOLS, else where this program lies.
static int find_programs(struct workshop *w)
{
    const char *named = getenv("RIGD_TOOLS");
    const ssize_t n = named ? (ssize_t)strlen(named) : readlink("/proc/self/exe", w->programs_dir, sizeof(w->programs_dir) - 1);
    if (n <= 0 || n >= (ssize_t)sizeof(w->programs_dir)) {
        log_error("workshop: cannot tell where rigd-develop and the others are; name their folder in RIGD_TOOLS");
        return -ENAMETOOLONG;
    }
    if (named) {
        memcpy(w->programs_dir, named, (size_t)n + 1);
    } else {
        w->programs_dir[n] = 0;
        *strrchr(w->programs_dir, '/') = 0;
    }
    return setenv("RIGD_TOOLS", w->programs_dir, 1) ? -errno : 0; // for hooks
}

static void settle_settings(const struct workshop *w, const struct config *config, struct processing_settings *s)
{
    const struct process_config *c = &config->process;
    const int64_t machine = (int64_t)sysconf(_SC_PHYS_PAGES) * sysconf(_SC_PAGESIZE);
    *s = (struct processing_settings){ .n_slots = n_cores(), .wanted = w->wanted };
    s->n_develop = c->develop_jobs ? c->develop_jobs : s->n_slots;
    s->memory_bytes = c->memory_mb ? (int64_t)c->memory_mb << 20 : machine / 2;
    for (int k = 0; k < PROCESSING_N_STEPS; k++)
        s->timeout_s[k] = (int)c->solve_timeout_s;
    s->timeout_s[STEP_DEVELOP] = (int)c->develop_timeout_s;
    s->timeout_s[STEP_SHEET] = s->timeout_s[STEP_FOCUS] = s->timeout_s[STEP_PANORAMA] = (int)c->panorama_timeout_s;
    s->timeout_s[STEP_RECONSTRUCT] = (int)c->reconstruct_timeout_s;
}

static unsigned configured(const struct process_config *c)
{
    unsigned mask = c->develop ? 1u << STEP_SHEET | 1u << STEP_DEVELOP | 1u << STEP_PANORAMA | 1u << STEP_FOCUS : 0;
    mask |= (c->preview ? 1u << STEP_PREVIEW : 0) | (c->then == SOLVE_THEN_STANDARD ? 1u << STEP_STANDARD : 0) | (c->then == SOLVE_THEN_FINAL ? 1u << STEP_FINAL : 0);
    if (c->preview || c->then != SOLVE_THEN_OFF || c->command[0] || c->calibrated[0])
        mask |= 1u << STEP_RECONSTRUCT;
    return mask;
}

static int watch(struct workshop *w, int fd)
{
    struct epoll_event e = { .events = EPOLLIN, .data.fd = fd };
    return fd < 0 || epoll_ctl(w->epoll_fd, EPOLL_CTL_ADD, fd, &e) ? -errno : 0;
}

int workshop_open(struct workshop **out, const struct config *config, const char *takes_dir, const struct workshop_host *host)
{
    struct processing_settings settings;
    char path[PATH_MAX];
    struct workshop *w = calloc(1, sizeof(*w));
    if (!w)
        return -ENOMEM;
    const struct executor_host hands = { on_line, on_ended, w };
    w->host = *host;
    pthread_mutex_init(&w->lock, NULL);
    pthread_cond_init(&w->wake, NULL);
    snprintf(w->takes_dir, sizeof(w->takes_dir), "%s", takes_dir);
    w->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    w->timer_fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK);
    w->answer_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    w->lock_fd = -1;
    w->wanted = configured(&config->process);
    settle_settings(w, config, &settings);
    w->site = (struct products_site){ .config = config, .takes_dir = w->takes_dir, .programs_dir = w->programs_dir,
                                      .n_threads = config->process.solve_threads ? config->process.solve_threads : settings.n_slots };
    int err = find_programs(w);
    if (!err) {
        snprintf(path, sizeof(path), "%s/.processing.lock", w->takes_dir);
        w->lock_fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0644);
        err = w->lock_fd < 0 ? -errno : 0;
        if (err)
            log_error("workshop: %s: %s", path, strerror(-err));
    }
    if (!err)
        err = processing_create(&w->processing, &settings);
    if (!err)
        err = executor_open(&w->executor, &hands);
    if (!err)
        executor_lock(w->executor, w->lock_fd);
    if (!err)
        err = w->epoll_fd < 0 ? -errno : watch(w, w->timer_fd);
    if (!err)
        err = watch(w, w->answer_fd);
    if (!err)
        err = watch(w, executor_fd(w->executor));
    if (!err)
        err = -pthread_create(&w->thread, NULL, thread, w);
    if (err) {
        log_error("workshop: cannot begin: %s", strerror(-err));
        workshop_close(w);
        return err;
    }
    w->thread_runs = true;
    *out = w;
    return 0;
}

static void free_tasks(struct task *list)
{
    while (list) {
        struct task *next = list->next;
        free_task(list);
        list = next;
    }
}

void workshop_close(struct workshop *w)
{
    if (!w)
        return;
    if (w->thread_runs) {
        pthread_mutex_lock(&w->lock);
        w->ends = true; // after what it is at; the rest is owed
        pthread_cond_signal(&w->wake);
        pthread_mutex_unlock(&w->lock);
        pthread_join(w->thread, NULL);
    }
    executor_close(w->executor);
    processing_free(w->processing);
    free_tasks(w->todo);
    free_tasks(w->done);
    free_tasks(w->prepared);
    while (w->beginning) {
        struct beginning *next = w->beginning->next;
        free(w->beginning);
        w->beginning = next;
    }
    for (int i = 0; i < w->n_benches; i++) {
        products_close(w->bench[i]->products);
        free(w->bench[i]);
    }
    free(w->bench);
    const int fds[] = { w->epoll_fd, w->timer_fd, w->answer_fd, w->lock_fd };
    for (int i = 0; i < 4; i++)
        if (fds[i] >= 0)
            close(fds[i]);
    free(w);
}

int workshop_fd(const struct workshop *w)
{
    return w->epoll_fd;
}
