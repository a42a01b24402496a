// rigd/panorama_plan.h - panorama.json: which frames were shot where, and with what.
//
//   { "lens": {...},                     rigd/lens.h
//     "nodal_offset_m": 0.002,           entrance pupil from the head's axes: declared, not corrected (default 0)
//     "neutral_density_ev": 0,           filter before the lens: the scene is 2^this brighter (default 0; frames may differ)
//     "colour": "colour.json" | {"gains": [r, g, b], "scale": s},        rigd/colour.h; absent: 1
//     "srgb_from_camera": [9 numbers],   absent: what the raws say
//     "sensor": {"electrons_at_white": w, "read_noise_e": s},            at the frames' ISO; absent: measured from the frames
//     "stops": [ {"name": "s01", "yaw_deg": 0, "pitch_deg": 0, "roll_deg": 0,      to the left, up, clockwise: lens_head(); default 0
//                 "frames": [ {"file": "raw/s01_01.dng", "exposure_s": 0.0078125, "neutral_density_ev": 0}, ... ]}, ... ] }
//
// exposure_s: the true time, where it is known better than from the file. Files are relative to the plan's folder. Frames in the order in
// which they were shot.
#pragma once
#include "rigd/bracket.h"
#include "rigd/lens.h"

enum { PANORAMA_STOPS_MAX = 256, PANORAMA_FRAMES_MAX = 64, PANORAMA_NAME_MAX = 64, PANORAMA_FILE_MAX = 1024 };

struct panorama_frame {
    char *file;        // as opened: with the plan's folder before it
    double exposure_s; // 0: the file's own
    double neutral_density_ev;
};

struct panorama_stop {
    char name[PANORAMA_NAME_MAX];
    double yaw_deg, pitch_deg, roll_deg;
    int n_frames; // 0 is allowed: a stop that was missed is a finding, not an error
    struct panorama_frame *frame;
};

struct panorama_plan {
    struct lens lens;
    double nodal_offset_m;
    bool has_colour, has_matrix;
    double gains[3], scale; // 1 if not has_colour
    double srgb_from_camera[9];
    char *colour_file;          // or NULL
    struct sensor_noise sensor; // electrons_at_white 0: not given
    int n_stops;
    struct panorama_stop *stop;
};

// 0; errors, logged with file, key, found, expected: those of json_read, -EINVAL, -ENOMEM. Zeroed on failure. folder: before file names.
int panorama_plan_read(struct panorama_plan *out, const char *path);
int panorama_plan_parse(struct panorama_plan *out, const char *text, size_t n_bytes, const char *name_for_errors, const char *folder);
void panorama_plan_free(struct panorama_plan *p); // leaves it zeroed
