// tests/rigsim/server_state.h - the server's inside, shared by server.c, server_faults.c and server_shutter.c only.
#pragma once
#include "tests/rigsim/dataset.h"
#include "tests/rigsim/frame.h"
#include "tests/rigsim/ptp.h"
#include "tests/rigsim/ptpip.h"
#include "tests/rigsim/server.h"
#include "rigd/shutter_line.h"

enum { LINKS_PER_CAMERA = 6, SHUTTER_CLIENTS_MAX = 16 };
enum link_role { LINK_FREE, LINK_NEW, LINK_COMMAND, LINK_EVENT };

struct link { // one TCP connection
    enum link_role role;
    int fd;
    bool wants_write, closing; // closing: after what is in out
    struct dataset in, out;
    size_t out_at; // of out is sent
    // a data phase from the client, and one to it
    bool collecting;
    struct ptp_request request;
    struct dataset data;
    struct frame *frame;
    uint64_t frame_at, frame_end;
    bool corrupt;
    struct ptpip_packet response; // after the frame
};

struct camera {
    struct server *server;
    unsigned index;
    struct body body;
    struct ptp_session session;
    struct ptp_reply reply;
    int listener[2]; // -1: refusing
    struct link link[LINKS_PER_CAMERA];
    struct link *command, *event;
    uint32_t connection, n_connects, n_exposures;
    // faults
    uint32_t *fault_count; // [faults->n] times that its trigger has come
    int64_t stall_until_ns, refuse_until_ns, power_until_ns, flood_until_ns, flood_next_ns;
    int64_t flood_rate;
    double bytes_per_s, bytes_ahead; // a bucket that fills: bytes sent beyond the rate so far
    int64_t bucket_ns;
    int hostile, n_hostile;
    bool boot; // power comes back at power_until_ns
};

struct shutter_client {
    int fd; // -1: free
    bool wants_write;
    struct shutter_line *out; // reports not yet sent
    size_t n_out, capacity;
};

// The panorama head: both axes start and arrive together.
struct head {
    double from_deg[2], to_deg[2]; // yaw, pitch
    int64_t began_ns, arrives_ns;  // arrives 0: it stands at to_deg
    int client;                    // who is told
    struct shutter_line order;
    bool fails;                    // it stops half way
    int stuck;                     // so many moves to come will
};

struct server {
    const struct server_settings *settings;
    struct scene *scene;
    struct camera *camera; // [n_cameras]
    int epoll, timer, signals;
    int64_t started_ns, now_ns;
    int shutter_listener;
    struct shutter_client client[SHUTTER_CLIENTS_MAX];
    struct head head;
};

// server.c
int64_t server_now_ns(void);
void server_drop_links(struct camera *c);
int server_listen(struct camera *c); // 0 or -errno (logged)
void server_refuse(struct camera *c);
void server_step_camera(struct camera *c); // the body to now; its events to whom they concern
int server_watch(struct server *s, int fd, uint64_t name, bool wants_write, bool is_new);
uint64_t server_name(unsigned kind, unsigned camera, unsigned which);
enum { NAME_TIMER, NAME_SIGNALS, NAME_LISTENER, NAME_LINK, NAME_SHUTTER_LISTENER, NAME_SHUTTER_CLIENT };

// server_faults.c
void server_fault_trigger(struct camera *c, enum fault_when when, uint32_t value);
void server_faults_step(struct camera *c);               // what is due by time; ends what has lasted long enough
int64_t server_faults_next_ns(const struct camera *c);   // INT64_MAX: nothing
void server_spoil_packets(struct camera *c, struct dataset *out, size_t from); // a hostile reply
void server_spoil_data(struct camera *c, struct dataset *data);
bool server_is_stalled(const struct camera *c);
void server_power(struct camera *c, bool on, int64_t back_ns); // back_ns: when it boots by itself; INT64_MAX never

// server_head.c
int server_head_move(struct server *s, int client, const struct shutter_line *order); // 0, -EBUSY, -EINVAL
void server_head_aim(void *arg, int64_t at_ns, struct scene_view *out);               // struct body's aim; arg: the server
void server_head_step(struct server *s);                                              // tells who is to be told
int64_t server_head_next_ns(const struct server *s);                                  // INT64_MAX: it stands

// server_shutter.c
void server_shutter_tell(struct server *s, int client, const struct shutter_line *record);
int server_shutter_open(struct server *s);
void server_shutter_close(struct server *s);
void server_shutter_accept(struct server *s);
void server_shutter_ready(struct server *s, unsigned client, bool readable);
void server_shutter_report(struct server *s, unsigned camera, const struct body_event *exposed);
void server_shutter_flush(struct server *s);
