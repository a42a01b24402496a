// tests/bench/bench_firmware.c - the trigger board measured: edges against their schedule, interrupts' latency, and long fuzz runs.
//
// bench_firmware [SHOTS [BYTES [AVR_BYTES]]]: 10,000 shots of the real image in simavr, 10^9 random bytes into the logic on the host,
// 10^6 into the real image. Exit status 1 when an edge was late or early, an output changed, or the core crashed.
#include "firmware/board_sim.h"
#include "tests/board/frames.h"
#include "tests/board/simavr_board.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { MS = 16000, N_OUTPUTS = PROTO_OUTPUTS_MAX, ERRORS = 41 };
static const char image[] = "build/firmware/trigger.elf";

static uint32_t seed = 1;
static uint32_t any(uint32_t n)
{
    seed ^= seed << 13;
    seed ^= seed >> 17;
    seed ^= seed << 5;
    return (uint32_t)(((uint64_t)seed * n) >> 32);
}

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// ---- the real image ---------------------------------------------------------------------------------------------------------------------
static struct simavr_board *board;
static struct frames host;
static uint64_t on[N_OUTPUTS], longest_on;
static unsigned long n_changes;
static uint8_t before[N_OUTPUTS / 8];

static void on_outputs(void *arg, uint64_t cycle, const uint8_t *outputs)
{
    (void)arg;
    n_changes++;
    for (int i = 0; i < N_OUTPUTS; i++) {
        const bool was = before[i / 8] >> i % 8 & 1, is = outputs[i / 8] >> i % 8 & 1;
        if (is && !was)
            on[i] = cycle;
        if (was && !is && cycle - on[i] > longest_on)
            longest_on = cycle - on[i];
    }
    memcpy(before, outputs, sizeof(before));
}

static bool usb_out(void *arg, const uint8_t *bytes, size_t n)
{
    (void)arg;
    return simavr_board_out(board, PROTO_ENDPOINT_OUT, bytes, n) == 0;
}

static int usb_in(void *arg, uint8_t *packet)
{
    (void)arg;
    const int n = simavr_board_in(board, PROTO_ENDPOINT_IN, packet);
    return n > 0 ? n : 0;
}

static void usb_run(void *arg, uint64_t ticks)
{
    (void)arg;
    simavr_board_run(board, ticks);
}

static int connect(int n_registers, int n_inputs)
{
    host = (struct frames){ .out = usb_out, .in = usb_in, .run = usb_run };
    const struct frames_config studio = {
        .n_registers = (uint8_t)n_registers, .n_input_registers = (uint8_t)n_inputs, .debounce_ms = 5, .silence_ms = 1000, .feedback_ms = 5,
        .n_banks = 1, .bank = { { 0, (uint16_t)(8 * n_registers), 1000 } },
    };
    return simavr_board_enumerate(board) || frames_hello(&host) || frames_configure(&host, &studio);
}

static void load_board(void)
{
    const struct simavr_board_watch watch = { .outputs = on_outputs };
    memset(before, 0, sizeof(before));
    longest_on = 0;
    board = simavr_board_open(image, &watch);
    if (!board)
        exit(1);
}

static uint64_t board_time(void)
{
    uint8_t a[16] = { 0 };
    simavr_board_control(board, (const uint8_t[]){ 0xC0, PROTO_GET_TIME, 0, 0, 0, 0, 16, 0 }, a, 16);
    return proto_get_u64(a);
}

// Shots with n channels in groups at the least distance the board allows, while contacts close; the error of every press edge.
static int shots(int n_shots, int n_channels, int n_registers, int n_inputs, long histogram[ERRORS])
{
    if (connect(n_registers, n_inputs)) {
        puts("bench_firmware: no session");
        return 1;
    }
    uint8_t a[PROTO_CAPABILITIES_BYTES];
    simavr_board_control(board, (const uint8_t[]){ 0xC0, PROTO_GET_CAPABILITIES, 0, 0, 0, 0, sizeof(a), 0 }, a, sizeof(a));
    const struct proto_capabilities c = proto_get_capabilities(a);
    int failed = 0;
    for (int k = 0; k < n_shots; k++) {
        struct frames_shot s = { .shot = (uint16_t)k, .hold = (1 + any(8)) * MS + any(MS) };
        uint32_t at = 0;
        while (s.n < n_channels) {
            int group = any(2) ? n_channels : 1 + (int)any(8);
            if (group > n_channels - s.n)
                group = n_channels - s.n;
            if (s.n > 0)
                at += c.gap_base_ticks + c.gap_register_ticks * (uint32_t)n_registers + c.gap_channel_ticks * (uint32_t)group + any(2) * any(3000);
            for (int i = 0; i < group; i++, s.n++) {
                s.delay[s.n] = at;
                s.output[s.n] = (uint8_t)s.n;
            }
        }
        struct frames_event e;
        uint64_t t0 = 0;
        int err = frames_load(&host, &s);
        if (!err) {
            t0 = board_time() + 5 * MS + any(3 * MS);
            err = frames_commit(&host, &s, t0);
        }
        for (int i = 0; i < 8 && n_inputs; i++)
            simavr_board_input(board, (int)any(8 * (uint32_t)n_inputs), any(2));
        if (err || !frames_listen(&host, 500 * MS, PROTO_FIRED, &e) || e.payload[2] != PROTO_FIRED_DONE || proto_get_u32(e.payload + 12)) {
            printf("bench_firmware: shot %d: error %d, or late\n", k, err);
            failed = 1;
            continue;
        }
        for (int i = 0; i < s.n; i++) {
            const int64_t error = (int64_t)(on[s.output[i]] - simavr_board_cycle_of(board, t0 + s.delay[i]));
            const int64_t bin = error < -ERRORS / 2 ? 0 : error > ERRORS / 2 ? ERRORS - 1 : error + ERRORS / 2;
            histogram[bin]++;
            failed |= error != 0;
        }
    }
    return failed;
}

static int bench_edges(int n_shots)
{
    static const struct {
        int channels, registers, inputs, share;
    } rigs[] = { { 64, 8, 0, 4 }, { 64, 8, 8, 4 }, { 200, 25, 25, 1 }, { 200, 52, 25, 1 } };
    int failed = 0;
    uint32_t latency[SIMAVR_VECTORS] = { 0 }, duration[SIMAVR_VECTORS] = { 0 };
    for (size_t r = 0; r < sizeof(rigs) / sizeof(*rigs); r++) {
        long histogram[ERRORS] = { 0 };
        load_board();
        simavr_board_fit(board, rigs[r].registers);
        connect(rigs[r].registers, rigs[r].inputs);
        simavr_board_clear_latency(board);
        const double begin = seconds();
        const int n = n_shots * rigs[r].share / 10;
        failed |= shots(n, rigs[r].channels, rigs[r].registers, rigs[r].inputs, histogram);
        printf("edges: %d shots of %d channels, %d output and %d input registers (%.0f s):", n, rigs[r].channels, rigs[r].registers,
               rigs[r].inputs, seconds() - begin);
        for (int i = 0; i < ERRORS; i++)
            if (histogram[i])
                printf(" %+d cycles: %ld", i - ERRORS / 2, histogram[i]);
        printf("; armed at least %" PRIu32 " cycles before\n", simavr_board_margin(board));
        for (int v = 0; v < SIMAVR_VECTORS; v++) {
            if (simavr_board_latency(board)[v] > latency[v])
                latency[v] = simavr_board_latency(board)[v];
            if (simavr_board_duration(board)[v] > duration[v])
                duration[v] = simavr_board_duration(board)[v];
        }
        uint8_t a[PROTO_PAYLOAD_MAX];
        if (!frames_command(&host, PROTO_STATUS, NULL, 0, a))
            printf("edges: RAM never used: %u bytes; longest on %.3f ms\n", proto_get_u16(a + 34), (double)longest_on / MS);
        failed |= simavr_board_is_dead(board);
        simavr_board_close(board);
    }
    for (int v = 0; v < SIMAVR_VECTORS; v++)
        if (duration[v])
            printf("interrupt %2d %-26s waits at most %5" PRIu32 " cycles, takes at most %5" PRIu32 "\n", v, simavr_board_vector_name(v), latency[v],
                   duration[v]);
    return failed;
}

static void fill(uint8_t *bytes, size_t n) // random, with begins of frames among it
{
    for (size_t i = 0; i < n; i++)
        bytes[i] = (uint8_t)any(256);
    for (size_t i = any(64); i + 3 < n; i += 1 + any(64)) {
        bytes[i] = PROTO_SYNC_0;
        bytes[i + 1] = PROTO_SYNC_1;
        bytes[i + 2] = (uint8_t)any(PROTO_PAYLOAD_MAX + 1);
    }
}

static int bench_avr_bytes(long n_bytes)
{
    load_board();
    connect(52, 25);
    n_changes = 0;
    const double begin = seconds();
    long n = 0;
    while (n < n_bytes && !simavr_board_is_dead(board)) {
        uint8_t bytes[64], answer[64];
        fill(bytes, sizeof(bytes));
        while (!usb_out(NULL, bytes, sizeof(bytes))) {
            simavr_board_run(board, 500);
            usb_in(NULL, answer);
        }
        n += (long)sizeof(bytes);
    }
    const int failed = simavr_board_is_dead(board) || n_changes || simavr_board_resets(board);
    printf("fuzz: %ld random bytes into the real image (%.0f s): %lu output changes, %u resets, core %s\n", n, seconds() - begin, n_changes,
           simavr_board_resets(board), simavr_board_is_dead(board) ? "crashed" : "alive");
    simavr_board_close(board);
    return failed;
}

// ---- the logic on the host ----------------------------------------------------------------------------------------------------------------
static unsigned long n_host_changes;
static void on_host_outputs(void *arg, uint64_t tick, const uint8_t *outputs)
{
    (void)arg;
    (void)tick;
    (void)outputs;
    n_host_changes++;
}

static bool sim_out(void *arg, const uint8_t *bytes, size_t n)
{
    (void)arg;
    board_sim_write(bytes, n);
    return true;
}

static int sim_in(void *arg, uint8_t *packet)
{
    (void)arg;
    return board_sim_read(packet);
}

static void sim_run(void *arg, uint64_t ticks)
{
    (void)arg;
    board_sim_run(ticks);
}

static int bench_bytes(long n_bytes)
{
    board_sim_start(0);
    board_sim.on_outputs = on_host_outputs;
    host = (struct frames){ .out = sim_out, .in = sim_in, .run = sim_run };
    const struct frames_config studio = {
        .n_registers = 52, .n_input_registers = 25, .debounce_ms = 5, .silence_ms = 1000, .n_banks = 1, .bank = { { 0, 416, 1000 } },
    };
    if (frames_hello(&host) || frames_configure(&host, &studio))
        return 1;
    const double begin = seconds();
    long n = 0;
    for (; n < n_bytes; n += 512) {
        uint8_t bytes[512], answer[PROTO_PACKET_BYTES];
        fill(bytes, sizeof(bytes));
        board_sim_write(bytes, sizeof(bytes));
        while (board_sim_waiting() > 0) {
            board_sim_run(2000);
            board_sim_read(answer);
        }
    }
    printf("fuzz: %ld random bytes into the logic on the host (%.0f s): %lu output changes\n", n, seconds() - begin, n_host_changes);
    return n_host_changes > 0;
}

int main(int argc, char **argv)
{
    const long n_shots = argc > 1 ? atol(argv[1]) : 10000, n_bytes = argc > 2 ? atol(argv[2]) : 1000000000, n_avr = argc > 3 ? atol(argv[3]) : 1000000;
    setvbuf(stdout, NULL, _IOLBF, 0);
    int failed = bench_edges((int)n_shots);
    failed |= bench_avr_bytes(n_avr);
    failed |= bench_bytes(n_bytes);
    puts(failed ? "bench_firmware: FAILED" : "bench_firmware: every edge on its cycle, no crash, no spurious edge");
    return failed;
}
