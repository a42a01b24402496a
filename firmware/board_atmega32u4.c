// firmware/board_atmega32u4.c - the ATmega32U4 at 16 MHz (Pro Micro, Leonardo): pins, timers, USB device controller.
//
//   PB1 SCK  PB2 MOSI  PB3 MISO   the chains          PD4 (ICP1)   flash-sync capture
//   PB5 (OC1A)  latch             PB6  enable, low    PE6 (INT6)   button
//   PB4  input load, low          PB0  LED, low       PF5          motor drivers' enable, low
//   PC6 yaw step   PD7 yaw direction   PF4 yaw home   PF7 pitch step   PF6 pitch direction   PD1 pitch home
//
// Timer 1 runs freely at 16 MHz: the clock, the latch by compare A, the capture. Timer 0 is the beat, and its compare B calls
// sequencer_work(): its vector comes after all others that matter, so they get their turn between two pieces. Timer 3 is the head's.
// Timer 1's overflows are counted in an interrupt; a reader sees one that was not counted yet by its flag.
#include "firmware/board.h"
#include "firmware/head.h"
#include "firmware/protocol.h"
#include "firmware/sequencer.h"
#include "firmware/session.h"
#include "firmware/usb.h"

#include <avr/boot.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>
#include <util/delay_basic.h>

enum {
    LED = 1 << PB0,
    SCK = 1 << PB1,
    MOSI = 1 << PB2,
    MISO = 1 << PB3,
    LOAD = 1 << PB4,
    LATCH = 1 << PB5,
    ENABLE = 1 << PB6,
    YAW_STEP = 1 << PC6,
    CAPTURE = 1 << PD4,
    PITCH_HOME = 1 << PD1,
    YAW_DIRECTION = 1 << PD7,
    BUTTON = 1 << PE6,
    YAW_HOME = 1 << PF4,
    MOTORS = 1 << PF5,
    PITCH_DIRECTION = 1 << PF6,
    PITCH_STEP = 1 << PF7,
};
enum {
    NEAR_TICKS = 120,   // an edge nearer than this cannot be armed safely
    WINDOW_TICKS = 49152, // armed when nearer than this: before the compare register comes round again
};
enum { LATCH_NONE, LATCH_FAR, LATCH_ARMED };

static volatile uint32_t overflows;
static volatile uint16_t overflows_high;
static uint8_t latch;
static uint32_t latch_tick;
static uint8_t n_beats, n_beats_seen;
static uint8_t reset_cause __attribute__((section(".noinit")));

// ---- start ------------------------------------------------------------------------------------------------------------------------------
// After a watchdog reset the watchdog still runs, at its shortest: it must be stopped before anything else. The RAM that nobody
// uses is marked, to see later how much the stack took.
extern uint8_t _end;
void first_of_all(void) __attribute__((naked, used, section(".init3")));
void first_of_all(void)
{
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
    for (uint8_t *p = &_end; p <= (uint8_t *)RAMEND; p++)
        *p = 0xC5;
}

void board_start(void)
{
    CLKPR = 1 << CLKPCE;
    CLKPR = 0;
    MCUCR = 1 << JTD; // twice, within 4 cycles: port F is ours
    MCUCR = 1 << JTD;
    PORTB = LED | MISO | LOAD | ENABLE; // outputs disabled, input with pull-up
    DDRB = LED | SCK | MOSI | LOAD | LATCH | ENABLE;
    PORTC = 0;
    DDRC = YAW_STEP;
    PORTD = CAPTURE | PITCH_HOME;
    DDRD = YAW_DIRECTION;
    PORTE = BUTTON;
    PORTF = YAW_HOME | MOTORS;
    DDRF = MOTORS | PITCH_DIRECTION | PITCH_STEP;
    SPCR = 1 << SPE | 1 << MSTR;
    SPSR = 1 << SPI2X;
    TCCR1A = 0;
    TCCR1B = 1 << ICNC1 | 1 << CS10; // capture: four equal samples, so 4 ticks late
    TCCR0A = 1 << WGM01;
    OCR0A = BOARD_TICKS_PER_BEAT / 8 - 1;
    TCCR0B = 1 << CS01;
    TCCR3A = 0;
    TCCR3B = 1 << WGM32;
    OCR3A = BOARD_TICKS_PER_S / BOARD_HEAD_HZ - 1;
    EICRB = 1 << ISC60; // both edges
}

uint8_t board_reset_cause(void)
{
    return (uint8_t)((reset_cause & 1 << PORF ? PROTO_RESET_POWER : 0) | (reset_cause & 1 << EXTRF ? PROTO_RESET_PIN : 0) |
                     (reset_cause & 1 << BORF ? PROTO_RESET_BROWN_OUT : 0) | (reset_cause & 1 << WDRF ? PROTO_RESET_WATCHDOG : 0));
}

uint16_t board_unused_ram(void)
{
    const uint8_t *p = &_end;
    while (p <= (uint8_t *)RAMEND && *p == 0xC5)
        p++;
    return (uint16_t)(p - &_end);
}

// ---- clock ------------------------------------------------------------------------------------------------------------------------------
uint8_t board_lock(void)
{
    const uint8_t lock = SREG;
    cli();
    return lock;
}

void board_unlock(uint8_t lock)
{
    __asm__ volatile("" ::: "memory");
    SREG = lock;
}

static uint64_t extend(uint16_t low) // locked; low was read not longer ago than half a turn
{
    uint32_t middle = overflows;
    uint16_t high = overflows_high;
    if ((TIFR1 & 1 << TOV1) && low < 0x8000 && ++middle == 0)
        high++;
    uint64_t now;
    memcpy((uint8_t *)&now, &low, 2);
    memcpy((uint8_t *)&now + 2, &middle, 4);
    memcpy((uint8_t *)&now + 6, &high, 2);
    return now;
}

uint64_t board_now(void)
{
    const uint8_t lock = board_lock();
    const uint64_t now = extend(TCNT1);
    board_unlock(lock);
    return now;
}

uint32_t board_now_low(void)
{
    const uint8_t lock = board_lock();
    const uint16_t low = TCNT1;
    uint16_t middle = (uint16_t)overflows;
    if ((TIFR1 & 1 << TOV1) && low < 0x8000)
        middle++;
    board_unlock(lock);
    return (uint32_t)middle << 16 | low;
}

ISR(TIMER1_OVF_vect)
{
    if (++overflows == 0)
        overflows_high++;
}

// ---- outputs ----------------------------------------------------------------------------------------------------------------------------
static inline __attribute__((always_inline)) void spi_wait(void) // 16 cycles a byte: what can be done meanwhile is done before
{
    while (!(SPSR & 1 << SPIF))
        ;
}

void board_shift(const uint8_t *registers, uint8_t n)
{
    if (n == 0)
        return;
    const uint8_t *p = registers + n - 1;
    SPDR = *p;
    while (--n > 0) {
        const uint8_t next = *--p;
        spi_wait();
        SPDR = next;
    }
    spi_wait();
}

void board_latch(void)
{
    PORTB |= LATCH;
    PORTB &= (uint8_t)~LATCH;
}

static void arm(void)
{
    latch = LATCH_ARMED;
    OCR1A = (uint16_t)(latch_tick - 1); // the pin follows one tick after the match
    TIFR1 = 1 << OCF1A;
    TCCR1A = 1 << COM1A1 | 1 << COM1A0; // rises on the match
    TIMSK1 |= 1 << OCIE1A;
}

bool board_latch_at(uint32_t tick_low)
{
    const int32_t ahead = (int32_t)(tick_low - board_now_low());
    if (ahead < NEAR_TICKS)
        return false;
    latch_tick = tick_low;
    if (ahead < WINDOW_TICKS)
        arm();
    else
        latch = LATCH_FAR;
    return true;
}

static void disconnect(void)
{
    TCCR1A = 1 << COM1A1; // the timer's own copy of the pin must fall too, or the next arm() would raise it at once
    TCCR1C = 1 << FOC1A;
    TCCR1A = 0;
    PORTB &= (uint8_t)~LATCH;
}

bool board_latch_cancel(void)
{
    if (latch == LATCH_NONE)
        return false;
    if (latch == LATCH_ARMED) {
        TCCR1A = 0;
        if (TIFR1 & 1 << OCF1A) { // it rose, or would have while the pin was being taken away
            board_latch();
            return false;
        }
        disconnect();
        TIMSK1 &= (uint8_t)~(1 << OCIE1A);
    }
    latch = LATCH_NONE;
    return true;
}

ISR(TIMER1_COMPA_vect)
{
    TIMSK1 &= (uint8_t)~(1 << OCIE1A);
    if (latch != LATCH_ARMED)
        return; // cancelled while this was on its way
    disconnect();
    latch = LATCH_NONE;
    sequencer_latched();
}

// The flag is cleared first: cleared after, it may be that of this very match, and the next comes a whole beat later.
void board_work_soon(void) // 16 to 32 ticks
{
    TIFR0 = 1 << OCF0B;
    const uint8_t at = (uint8_t)(TCNT0 + 3);
    OCR0B = at > BOARD_TICKS_PER_BEAT / 8 - 1 ? (uint8_t)(at - BOARD_TICKS_PER_BEAT / 8) : at;
    TIMSK0 |= 1 << OCIE0B;
}

ISR(TIMER0_COMPB_vect)
{
    TIMSK0 &= (uint8_t)~(1 << OCIE0B);
    sequencer_work();
}

void board_enable(bool on)
{
    if (on)
        PORTB &= (uint8_t)~ENABLE;
    else
        PORTB |= ENABLE;
}

// ---- inputs -----------------------------------------------------------------------------------------------------------------------------
void board_sample(uint8_t *inputs, uint8_t n_inputs, const uint8_t *outputs, uint8_t n_outputs)
{
    PORTB &= (uint8_t)~LOAD;
    PORTB |= LOAD;
    for (; n_inputs > n_outputs; n_inputs--) { // inputs that come before the outputs must begin
        SPDR = 0;
        spi_wait();
        *inputs++ = SPDR;
    }
    n_outputs = (uint8_t)(n_outputs - n_inputs);
    for (const uint8_t *p = outputs + n_outputs + n_inputs; n_inputs > 0; n_inputs--) {
        SPDR = *--p;
        spi_wait();
        *inputs++ = SPDR;
    }
    board_shift(outputs, n_outputs);
}

bool board_button_high(void)
{
    return PINE & BUTTON;
}

ISR(INT6_vect)
{
    session_button_edge(board_now());
}

void board_capture_edge(bool rising)
{
    const uint8_t lock = board_lock();
    if (rising)
        TCCR1B |= 1 << ICES1;
    else
        TCCR1B &= (uint8_t)~(1 << ICES1);
    TIFR1 = 1 << ICF1;
    board_unlock(lock);
}

ISR(TIMER1_CAPT_vect)
{
    session_capture(extend(ICR1));
}

// ---- beat, head -------------------------------------------------------------------------------------------------------------------------
ISR(TIMER0_COMPA_vect)
{
    n_beats++;
    if (latch == LATCH_FAR && (int32_t)(latch_tick - board_now_low()) < WINDOW_TICKS)
        arm();
    session_beat();
}

ISR(TIMER3_COMPA_vect)
{
    head_beat();
}

void board_head_run(bool on)
{
    if (on) {
        PORTF &= (uint8_t)~MOTORS;
        TIMSK3 = 1 << OCIE3A;
        TCCR3B |= 1 << CS30;
    } else {
        TCCR3B &= (uint8_t)~(1 << CS30);
        TIMSK3 = 0;
    }
}

void board_head_direction(uint8_t axis, bool positive)
{
    if (axis == 0)
        PORTD = positive ? PORTD | YAW_DIRECTION : PORTD & (uint8_t)~YAW_DIRECTION;
    else
        PORTF = positive ? PORTF | PITCH_DIRECTION : PORTF & (uint8_t)~PITCH_DIRECTION;
}

void board_head_step(uint8_t axis)
{
    if (axis == 0)
        PORTC |= YAW_STEP;
    else
        PORTF |= PITCH_STEP;
    _delay_loop_1(11); // 33 cycles: 2 us, what the slowest common driver (DRV8825) asks for
    if (axis == 0)
        PORTC &= (uint8_t)~YAW_STEP;
    else
        PORTF &= (uint8_t)~PITCH_STEP;
}

bool board_home_high(uint8_t axis)
{
    return axis == 0 ? PINF & YAW_HOME : PIND & PITCH_HOME;
}

void board_led(bool on)
{
    if (on)
        PORTB &= (uint8_t)~LED;
    else
        PORTB |= LED;
}

// ---- USB device controller ---------------------------------------------------------------------------------------------------------------
// Interrupts do the least: the stamp of a SETUP packet, and what must not wait (reset, suspend). The rest is polled. UENUM
// selects which endpoint's registers are seen; interrupts put it back.
enum { OUT = PROTO_ENDPOINT_OUT, IN = PROTO_ENDPOINT_IN & 15 };
enum { SIZE_64 = 1 << EPSIZE1 | 1 << EPSIZE0, TYPE_BULK = 1 << EPTYPE1 };

static volatile uint64_t setup_tick;
static volatile bool setup_stamped, is_reset;
static bool is_configured, is_address_due;

static void open_endpoint(uint8_t number, uint8_t type, uint8_t size)
{
    UENUM = number;
    UECONX = 1 << EPEN;
    UECFG0X = type;
    UECFG1X = size | 1 << ALLOC;
}

void board_run(void)
{
    set_sleep_mode(SLEEP_MODE_IDLE);
    sleep_enable();
    wdt_enable(WDTO_120MS);
    UHWCON = 1 << UVREGE;
    PLLCSR = 1 << PINDIV | 1 << PLLE;
    while (!(PLLCSR & 1 << PLOCK)) // a dead PLL is the watchdog's
        ;
    USBCON = 1 << USBE | 1 << OTGPADE | 1 << VBUSTE;
    UDIEN = 1 << EORSTE | 1 << SUSPE;
    UDCON = 0; // full speed, attached
    TIMSK1 = 1 << TOIE1 | 1 << ICIE1;
    TIMSK0 = 1 << OCIE0A;
    EIMSK = 1 << INT6;
    sei();
}

ISR(USB_GEN_vect)
{
    if (UDINT & 1 << EORSTI) {
        UDINT = (uint8_t)~(1 << EORSTI);
        const uint8_t endpoint = UENUM;
        open_endpoint(0, 0, SIZE_64);
        UEIENX = 1 << RXSTPE;
        UENUM = endpoint;
        is_reset = true;
        session_link_lost();
    }
    if (UDINT & 1 << SUSPI) {
        UDINT = (uint8_t)~(1 << SUSPI);
        session_link_lost();
    }
    if (USBINT & 1 << VBUSTI) {
        USBINT = (uint8_t)~(1 << VBUSTI);
        if (!(USBSTA & 1 << VBUS))
            session_link_lost();
    }
}

ISR(USB_COM_vect)
{
    const uint64_t now = board_now();
    const uint8_t endpoint = UENUM;
    UENUM = 0;
    if (UEINTX & 1 << RXSTPI) {
        setup_tick = now;
        setup_stamped = true;
    }
    UEIENX = 0; // until it is answered
    UENUM = endpoint;
}

void board_control_put(uint8_t byte)
{
    UEDATX = byte;
}

static void answer_setup(void)
{
    uint8_t setup[8];
    for (uint8_t i = 0; i < sizeof(setup); i++)
        setup[i] = UEDATX;
    const uint8_t lock = board_lock();
    const uint64_t tick = setup_stamped ? setup_tick : board_now();
    setup_stamped = false;
    UEINTX = (uint8_t)~(1 << RXSTPI);
    UEIENX = 1 << RXSTPE;
    board_unlock(lock);
    is_address_due = false;
    for (uint8_t i = 0; !(UEINTX & 1 << TXINI) && i < UINT8_MAX; i++) // a few cycles, until the bank is ours
        ;
    const enum usb_answer answer = usb_setup(setup, tick);
    switch (answer) {
    case USB_STALL:
        UECONX = 1 << STALLRQ | 1 << EPEN;
        return;
    case USB_ADDRESS:
        UDADDR = setup[2];
        is_address_due = true;
        break;
    case USB_CONFIGURED:
        UERST = 1 << OUT | 1 << IN;
        UERST = 0;
        open_endpoint(OUT, TYPE_BULK, SIZE_64 | 1 << EPBK0);
        open_endpoint(IN, TYPE_BULK | 1 << EPDIR, SIZE_64 | 1 << EPBK0);
        UENUM = 0;
        is_configured = true;
        break;
    case USB_CLEAR_HALT:
        UENUM = setup[4] & 7;
        UECONX = 1 << STALLRQC | 1 << RSTDT | 1 << EPEN;
        UENUM = 0;
        break;
    case USB_UNCONFIGURED:
        is_configured = false;
        break;
    case USB_ACK:
    case USB_DATA:
        break;
    }
    UEINTX = (uint8_t)~(1 << TXINI);
}

void board_poll(void)
{
    UENUM = OUT;
    if (!is_configured || !(UEINTX & 1 << RXOUTI))
        sleep_cpu(); // at most a beat
    const uint8_t beats = n_beats;
    if (beats != n_beats_seen) { // the interrupts go on, and the loop does
        n_beats_seen = beats;
        wdt_reset();
    }
    if (is_reset) {
        is_reset = false;
        is_configured = is_address_due = false;
        UDADDR = 0;
        usb_reset();
    }
    UENUM = 0;
    const uint8_t flags = UEINTX;
    if (flags & 1 << RXSTPI) {
        answer_setup();
        return;
    }
    if (flags & 1 << RXOUTI) // the host has taken the answer
        UEINTX = (uint8_t)~(1 << RXOUTI);
    if (is_address_due && (flags & 1 << TXINI)) {
        is_address_due = false;
        UDADDR |= 1 << ADDEN;
    }
}

bool board_receive(uint8_t *byte)
{
    if (!is_configured)
        return false;
    UENUM = OUT;
    if (!(UEINTX & 1 << RXOUTI))
        return false;
    const bool has = UEBCLX > 0;
    if (has)
        *byte = UEDATX;
    if (UEBCLX == 0) {
        UEINTX = (uint8_t)~(1 << RXOUTI);
        UEINTX = (uint8_t)~(1 << FIFOCON);
    }
    return has;
}

bool board_can_send(void)
{
    UENUM = IN;
    return is_configured && (UEINTX & 1 << TXINI);
}

// Of an IN endpoint bit 2 of UEINTX is not RXOUTI but KILLBK: a 1 throws away the packet that was written last.
void board_send(const uint8_t *frame, uint8_t n)
{
    UENUM = IN;
    for (uint8_t i = 0; i < n; i++)
        UEDATX = frame[i];
    UEINTX = (uint8_t)~(1 << TXINI | 1 << RXOUTI);
    UEINTX = (uint8_t)~(1 << FIFOCON | 1 << RXOUTI);
}

uint8_t board_serial(uint8_t i)
{
    const uint8_t lock = board_lock();
    const uint8_t byte = boot_signature_byte_get((uint16_t)(0x0E + i));
    board_unlock(lock);
    return byte;
}
