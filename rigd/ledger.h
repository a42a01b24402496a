// rigd/ledger.h - take.json: what a take owes, and what is safely here.
//
// Plain data first; the state machine (rig.h) owns one and writes into it, the daemon makes it durable when told to. A ledger on
// disk is always a whole one (temporary name, fsync, rename, fsync of the folder). Frames are named only when their bytes are
// synced and read back, so the folder can be ahead of the ledger but never behind: ledger_reconcile() brings them together after
// any crash, and the cards' listings (rig_request_resume) bring the rest.
#pragma once
#include "rigd/config.h"
#include "rigd/frame_facts.h"

enum { LEDGER_FORMAT = 1, LEDGER_OBJECTS_MAX = 8 }; // per camera and take

// A capture: one shot of all cameras, an entry of `camera` for each. A panorama: many exposures of one camera, an entry for each exposure.
enum ledger_kind { LEDGER_CAPTURE, LEDGER_PANORAMA, LEDGER_N_KINDS };

enum take_state { TAKE_IDLE, TAKE_PREFLIGHT, TAKE_ARMED, TAKE_EXPOSING, TAKE_COLLECTING, TAKE_VERIFIED, TAKE_DEVELOPED, TAKE_SOLVED, TAKE_FAILED, TAKE_N_STATES };

enum object_state {
    OBJECT_FOUND,    // on the card; where its copy goes is decided
    OBJECT_COPIED,   // the copy is here: hashed, synced, read back, named
    OBJECT_DELETED,  // and no longer on the card
    OBJECT_GONE,     // neither here nor on the card any more: lost, and said so
    OBJECT_N_STATES
};

struct ledger_object {
    struct camera_object object;
    enum object_state state;
    char file[64];       // "raw/A01.nef", relative to the take
    char xxh128[33];     // of the copy; "" before
    int n_retries;
    int64_t copied_ms;   // from the shot until the copy was safe; -1 not known
};

// What happens after the frames are here (processing.h).
enum ledger_processing {
    LEDGER_UNPROCESSED, // not asked for
    LEDGER_OWED,        // begins, or goes on, with the next start
    LEDGER_SETTLED,     // all done, or notes say what is missing
    LEDGER_CANCELLED,
    LEDGER_N_PROCESSING
};
enum { LEDGER_NOTES_MAX = 12, LEDGER_NOTE_BYTES = 240, LEDGER_SOLVES_MAX = 3 };

// One stage of a take's time line: button (press to shutters), exposed, thumbnails (all there), collected, verified, then the steps of processing.h by name.
struct ledger_stage {
    char name[16];
    int64_t began_utc_ms, ended_utc_ms;
};
enum { LEDGER_STAGES_MAX = 16 };

struct ledger_solve {
    char name[16];                // preview, standard, final: solve/<name>
    bool trusted;
    double rmse_held_out_percent; // NAN: none was held out
    double seconds;
    char why[200];                // why it is not to be trusted
};

enum debt { DEBT_OPEN, DEBT_PAID, DEBT_MISSED }; // all expected objects copied | given up, see note

// Which one of a panorama's this is.
struct ledger_exposure {
    int stop, bracket;      // from 0
    double yaw_deg, pitch_deg;
    double wanted_s;        // true time, a power of two in thirds of a stop
    char label[16];         // of it, on the dial
    int object;             // whose facts these are; -1: none yet
    bool rejected;          // not the frame that was wanted, note says why
    struct frame_facts facts;
};

struct ledger_camera {
    char name[24], serial[40], port[96], model[64], firmware[40], lens[64];
    int battery_percent;
    bool expected;              // it takes part; false: left out (quarantined before the shot), see note
    enum debt debt;
    char note[200];             // why it was left out, missed or quarantined, and what to do
    int n_before;               // newest object of each store before the shot: everything later is the take's
    struct camera_object before[CAMERA_STORES_MAX];
    bool has_until;             // a later take exists: what is later than until[], or on a store without one, belongs to it
    int n_until;
    struct camera_object until[CAMERA_STORES_MAX]; // not on disk: ledger_bound() finds it
    int64_t delay_us;           // lag compensation applied
    int64_t lag_ns;             // flash-sync after the press; INT64_MIN: not measured
    int n_settings;
    struct camera_setting_found setting[CAMERA_SETTINGS_MAX]; // read back
    int n_objects;
    struct ledger_object object[LEDGER_OBJECTS_MAX];
    bool is_exposure;           // of a panorama: name is "STOP_BRACKET"
    struct ledger_exposure exposure;
    char developed[64];         // "linear/A01.exr"; ""
    double clipped_share, developed_s; // of it: photosites that are clipped; seconds it took
};

struct ledger {
    char id[96];                // folder name: <UTC date>T<time>_<name>
    char name[64];
    char created[32];           // UTC, ISO 8601
    enum ledger_kind kind;
    enum take_state state;
    char reason[200];           // of failed
    char panorama_take[96];     // of a capture: the newest panorama take there was; ""
    int n_stops;                // of a panorama, as planned
    struct config_stop stop[CONFIG_STOPS_MAX];
    int objects_per_shot;
    bool synchronised;          // pressed by lines, not by drivers
    int64_t shot_utc_ms;        // when the shutters were pressed; 0: not yet
    int64_t spread_ns, sigma_ns; // over measured bodies; -1: not measured
    int n_measured;
    int64_t jitter_ns;          // how late the press was; -1
    int n_stages;
    struct ledger_stage stage[LEDGER_STAGES_MAX];
    enum ledger_processing processing;
    char panorama_from[96];     // the panorama take whose panorama.exr this one's is; "": none, or its own
    int n_notes;                // what went wrong in processing, or is worth knowing: camera, slot, file, remedy
    char process_note[LEDGER_NOTES_MAX][LEDGER_NOTE_BYTES];
    int n_solves;
    struct ledger_solve solve[LEDGER_SOLVES_MAX];
    int n_cameras;
    struct ledger_camera *camera; // in the order of the configuration
};

// Every configured camera expected, with an open debt. Out of memory: camera is NULL.
void ledger_init(struct ledger *l, const struct config *config);
// No entry yet: ledger_expose() adds them.
void ledger_init_panorama(struct ledger *l, const struct config *config);
// One more exposure of the panorama camera, expected, with an open debt: its number, or -ENOMEM, -EFBIG.
int ledger_expose(struct ledger *l, const struct config *config, int stop, int bracket, double wanted_s);
// The true time nearest to seconds, and what dials call it: 1/125 for 2^-7 s.
double ledger_exposure_label(double seconds, char label[16]);
void ledger_free(struct ledger *l);
bool ledger_owns(const struct ledger_camera *c, const struct camera_object *o); // later than before[], not later than until[]?
struct ledger_object *ledger_find(struct ledger_camera *c, const struct camera_object *o); // same folder and name; NULL
// A new object of a camera with the name of its copy: raw/<camera>.<ext> (panorama/raw/<stop>_<bracket>.<ext>), the second of one extension raw/<camera>_2.<ext>.
// NULL when there are LEDGER_OBJECTS_MAX already.
struct ledger_object *ledger_add(struct ledger_camera *c, const struct camera_object *o);

char *ledger_text(const struct ledger *l);                      // JSON, malloc'd; NULL without memory
void ledger_note_stage(struct ledger *l, const char *name, int64_t began_utc_ms, int64_t ended_utc_ms); // made anew: the later one stands
int ledger_commit(const char *text, const char *take_dir);      // take.json, durable when it returns 0; else -errno (logged), the old one stands
int ledger_read(struct ledger *out, const char *take_dir);      // 0, -ENOENT, -EINVAL (logged); *out zeroed on failure
int ledger_parse(struct ledger *out, const char *text, size_t n_bytes, const char *name);

// Create takes_dir/id with raw/, thumbnails/, linear/ and geometry/cameras/ (panorama/raw/) and its first ledger, whole and durable or not at all.
// -EEXIST if there is one. 0 or -errno (logged).
int ledger_create(const char *text, enum ledger_kind kind, const char *id, const char *takes_dir);
void ledger_remove_leftovers(const char *takes_dir); // of creations and of ledgers that a crash ended; for the start of the daemon

// Bring ledger and disk together after a crash: remove *.part, hash frames that are here but not yet noted (they become COPIED),
// take back COPIED notes whose file is missing, short or different (the copy is set aside as <name>.damaged, never deleted).
struct ledger_findings { int n_adopted, n_taken_back, n_parts_removed, n_strangers; };
int ledger_reconcile(struct ledger *l, const char *take_dir, struct ledger_findings *found); // 0 or -errno (logged)

// Remove *.part in the take and its folders, when nothing is copied any more: what a worker that was killed had begun. 0 or -errno.
int ledger_remove_parts(const char *take_dir, int *n_removed);

// Which frames belong to this take and not to later ones: look at the ledgers in takes_dir that come after it. 0 or -errno (logged).
int ledger_bound(struct ledger *l, const char *takes_dir);

// Every object of every expected camera copied (or deleted after copying) and no debt left?
bool ledger_is_whole(const struct ledger *l);
const char *take_state_name(enum take_state s); // "idle" ...
