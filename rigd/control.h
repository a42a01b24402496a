// rigd/control.h - the daemon's door: JSON lines over a Unix socket.
//
// rigd/CONTROL.md is the protocol. This is the carrying part: sockets, lines, clients, limits. What a request means is the
// handler's business. A client may be slow, silent, endless or hostile: a line is at most CONTROL_LINE_MAX bytes, there are at most
// CONTROL_CLIENTS_MAX clients, one that does not read loses events (it is told how many) and is dropped when its replies do not fit
// into CONTROL_BACKLOG_MAX bytes. Nothing here waits. Loop thread only.
#pragma once
#include "solver/take/json.h"

enum { CONTROL_PROTOCOL = 1, CONTROL_LINE_MAX = 65536, CONTROL_CLIENTS_MAX = 64, CONTROL_BACKLOG_MAX = 4 << 20 };

struct control;

// request is the decoded line, its "do" is what. The handler either replies at once (control_reply) or keeps token and replies
// later; a token whose client has left is ignored.
typedef void control_handler(void *arg, uint64_t token, const char *what, const struct json *request);

// Listen on path (mode 0660; a socket file left by a dead daemon is replaced, a live one is -EADDRINUSE). 0 or -errno (logged).
int control_open(struct control **out, const char *path, control_handler *handler, void *arg);
void control_close(struct control *c); // NULL allowed; removes the socket file

int control_fd(const struct control *c); // readable: call dispatch
void control_dispatch(struct control *c);

void control_reply(struct control *c, uint64_t token, struct json *result); // takes result; to a token that was answered: nothing
// code: a stable word ("busy", "not_ready", "unknown_camera", ...); text for people, with a remedy.
void control_refuse(struct control *c, uint64_t token, const char *code, const char *text);
bool control_has_subscribers(const struct control *c);
void control_publish(struct control *c, const char *event, struct json *body); // to all subscribers; takes body

// For tests and the fuzzer: a client that is not a socket. Feed bytes, take what would be sent (malloc'd, "" if nothing).
int control_virtual_client(struct control *c); // id, or -EMFILE
void control_feed(struct control *c, int client, const char *bytes, size_t n_bytes);
char *control_take(struct control *c, int client);
int control_open_virtual(struct control **out, control_handler *handler, void *arg); // listens nowhere
