// tests/fuzz/fuzz_board.c - hostile packets from the trigger board: refused with a reason, or within their bounds.
#include "rigd/board.h"
#include "solver/take/log.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);
int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    struct board_said s;
    struct proto_capabilities c;
    const char *why = NULL;
    uint8_t frame[PROTO_FRAME_MAX];
    log_set_level(LOG_SILENT);
    if (board_capabilities(&c, bytes, n, &why) ? !why : c.n_channels > PROTO_CHANNELS_MAX || !c.ticks_per_s || c.n_outputs > PROTO_OUTPUTS_MAX || c.n_inputs > PROTO_INPUTS_MAX)
        abort();
    why = NULL;
    if (board_decode(&s, bytes, n, &why) && !why)
        abort();
    if (n < 1 || n > PROTO_PAYLOAD_MAX) // the same as a payload of an intact frame
        return 0;
    memcpy(frame + PROTO_HEADER_BYTES, bytes + 1, n - 1);
    if (board_decode(&s, frame, proto_seal(frame, bytes[0], 0, (uint8_t)(n - 1)), &why))
        return 0;
    if (s.type < PROTO_REPLY || s.type != bytes[0])
        abort();
    if (s.type <= PROTO_EVENT && s.reply.n != n - 2)
        abort();
    if (s.type == PROTO_INPUTS && (s.inputs.n < 0 || s.inputs.n > BOARD_INPUTS_PER_FRAME || s.inputs.ticks < 0))
        abort();
    if ((s.type == PROTO_FIRED && s.fired.first_ticks < 0) || (s.type == PROTO_BUTTON && s.button.ticks < 0) || (s.type == PROTO_CAPTURE && s.capture.ticks < 0))
        abort();
    return 0;
}
