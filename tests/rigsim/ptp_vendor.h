// tests/rigsim/ptp_vendor.h - what the vendors' families answer beside the standard operations. Private to ptp*.c.
//
// Each returns true if it knew the operation and then has set reply->code; ptp.c has checked session, personality and busy.
#pragma once
#include "tests/rigsim/ptp.h"

bool ptp_nikon_answer(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply);
bool ptp_canon_answer(struct ptp_session *s, const struct ptp_request *q, struct ptp_reply *reply);

void ptp_queue_event(struct ptp_session *s, uint16_t code, uint32_t param);
// Answers with the bytes [offset, offset + n) of an object, cut at its end; reply->param[0] is how many.
void ptp_send_object(struct ptp_session *s, uint32_t handle, uint64_t offset, uint64_t n, struct ptp_reply *reply);
void ptp_send_object_info(struct ptp_session *s, uint32_t handle, struct ptp_reply *reply);
void ptp_send_thumbnail(struct ptp_session *s, uint32_t handle, struct ptp_reply *reply);
int ptp_find_property(const struct ptp_session *s, uint32_t code); // index, or -1
