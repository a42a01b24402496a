// rigd/config.h - rigd.conf: which cameras, which wires, what is wanted of them.
//
// INI (config/*.conf are complete examples). Everything is checked when it is read: an error names the file, the line, what was
// found, what was expected and what to do. Unknown sections and keys are errors; so is a serial, port, line or name used twice,
// and a line that the INI reader would cut (200 characters; section names 49).
#pragma once
#include "rigd/camera.h"
#include "rigd/lens.h"

enum { CONFIG_CAMERAS_MAX = 256, CONFIG_NONE = -1, CONFIG_CAPTURE = -2, CONFIG_STOPS_MAX = 64, CONFIG_FRAMES_MAX = 32, CONFIG_SHOTS_FACTOR = 4 };

struct config_camera {       // [camera "A01"]
    char name[24];           // letters, digits, - and _: it names files
    char serial[40];         // "" : any body (a warning of preflight)
    char port[96];           // usb:1-4.3 | ptpip:HOST:PORT:EVENTPORT
    char model[64];          // driver's name of the body; "" by detection
    char personality[256];   // path of NAME.conf: in personality_dir, else in cameras/ beside rigd.conf, else as installed; "" none
    char lens[64];           // as the body reports it, "": not checked
    int full_line, half_line; // trigger channels of this body alone; CONFIG_NONE: it hangs on the common lines
    int feedback_line;       // flash-sync input; CONFIG_NONE; CONFIG_CAPTURE: the board's exact one ("capture", kind = usb)
    int relay_line;          // output that cuts its supply when set; CONFIG_NONE
    char power[48];          // "1-4:3": hub and port that can switch its USB power; ""
    int controller;          // bodies with the same number share one USB controller (the slot's bus + 1; PTP/IP: 0)
    int n_settings;          // [settings] with this camera's own "setting.NAME = VALUE" on top
    struct camera_setting setting[CAMERA_SETTINGS_MAX];
};

enum trigger_kind { TRIGGER_SOFTWARE, TRIGGER_GPIO, TRIGGER_USB, TRIGGER_SIMULATED };

struct trigger_config {      // [trigger]
    enum trigger_kind kind;
    char chip[64];           // gpio: "gpiochip0" or a chip's label
    char address[108];       // simulated: Unix socket of rigsim's trigger input
    int full_line, half_line; // common lines; CONFIG_NONE
    bool active_low;
    int button_line;         // CONFIG_NONE
    bool button_active_low, feedback_active_low;
    uint32_t button_debounce_ms;
    uint32_t half_press_ms;  // half-press before full-press; 0: no half-press
    uint32_t hold_ms;        // full-press
    uint32_t max_hold_ms;    // no line stays pressed longer, whatever anyone asks; at most 10000
    // usb. Lines are the outputs of the board's chain of registers, 8 each, number 0 next to the board; feedback lines its inputs.
    char serial[40];         // of the board; "": the only one
    int output_registers;    // wired: fewer would leave the last ones with what was shifted through them
    // The panorama head's motors, yaw and pitch. steps_per_turn 0: none; negative: wired the other way round.
    int head_steps_per_turn[2];
    double head_deg_per_s, head_deg_per_s2;
    double head_limit_deg[2]; // either way from home
    bool head_home_switch;    // yes: it looks for its switches before the first move; no: it stands at home when rigd starts
};

struct web_config {          // [web], rigd/web.h
    char listen[64];         // "127.0.0.1:8420", "[::1]:8420"; port 0: any free one; "": no page
    bool token_always;       // on a loopback address, too; others want it anyway
};

enum develop_quality { DEVELOP_AHD, DEVELOP_BILINEAR, DEVELOP_HALF };
enum solve_then { SOLVE_THEN_OFF, SOLVE_THEN_STANDARD, SOLVE_THEN_FINAL };

// What happens once the frames are here. Without a [develop] section: nothing; without [solve]: no solve.
struct process_config {
    // [develop]
    bool develop;             // after = on
    enum develop_quality demosaic;
    char flat[256];           // frame of an even white, or folder of <camera>.exr; "": none
    char colour[256];         // gains and scales of all bodies (rigctl calibrate colour), or folder of <camera>.json; "": none
    int develop_jobs;         // frames at a time; 0: one per core
    uint32_t memory_mb;       // of developing; 0: half of what the machine has
    uint32_t develop_timeout_s, panorama_timeout_s;
    // [reconstruct]
    char command[190];        // words; the take's path is added. "": none
    char calibrated[256];     // a fixed rig's mesh.*, cameras and start.json; "": none
    uint32_t reconstruct_timeout_s;
    // [solve]
    bool preview;
    enum solve_then then;
    char options[190];        // words for rigsolve solve
    int solve_threads;        // 0: all cores
    char solve_program[256];  // "": rigsolve beside rigd
    uint32_t solve_timeout_s;
};

enum head_kind { HEAD_NONE, HEAD_MANUAL, HEAD_BOARD }; // the camera stays where it is | a person turns it | the trigger does

struct config_stop { double yaw_deg, pitch_deg; }; // as trigger_head(): yaw to the left seen from above, pitch up

struct panorama_config {     // [panorama]
    char camera_name[24];    // "": there is no [panorama]
    int camera;              // its number: config_panorama_camera()
    enum head_kind head;
    struct lens lens;
    double max_angle_deg;
    double nodal_offset_m;   // entrance pupil in front of the point about which the head turns
    double overlap;          // of neighbouring stops, where they are planned and not listed
    int n_stops;
    struct config_stop stop[CONFIG_STOPS_MAX];
    double meter_s;          // first exposure of each stop; labels as on the dial, as in setting.shutter
    double shortest_s, longest_s; // no exposure beyond
    int frames_max;          // per stop; at most CONFIG_FRAMES_MAX
    uint32_t settle_ms;      // from the head's rest to the first exposure
    double neutral_density_ev; // of a filter in front of the lens
};

struct config {
    // [rig]
    char name[64];
    char takes_dir[300], socket_path[108], state_dir[300]; // state_dir: lag.json
    char personality_dir[256];
    int objects_per_shot;
    uint32_t raw_mb;             // largest raw, for the check of free space and free images
    uint32_t free_space_mb;      // left over after a take
    bool delete_after_verify;    // from the card, after hash, sync and read-back
    bool thumbnails;
    int fetch_limit;             // parallel downloads per controller
    uint32_t heartbeat_s;
    int battery_min_percent;
    double clock_max_s;
    uint32_t collect_timeout_ms; // from the shot until a body must have announced its objects
    uint32_t fetch_timeout_ms;   // one object, however slow, while bytes keep coming
    int may_miss;                // cameras a take may leave out because they are not fit
    // [calibration]
    int calibration_shots;       // at least; up to CONFIG_SHOTS_FACTOR times as many
    double lag_within_ms;        // until the mean of each body is known so well; 0: no more shots than calibration_shots
    double lag_max_std_ms;
    struct trigger_config trigger;
    struct web_config web;
    struct process_config process;
    struct panorama_config panorama;
    int n_cameras;
    struct config_camera *camera; // in the file's order: the camera numbers of all of rigd
};

// The number of the camera that makes panoramas and takes no part in ordinary takes. CONFIG_NONE: there is none.
static inline int config_panorama_camera(const struct config *c)
{
    return c->panorama.camera_name[0] ? c->panorama.camera : CONFIG_NONE;
}

// 0; -ENOENT..., -EINVAL (every finding logged, at most 20). *out is zeroed on failure.
int config_read(struct config *out, const char *path);
// The same from memory; name for errors. Personality files are not looked for.
int config_parse(struct config *out, const char *text, size_t n_bytes, const char *name);
void config_free(struct config *config);
