// rigd/container.c - containers of frames, from outside: every read is bounded, every directory is visited at most once.
#include "rigd/container.h"

#include <errno.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

enum { DIRECTORIES_MAX = 64, ENTRIES_MAX = 4096, PIECES_MAX = 65536 };

struct file {
    int fd, err; // err: of reading
    int64_t size;
    bool big_endian;
    uint32_t n_pieces; // looked at so far
    char *why;
    size_t room;
};

static int bad(struct file *f, const char *format, ...) __attribute__((format(printf, 2, 3)));
static int bad(struct file *f, const char *format, ...)
{
    va_list ap;
    va_start(ap, format);
    vsnprintf(f->why, f->room, format, ap);
    va_end(ap);
    return f->err ? f->err : -EBADMSG;
}

static bool get(struct file *f, int64_t at, void *out, size_t n)
{
    memset(out, 0, n);
    if (at < 0 || (int64_t)n > f->size || at > f->size - (int64_t)n)
        return false;
    for (size_t done = 0; done < n;) {
        const ssize_t got = pread(f->fd, (char *)out + done, n - done, at + (int64_t)done);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0) {
            f->err = got ? -errno : -EIO;
            return false;
        }
        done += (size_t)got;
    }
    return true;
}

static uint64_t number(const unsigned char *b, int n, bool big_endian)
{
    uint64_t v = 0;
    for (int i = 0; i < n; i++)
        v = v << 8 | b[big_endian ? i : n - 1 - i];
    return v;
}

// ---- TIFF ----------------------------------------------------------------------------------------------------------------

struct numbers { // the values of one entry: where and how wide
    int64_t at;
    uint32_t count;
    int width;
};

static bool value(struct file *f, const struct numbers *n, uint32_t i, uint64_t *out)
{
    unsigned char b[4];
    if (i >= n->count || !get(f, n->at + (int64_t)i * n->width, b, (size_t)n->width))
        return false;
    *out = number(b, n->width, f->big_endian);
    return true;
}

// Do the pieces of an image (strips, tiles, an embedded JPEG) lie within the file?
static int check_pieces(struct file *f, const struct numbers *at, const struct numbers *length, const char *what)
{
    if (!at->count || !length->count)
        return 0;
    if (at->count != length->count)
        return bad(f, "%u %s but %u lengths", at->count, what, length->count);
    if (at->count > PIECES_MAX - f->n_pieces)
        return bad(f, "more than %d strips and tiles", PIECES_MAX);
    f->n_pieces += at->count;
    for (uint32_t i = 0; i < at->count; i++) {
        uint64_t begin, n;
        if (!value(f, at, i, &begin) || !value(f, length, i, &n))
            return bad(f, "its table of %s ends beyond the file", what);
        if (begin > (uint64_t)f->size || n > (uint64_t)f->size - begin)
            return bad(f, "%s end at byte %llu, the file at %lld", what, (unsigned long long)(begin + n), (long long)f->size);
    }
    return 0;
}

static int check_tiff(struct file *f, const unsigned char head[16])
{
    int64_t directory[DIRECTORIES_MAX];
    int n_directories = 1, n_entries = 0;
    f->big_endian = head[0] == 'M';
    directory[0] = (int64_t)number(head + 4, 4, f->big_endian);
    for (int d = 0; d < n_directories; d++) {
        unsigned char b[12];
        if (directory[d] < 8 || !get(f, directory[d], b, 2))
            return bad(f, "directory at byte %lld of %lld", (long long)directory[d], (long long)f->size);
        const int n = (int)number(b, 2, f->big_endian);
        struct numbers strip_at = { 0 }, strip_length = { 0 }, tile_at = { 0 }, tile_length = { 0 }, jpeg_at = { 0 }, jpeg_length = { 0 };
        n_entries += n;
        if (n_entries > ENTRIES_MAX)
            return bad(f, "more than %d entries in its directories", ENTRIES_MAX);
        for (int i = 0; i < n; i++) {
            const int64_t at = directory[d] + 2 + 12 * i;
            if (!get(f, at, b, 12))
                return bad(f, "directory at byte %lld ends beyond the file of %lld", (long long)directory[d], (long long)f->size);
            const int tag = (int)number(b, 2, f->big_endian), type = (int)number(b + 2, 2, f->big_endian);
            struct numbers v = { at + 8, (uint32_t)number(b + 4, 4, f->big_endian), type == 3 ? 2 : 4 };
            if (type != 3 && type != 4 && type != 13) // SHORT, LONG, IFD: the rest is not looked into
                continue;
            if ((uint64_t)v.count * (unsigned)v.width > 4)
                v.at = (int64_t)number(b + 8, 4, f->big_endian);
            switch (tag) {
            case 273: strip_at = v; break;
            case 279: strip_length = v; break;
            case 324: tile_at = v; break;
            case 325: tile_length = v; break;
            case 513: jpeg_at = v; break;
            case 514: jpeg_length = v; break;
            case 330: // SubIFDs
                for (uint32_t k = 0; k < v.count && n_directories < DIRECTORIES_MAX; k++) {
                    uint64_t sub;
                    if (!value(f, &v, k, &sub))
                        return bad(f, "its list of directories ends beyond the file");
                    directory[n_directories++] = (int64_t)sub;
                }
                break;
            default: break;
            }
        }
        int err = check_pieces(f, &strip_at, &strip_length, "strips");
        if (!err)
            err = check_pieces(f, &tile_at, &tile_length, "tiles");
        if (!err)
            err = check_pieces(f, &jpeg_at, &jpeg_length, "previews");
        if (err)
            return err;
        if (get(f, directory[d] + 2 + 12 * n, b, 4)) {
            const int64_t next = (int64_t)number(b, 4, f->big_endian);
            bool seen = !next;
            for (int k = 0; k < n_directories; k++)
                seen |= directory[k] == next;
            if (!seen && n_directories < DIRECTORIES_MAX)
                directory[n_directories++] = next;
        }
    }
    return 0;
}

// ---- the others ----------------------------------------------------------------------------------------------------------

static int check_boxes(struct file *f) // CR3: ISO base media
{
    int64_t at = 0;
    for (int i = 0; at < f->size; i++) {
        unsigned char b[16];
        if (i == DIRECTORIES_MAX || !get(f, at, b, 8))
            return bad(f, "%d boxes and then %lld bytes that are none", i, (long long)(f->size - at));
        uint64_t n = number(b, 4, true);
        if (n == 1)
            n = get(f, at, b, 16) ? number(b + 8, 8, true) : 0;
        else if (n == 0)
            n = (uint64_t)(f->size - at); // to the end of the file
        if (n < 8 || n > (uint64_t)(f->size - at))
            return bad(f, "box '%.4s' at byte %lld wants %llu bytes, the file ends at %lld", (const char *)b + 4, (long long)at,
                       (unsigned long long)n, (long long)f->size);
        at += (int64_t)n;
    }
    return 0;
}

static int check_raf(struct file *f)
{
    unsigned char b[24];
    static const char *const what[] = { "preview", "header of the raw", "raw" };
    if (!get(f, 84, b, 24))
        return bad(f, "it ends within its header");
    for (int i = 0; i < 3; i++) {
        const uint64_t begin = number(b + 8 * i, 4, true), n = number(b + 8 * i + 4, 4, true);
        if (begin + n > (uint64_t)f->size)
            return bad(f, "its %s ends at byte %llu, the file at %lld", what[i], (unsigned long long)(begin + n), (long long)f->size);
    }
    return 0;
}

// Cameras pad the end of a JPEG with zeros.
static int check_jpeg(struct file *f)
{
    unsigned char tail[512];
    for (int64_t end = f->size; end > 2;) {
        const size_t n = end < (int64_t)sizeof(tail) ? (size_t)end : sizeof(tail);
        if (!get(f, end - (int64_t)n, tail, n))
            return bad(f, "it cannot be read to its end");
        size_t last = n;
        while (last > 1 && !tail[last - 1])
            last--;
        if (last > 1)
            return tail[last - 2] == 0xff && tail[last - 1] == 0xd9 ? 0 : bad(f, "its last marker is missing");
        end -= (int64_t)n - 1;
    }
    return bad(f, "it is empty");
}

static bool is_any(const char *extension, const char *list)
{
    const size_t n = strlen(extension);
    for (const char *s = list; *s; s += strcspn(s, " "), s += *s == ' ')
        if (!strncasecmp(s, extension, n) && (s[n] == ' ' || !s[n]))
            return true;
    return false;
}

int container_check(int fd, int64_t size_bytes, const char *name, char *why, size_t room)
{
    struct file f = { .fd = fd, .size = size_bytes, .why = why, .room = room };
    const char *dot = strrchr(name, '.');
    unsigned char head[16];
    why[0] = 0;
    if (!dot || !dot[1])
        return 0;
    const bool tiff = is_any(dot + 1, "dng nef nrw cr2 arw srw pef 3fr iiq tif tiff"), jpeg = is_any(dot + 1, "jpg jpeg");
    const bool cr3 = is_any(dot + 1, "cr3"), raf = is_any(dot + 1, "raf");
    if (!tiff && !jpeg && !cr3 && !raf)
        return 0;
    if (!get(&f, 0, head, sizeof(head)))
        return bad(&f, "%lld bytes are no %s file", (long long)size_bytes, dot + 1);
    const bool good = tiff ? !memcmp(head, "II*\0", 4) || !memcmp(head, "MM\0*", 4)
                      : jpeg ? head[0] == 0xff && head[1] == 0xd8 && head[2] == 0xff
                      : cr3 ? !memcmp(head + 4, "ftypcrx ", 8)
                            : !memcmp(head, "FUJIFILMCCD-RAW ", 16);
    if (!good)
        return bad(&f, "it begins with %02x %02x %02x %02x, which no %s file does", head[0], head[1], head[2], head[3], dot + 1);
    return tiff ? check_tiff(&f, head) : jpeg ? check_jpeg(&f) : cr3 ? check_boxes(&f) : check_raf(&f);
}
