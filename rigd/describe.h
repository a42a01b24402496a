// rigd/describe.h - the rig and its takes, as JSON for clients and as text for Prometheus. CONTROL.md names every field.
#pragma once
#include "rigd/rig.h"
#include "solver/take/json.h"

struct json *describe_rig(const struct rig *rig, const struct config *config, const char *trigger); // `status` but for its cameras[]
struct json *describe_cameras(const struct rig *rig, const struct config *config);
struct json *describe_camera(const struct rig *rig, const struct config *config, int camera);
struct json *describe_findings(const struct rig *rig, const struct config *config);
struct json *describe_lag(const struct rig *rig, const struct config *config);
struct json *describe_take(const struct ledger *l, bool with_cameras);
struct json *describe_plan(const struct ledger *l, const struct config *config); // of a panorama take: panorama_plan.h's panorama.json
struct json *describe_progress(const struct ledger *l, const struct rig_progress *p);

// The newest takes in takes_dir, at most so many, oldest first. NULL (logged) if the folder cannot be listed.
struct json *describe_takes(const char *takes_dir, int newest);

struct counters {
    int64_t n_takes, n_verified, n_failed, n_frames, n_bytes, n_quarantines;
    double last_take_s;
};
char *describe_metrics(const struct rig *rig, const struct config *config, const struct counters *counters); // malloc'd
