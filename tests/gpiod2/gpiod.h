// tests/gpiod2/gpiod.h - what trigger_gpio.c uses of libgpiod's API 2, declared and no more: hosts with API 1 (Debian 12) still
// check that the other half compiles. Names and signatures follow libgpiod 2's documentation; the values of the constants do not.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct gpiod_chip;
struct gpiod_chip_info;
struct gpiod_line_info;
struct gpiod_line_settings;
struct gpiod_line_config;
struct gpiod_request_config;
struct gpiod_line_request;
struct gpiod_edge_event;
struct gpiod_edge_event_buffer;

enum gpiod_line_value { GPIOD_LINE_VALUE_ERROR = -1, GPIOD_LINE_VALUE_INACTIVE, GPIOD_LINE_VALUE_ACTIVE };
enum gpiod_line_direction { GPIOD_LINE_DIRECTION_INPUT, GPIOD_LINE_DIRECTION_OUTPUT };
enum gpiod_line_edge { GPIOD_LINE_EDGE_BOTH };
enum gpiod_line_bias { GPIOD_LINE_BIAS_PULL_UP, GPIOD_LINE_BIAS_PULL_DOWN };
enum gpiod_line_clock { GPIOD_LINE_CLOCK_MONOTONIC };
enum gpiod_edge_event_type { GPIOD_EDGE_EVENT_RISING_EDGE, GPIOD_EDGE_EVENT_FALLING_EDGE };

struct gpiod_chip *gpiod_chip_open(const char *path);
void gpiod_chip_close(struct gpiod_chip *);
struct gpiod_chip_info *gpiod_chip_get_info(struct gpiod_chip *);
void gpiod_chip_info_free(struct gpiod_chip_info *);
const char *gpiod_chip_info_get_label(struct gpiod_chip_info *);
size_t gpiod_chip_info_get_num_lines(struct gpiod_chip_info *);
struct gpiod_line_info *gpiod_chip_get_line_info(struct gpiod_chip *, unsigned int offset);
void gpiod_line_info_free(struct gpiod_line_info *);
bool gpiod_line_info_is_used(struct gpiod_line_info *);
const char *gpiod_line_info_get_consumer(struct gpiod_line_info *);

struct gpiod_line_settings *gpiod_line_settings_new(void);
void gpiod_line_settings_free(struct gpiod_line_settings *);
int gpiod_line_settings_set_direction(struct gpiod_line_settings *, enum gpiod_line_direction);
int gpiod_line_settings_set_edge_detection(struct gpiod_line_settings *, enum gpiod_line_edge);
int gpiod_line_settings_set_bias(struct gpiod_line_settings *, enum gpiod_line_bias);
int gpiod_line_settings_set_event_clock(struct gpiod_line_settings *, enum gpiod_line_clock);
int gpiod_line_settings_set_output_value(struct gpiod_line_settings *, enum gpiod_line_value);
void gpiod_line_settings_set_active_low(struct gpiod_line_settings *, bool);

struct gpiod_line_config *gpiod_line_config_new(void);
void gpiod_line_config_free(struct gpiod_line_config *);
int gpiod_line_config_add_line_settings(struct gpiod_line_config *, const unsigned int *offsets, size_t n, struct gpiod_line_settings *);
struct gpiod_request_config *gpiod_request_config_new(void);
void gpiod_request_config_free(struct gpiod_request_config *);
void gpiod_request_config_set_consumer(struct gpiod_request_config *, const char *consumer);

struct gpiod_line_request *gpiod_chip_request_lines(struct gpiod_chip *, struct gpiod_request_config *, struct gpiod_line_config *);
void gpiod_line_request_release(struct gpiod_line_request *);
int gpiod_line_request_get_fd(struct gpiod_line_request *);
enum gpiod_line_value gpiod_line_request_get_value(struct gpiod_line_request *, unsigned int offset);
int gpiod_line_request_set_values(struct gpiod_line_request *, const enum gpiod_line_value *);
int gpiod_line_request_read_edge_events(struct gpiod_line_request *, struct gpiod_edge_event_buffer *, size_t max);
struct gpiod_edge_event_buffer *gpiod_edge_event_buffer_new(size_t capacity);
void gpiod_edge_event_buffer_free(struct gpiod_edge_event_buffer *);
struct gpiod_edge_event *gpiod_edge_event_buffer_get_event(struct gpiod_edge_event_buffer *, unsigned long index);
enum gpiod_edge_event_type gpiod_edge_event_get_event_type(struct gpiod_edge_event *);
uint64_t gpiod_edge_event_get_timestamp_ns(struct gpiod_edge_event *);
