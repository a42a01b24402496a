// tests/board/simavr_board.c - the trigger board in simavr.
//
// simavr 1.6 (Debian 12 and 13) differs from the chip where this firmware would notice; all of it is put right here, so that the
// firmware can be written for the chip:
// - SPI takes 100 us a byte, whatever its clock: replaced by one that takes what SPCR and SPSR say, with our shift registers at it;
// - writing TIFR clears all flags of the timer, also those written as 0: an overflow would be lost now and then;
// - UDINT and USBINT are plain memory: writing 1 would set a flag;
// - force-compare (FOC1A) does nothing: the timer's copy of the latch pin is not modelled in simavr either, so nothing is missed;
// - a bulk IN endpoint answers an empty packet where it should answer NAK: this firmware never sends one, so empty means NAK;
// - suspend never comes: made by hand;
// - KILLBK, which throws away what an IN endpoint was given, does nothing: it is counted, and a test wants none;
// - after a reset the ports' IRQs keep their old values, and the inputs read 0;
// - sleeping sleeps in real time.
#include "tests/board/simavr_board.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>
#include <simavr/sim_time.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_interrupts.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_usb.h>

// libsimavr frees neither the names of its IRQs nor its ports.
const char *__lsan_default_suppressions(void);
const char *__lsan_default_suppressions(void)
{
    return "leak:libsimavr\nleak:libelf\n";
}

enum { // data addresses
    DDRB = 0x24, PORTB = 0x25, PIND = 0x29, PINE = 0x2C, PINF = 0x2F, TIFR0 = 0x35, TIFR1 = 0x36, SPCR = 0x4C, SPSR = 0x4D,
    SPDR = 0x4E, MCUSR = 0x54, TCCR1A = 0x80, USBCON = 0xD8, USBINT = 0xDA, UDCON = 0xE0, UDINT = 0xE1, UDIEN = 0xE2,
    UEINTX = 0xE8, UENUM = 0xE9,
};
enum { KILLBK = 1 << 2, IN_ENDPOINT = 2 };
enum { SPIF = 0x80, SUSPI = 1, DETACH = 1, LED = 1 << 0, LOAD = 1 << 4, LATCH = 1 << 5, ENABLE = 1 << 6, USB_GEN = 10, N_AXES = 2 };
enum { CONTROL_TIMEOUT = 50 * (SIMAVR_HZ / 1000), POLL_CYCLES = 160 };

struct simavr_board {
    avr_t *avr;
    struct simavr_board_watch watch;
    avr_timer_t *timer1;
    uint64_t clock_start; // cycle at which timer 1 began to count
    bool clock_runs, dead;
    unsigned n_resets, n_killed;
    int n_registers;
    void (*core_reset)(struct avr_t *);
    // the chains
    uint8_t chain[SIMAVR_REGISTERS], latched[SIMAVR_REGISTERS], seen[SIMAVR_REGISTERS];
    uint8_t in_chain[SIMAVR_INPUT_REGISTERS], input[SIMAVR_INPUT_REGISTERS]; // input: open is 1
    uint8_t spi_out, spi_in, portb, ddrb;
    bool latch_high;
    bool step_high[N_AXES], direction[N_AXES];
    // interrupts
    uint64_t requested[SIMAVR_VECTORS]; // 0: not
    uint64_t began[SIMAVR_VECTORS];
    uint32_t latency[SIMAVR_VECTORS], duration[SIMAVR_VECTORS], margin;
    uint64_t armed;
    struct vector_hook {
        struct simavr_board *b;
        avr_int_vector_t *vector;
    } hook[SIMAVR_VECTORS];
};

static struct simavr_board *of_avr[4]; // avr_t has no place for us that simavr leaves alone

static struct simavr_board *board_of(const avr_t *avr)
{
    for (size_t i = 0; i < sizeof(of_avr) / sizeof(*of_avr); i++)
        if (of_avr[i] && of_avr[i]->avr == avr)
            return of_avr[i];
    abort();
}

// ---- shift registers --------------------------------------------------------------------------------------------------------------------
static void show(struct simavr_board *b, uint64_t cycle)
{
    static const uint8_t none[SIMAVR_REGISTERS];
    const bool enabled = (b->ddrb & ENABLE) && !(b->portb & ENABLE); // else the line's pull-up disables them
    const uint8_t *now = enabled ? b->latched : none;
    if (!memcmp(now, b->seen, sizeof(b->seen)))
        return;
    memcpy(b->seen, now, sizeof(b->seen));
    if (b->watch.outputs)
        b->watch.outputs(b->watch.arg, cycle, b->seen);
}

// The compare unit raises the pin on its own cycle; simavr, which does whole instructions, tells us up to 3 cycles later.
static void on_latch(avr_irq_t *irq, uint32_t value, void *param)
{
    struct simavr_board *b = param;
    (void)irq;
    const bool high = value & 0xFF;
    if (high && !b->latch_high) {
        const uint64_t match = b->timer1->tov_base + b->timer1->comp[AVR_TIMER_COMPA].comp_cycles;
        const bool by_timer = !(b->portb & LATCH) && match <= b->avr->cycle && b->avr->cycle - match < 64;
        bool press = false; // a release may be armed as late as it likes
        for (int r = 0; r < b->n_registers; r++) {
            press |= (b->chain[r] & ~b->latched[r]) != 0;
            b->latched[r] = b->chain[r];
        }
        if (by_timer && press && match - b->armed < b->margin)
            b->margin = (uint32_t)(match - b->armed);
        show(b, by_timer ? match : b->avr->cycle);
    }
    b->latch_high = high;
}

// Not by the port's IRQs: those keep their old value over a reset, and then miss the first write of the same.
static void portb_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    struct simavr_board *b = param;
    (void)addr;
    b->portb = value;
    if (!(value & LOAD))
        memcpy(b->in_chain, b->input, sizeof(b->in_chain));
    show(b, avr->cycle);
}

static void ddrb_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    struct simavr_board *b = param;
    (void)addr;
    b->ddrb = value;
    show(b, avr->cycle);
}

static avr_cycle_count_t spi_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct simavr_board *b = param;
    (void)when;
    memmove(b->chain + 1, b->chain, sizeof(b->chain) - 1);
    b->chain[0] = b->spi_out;
    b->spi_in = b->in_chain[0];
    memmove(b->in_chain, b->in_chain + 1, sizeof(b->in_chain) - 1);
    b->in_chain[sizeof(b->in_chain) - 1] = 0;
    avr->data[SPSR] |= SPIF;
    return 0;
}

static void spi_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    struct simavr_board *b = param;
    static const uint8_t divider[4] = { 4, 16, 64, 128 };
    avr->data[addr] = value;
    avr->data[SPSR] &= (uint8_t)~SPIF;
    b->spi_out = value;
    avr_cycle_timer_register(avr, 8u * divider[avr->data[SPCR] & 3] / (avr->data[SPSR] & 1 ? 2 : 1), spi_done, b);
}

static uint8_t spi_read(avr_t *avr, avr_io_addr_t addr, void *param)
{
    struct simavr_board *b = param;
    (void)addr;
    avr->data[SPSR] &= (uint8_t)~SPIF;
    return b->spi_in;
}

// ---- repairs, measurement -----------------------------------------------------------------------------------------------------------------
static void tifr_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    struct simavr_board *b = param;
    for (int i = 0; i < avr->interrupts.vector_count; i++) {
        avr_int_vector_t *v = avr->interrupts.vector[i];
        if (v->raised.reg == addr && (value >> v->raised.bit & 1)) {
            avr_clear_interrupt(avr, v);
            b->requested[v->vector] = 0;
        }
    }
}

static void tccr1a_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    (void)addr;
    if (value >> 6 == 3) // the latch pin rises on the match
        ((struct simavr_board *)param)->armed = avr->cycle;
}

static void flags_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    (void)param;
    avr->data[addr] &= value;
}

static void on_request(avr_irq_t *irq, uint32_t value, void *param)
{
    const struct vector_hook *h = param;
    (void)irq;
    if (value && avr_regbit_get(h->b->avr, h->vector->enable) && !h->b->requested[h->vector->vector])
        h->b->requested[h->vector->vector] = h->b->avr->cycle;
}

static void on_running(avr_irq_t *irq, uint32_t value, void *param)
{
    const struct vector_hook *h = param;
    const uint8_t v = h->vector->vector;
    (void)irq;
    if (!value && h->b->began[v] && h->b->avr->cycle - h->b->began[v] > h->b->duration[v])
        h->b->duration[v] = (uint32_t)(h->b->avr->cycle - h->b->began[v]);
    h->b->began[v] = value ? h->b->avr->cycle : 0;
    if (!value || !h->b->requested[v])
        return;
    const uint64_t latency = h->b->avr->cycle - h->b->requested[v];
    if (latency > h->b->latency[v])
        h->b->latency[v] = (uint32_t)latency;
    h->b->requested[v] = 0;
}

static void on_step(struct simavr_board *b, int axis, bool high)
{
    if (high && !b->step_high[axis] && b->watch.step)
        b->watch.step(b->watch.arg, b->avr->cycle, axis, b->direction[axis]);
    b->step_high[axis] = high;
}

static void on_yaw_step(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    on_step(param, 0, value & 1);
}

static void on_pitch_step(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    on_step(param, 1, value & 1);
}

static void on_yaw_direction(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    ((struct simavr_board *)param)->direction[0] = value & 1;
}

static void on_pitch_direction(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    ((struct simavr_board *)param)->direction[1] = value & 1;
}

static avr_irq_t *pin(struct simavr_board *b, char port, int bit)
{
    return avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit);
}

static void core_reset(avr_t *avr)
{
    struct simavr_board *b = board_of(avr);
    b->core_reset(avr);
    b->n_resets++;
    b->clock_runs = false;
    b->timer1->tov_base = 0;
    b->portb = b->ddrb = 0;
    pin(b, 'B', 5)->value = 0;
    b->latch_high = false;
    // What is wired to the inputs is still there.
    avr->data[PIND] = (uint8_t)((pin(b, 'D', 4)->value & 1) << 4 | (pin(b, 'D', 1)->value & 1) << 1);
    avr->data[PINE] = (uint8_t)((pin(b, 'E', 6)->value & 1) << 6);
    avr->data[PINF] = (uint8_t)((pin(b, 'F', 4)->value & 1) << 4);
    memset(b->requested, 0, sizeof(b->requested));
    show(b, avr->cycle);
}

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    (void)avr;
    (void)cycles;
}

static void quiet(avr_t *avr, const int level, const char *format, va_list arguments)
{
    (void)avr;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

static void ueintx_write(avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param)
{
    struct simavr_board *b = param;
    (void)addr;
    b->n_killed += (avr->data[UENUM] & 7) == IN_ENDPOINT && (value & KILLBK);
}

// ---- open -----------------------------------------------------------------------------------------------------------------------------------
static avr_timer_t *find_timer1(avr_t *avr)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (!strcmp(io->kind, "timer") && ((avr_timer_t *)io)->name == '1')
            return (avr_timer_t *)io;
    abort();
}

static void wire(struct simavr_board *b)
{
    avr_t *avr = b->avr;
    avr->io[AVR_DATA_TO_IO(SPDR)].w.c = spi_write;
    avr->io[AVR_DATA_TO_IO(SPDR)].w.param = b;
    avr->io[AVR_DATA_TO_IO(SPDR)].r.c = spi_read;
    avr->io[AVR_DATA_TO_IO(SPDR)].r.param = b;
    avr->io[AVR_DATA_TO_IO(TIFR0)].w.c = avr->io[AVR_DATA_TO_IO(TIFR1)].w.c = tifr_write;
    avr->io[AVR_DATA_TO_IO(TIFR0)].w.param = avr->io[AVR_DATA_TO_IO(TIFR1)].w.param = b;
    avr_register_io_write(avr, TCCR1A, tccr1a_write, b);
    avr_register_io_write(avr, UEINTX, ueintx_write, b);
    avr_register_io_write(avr, UDINT, flags_write, b);
    avr_register_io_write(avr, USBINT, flags_write, b);
    avr_irq_register_notify(pin(b, 'B', 5), on_latch, b);
    avr_register_io_write(avr, PORTB, portb_write, b);
    avr_register_io_write(avr, DDRB, ddrb_write, b);
    avr_irq_register_notify(pin(b, 'C', 6), on_yaw_step, b);
    avr_irq_register_notify(pin(b, 'F', 7), on_pitch_step, b);
    avr_irq_register_notify(pin(b, 'D', 7), on_yaw_direction, b);
    avr_irq_register_notify(pin(b, 'F', 6), on_pitch_direction, b);
    for (int i = 0; i < avr->interrupts.vector_count; i++) {
        avr_int_vector_t *v = avr->interrupts.vector[i];
        if (v->vector >= SIMAVR_VECTORS)
            continue;
        b->hook[v->vector] = (struct vector_hook){ b, v };
        avr_irq_register_notify(&v->irq[AVR_INT_IRQ_PENDING], on_request, &b->hook[v->vector]);
        avr_irq_register_notify(&v->irq[AVR_INT_IRQ_RUNNING], on_running, &b->hook[v->vector]);
    }
}

static void rest_inputs(struct simavr_board *b)
{
    avr_raise_irq(pin(b, 'E', 6), 1);
    avr_raise_irq(pin(b, 'D', 4), 1);
    avr_raise_irq(pin(b, 'F', 4), 1);
    avr_raise_irq(pin(b, 'D', 1), 1);
}

struct simavr_board *simavr_board_open(const char *elf, const struct simavr_board_watch *watch)
{
    elf_firmware_t image;
    memset(&image, 0, sizeof(image));
    avr_global_logger_set(quiet);
    if (elf_read_firmware(elf, &image)) {
        fprintf(stderr, "simavr_board: cannot read %s: make firmware\n", elf);
        return NULL;
    }
    struct simavr_board *b = calloc(1, sizeof(*b));
    size_t slot = 0;
    while (slot < sizeof(of_avr) / sizeof(*of_avr) && of_avr[slot])
        slot++;
    if (!b || slot == sizeof(of_avr) / sizeof(*of_avr)) {
        fprintf(stderr, "simavr_board: no memory, or more than %zu boards at once\n", sizeof(of_avr) / sizeof(*of_avr));
        free(b);
        return NULL;
    }
    b->avr = avr_make_mcu_by_name("atmega32u4");
    of_avr[slot] = b;
    if (watch)
        b->watch = *watch;
    avr_init(b->avr);
    b->avr->log = LOG_ERROR;
    b->avr->frequency = SIMAVR_HZ;
    b->avr->sleep = no_sleep;
    avr_load_firmware(b->avr, &image);
    b->avr->frequency = SIMAVR_HZ;
    free(image.flash);
    free(image.eeprom);
    memset(b->input, 0xFF, sizeof(b->input));
    b->timer1 = find_timer1(b->avr);
    b->margin = UINT32_MAX;
    b->n_registers = SIMAVR_REGISTERS;
    wire(b);
    rest_inputs(b);
    b->core_reset = b->avr->reset;
    b->avr->reset = core_reset;
    return b;
}

void simavr_board_fit(struct simavr_board *b, int n_registers)
{
    b->n_registers = n_registers;
}

void simavr_board_close(struct simavr_board *b)
{
    if (!b)
        return;
    for (size_t i = 0; i < sizeof(of_avr) / sizeof(*of_avr); i++)
        if (of_avr[i] == b)
            of_avr[i] = NULL;
    avr_terminate(b->avr);
    free(b->avr);
    free(b);
}

// ---- time, what is seen -----------------------------------------------------------------------------------------------------------------------
void simavr_board_run(struct simavr_board *b, uint64_t n_cycles)
{
    const uint64_t end = b->avr->cycle + n_cycles;
    while (b->avr->cycle < end && !b->dead) {
        const int state = avr_run(b->avr);
        if (state == cpu_Crashed || state == cpu_Done || state == cpu_Stopped)
            b->dead = true;
        if (!b->clock_runs && b->timer1->tov_base) {
            b->clock_runs = true;
            b->clock_start = b->timer1->tov_base;
        }
    }
}

uint64_t simavr_board_cycle(const struct simavr_board *b)
{
    return b->avr->cycle;
}

uint64_t simavr_board_cycle_of(const struct simavr_board *b, uint64_t tick)
{
    return b->clock_start + tick;
}

bool simavr_board_is_dead(const struct simavr_board *b)
{
    return b->dead;
}

bool simavr_board_is_attached(const struct simavr_board *b)
{
    return (b->avr->data[USBCON] & 0x80) && !(b->avr->data[UDCON] & DETACH);
}

const uint8_t *simavr_board_outputs(const struct simavr_board *b)
{
    return b->seen;
}

bool simavr_board_led(const struct simavr_board *b)
{
    return (b->ddrb & LED) && !(b->portb & LED);
}

unsigned simavr_board_resets(const struct simavr_board *b)
{
    return b->n_resets;
}

unsigned simavr_board_killed(const struct simavr_board *b)
{
    return b->n_killed;
}

// ---- hands ------------------------------------------------------------------------------------------------------------------------------------
void simavr_board_button(struct simavr_board *b, bool pressed)
{
    avr_raise_irq(pin(b, 'E', 6), !pressed);
}

void simavr_board_capture(struct simavr_board *b, bool closed)
{
    avr_raise_irq(pin(b, 'D', 4), !closed);
}

void simavr_board_home(struct simavr_board *b, int axis, bool closed)
{
    avr_raise_irq(axis == 0 ? pin(b, 'F', 4) : pin(b, 'D', 1), !closed);
}

void simavr_board_input(struct simavr_board *b, int input, bool closed)
{
    const uint8_t bit = (uint8_t)(1 << input % 8);
    if (closed)
        b->input[input / 8] &= (uint8_t)~bit;
    else
        b->input[input / 8] |= bit;
}

void simavr_board_reset(struct simavr_board *b, enum simavr_cause cause)
{
    static const uint8_t flag[] = { [SIMAVR_POWER] = 1, [SIMAVR_PIN] = 2, [SIMAVR_BROWN_OUT] = 4 };
    avr_reset(b->avr);
    b->avr->data[MCUSR] = flag[cause];
}

void simavr_board_hang(struct simavr_board *b)
{
    while (!b->dead && (!b->avr->sreg[S_I] || b->avr->interrupts.running_ptr > 0 || b->avr->state != cpu_Running))
        simavr_board_run(b, 1);
    b->avr->flash[b->avr->pc] = 0xFF; // rjmp .-2
    b->avr->flash[b->avr->pc + 1] = 0xCF;
}

// ---- host -------------------------------------------------------------------------------------------------------------------------------------
static int transfer(struct simavr_board *b, uint32_t what, int endpoint, uint8_t *data, size_t *n)
{
    struct avr_io_usb io = { .pipe = (uint8_t)endpoint, .sz = (uint32_t)*n, .buf = data };
    const int answer = avr_ioctl(b->avr, what, &io);
    *n = io.sz;
    return answer == AVR_IOCTL_USB_OK ? 0 : answer == AVR_IOCTL_USB_STALL ? -EPIPE : -EAGAIN;
}

void simavr_board_bus_reset(struct simavr_board *b)
{
    avr_ioctl(b->avr, AVR_IOCTL_USB_RESET, NULL);
    simavr_board_run(b, 10 * (SIMAVR_HZ / 1000));
}

void simavr_board_suspend(struct simavr_board *b)
{
    b->avr->data[UDINT] |= SUSPI;
    if (b->avr->data[UDIEN] & SUSPI)
        avr_raise_interrupt(b->avr, b->hook[USB_GEN].vector);
}

// NAK is asked again until CONTROL_TIMEOUT.
static int patient(struct simavr_board *b, uint32_t what, uint8_t *data, size_t *n)
{
    const size_t asked = *n;
    for (const uint64_t end = b->avr->cycle + CONTROL_TIMEOUT; b->avr->cycle < end && !b->dead;) {
        *n = asked;
        const int err = transfer(b, what, 0, data, n);
        if (err != -EAGAIN)
            return err;
        simavr_board_run(b, POLL_CYCLES);
    }
    return -ETIMEDOUT;
}

int simavr_board_control(struct simavr_board *b, const uint8_t setup[8], uint8_t *data, size_t n)
{
    uint8_t packet[64];
    size_t moved = 0, n_packet = 8;
    memcpy(packet, setup, 8);
    int err = patient(b, AVR_IOCTL_USB_SETUP, packet, &n_packet);
    if (err)
        return err;
    simavr_board_run(b, POLL_CYCLES);
    if (setup[0] & 0x80) {
        do {
            n_packet = sizeof(packet);
            err = patient(b, AVR_IOCTL_USB_READ, packet, &n_packet);
            if (err)
                return err;
            if (n_packet > n - moved)
                n_packet = n - moved;
            memcpy(data + moved, packet, n_packet);
            moved += n_packet;
        } while (n_packet == sizeof(packet) && moved < n);
        n_packet = 0;
        err = patient(b, AVR_IOCTL_USB_WRITE, packet, &n_packet);
    } else {
        while (moved < n) {
            n_packet = n - moved < sizeof(packet) ? n - moved : sizeof(packet);
            memcpy(packet, data + moved, n_packet);
            const size_t sent = n_packet;
            err = patient(b, AVR_IOCTL_USB_WRITE, packet, &n_packet);
            if (err)
                return err;
            moved += sent;
            simavr_board_run(b, POLL_CYCLES);
        }
        n_packet = sizeof(packet);
        err = patient(b, AVR_IOCTL_USB_READ, packet, &n_packet);
    }
    simavr_board_run(b, POLL_CYCLES);
    return err ? err : (int)moved;
}

int simavr_board_out(struct simavr_board *b, int endpoint, const uint8_t *data, size_t n)
{
    uint8_t packet[64];
    if (n > sizeof(packet))
        return -EINVAL;
    memcpy(packet, data, n);
    return transfer(b, AVR_IOCTL_USB_WRITE, endpoint & 15, packet, &n);
}

int simavr_board_in(struct simavr_board *b, int endpoint, uint8_t data[64])
{
    size_t n = 64;
    const int err = transfer(b, AVR_IOCTL_USB_READ, endpoint & 15, data, &n);
    return err ? err : n == 0 ? -EAGAIN : (int)n;
}

int simavr_board_enumerate(struct simavr_board *b)
{
    for (int ms = 0; ms < 100 && !simavr_board_is_attached(b); ms++)
        simavr_board_run(b, SIMAVR_HZ / 1000);
    simavr_board_bus_reset(b);
    const int err = simavr_board_control(b, (const uint8_t[]){ 0, 5, 5, 0, 0, 0, 0, 0 }, NULL, 0); // SET_ADDRESS 5
    return err < 0 ? err : simavr_board_control(b, (const uint8_t[]){ 0, 9, 1, 0, 0, 0, 0, 0 }, NULL, 0);
}

// ---- measurement ------------------------------------------------------------------------------------------------------------------------------
void simavr_board_clear_latency(struct simavr_board *b)
{
    memset(b->latency, 0, sizeof(b->latency));
    memset(b->duration, 0, sizeof(b->duration));
    b->margin = UINT32_MAX;
}

const uint32_t *simavr_board_duration(const struct simavr_board *b)
{
    return b->duration;
}

uint32_t simavr_board_margin(const struct simavr_board *b)
{
    return b->margin;
}

const uint32_t *simavr_board_latency(const struct simavr_board *b)
{
    return b->latency;
}

const char *simavr_board_vector_name(int vector)
{
    static const char *const name[SIMAVR_VECTORS] = {
        [7] = "INT6 (button)", [10] = "USB_GEN (reset, suspend)", [11] = "USB_COM (SETUP)", [16] = "TIMER1_CAPT (flash sync)",
        [17] = "TIMER1_COMPA (edge)", [20] = "TIMER1_OVF (clock)", [21] = "TIMER0_COMPA (beat)", [22] = "TIMER0_COMPB (work)", [32] = "TIMER3_COMPA (head)",
    };
    return name[vector];
}
