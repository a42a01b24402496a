// rigd/products.h - what a take has been made into, and what that was made from.
//
// processing.json in the take is the memory: for each product the key of its inputs - a hash over raws, settings, versions and the
// identity (size, time of change) of other files. What is there, whole, and noted under the key of today's inputs is not made again.
// A note is written only when its product has its final name, so after kill -9 the worst is that something is made twice.
// Pieces that a person put there (panorama.exr, geometry/) have no note and are never replaced.
//
// Everything here touches the disk: not for the loop's thread. One thread at a time per take.
#pragma once
#include "rigd/config.h"
#include "rigd/executor.h"
#include "rigd/processing.h"

struct products;

struct products_site { // what is the same for all takes
    const struct config *config;
    const char *takes_dir;
    const char *programs_dir; // of rigd-develop, rigd-panorama, rigd-contact, rigsolve
    int n_threads;            // for solves
};

// Reads take.json and processing.json (broken: set aside with a warning, everything is looked at anew). 0 or -errno (logged).
int products_open(struct products **out, const struct products_site *site, const char *id); // *site stays the caller's
void products_close(struct products *p); // NULL allowed

struct products_facts {
    bool is_panorama;
    enum take_state state;
    enum ledger_processing processing;
    unsigned noted; // mask of steps that were made or asked for earlier
};
void products_facts(const struct products *p, struct products_facts *out);

// What a step owes. *items is malloc'd, *n items; text is why the step cannot begin, "" if it can. 0 or -errno (logged).
int products_look(struct products *p, enum processing_step step, struct processing_item **items, int *n, char text[PROCESSING_TEXT]);

// Ready to make item: *out is what to start, or has n_words 0 - then it was file work, and is done. -errno: text says why not.
int products_begin(struct products *p, enum processing_step step, int item, struct executor_command *out, char text[PROCESSING_TEXT]);

// The process has ended well after so many seconds; said is its last line. Gives the product its final name and notes it. 0 (text: worth saying) or -errno (text: why not).
int products_keep(struct products *p, enum processing_step step, int item, const char *said, double seconds, char text[PROCESSING_TEXT]);

// Why a process that kept a log failed: its last words. said: what was heard.
void products_complaint(const struct products *p, enum processing_step step, const char *heard, int code, char text[PROCESSING_TEXT]);

int products_forget(struct products *p, unsigned steps); // 0 or -errno (logged)

// take.json of a take that nobody else changes now: state, notes, what was developed and solved. 0 or -errno (logged).
int products_record(const char *take_dir, const struct processing_record *record);
