// tests/rigsim/ptp_datasets.h - a body's standard PTP datasets, appended to a writer.
#pragma once
#include "tests/rigsim/body.h"
#include "tests/rigsim/dataset.h"

void ptp_put_value(struct dataset *d, enum property_type type, int64_t value, const char *text);
// False: not exactly one value of that type.
bool ptp_get_value(struct dataset_reader *r, enum property_type type, int64_t *value, char text[BODY_TEXT_MAX]);
bool ptp_is_listed(const struct personality *p, uint16_t property); // in DeviceInfo
void ptp_put_device_info(struct dataset *d, const struct body *b);
void ptp_put_storage_info(struct dataset *d, const struct body *b);
void ptp_put_object_info(struct dataset *d, const struct body *b, const struct body_object *o, uint32_t width_px,
                         uint32_t height_px);
void ptp_put_property(struct dataset *d, const struct body *b, int property); // DevicePropDesc
