// rigd/workshop.h - processing.h's hands: processes, a thread for the takes' files, a timer.
//
// The daemon polls one descriptor, says when the rig is at work, and writes take.json when told to. Decisions are processing.c's,
// what lies in a take is products.c's business, programs are executor.c's.
#pragma once
#include "rigd/config.h"
#include "rigd/processing.h"
#include "solver/take/json.h"

struct workshop;

struct workshop_host {
    // take.json of this take is to say this: durably, then workshop_recorded(). Not called while held.
    void (*record)(void *arg, const char *take, const struct processing_record *record);
    void (*changed)(void *arg, const char *take, enum processing_step step);  // workshop_describe() has the news
    void (*progress)(void *arg, const char *take, enum processing_step step, const char *line); // as the program said it: a JSON object
    void (*settled)(void *arg, const char *take);
    void (*added)(void *arg, uint64_t token, const char *take, int err, const char *why); // of workshop_add
    void *arg;
};

// config is kept (borrowed). 0 or -errno (logged).
int workshop_open(struct workshop **out, const struct config *config, const char *takes_dir, const struct workshop_host *host);
void workshop_close(struct workshop *w); // what runs is killed; NULL allowed
int workshop_fd(const struct workshop *w); // readable: call dispatch
void workshop_dispatch(struct workshop *w);

void workshop_hold(struct workshop *w, bool hold); // the rig is at work
void workshop_recorded(struct workshop *w, const char *take, int err);

struct workshop_request {
    uint64_t token;   // 0: nobody asks
    int again;        // a step to be made anew, or -1
    unsigned more;    // steps beside the configured ones
    bool urgent;
};
void workshop_add(struct workshop *w, const char *take, const struct workshop_request *request);
int workshop_cancel(struct workshop *w, const char *take); // 0, -ENOENT: nothing of it is under way

unsigned workshop_wanted(const struct workshop *w); // steps that are configured, of each take
bool workshop_is_idle(const struct workshop *w);
bool workshop_is_settled(const struct workshop *w, const char *take); // also true for takes that it does not know
struct json *workshop_describe(const struct workshop *w, const char *take); // one take; NULL: it is not known
struct json *workshop_describe_all(const struct workshop *w);
