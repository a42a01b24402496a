// firmware/usb.c - descriptors and control requests.
#include "firmware/usb.h"
#include "firmware/board.h"
#include "firmware/protocol.h"
#include "firmware/session.h"

enum { DEVICE = 1, CONFIGURATION = 2, STRING = 3 };          // descriptors
enum { MANUFACTURER_STRING = 1, PRODUCT_STRING, SERIAL_STRING }; // string indices
enum { // standard requests
    GET_STATUS = 0,
    CLEAR_FEATURE = 1,
    SET_ADDRESS = 5,
    GET_DESCRIPTOR = 6,
    GET_CONFIGURATION = 8,
    SET_CONFIGURATION = 9,
    GET_INTERFACE = 10,
    SET_INTERFACE = 11,
};

#define TWO(x) (uint8_t)((x) & 0xFF), (uint8_t)((x) >> 8)

static const uint8_t device_descriptor[] BOARD_ROM = {
    18, DEVICE, TWO(0x0200), 0, 0, 0, 64, // USB 2.0, class is the interface's, endpoint 0 of 64 bytes
    TWO(PROTO_VENDOR_ID), TWO(PROTO_PRODUCT_ID), TWO(PROTO_VERSION), MANUFACTURER_STRING, PRODUCT_STRING, SERIAL_STRING, 1,
};

static const uint8_t configuration_descriptor[] BOARD_ROM = {
    9, CONFIGURATION, TWO(32), 1, 1, 0, 0x80, 250 / 2, // one interface, from the bus, 250 mA: the board and its registers' logic
    9, 4, 0, 0, 2, 0xFF, 0, 0, 0,                      // interface 0, two endpoints, vendor class
    7, 5, PROTO_ENDPOINT_OUT, 2, TWO(PROTO_PACKET_BYTES), 0,
    7, 5, PROTO_ENDPOINT_IN, 2, TWO(PROTO_PACKET_BYTES), 0,
};

static const char manufacturer[] BOARD_ROM = PROTO_MANUFACTURER;
static const char product[] BOARD_ROM = PROTO_PRODUCT;

static uint8_t configuration;
static uint64_t tick_before;
static uint16_t room; // what the host asked for and did not get yet

void usb_reset(void)
{
    configuration = 0;
}

static void put(uint8_t byte)
{
    if (room == 0)
        return;
    room--;
    board_control_put(byte);
}

static enum usb_answer put_all(const uint8_t *bytes, uint8_t n)
{
    for (uint8_t i = 0; i < n; i++)
        put(bytes[i]);
    return USB_DATA;
}

static enum usb_answer put_rom(const uint8_t *bytes, uint8_t n)
{
    for (uint8_t i = 0; i < n; i++)
        put(board_rom(bytes + i));
    return USB_DATA;
}

static enum usb_answer put_string(const char *text, uint8_t n)
{
    put((uint8_t)(2 + 2 * n));
    put(STRING);
    for (uint8_t i = 0; i < n; i++) {
        put((uint8_t)board_rom(text + i));
        put(0);
    }
    return USB_DATA;
}

static enum usb_answer put_serial(void)
{
    put(2 + 2 * 20);
    put(STRING);
    for (uint8_t i = 0; i < 20; i++) {
        const uint8_t digit = (uint8_t)(board_serial(i / 2) >> (i % 2 ? 0 : 4)) & 15;
        put((uint8_t)(digit < 10 ? '0' + digit : 'A' + digit - 10));
        put(0);
    }
    return USB_DATA;
}

static enum usb_answer put_descriptor(uint8_t type, uint8_t index)
{
    if (type == DEVICE)
        return put_rom(device_descriptor, sizeof(device_descriptor));
    if (type == CONFIGURATION && index == 0)
        return put_rom(configuration_descriptor, sizeof(configuration_descriptor));
    if (type == STRING && index == 0)
        return put_all((const uint8_t[]){ 4, STRING, TWO(0x0409) }, 4); // English
    if (type == STRING && index == MANUFACTURER_STRING)
        return put_string(manufacturer, sizeof(manufacturer) - 1);
    if (type == STRING && index == PRODUCT_STRING)
        return put_string(product, sizeof(product) - 1);
    if (type == STRING && index == SERIAL_STRING)
        return put_serial();
    return USB_STALL;
}

static enum usb_answer standard(const uint8_t *s)
{
    switch (s[1]) {
    case GET_STATUS:
        return s[0] & 0x80 ? put_all((const uint8_t[]){ 0, 0 }, 2) : USB_STALL;
    case CLEAR_FEATURE:
        return s[0] == 2 && s[2] == 0 && configuration && (s[4] == PROTO_ENDPOINT_OUT || s[4] == PROTO_ENDPOINT_IN) ? USB_CLEAR_HALT : USB_STALL;
    case SET_ADDRESS:
        return s[0] == 0 && s[2] < 128 ? USB_ADDRESS : USB_STALL;
    case GET_DESCRIPTOR:
        return s[0] == 0x80 ? put_descriptor(s[3], s[2]) : USB_STALL;
    case GET_CONFIGURATION:
        return s[0] == 0x80 ? put_all(&configuration, 1) : USB_STALL;
    case SET_CONFIGURATION:
        if (s[0] != 0 || s[2] > 1)
            return USB_STALL;
        configuration = s[2];
        session_link_lost(); // whatever was, begins anew
        return configuration ? USB_CONFIGURED : USB_UNCONFIGURED;
    case GET_INTERFACE:
        return s[0] == 0x81 ? put_all((const uint8_t[]){ 0 }, 1) : USB_STALL;
    case SET_INTERFACE:
        return s[0] == 1 && s[2] == 0 && configuration ? USB_CONFIGURED : USB_STALL;
    }
    return USB_STALL;
}

static enum usb_answer vendor(const uint8_t *s, uint64_t tick)
{
    uint8_t out[PROTO_PACKET_BYTES];
    if (s[0] == 0xC0 && s[1] == PROTO_GET_TIME) {
        proto_put_u64(out, tick);
        proto_put_u64(out + 8, tick_before);
        tick_before = tick;
        return put_all(out, 16);
    }
    if (s[0] == 0xC0 && s[1] == PROTO_GET_CAPABILITIES) {
        session_capabilities(out);
        return put_all(out, PROTO_CAPABILITIES_BYTES);
    }
    if (s[0] == 0xC0 && s[1] == PROTO_GET_STATUS) {
        session_status(out);
        return put_all(out, PROTO_STATUS_BYTES);
    }
    if (s[0] == 0x40 && s[1] == PROTO_RELEASE_ALL) {
        session_release_everything();
        return USB_ACK;
    }
    if (s[0] == 0x40 && s[1] == PROTO_IDENTIFY_LED) {
        session_identify(proto_get_u16(s + 2));
        return USB_ACK;
    }
    return USB_STALL;
}

enum usb_answer usb_setup(const uint8_t setup[8], uint64_t tick)
{
    room = proto_get_u16(setup + 6);
    if (!(setup[0] & 0x80) && room > 0)
        return USB_STALL; // no request of ours carries data to the board
    switch (setup[0] & 0x60) {
    case 0x00:
        return standard(setup);
    case 0x40:
        return vendor(setup, tick);
    }
    return USB_STALL;
}
