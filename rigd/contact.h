// rigd/contact.h - a contact sheet that says which camera to look at: focus and exposure of each beside those of the others.
//
// Sharpness is how much of the edges' energy is in the finest octave (1 px) compared with the next one (2 px), over the blocks with the
// strongest edges, less what flat blocks have (noise): a figure of the lens and its focus rather than of what is in front of it, so
// that bodies can be compared with one another. A camera is soft if it is below half of the others' median.
//
// Exposure is judged in the middle third of the frame, where the subject is: lamps that a camera sees behind it may clip. So may glints:
// a fiftieth of the middle.
#pragma once
#include "solver/take/image.h"

enum { CONTACT_CELL_PX = 240, CONTACT_CELL_HEIGHT_PX = 160, CONTACT_NAME = 24 };

struct contact_figures {
    double sharpness;     // NAN: too small or too flat to say
    double clipped_share, middle_clipped_share; // of pixels
    double headroom_ev;   // from what 98 % of the middle stay below to full; 0: clipped. NAN where full is not known
    double median, p99;   // of luminance, linear
};

enum contact_doubt { CONTACT_SOFT = 1, CONTACT_CLIPPED = 2, CONTACT_DARK = 4 };

struct contact_entry {
    char name[CONTACT_NAME];
    struct contact_figures figures;
    double relative_sharpness, relative_ev; // to the median of all: factor; EV of p99: what is behind the object may be black
    unsigned doubts;
    float (*cell)[3]; // [CONTACT_CELL_HEIGHT_PX][CONTACT_CELL_PX], linear
};

// full_is_one: without a channel "clip" what reaches 1 is clipped (8-bit pictures). 0, -ENOMEM, -EINVAL (no pixels)
int contact_measure(struct contact_figures *out, const struct image *image, bool full_is_one);
int contact_cell(struct contact_entry *e, const struct image *image);        // box means, centred on black; allocates. 0 or -ENOMEM
// Needs three cameras to compare; with fewer only what is clipped is said. developed: luminance is radiance, not the sensor's range.
void contact_judge(struct contact_entry *e, int n, bool developed);
double contact_headroom(const struct contact_entry *e, int n); // what four of five cameras have; NAN: not known
void contact_sentence(const struct contact_entry *e, int n, char *out, size_t room); // "2 of 12 cameras to look at: A03 soft (0.31 of the others'), ..."; ""
// PNG, n cells with names; doubtful ones framed and told. exposure_ev scales all alike. 0 or -errno (logged).
int contact_write(const struct contact_entry *e, int n, double exposure_ev, const char *path);
