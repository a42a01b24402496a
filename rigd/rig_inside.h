// rigd/rig_inside.h - the rig's inside, shared by rig.c, rig_body.c, rig_answers.c, rig_take.c and rig_panorama.c only.
#pragma once
#include "rigd/rig.h"

#define MS INT64_C(1000000)
#define S (1000 * MS)

enum {
    STARTING_MAX = 16,        // workers that are started and opened at once: more only fight for the processor
    READY_WAIT_S = 20,        // preflight and arming wait so long for a body that is being opened
    GRACE_MS = 1000,          // an answer may be so much later than the command's timeout
    GREETING_MS = 8000,       // from spawn to HELLO
    BUSY_MS = 5000,           // back-off in all
    TROUBLE_MS = 14500,       // ladder in all, counted from
    SILENCE_MS = 4000,        // when the command was sent that failed, but at most so long before it did: drivers wait 3 s for an answer
    POWER_OFF_MS = 1500, POWER_ON_MS = 2000, RELAY_OFF_MS = 2000, RELAY_ON_MS = 2500,
    REOPEN_MS = 1000,         // between tries when the ladder has no rung left
    STARTS_AT_ONCE = 5,       // of a worker in one trouble: a rung each; then REOPEN_MS between them
    QUARANTINE_MS = 60000,    // between tries from quarantine
    DRAIN_QUIET_MS = 200,
    ADJUST_QUIET_MS = 50,     // between exposures of a panorama: this camera was drained, and has only been listened to since
    PROGRESS_MS = 6000,       // a copy without a byte for so long is stalled
    TRIES_MAX = 3, DISK_TRIES_MAX = 10, COMMIT_TRIES_MAX = 30, FIRE_TRIES_MAX = 3,
    AWAKE_HALF_PRESS_MS = 150, DRIVER_PRESS_MS = 8000, // of the panorama camera
    TURN_MS = 60000, TURN_TRIES_MAX = 3, // a head takes so long at most
    FIRE_LEAD_MS = 150,       // from the decision to half-press: the board is told of each body first, 200 of them in some 60 ms
    AFTER_EXPOSURE_MS = 100,
    UNMEASURED_LAG_MS = 350,  // from full-press to the open shutter, of a body whose lag is not known; one that slept takes so long
    FEEDBACK_WAIT_MS = 1000,  // calibration: flash-sync contacts close within
    RECONCILE_MS = 4000,      // how long a card is listed again before a frame counts as missed
    LATE_MS = 2,              // a shutter further than this from the median is named
    MAX_DELAY_US = 990000,
    FINDINGS_MAX = 4 * CONFIG_CAMERAS_MAX,
    CONTROLLERS_MAX = 256,
};

// TURN to NOTE: of a panorama, before each exposure (rig_panorama.c).
enum phase { PHASE_IDLE, PHASE_PREFLIGHT, PHASE_ARM, PHASE_CREATE, PHASE_TURN, PHASE_STILL, PHASE_ADJUST, PHASE_NOTE, PHASE_FIRE, PHASE_EXPOSE, PHASE_COLLECT, PHASE_MANIFEST, PHASE_SETTLE, PHASE_DELETE, PHASE_END };
enum purpose { FOR_PREFLIGHT, FOR_TAKE, FOR_LAG, FOR_RESUME, FOR_PANORAMA };
enum step { STEP_NONE, STEP_CONFIGURE, STEP_STATUS, STEP_DRAIN, STEP_BEFORE, STEP_COLLECT, STEP_RECONCILE, STEP_COPY, STEP_DELETE };

struct body {
    const struct config_camera *config;
    enum rig_condition condition;
    bool worker, greeted, killing;  // a process is there | said HELLO | was killed and has not gone yet
    bool reset_next;                // the next OPEN resets the port
    struct {
        bool on;
        enum camera_command_kind kind;
        int object;                 // FETCH, DELETE: which of the ledger's
        int64_t since_ns;           // sent, or last PROGRESS
        int64_t due_ns, limit_ns;   // due moves on with PROGRESS, the limit does not
    } flight;
    uint32_t seq;
    int n_starts;       // of its worker, in this trouble
    int64_t start_ns;   // 0, or when its worker is to be started again
    int64_t greet_due_ns, retry_ns, busy_since_ns, heartbeat_ns;
    int n_busy, n_failed;

    int64_t trouble_ns; // 0: none
    int rung, n_recoveries;
    enum camera_command_kind suspect; // trouble is over when this works again
    enum { WIRED, POWER_IS_OFF, RELAY_IS_CUT } supply;
    int64_t again_ns; // from quarantine
    char note[200];

    bool part;       // of the take under way
    enum step step;
    bool identify, identifying, press, thumbed; // identifying: somebody waits for RIG_IDENTIFIED
    int64_t owed_due_ns; // RECONCILE: miss it after
    bool saw_nothing;    // RECONCILE: the card was listed and holds nothing new
    struct camera_object cursor[CAMERA_STORES_MAX];
    int n_cursor;
    uint64_t noted[LEDGER_OBJECTS_MAX];
    int64_t flash_ns; // INT64_MIN: not seen
    int64_t bytes_now;
    struct camera_facts facts;
    struct camera_status status;
    bool has_status;
    int n_settings;
    struct camera_setting_found setting[CAMERA_SETTINGS_MAX];
    struct lag lag;
    double *sample_ms;
    int n_samples;
};

struct rig {
    const struct config *config;
    int n;
    struct body *body;
    int abilities; // of the trigger; -1: none

    enum phase phase;
    enum purpose purpose;
    int64_t phase_due_ns;
    int n_pending, n_wanted; // bodies with a step | that the take wants
    bool cancelled, without_missing, on_button;
    char outcome[200]; // why the last take, preflight or calibration failed; "" it did not
    bool created; // the take's folder is there
    bool has_ledger;
    struct ledger ledger;
    char takes_dir[300];
    int64_t utc_ms, utc_at_ns; // wall clock at a monotonic time

    bool space_known;
    int64_t free_bytes;

    uint64_t change, covered, durable; // the ledger's changes: made | in the commit under way | on disk
    bool committing;
    int n_commit_failures;
    int64_t commit_retry_ns;

    struct {
        int entry;                    // the ledger's exposure under way
        int n_tries;                  // at it
        int stop_at, n_turns;         // where the head stands, -1: not known | how often it was asked to go to the present stop
        int64_t turn_limit_ns;        // TURN: a head that is busy is waited for so long
        bool turn_again;              // TURN: the head failed, and is asked again when the phase is due
        int n_old, looked;            // resumed: that many entries of before, up to this one looked for on the card
        bool looking;                 // COLLECT without an exposure: on the card of an earlier life
        bool list_before;             // resumed: what is on the card now is none of ours
        double metered_s, shortest_s, longest_s; // as far as the camera accepts them
        char prompt[320];             // what a person is asked to do; ""
        bool attended;                // somebody is there who turns the head
        bool refused;                 // the shutter setting
        bool failed;                  // r->outcome says why; the plan is written all the same
        char lost[200];               // the camera; why
        char judge[CAMERA_LENS_MAX];
    } panorama;

    int n_fire_tries, n_shots, n_shots_wanted, n_shots_most;
    int64_t at_ns, pressed_ns, late_ns, released_ns, quiet_until_ns, shot_ns, thumbed_ns; // thumbed: the last thumbnail came; 0: none
    uint32_t *delay_us;
    uint64_t skip[CONFIG_CAMERAS_MAX / 64];

    int copying[CONTROLLERS_MAX];
    int n_findings;
    struct rig_finding *finding;

    struct rig_action *queue; // a ring
    int queue_begin, queue_n, queue_room;
};

// rig.c
struct rig_action *rig_act(struct rig *r, enum rig_action_kind kind, int camera);
__attribute__((format(printf, 4, 5))) void rig_say(struct rig *r, enum rig_severity severity, int camera, const char *format, ...);
__attribute__((format(printf, 4, 5))) void rig_find(struct rig *r, enum rig_severity severity, int camera, const char *format, ...);
uint64_t rig_changed(struct rig *r);
void rig_set_state(struct rig *r, enum take_state state);
struct ledger_camera *rig_entry(struct rig *r, int i);
void rig_settle(struct rig *r, int64_t now);
int rig_may_begin(const struct rig *r, bool needs_trigger, char *why);
void rig_new_ledger(struct rig *r); // empty: the caller fills it
void rig_name_take(struct rig *r, int64_t now, const struct rig_take *take);

// rig_body.c
void rig_set_step(struct rig *r, int i, enum step step);
const char *rig_remedy(enum camera_trouble trouble);
void rig_explain(char why[200], const char *found, const char *to_do);
void rig_give_up(struct rig *r, int i, const char *why);
bool rig_is_silent(const struct rig *r);
bool rig_rests(const struct rig *r);
bool rig_is_copy(enum camera_command_kind kind);
void rig_flight_ends(struct rig *r, struct body *b);
void rig_copy_next(struct rig *r, int controller, int64_t now);
void rig_begin_reconcile(struct rig *r, int i, int64_t now);
void rig_collect_from_card(struct rig *r, int i, int64_t now);
void rig_look_at_debt(struct rig *r, int i, int64_t now);
int rig_to_delete(struct rig *r, int i);
void rig_pump(struct rig *r, int i, int64_t now);
void rig_pump_all(struct rig *r, int64_t now);
void rig_start_worker(struct rig *r, int i, int64_t now);
void rig_kill_worker(struct rig *r, int i);
void rig_start_more(struct rig *r, int64_t now);
void rig_identified(struct rig *r, int i, const char *why); // why "": it was
void rig_restore_supply(struct rig *r, int i);
void rig_quarantine(struct rig *r, int i, int64_t now, const char *why);
void rig_trouble(struct rig *r, int i, int64_t now, int64_t since, enum camera_command_kind suspect, const char *text);
void rig_works_again(struct rig *r, int i, int64_t now, enum camera_command_kind kind);
void rig_body_time(struct rig *r, int i, int64_t now);

// rig_take.c
void rig_finish(struct rig *r, int64_t now);
__attribute__((format(printf, 3, 4))) void rig_fail_take(struct rig *r, int64_t now, const char *format, ...);
void rig_begin_preflight(struct rig *r, int64_t now);
void rig_check_status(struct rig *r, int i);
bool rig_too_many_missing(struct rig *r, int64_t now);
void rig_end_preflight(struct rig *r, int64_t now);
void rig_begin_fire(struct rig *r, int64_t now);
void rig_begin_collect(struct rig *r, int64_t now);
void rig_begin_manifest(struct rig *r);
void rig_end_collect(struct rig *r, int64_t now);
void rig_begin_delete(struct rig *r, int64_t now);

// rig_panorama.c
void rig_panorama_unprompt(struct rig *r);
bool rig_makes_panoramas(const struct rig *r, int i); // this body, now
bool rig_pressed_by_driver(const struct rig *r);      // the panorama camera has no shutter line of its own
void rig_panorama_next(struct rig *r, int64_t now);   // an exposure is settled: what now?
void rig_panorama_phase_over(struct rig *r, int64_t now); // TURN to NOTE: is it?
void rig_panorama_time(struct rig *r, int64_t now);
void rig_panorama_collected(struct rig *r, int64_t now);
void rig_panorama_configured(struct rig *r, int i);   // CONFIGURE was answered, in ADJUST
void rig_panorama_frame(struct rig *r, int k, const struct camera_event *e); // a copy is here
int rig_resume_panorama(struct rig *r, int64_t now, struct ledger *old, const char *takes_dir, char *why);
