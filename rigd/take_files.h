// rigd/take_files.h - what of a take people may look at in a browser.
//
// Known names only: reports, contact sheets, thumbnails, models. Raws and ledgers are not shown. Nothing is opened through a link,
// and nothing outside of takes_dir.
#pragma once
#include "solver/take/json.h"

// Media type of "thumbnails/A01.jpg", "solve/preview/report.html", ...; NULL: not one of the known names.
const char *take_file_type(const char *path);

// The file `path` of take `id`: a descriptor for reading, its size in *size. -ENOENT: no such take, not a known name, not there, or
// no plain file; or another -errno.
int take_file_open(const char *takes_dir, const char *id, const char *path, int64_t *size);

// What there is of reports, contact sheets and models in folder take_dir: [{"what":"report","path":"solve/preview/report.html"}, ...].
struct json *take_files_list(const char *take_dir);
