// rigd/trigger_lines.h - a trigger made of lines: what trigger_gpio.c and trigger_sim.c have in common.
//
// A thread of its own moves the edges (edges.h): SCHED_FIFO where allowed, asleep until shortly before, then watching the clock.
// Over wires that outlive their process a guard watches: a forked child that holds the same lines and makes each inactive when its
// limit has passed or rigd is gone, be it killed, crashed, hung or stopped. See trigger_gpio.c for what remains to the hardware.
#pragma once
#include "rigd/edges.h"

struct trigger_lines;

// Lines as configured; of_cameras as edges_init(). The rest is as trigger.h says of struct trigger_ops.
int trigger_lines_open(struct trigger_lines **out, const struct config *config, const struct trigger_host *host,
    const struct lines_ops *ops, bool of_cameras);
unsigned trigger_lines_abilities(const void *self);
int trigger_lines_fire(void *self, const struct trigger_shot *shot);
void trigger_lines_release(void *self);
int trigger_lines_relay(void *self, int camera, bool cut);
int trigger_lines_head(void *self, int32_t yaw_mdeg, int32_t pitch_mdeg);
int trigger_lines_fd(const void *self);
void trigger_lines_dispatch(void *self);
void trigger_lines_close(void *self);
