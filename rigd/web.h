// rigd/web.h - the page: HTTP in front of the control protocol.
//
//   GET /                     the page (rigd/web/)
//   POST /api                 one request of the control protocol (CONTROL.md), its answer comes back
//   GET /events               the answer to `status`, then events, one JSON object per server-sent message; not for pages of other sites
//   GET /takes/<id>/<file>    reports, contact sheets, thumbnails, models (take_files.h)
//
// A thread per connection, none of which touches the daemon: each is a client of the Unix socket, as rigctl is, and can do what that
// can and no more. access.h judges who may. Bounds: 64 KiB a request, WEB_STREAMS_MAX listeners, WEB_ASKING_MAX requests
// under way, 15 s for a request to arrive; with too many connections those that ask nothing are closed first.
#pragma once
#include "rigd/config.h"

enum { WEB_STREAMS_MAX = 32, WEB_ASKING_MAX = 16, WEB_CONNECTIONS_MAX = 192, WEB_REQUEST_MAX_MS = 15000 };

struct web;

// config is kept (borrowed): web, socket_path, takes_dir, state_dir. 0; 0 and *out NULL if no page is wanted; -errno (logged, with
// the remedy).
int web_open(struct web **out, const struct config *config);
void web_close(struct web *w); // NULL allowed; ends all connections, at once
const char *web_address(const struct web *w); // "http://127.0.0.1:8420/"
