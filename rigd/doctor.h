// rigd/doctor.h - what in this machine will fail, before it fails: USB endpoints and memory, permissions, holders, clock, disk.
#pragma once
#include "rigd/config.h"
#include "solver/take/json.h"

// {"healthy":bool,"findings":[{"severity","about","text"}]}. root: "" for this machine, or a folder that plays / in tests.
struct json *doctor_examine(const struct config *config, const char *root, const char *takes_dir);
