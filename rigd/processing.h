// rigd/processing.h - from verified to solved: which job comes next, as a state machine.
//
// Pure, as rig.h is: no process, file or clock. Inputs carry now_ns and may add actions; take them with processing_next() until it
// says false, carry them out in that order, and feed back what came of them. The same inputs give the same actions.
//
// A take goes through steps; each has items (develop: one per camera; the others: one), and each item is one process or one piece
// of file work. What holds at every moment:
//  - While the rig is at work (processing_hold) nothing is started, looked at or recorded, and what runs is paused.
//  - At most n_slots slots are used, and no more memory for developing than memory_bytes (one frame always fits).
//  - What is better comes first: contact sheets, then the newest take up to its preview, then older ones, then what has time
//    (focus, standard, final). A job that has time makes room, paused, for one that has not.
//  - A step begins when those that it needs are done; else it says which are missing. A failure harms nothing else: the take keeps
//    its state, and a note names camera, slot, file and remedy.
//  - A process that was killed is started once more; one that refuses is not.
//  - Nothing is made twice: before a step begins, the disk is asked what is there already, made from these inputs (PROCESSING_LOOK).
//    So a new life after kill -9 goes on where the old one was: takes that are owed are added, and looked at.
#pragma once
#include "rigd/ledger.h"

enum { PROCESSING_TEXT = LEDGER_NOTE_BYTES, PROCESSING_NOTES_MAX = LEDGER_NOTES_MAX };

enum processing_step {
    STEP_SHEET,       // contact sheet of the cameras' own thumbnails
    STEP_DEVELOP,     // linear/<camera>.exr, one item per camera
    STEP_PANORAMA,    // panorama.exr: merged of brackets, or the one of the panorama take before
    STEP_RECONSTRUCT, // geometry/: a fixed rig's, or the hook's
    STEP_PREVIEW,     // solve/preview
    STEP_FOCUS,       // the sheet again, of developed frames: focus and exposure
    STEP_STANDARD,    // solve/standard
    STEP_FINAL,       // solve/final
    PROCESSING_N_STEPS
};

enum processing_state {
    PROCESSING_OFF,      // not wanted
    PROCESSING_WAITING,  // for other steps, or for another take's panorama
    PROCESSING_LOOKING,  // what is there?
    PROCESSING_OPEN,     // items are queued or running
    PROCESSING_DONE,
    PROCESSING_FAILED,   // some item did: text
    PROCESSING_MISSING,  // cannot begin: text says what is missing
    PROCESSING_CANCELLED,
};

struct processing_settings {
    unsigned wanted;         // 1 << STEP_... of each take
    int n_slots;             // cores
    int n_develop;           // frames at a time
    int64_t memory_bytes;    // of developing
    int timeout_s[PROCESSING_N_STEPS];
};

enum processing_action_kind {
    PROCESSING_LOOK,     // what does this step owe?                          -> processing_looked
    PROCESSING_START,    // start item                                        -> processing_progress, processing_ended
    PROCESSING_STOP,     // ask it to end (SIGTERM)                           -> processing_ended
    PROCESSING_KILL,     //                                                   -> processing_ended
    PROCESSING_PAUSE,    // SIGSTOP
    PROCESSING_CONTINUE, // SIGCONT
    PROCESSING_KEEP,     // check what item made, name it, note it durably    -> processing_kept
    PROCESSING_FORGET,   // durably: what these steps (mask) made is owed anew, before any later LOOK
    PROCESSING_RECORD,   // take.json: processing_record()                    -> processing_recorded
    PROCESSING_STATE,    // step's state or counts changed: tell people
    PROCESSING_SETTLED,  // take: all is recorded, nothing more will happen
};

struct processing_action {
    enum processing_action_kind kind;
    char take[96];
    enum processing_step step;
    int item;
    unsigned mask; // FORGET
};

// What a LOOK found, per item.
enum processing_verdict {
    PRODUCT_THERE,   // made from these inputs, whole
    PRODUCT_OWED,    // to be made now
    PRODUCT_MISSING, // cannot be made: text
    PRODUCT_WAITS,   // for the panorama of another take: name
};
struct processing_item {
    enum processing_verdict verdict;
    char name[96];               // of the camera; WAITS: take
    char slot[96];               // its port
    int64_t memory_bytes;        // that making it takes
    char text[PROCESSING_TEXT];  // MISSING; THERE: what is worth saying
};

enum processing_how { JOB_DONE, JOB_REFUSED, JOB_KILLED, JOB_CANNOT_START };

struct processing; // the queue

int processing_create(struct processing **out, const struct processing_settings *settings); // settings are copied. 0 or -ENOMEM
void processing_free(struct processing *p);
bool processing_next(struct processing *p, struct processing_action *out);
int64_t processing_deadline_ns(const struct processing *p); // INT64_MAX: nothing is due

// ---- what happened -------------------------------------------------------------------------------------------------------
void processing_time(struct processing *p, int64_t now_ns);
void processing_hold(struct processing *p, int64_t now_ns, bool hold); // the rig is at work
// n may be 0: nothing to do, the step is done. text (NULL: none) is why the whole step cannot begin.
void processing_looked(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, const struct processing_item *items, int n,
                       const char *text);
void processing_progress(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, const char *stage, int64_t done, int64_t total);
void processing_ended(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, int item, enum processing_how how, const char *text);
// ok: text is what is worth saying about it ("not to be trusted: ..."); else why it could not be kept.
void processing_kept(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, int item, bool ok, const char *text);
void processing_recorded(struct processing *p, int64_t now_ns, const char *take, int err);

// ---- what is wanted ------------------------------------------------------------------------------------------------------
struct processing_take {
    const char *id;
    bool is_panorama; // brackets of the lights: developed when its panorama is merged
    bool is_owed;     // take.json says so already
    unsigned more;    // steps beside the settings' (asked for earlier; made earlier)
};
// A take that is there and settled begins again with what failed or was missing; `more` is added. 0 or -ENOMEM.
int processing_add(struct processing *p, int64_t now_ns, const struct processing_take *take);
// step is made anew, and what follows from it where that changed. 0, -ENOENT (not added), -EBUSY with why[200].
int processing_again(struct processing *p, int64_t now_ns, const char *take, enum processing_step step, char *why);
int processing_cancel(struct processing *p, int64_t now_ns, const char *take); // 0, -ENOENT
void processing_urge(struct processing *p, int64_t now_ns, const char *take);  // somebody waits for it: before all others

// ---- what is to be seen --------------------------------------------------------------------------------------------------
struct processing_step_view {
    enum processing_state state;
    int n_items, n_done, n_failed, n_running, n_paused;
    double began_s, ended_s;  // since the take was added; < 0: not yet. Made in an earlier life: 0, 0
    const char *text;         // why it failed, is missing; what is worth saying. ""
    const char *stage;        // of the process that tells: ""
    int64_t done, total;
};
int processing_n_takes(const struct processing *p); // in the order of adding; settled ones stay for a while
const char *processing_take_id(const struct processing *p, int i);
bool processing_is_settled(const struct processing *p, int i);
int processing_find(const struct processing *p, const char *take); // index or -1
struct processing_step_view processing_step(const struct processing *p, int i, enum processing_step step);
bool processing_is_idle(const struct processing *p); // all settled

// For take.json.
struct processing_record {
    enum take_state state;   // verified, developed or solved
    enum ledger_processing processing;
    int n_notes;
    char note[PROCESSING_NOTES_MAX][PROCESSING_TEXT];
    int64_t began_ns[PROCESSING_N_STEPS], ended_ns[PROCESSING_N_STEPS]; // of what was made in this life; INT64_MIN: was not
    int64_t utc_offset_ms; // the caller's: UTC less that clock
};
void processing_record(const struct processing *p, const char *take, struct processing_record *out);

const char *processing_step_name(enum processing_step step);   // "develop"
int processing_step_named(const char *name);                   // -1: none
const char *processing_state_name(enum processing_state state);
unsigned processing_followers(enum processing_step step);      // mask of step and of those that need it
