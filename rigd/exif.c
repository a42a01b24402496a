// rigd/exif.c - see exif.h. A walk over two directories of a TIFF: the main one and the one EXIF adds. Each offset is checked against
// the file before it is read, each count against what is wanted; nothing is allocated by what the file says.
#include "rigd/exif.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { MOST_ENTRIES = 1000, SEARCHED_BYTES = 65536 };
enum { TYPE_ASCII = 2, TYPE_SHORT = 3, TYPE_LONG = 4, TYPE_RATIONAL = 5, TYPE_SRATIONAL = 10, TYPE_DIRECTORY = 13 };
enum { // tags
    ORIENTATION = 0x112, EXPOSURE_TIME = 0x829a, F_NUMBER = 0x829d, EXIF_DIRECTORY = 0x8769, DATE_ORIGINAL = 0x9003, SHUTTER_SPEED = 0x9201,
    SUBSEC_ORIGINAL = 0x9291, FOCAL_LENGTH = 0x920a, BODY_SERIAL = 0xa431, LENS_MODEL = 0xa434
};

struct tiff {
    int fd;
    int64_t base, end; // of the TIFF in the file
    bool big_endian;
};

struct entry {
    uint16_t tag, type;
    uint32_t count;
    int64_t at; // of its value, from base
};

static bool read_at(const struct tiff *t, int64_t at, void *to, size_t n)
{
    if (at < 0 || at > t->end - t->base || (int64_t)n > t->end - t->base - at)
        return false;
    return pread(t->fd, to, n, (off_t)(t->base + at)) == (ssize_t)n;
}

static uint32_t integer(const struct tiff *t, const uint8_t *p, int n_bytes)
{
    uint32_t v = 0;
    for (int i = 0; i < n_bytes; i++)
        v |= (uint32_t)p[i] << 8 * (t->big_endian ? n_bytes - 1 - i : i);
    return v;
}

static void read_text(const struct tiff *t, const struct entry *e, char *to, size_t room)
{
    const size_t n = e->count < room - 1 ? e->count : room - 1;
    if (e->type != TYPE_ASCII || !read_at(t, e->at, to, n)) {
        to[0] = 0;
        return;
    }
    to[n] = 0;
    for (size_t k = strlen(to); k && to[k - 1] == ' '; k--)
        to[k - 1] = 0;
    for (char *c = to; *c; c++)
        if ((unsigned char)*c < ' ' || (unsigned char)*c > '~')
            *c = '?';
}

static double read_ratio(const struct tiff *t, const struct entry *e)
{
    uint8_t b[8];
    if ((e->type != TYPE_RATIONAL && e->type != TYPE_SRATIONAL) || e->count < 1 || !read_at(t, e->at, b, sizeof(b)))
        return NAN;
    const uint32_t above = integer(t, b, 4), below = integer(t, b + 4, 4);
    if (!below)
        return NAN;
    return e->type == TYPE_RATIONAL ? (double)above / below : (double)(int32_t)above / (int32_t)below;
}

// "2026:11:22 12:34:56"
static bool seconds_of(const char *text, int64_t *seconds)
{
    struct tm tm = { 0 };
    if (sscanf(text, "%4d:%2d:%2d %2d:%2d:%2d", &tm.tm_year, &tm.tm_mon, &tm.tm_mday, &tm.tm_hour, &tm.tm_min, &tm.tm_sec) != 6 ||
        tm.tm_year < 1970 || tm.tm_year > 2200 || tm.tm_mon < 1 || tm.tm_mon > 12 || tm.tm_mday < 1 || tm.tm_mday > 31 || tm.tm_hour < 0 || tm.tm_hour > 23 ||
        tm.tm_min < 0 || tm.tm_min > 59 || tm.tm_sec < 0 || tm.tm_sec > 60)
        return false;
    tm.tm_year -= 1900;
    tm.tm_mon -= 1;
    *seconds = timegm(&tm);
    return true;
}

static void read_entry(struct exif *out, const struct tiff *t, const struct entry *e, int64_t *subsec_ns, int64_t *exif_at)
{
    char text[64];
    double v;
    int64_t seconds;
    uint8_t b[4];
    switch (e->tag) {
    case ORIENTATION:
        if (e->type == TYPE_SHORT && read_at(t, e->at, b, 2) && integer(t, b, 2) >= 1 && integer(t, b, 2) <= 8)
            out->orientation = (int)integer(t, b, 2);
        break;
    case EXIF_DIRECTORY:
        if ((e->type == TYPE_LONG || e->type == TYPE_DIRECTORY) && read_at(t, e->at, b, 4))
            *exif_at = integer(t, b, 4);
        break;
    case EXPOSURE_TIME:
        v = read_ratio(t, e);
        out->label_s = v > 0 && v < 1e5 ? v : 0;
        break;
    case SHUTTER_SPEED:
        v = read_ratio(t, e);
        out->apex_s = fabs(v) < 17 ? exp2(-v) : 0;
        break;
    case F_NUMBER:
        v = read_ratio(t, e);
        out->f_number = v > 0 && v < 1e3 ? v : 0;
        break;
    case FOCAL_LENGTH:
        v = read_ratio(t, e);
        out->focal_mm = v > 0 && v < 1e5 ? v : 0;
        break;
    case DATE_ORIGINAL:
        read_text(t, e, text, sizeof(text));
        if (seconds_of(text, &seconds)) {
            out->has_time = true;
            out->taken_ns = seconds * 1000000000;
        }
        break;
    case SUBSEC_ORIGINAL:
        read_text(t, e, text, sizeof(text));
        int64_t ns = 0, unit = 100000000;
        for (const char *c = text; *c >= '0' && *c <= '9'; c++, unit /= 10)
            ns += (*c - '0') * unit;
        if (text[0] >= '0' && text[0] <= '9') {
            *subsec_ns = ns;
            out->has_subseconds = true;
        }
        break;
    case BODY_SERIAL:
        read_text(t, e, out->serial, sizeof(out->serial));
        break;
    case LENS_MODEL:
        read_text(t, e, out->lens, sizeof(out->lens));
        break;
    default:
        break;
    }
}

static bool read_directory(struct exif *out, const struct tiff *t, int64_t at, int64_t *subsec_ns, int64_t *exif_at)
{
    uint8_t b[12];
    if (!read_at(t, at, b, 2))
        return false;
    const uint32_t n = integer(t, b, 2);
    for (uint32_t i = 0; i < n && i < MOST_ENTRIES; i++) {
        const int64_t entry_at = at + 2 + 12 * (int64_t)i;
        if (!read_at(t, entry_at, b, 12))
            return false;
        struct entry e = { .tag = (uint16_t)integer(t, b, 2), .type = (uint16_t)integer(t, b + 2, 2), .count = integer(t, b + 4, 4) };
        const int size = e.type == TYPE_ASCII ? 1 : e.type == TYPE_SHORT ? 2 : e.type == TYPE_LONG || e.type == TYPE_DIRECTORY ? 4 : 8;
        e.at = (uint64_t)e.count * (uint64_t)size <= 4 ? entry_at + 8 : (int64_t)integer(t, b + 8, 4);
        read_entry(out, t, &e, subsec_ns, exif_at);
    }
    return true;
}

// A TIFF's four bytes: "II*\0", "MM\0*", and the other numbers that Olympus and Panasonic write there.
static bool is_tiff(const uint8_t *p)
{
    return (p[0] == 'I' && p[1] == 'I' && (p[2] == 42 || p[2] == 'U' || p[2] == 'R')) || (p[0] == 'M' && p[1] == 'M' && (p[3] == 42 || p[2] == 'O'));
}

static bool read_tiff(struct exif *out, struct tiff t, int64_t *subsec_ns)
{
    uint8_t b[8];
    int64_t exif_at = 0, none = 0;
    if (!read_at(&t, 0, b, 8) || !is_tiff(b))
        return false;
    t.big_endian = b[0] == 'M';
    if (!read_directory(out, &t, integer(&t, b + 4, 4), subsec_ns, &exif_at))
        return false;
    if (exif_at)
        read_directory(out, &t, exif_at, subsec_ns, &none);
    return true;
}

int exif_read(struct exif *out, int fd)
{
    struct stat st;
    uint8_t b[SEARCHED_BYTES];
    int64_t subsec_ns = 0;
    *out = (struct exif){ 0 };
    if (fstat(fd, &st))
        return -errno;
    const ssize_t n = pread(fd, b, sizeof(b), 0);
    if (n < 0)
        return -errno;
    bool found = read_tiff(out, (struct tiff){ .fd = fd, .end = st.st_size }, &subsec_ns);
    if (!found) { // RAF: in the JPEG's head; CR3: boxes CMT1 (main) and CMT2 (EXIF), each a TIFF
        static const struct {
            char text[7];
            uint8_t n;
        } mark[] = { { "Exif\0\0", 6 }, { "CMT1", 4 }, { "CMT2", 4 } };
        for (size_t k = 0; k < sizeof(mark) / sizeof(mark[0]); k++) {
            const uint8_t *p = memmem(b, (size_t)n, mark[k].text, mark[k].n);
            if (p && read_tiff(out, (struct tiff){ .fd = fd, .base = p + mark[k].n - b, .end = st.st_size }, &subsec_ns))
                found = true;
        }
    }
    if (!found || (!out->has_time && !out->label_s && !out->orientation && !out->serial[0])) {
        *out = (struct exif){ 0 };
        return -ENODATA;
    }
    out->has_subseconds = out->has_subseconds && out->has_time;
    out->taken_ns += out->has_subseconds ? subsec_ns : 0;
    return 0;
}

double exif_true_time_s(double label_s, double apex_s)
{
    // Rounding of labels reaches .093 stops (1/15, 1/30, 1/60, 15, 30); a third and a half lie .167 apart.
    const double most_off = .1, apex_off = .02, dial_end_s = 30.5;
    if (!(label_s > 0) || label_s > dial_end_s)
        return label_s;
    const double stops = log2(label_s), third = round(3 * stops) / 3, half = round(2 * stops) / 2;
    if (apex_s > 0) {
        const double apex = log2(apex_s), grid_3 = round(3 * apex) / 3, grid_2 = round(2 * apex) / 2;
        const double grid = fabs(apex - grid_3) <= fabs(apex - grid_2) ? grid_3 : grid_2;
        if (fabs(apex - grid) <= apex_off && fabs(grid - stops) <= 2 * most_off)
            return exp2(grid);
    }
    if (fabs(stops - third) > most_off && fabs(stops - half) > most_off)
        return label_s;
    return exp2(fabs(stops - third) <= fabs(stops - half) + 1e-9 ? third : half);
}
