// rigd/changes.h - what clients see of a rig that changes all the time: events with what differs from the last one.
//
// "rig" has what `status` has but for its cameras; "cameras" has those of them that differ. A client that subscribes, asks for the
// status and then takes these in is never wrong for longer than CHANGES_EVERY_MS.
#pragma once
#include "rigd/control.h"
#include "rigd/rig.h"

enum { CHANGES_EVERY_MS = 100 }; // not more often

struct changes;

int changes_create(struct changes **out, int n_cameras); // 0 or -ENOMEM
void changes_free(struct changes *c);                    // NULL allowed
// rig_part: as describe_rig() says; is taken.
void changes_publish(struct changes *c, struct control *control, struct json *rig_part, const struct rig *rig, const struct config *config);
