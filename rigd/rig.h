// rigd/rig.h - the rig as a state machine: events and times in, actions out.
//
// Pure: no socket, thread, file or clock. Every input carries now_ns (CLOCK_MONOTONIC in the daemon, anything ascending in tests)
// and may add actions; take them with rig_next() until it says false, carry them out in that order, and feed back what came of
// them. rig_deadline_ns() says when rig_time() is due if nothing happens before. 200 cameras take milliseconds, and the same
// inputs give the same actions.
//
// A take: idle -> preflight -> armed -> exposing -> collecting -> verified, or failed with a reason. What holds at every step:
//  - Nothing is sent to any camera between the last answer before half-press and the end of the exposure.
//  - The ledger with every card's newest object is durable before the shutters are pressed; the name of every copy is durable before
//    it is fetched; a frame is deleted (only if configured) after its hash and `verified` are durable.
//  - Each expected camera ends with its debt paid or missed, with a note naming slot and remedy. Events alone are not believed:
//    what was not announced is looked for on the card.
//  - A camera in trouble climbs a ladder - again, open anew, reset, port power, relay - and is quarantined 15 s after it fell
//    silent. The others do not wait for it, except at the end of the take.
#pragma once
#include "rigd/calibrate.h"
#include "rigd/camera.h"
#include "rigd/ledger.h"
#include "rigd/trigger.h"

struct rig;

enum rig_severity { RIG_INFO, RIG_WARNING, RIG_ERROR };

enum rig_action_kind {
    RIG_SPAWN,    // start camera's worker                  -> HELLO, or rig_worker_gone
    RIG_KILL,     // kill camera's worker (SIGKILL)         -> rig_worker_gone
    RIG_SEND,     // command to camera's worker             -> its events
    RIG_POWER,    // USB power of camera's port: on         -> nothing
    RIG_RELAY,    // supply of camera: on                   -> nothing
    RIG_SPACE,    // free space of the takes' file system   -> rig_space
    RIG_CREATE,   // ledger_create(rig_ledger())            -> rig_committed
    RIG_COMMIT,   // ledger_commit(rig_ledger() as it is now) -> rig_committed
    RIG_FIRE,     // trigger_fire(shot); its arrays live until fired -> rig_fired (also when refused)
    RIG_RELEASE,  // trigger_release
    RIG_MANIFEST, // manifest of the take                   -> rig_manifest_written
    RIG_STATE,    // the state changed: tell people
    RIG_SAY,      // severity, camera or CONFIG_NONE, text: tell people
    RIG_PREFLIGHT_DONE, // findings are in rig_finding()
    RIG_TAKE_DONE, // rig_ledger() is final, and durable
    RIG_LAG_DONE,  // rig_lag() is measured: keep it
    RIG_IDENTIFIED, // camera was told; text on failure
    RIG_HEAD,       // trigger_head(yaw_mdeg, pitch_mdeg)   -> rig_head_arrived (also when refused)
    RIG_PROMPT,     // on: ask a person to do what text says -> rig_continue; off: no more
    RIG_PROGRESS,   // of a panorama: tell people
};

enum rig_step { RIG_STEP_TURN, RIG_STEP_EXPOSE, RIG_STEP_FRAME, RIG_STEP_STOP_DONE };

struct rig_progress {
    enum rig_step step;
    int stop, n_stops, bracket;
    double yaw_deg, pitch_deg;
    char label[16];  // EXPOSE, FRAME: the exposure time
    char text[200];  // FRAME, STOP_DONE: what was found
};

struct rig_action {
    enum rig_action_kind kind;
    int camera;
    union {
        struct camera_command command; // RIG_SEND
        struct trigger_shot shot;      // RIG_FIRE
        struct rig_progress progress;  // RIG_PROGRESS
        struct { int32_t yaw_mdeg, pitch_mdeg; } head; // RIG_HEAD
    };
    bool on;                           // RIG_POWER, RIG_RELAY, RIG_PROMPT
    enum rig_severity severity;        // RIG_SAY
    char text[320];                    // RIG_SAY, RIG_IDENTIFIED, RIG_PROMPT
};

// config is kept (borrowed). 0 or -ENOMEM.
int rig_create(struct rig **out, const struct config *config);
void rig_free(struct rig *rig);
bool rig_next(struct rig *rig, struct rig_action *out);
int64_t rig_deadline_ns(const struct rig *rig); // INT64_MAX: nothing is due

// ---- what happened -------------------------------------------------------------------------------------------------------
void rig_start(struct rig *rig, int64_t now_ns); // once, first: opens every camera
void rig_time(struct rig *rig, int64_t now_ns);
void rig_camera_event(struct rig *rig, int64_t now_ns, int camera, const struct camera_event *e);
void rig_worker_gone(struct rig *rig, int64_t now_ns, int camera, const char *how); // "killed by SIGSEGV", "exit 1", "cannot start: ..."
void rig_trigger_is(struct rig *rig, int64_t now_ns, int abilities);                // trigger_abilities(); -1: no trigger, or a broken one
void rig_fired(struct rig *rig, int64_t now_ns, int err, int64_t pressed_ns, int64_t late_ns);
void rig_feedback(struct rig *rig, int64_t now_ns, int camera, int64_t at_ns);
void rig_press_camera(struct rig *rig, int64_t now_ns, int camera); // trigger_host.press_camera
void rig_space(struct rig *rig, int64_t now_ns, int64_t free_bytes); // < 0: -errno
void rig_committed(struct rig *rig, int64_t now_ns, int err);        // in the order of RIG_CREATE and RIG_COMMIT
void rig_manifest_written(struct rig *rig, int64_t now_ns, int err);
void rig_head_arrived(struct rig *rig, int64_t now_ns, int err); // trigger_host.head_arrived

// ---- what is wanted ------------------------------------------------------------------------------------------------------
// 0, or -EBUSY (a take is under way), -ENOTCONN (no trigger), -EINVAL (no such camera), with a sentence in why[200].
struct rig_take {
    const char *id, *name, *created;
    int64_t utc_ms;
    const char *takes_dir;
    const char *panorama_take; // capture: the newest panorama there is; NULL
    bool on_button;            // capture: armed, then the trigger itself fires when its button is pressed (TRIGGER_WAITS; -EINVAL without)
};
int rig_capture(struct rig *rig, int64_t now_ns, const struct rig_take *take, bool without_missing, char *why);
// A take of kind panorama: for each stop the head turns (or a person turns it: RIG_PROMPT), then the panorama camera alone is exposed as
// bracket_next() asks for, frame by frame; each is fetched and judged before the next. -EINVAL: no [panorama] in the configuration.
int rig_panorama(struct rig *rig, int64_t now_ns, const struct rig_take *take, char *why);
int rig_continue(struct rig *rig, int64_t now_ns, char *why); // what RIG_PROMPT asked for is done
// Preflight alone.
int rig_preflight(struct rig *rig, int64_t now_ns, char *why);
// Shots without frames fetched: lag per body. n_shots at least; up to CONFIG_SHOTS_FACTOR times as many while lag_more_shots() asks for
// them. Frames stay on the cards.
int rig_calibrate(struct rig *rig, int64_t now_ns, int n_shots, char *why);
// Finish a take of an earlier life; ledger (reconciled with the disk) is taken over and zeroed when 0 is returned. A panorama keeps the
// exposures that are here or on the card, and shoots those that are missing: with a head that is turned by hand only if attended.
int rig_resume(struct rig *rig, int64_t now_ns, struct ledger *ledger, const char *takes_dir, bool attended, char *why);
int rig_identify(struct rig *rig, int64_t now_ns, int camera, char *why);
int rig_reinstate(struct rig *rig, int64_t now_ns, int camera, char *why); // out of quarantine, or anew
int rig_cancel(struct rig *rig, int64_t now_ns, char *why); // before the shutters are pressed, also while the button is waited for; later the frames are collected all the same
void rig_stop(struct rig *rig, int64_t now_ns); // release the trigger, close the cameras; a take under way stays resumable

// ---- what is to be seen --------------------------------------------------------------------------------------------------
enum rig_condition { RIG_OFF, RIG_STARTING, RIG_OPENING, RIG_READY, RIG_RECOVERING, RIG_QUARANTINED };

struct rig_camera_view {
    enum rig_condition condition;
    bool busy;                // a command is being carried out
    enum camera_command_kind command;
    const char *note;         // last trouble, or why quarantined; ""
    const struct camera_facts *facts;
    const struct camera_status *status;
    const struct camera_setting_found *setting;
    int n_settings;
    struct lag lag;           // n == 0: not measured
    int n_recoveries;         // since start
    int64_t bytes_now;        // of the copy under way
};
struct rig_camera_view rig_camera(const struct rig *rig, int camera);

struct rig_finding { enum rig_severity severity; int camera; char text[200]; }; // of the last preflight; camera CONFIG_NONE: the rig
int rig_n_findings(const struct rig *rig);
const struct rig_finding *rig_finding(const struct rig *rig, int i);

enum take_state rig_state(const struct rig *rig); // of the take under way, TAKE_IDLE without one
const char *rig_outcome(const struct rig *rig);   // why the last take, preflight or calibration failed; "": it did not
const char *rig_prompt(const struct rig *rig);    // what a person is asked to do; "": nothing
bool rig_is_busy(const struct rig *rig);          // capture would be refused
bool rig_waits_for_button(const struct rig *rig); // armed: the next press fires, with no decision of this host in between
const struct ledger *rig_ledger(const struct rig *rig); // of the take under way or the last one; NULL: none yet
void rig_set_lag(struct rig *rig, const struct lag *lag); // as read from lag.json
const char *rig_condition_name(enum rig_condition c);
