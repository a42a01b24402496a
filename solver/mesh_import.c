// solver/mesh_import.c - from a mesh file to a mesh: our own check of the file's outer form, then assimp, then clean-up.
//
// assimp is lenient: it makes something of a file cut short, of faces that point nowhere, of quantised glTF. So each format is
// first walked by code of ours that knows only counts, ranges and lengths and can say where and what is wrong. assimp reads from
// memory through our file functions: it opens nothing but the file itself and a glTF's buffers.
#include "solver/mesh.h"
#include "solver/mesh_import.h"
#include "solver/take/json.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <assimp/cfileio.h>
#include <assimp/cimport.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>
#include <errno.h>
#include <inttypes.h>
#include <locale.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { MAX_TRIANGLES = 1 << 26, GLTF_MAX_DEPTH = 256 };
static const size_t max_file_bytes = (size_t)8 << 30;

__attribute__((format(printf, 3, 4))) static int refuse(const struct mesh_file *f, int err, const char *format, ...)
{
    char what[512];
    va_list args;
    va_start(args, format);
    vsnprintf(what, sizeof(what), format, args);
    va_end(args);
    log_error("mesh: %s: %s", f->path, what);
    return err;
}

// ---- OBJ ----------------------------------------------------------------------------------------------------------------

static bool is_blank(char c)
{
    return c == ' ' || c == '\t' || c == '\r' || c == '\v' || c == '\f';
}

static size_t next_word(const char **at, const char *end, const char **word)
{
    while (*at < end && is_blank(**at))
        ++*at;
    *word = *at;
    while (*at < end && !is_blank(**at))
        ++*at;
    return (size_t)(*at - *word);
}

static size_t count_digits(const char *c, const char *end)
{
    size_t n = 0;
    while (c + n < end && c[n] >= '0' && c[n] <= '9')
        n++;
    return n;
}

static bool is_number(const char *c, size_t n)
{
    const char *end = c + n;
    c += c < end && (*c == '+' || *c == '-');
    const size_t n_whole = count_digits(c, end);
    c += n_whole;
    size_t n_fraction = 0;
    if (c < end && *c == '.') {
        n_fraction = count_digits(c + 1, end);
        c += 1 + n_fraction;
    }
    if (n_whole + n_fraction == 0)
        return false;
    if (c < end && (*c == 'e' || *c == 'E')) {
        c++;
        c += c < end && (*c == '+' || *c == '-');
        const size_t n_exponent = count_digits(c, end);
        if (n_exponent == 0 || n_exponent > 4)
            return false;
        c += n_exponent;
    }
    return c == end;
}

struct obj {
    const struct mesh_file *file;
    int64_t line;
    int64_t n[3];                    // v, vt, vn so far
    int64_t highest[3], highest_line[3]; // largest index seen, and where: forward references are resolved at the end
    int64_t n_faces;
};
static const char *const obj_kinds[3] = { "v", "vt", "vn" };

static int check_obj_numbers(struct obj *o, const char *at, const char *end, int kind, int n_least)
{
    const char *word;
    size_t n;
    int found = 0;
    for (; (n = next_word(&at, end, &word)); found++)
        if (!is_number(word, n))
            return refuse(o->file, -EINVAL, "line %" PRId64 ": '%.*s' is not a finite number (%s number %" PRId64 ")", o->line,
                          n < 40 ? (int)n : 40, word, obj_kinds[kind], o->n[kind] + 1);
    if (found < n_least)
        return refuse(o->file, -EINVAL, "line %" PRId64 ": %s with %d numbers; expected %d", o->line, obj_kinds[kind], found,
                      n_least);
    o->n[kind]++;
    return 0;
}

// One index of a corner; "" is allowed for vt (found = false).
static int check_obj_index(struct obj *o, const char *text, size_t n, int kind, bool *found)
{
    *found = n > 0;
    if (n == 0)
        return 0;
    const bool negative = *text == '-';
    const size_t n_digits = n - negative;
    if (count_digits(text + negative, text + n) != n_digits || n_digits < 1 || n_digits > 10)
        return refuse(o->file, -EINVAL, "line %" PRId64 ": '%.*s' is not an index", o->line, n < 40 ? (int)n : 40, text);
    int64_t index = 0;
    for (size_t i = negative; i < n; i++)
        index = 10 * index + (text[i] - '0');
    const int64_t absolute = negative ? o->n[kind] + 1 - index : index;
    if (absolute < 1 || index == 0)
        return refuse(o->file, -EINVAL, "line %" PRId64 ": a face uses %s %.*s; there are %" PRId64 " so far, counted from 1",
                      o->line, obj_kinds[kind], (int)n, text, o->n[kind]);
    if (absolute > o->highest[kind])
        o->highest[kind] = absolute, o->highest_line[kind] = o->line;
    return 0;
}

static int check_obj_face(struct obj *o, const char *at, const char *end)
{
    const char *word;
    size_t n;
    int n_corners = 0, n_with_uv = 0;
    for (; (n = next_word(&at, end, &word)); n_corners++) {
        for (int kind = 0; kind < 3; kind++) {
            const char *slash = kind < 2 ? memchr(word, '/', n) : NULL;
            const size_t n_index = slash ? (size_t)(slash - word) : n;
            bool found;
            const int err = check_obj_index(o, word, n_index, kind, &found);
            if (err)
                return err;
            if (kind == 0 && !found)
                return refuse(o->file, -EINVAL, "line %" PRId64 ": a corner without a vertex", o->line);
            n_with_uv += kind == 1 && found;
            word += n_index + (slash ? 1 : 0), n -= n_index + (slash ? 1 : 0);
        }
    }
    if (n_corners < 3)
        return refuse(o->file, -EINVAL, "line %" PRId64 ": a face with %d corners; expected 3 or more", o->line, n_corners);
    if (n_with_uv != 0 && n_with_uv != n_corners)
        return refuse(o->file, -EINVAL, "line %" PRId64 ": %d of %d corners have UVs; expected all or none", o->line, n_with_uv,
                      n_corners);
    o->n_faces++;
    return 0;
}

static int check_obj(struct mesh_file *f)
{
    struct obj o = { .file = f };
    const char *at = f->bytes, *end = f->bytes + f->n_bytes;
    while (at < end) {
        const char *stop = memchr(at, '\n', (size_t)(end - at));
        o.line++;
        if (!stop)
            return refuse(f, -EINVAL, "the file ends within line %" PRId64 ": it is cut short (or lacks its last line end)",
                          o.line);
        const char *text = at, *word;
        const size_t n = next_word(&text, stop, &word);
        int err = 0;
        const char *last = stop - (stop > at && stop[-1] == '\r');
        if (last > at && last[-1] == '\\')
            err = refuse(f, -ENOTSUP, "line %" PRId64 ": continued on the next line by \\: write it as one line", o.line);
        else if (n == 1 && *word == 'v')
            err = check_obj_numbers(&o, text, stop, 0, 3);
        else if (n == 2 && !memcmp(word, "vt", 2))
            err = check_obj_numbers(&o, text, stop, 1, 2);
        else if (n == 2 && !memcmp(word, "vn", 2))
            err = check_obj_numbers(&o, text, stop, 2, 3);
        else if (n == 1 && *word == 'f')
            err = check_obj_face(&o, text, stop);
        if (err)
            return err;
        at = stop + 1;
    }
    for (int kind = 0; kind < 3; kind++)
        if (o.highest[kind] > o.n[kind])
            return refuse(f, -EINVAL, "line %" PRId64 ": a face uses %s %" PRId64 "; the file has %" PRId64 " of them",
                          o.highest_line[kind], obj_kinds[kind], o.highest[kind], o.n[kind]);
    if (o.n_faces == 0)
        return refuse(f, -EINVAL, "no faces among %" PRId64 " lines: it is cut short, or a point cloud; expected triangles",
                      o.line);
    if (o.highest[0] < o.n[0])
        log_warning("mesh: %s: no face uses the last %" PRId64 " of %" PRId64 " vertices: was the file cut short?", f->path,
                    o.n[0] - o.highest[0], o.n[0]);
    return 0;
}

// assimp takes ".5" for no number: the same text with "0.5" in such places, malloc'd. NULL without memory.
static char *obj_with_leading_zeros(const struct mesh_file *f, size_t *n_bytes)
{
    char *out = malloc(f->n_bytes + f->n_bytes / 3 + 1); // " .5": one more for every three, at most
    size_t n = 0;
    for (size_t i = 0; i < f->n_bytes && out; i++) {
        const char *c = f->bytes + i; // c[1] is there: a NUL ends the bytes
        if (*c == '.' && i > 0 && is_blank(c[-1]) && c[1] >= '0' && c[1] <= '9')
            out[n++] = '0';
        out[n++] = *c;
    }
    *n_bytes = n;
    return out;
}

// ---- PLY ----------------------------------------------------------------------------------------------------------------

enum { PLY_MAX_ELEMENTS = 32, PLY_MAX_PROPERTIES = 128, PLY_ASCII = 0, PLY_LITTLE, PLY_BIG };

struct ply_property {
    int size, list_size; // bytes of a value, and of a list's count (0: no list)
    bool is_float, list_is_float, is_indices, is_texcoord;
    char name[16];
};
struct ply_element {
    char name[32];
    uint64_t count;
    int n_properties;
    struct ply_property property[PLY_MAX_PROPERTIES];
};
struct ply {
    const struct mesh_file *file;
    int encoding;
    const char *at, *end;
    int n_elements;
    bool has_texcoord; // UVs per corner of a face
    struct ply_element element[PLY_MAX_ELEMENTS];
};

static int ply_type(const char *word, size_t n, bool *is_float)
{
    static const struct {
        const char *name;
        int size;
    } types[] = {
        { "char", 1 }, { "int8", 1 }, { "uchar", 1 }, { "uint8", 1 }, { "short", 2 }, { "int16", 2 }, { "ushort", 2 },
        { "uint16", 2 }, { "int", 4 }, { "int32", 4 }, { "uint", 4 }, { "uint32", 4 }, { "float", 4 }, { "float32", 4 },
        { "double", 8 }, { "float64", 8 },
    };
    for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
        if (n == strlen(types[i].name) && !memcmp(types[i].name, word, n)) {
            *is_float = i >= 12;
            return types[i].size;
        }
    return 0;
}

static bool word_is(const char *word, size_t n, const char *what)
{
    return n == strlen(what) && !memcmp(word, what, n);
}

static int ply_property_line(struct ply *p, const char *at, const char *end, int line)
{
    struct ply_element *e = p->n_elements ? &p->element[p->n_elements - 1] : NULL;
    if (!e || e->n_properties == PLY_MAX_PROPERTIES)
        return refuse(p->file, -EINVAL, "header line %d: %s", line,
                      e ? "too many properties" : "a property before any element");
    struct ply_property *q = &e->property[e->n_properties];
    const char *word;
    size_t n = next_word(&at, end, &word);
    *q = (struct ply_property){ 0 };
    if (word_is(word, n, "list")) {
        n = next_word(&at, end, &word);
        q->list_size = ply_type(word, n, &q->list_is_float);
        if (!q->list_size || q->list_is_float)
            return refuse(p->file, -EINVAL, "header line %d: '%.*s' is not a whole-number type", line, n < 40 ? (int)n : 40,
                          word);
        n = next_word(&at, end, &word);
    }
    q->size = ply_type(word, n, &q->is_float);
    if (!q->size)
        return refuse(p->file, -EINVAL, "header line %d: '%.*s' is not a type of PLY", line, n < 40 ? (int)n : 40, word);
    n = next_word(&at, end, &word);
    if (n == 0)
        return refuse(p->file, -EINVAL, "header line %d: a property without a name", line);
    if (!strcmp(e->name, "face") && q->list_size) {
        q->is_indices = word_is(word, n, "vertex_indices") || word_is(word, n, "vertex_index");
        q->is_texcoord = word_is(word, n, "texcoord");
        if (q->is_texcoord && !q->is_float)
            return refuse(p->file, -EINVAL, "header line %d: texcoord is of whole numbers; expected float", line);
        p->has_texcoord = p->has_texcoord || q->is_texcoord;
    }
    snprintf(q->name, sizeof(q->name), "%.*s", n < 15 ? (int)n : 15, word);
    e->n_properties++;
    return 0;
}

static int ply_header(struct ply *p)
{
    bool has_format = false;
    for (int line = 1;; line++) {
        const char *stop = memchr(p->at, '\n', (size_t)(p->end - p->at));
        if (!stop)
            return refuse(p->file, -EINVAL, "header line %d: the file ends before end_header: it is cut short", line);
        const char *at = p->at, *word;
        p->at = stop + 1;
        size_t n = next_word(&at, stop, &word);
        if (word_is(word, n, "format")) {
            n = next_word(&at, stop, &word);
            p->encoding = word_is(word, n, "ascii") ? PLY_ASCII : word_is(word, n, "binary_little_endian") ? PLY_LITTLE
                          : word_is(word, n, "binary_big_endian") ? PLY_BIG : -1;
            if (p->encoding < 0)
                return refuse(p->file, -EINVAL, "header line %d: format '%.*s' is not one of PLY's", line,
                              n < 40 ? (int)n : 40, word);
            has_format = true;
        } else if (word_is(word, n, "element")) {
            if (p->n_elements == PLY_MAX_ELEMENTS)
                return refuse(p->file, -EINVAL, "header line %d: more than %d elements", line, PLY_MAX_ELEMENTS);
            struct ply_element *e = &p->element[p->n_elements++];
            n = next_word(&at, stop, &word);
            snprintf(e->name, sizeof(e->name), "%.*s", n < 31 ? (int)n : 31, word);
            n = next_word(&at, stop, &word);
            if (n < 1 || n > 10 || count_digits(word, word + n) != n)
                return refuse(p->file, -EINVAL, "header line %d: count '%.*s'; expected a whole number up to 9999999999", line,
                              n < 40 ? (int)n : 40, word);
            for (size_t i = 0; i < n; i++)
                e->count = 10 * e->count + (uint64_t)(word[i] - '0');
        } else if (word_is(word, n, "property")) {
            const int err = ply_property_line(p, at, stop, line);
            if (err)
                return err;
        } else if (word_is(word, n, "end_header")) {
            return has_format ? 0 : refuse(p->file, -EINVAL, "the header has no format line");
        }
    }
}

// The next value, as a whole number where it is one. False: the file ends, or (ASCII) it is no number.
static bool ply_value(struct ply *p, int size, int64_t *out)
{
    uint64_t bits = 0;
    *out = 0;
    if (p->encoding == PLY_ASCII) {
        while (p->at < p->end && (is_blank(*p->at) || *p->at == '\n'))
            p->at++;
        const char *word = p->at;
        while (p->at < p->end && !is_blank(*p->at) && *p->at != '\n')
            p->at++;
        const size_t n = (size_t)(p->at - word);
        if (p->at == p->end || !is_number(word, n)) // a value at the very end may be cut short
            return false;
        const bool negative = *word == '-';
        for (size_t i = negative; i < n && word[i] >= '0' && word[i] <= '9' && *out < INT64_C(1) << 40; i++)
            *out = 10 * *out + (word[i] - '0');
        *out = negative ? -*out : *out;
        return true;
    }
    if (p->end - p->at < size)
        return false;
    for (int i = 0; i < size; i++)
        bits |= (uint64_t)(unsigned char)p->at[p->encoding == PLY_LITTLE ? i : size - 1 - i] << 8 * i;
    p->at += size;
    *out = (int64_t)bits;
    return true;
}

static int ply_element_data(struct ply *p, const struct ply_element *e, uint64_t n_vertices)
{
    uint64_t i = 0;
    for (; i < e->count; i++) {
        int64_t n_corners = 0, n_texcoord = 0;
        for (int k = 0; k < e->n_properties; k++) {
            const struct ply_property *q = &e->property[k];
            int64_t n = 1, value;
            if (q->list_size && !ply_value(p, q->list_size, &n))
                goto cut_short;
            if (q->list_size && (n < 0 || n > p->end - p->at))
                return refuse(p->file, -EINVAL, "%s %" PRIu64 ": a list of %" PRId64 " values; %td bytes follow", e->name, i,
                              n, p->end - p->at);
            n_corners = q->is_indices ? n : n_corners;
            n_texcoord = q->is_texcoord ? n : n_texcoord;
            if (q->is_indices && n < 3)
                return refuse(p->file, -EINVAL, "face %" PRIu64 " has %" PRId64 " corners; expected 3 or more", i, n);
            for (int64_t j = 0; j < n; j++) {
                if (!ply_value(p, q->size, &value))
                    goto cut_short;
                if (q->is_indices && (value < 0 || (uint64_t)value >= n_vertices))
                    return refuse(p->file, -EINVAL, "face %" PRIu64 " uses vertex %" PRId64 " of %" PRIu64, i, value,
                                  n_vertices);
            }
        }
        if (n_texcoord && n_texcoord != 2 * n_corners)
            return refuse(p->file, -EINVAL, "face %" PRIu64 " has %" PRId64 " numbers in texcoord; expected two for each of its %" PRId64
                          " corners, or none", i, n_texcoord, n_corners);
    }
    return 0;
cut_short:
    return refuse(p->file, -EINVAL, "the data end (or are no number) at offset %td, within %s %" PRIu64 " of %" PRIu64
                  " announced: the file is cut short or broken", p->at - p->file->bytes, e->name, i + 1, e->count);
}

static int check_ply(struct mesh_file *f)
{
    struct ply *p = calloc(1, sizeof(*p));
    if (!p)
        return -ENOMEM;
    p->file = f, p->at = f->bytes, p->end = f->bytes + f->n_bytes;
    uint64_t n_vertices = 0, n_faces = 0;
    int err = ply_header(p);
    for (int i = 0; i < p->n_elements && !err; i++) {
        const struct ply_element *e = &p->element[i];
        if (!strcmp(e->name, "vertex"))
            n_vertices = e->count;
        if (!strcmp(e->name, "face"))
            n_faces = e->count;
        // every value is at least a byte: a count beyond the file's size is refused before anyone allocates for it
        if (e->count > f->n_bytes || (e->n_properties == 0 && e->count > 0))
            err = refuse(f, -EINVAL, "%" PRIu64 " %s elements announced, %d properties each; the file has %zu bytes", e->count,
                         e->name, e->n_properties, f->n_bytes);
        else
            err = ply_element_data(p, e, n_vertices);
    }
    if (!err && n_faces == 0)
        err = refuse(f, -EINVAL, "no faces: a point cloud; expected triangles");
    free(p);
    return err;
}

// A value as a number. Only after check_ply().
static double ply_number(struct ply *p, const struct ply_property *q, locale_t c_locale)
{
    const char *before = p->at;
    int64_t bits;
    (void)ply_value(p, q->size, &bits);
    if (p->encoding == PLY_ASCII)
        return strtod_l(before, NULL, c_locale);
    if (!q->is_float)
        return (double)bits;
    if (q->size == 4) {
        const uint32_t low = (uint32_t)bits;
        float value;
        memcpy(&value, &low, sizeof(value));
        return value;
    }
    double value;
    memcpy(&value, &bits, sizeof(value));
    return value;
}

// Corners are written as OBJ's v/vt/vn: assimp would give a vertex one UV, whatever its faces say.
static void put_ply_face(FILE *out, struct ply *p, const struct ply_element *e, bool has_normals, uint64_t *n_uvs,
                         locale_t c_locale)
{
    struct ply indices = { 0 }, texcoord = { 0 };
    const struct ply_property *index = NULL, *uv = NULL;
    int64_t n_corners = 0, n_texcoord = 0, ignored;
    for (int k = 0; k < e->n_properties; k++) {
        const struct ply_property *q = &e->property[k];
        int64_t n = 1;
        if (q->list_size)
            (void)ply_value(p, q->list_size, &n);
        if (q->is_indices)
            index = q, n_corners = n, indices.at = p->at;
        if (q->is_texcoord)
            uv = q, n_texcoord = n, texcoord.at = p->at;
        while (n-- > 0)
            (void)ply_value(p, q->size, &ignored);
    }
    if (!index)
        return;
    indices.end = texcoord.end = p->end, indices.encoding = texcoord.encoding = p->encoding;
    for (int64_t i = 0; uv && i < n_texcoord / 2; i++) {
        const double u = ply_number(&texcoord, uv, c_locale), v = ply_number(&texcoord, uv, c_locale);
        fprintf(out, "vt %.9g %.9g\n", u, v);
    }
    fprintf(out, "f");
    for (int64_t i = 0; i < n_corners; i++) {
        int64_t vertex;
        (void)ply_value(&indices, index->size, &vertex);
        fprintf(out, " %" PRId64, vertex + 1);
        if (n_texcoord)
            fprintf(out, "/%" PRIu64, *n_uvs + (uint64_t)i + 1);
        if (has_normals)
            fprintf(out, "%s/%" PRId64, n_texcoord ? "" : "/", vertex + 1);
    }
    fprintf(out, "\n");
    *n_uvs += (uint64_t)n_texcoord / 2;
}

static char *ply_as_obj(const struct mesh_file *f, size_t *n_bytes)
{
    static const char *const wanted[6] = { "x", "y", "z", "nx", "ny", "nz" };
    char *text = NULL;
    uint64_t n_uvs = 0;
    struct ply *p = calloc(1, sizeof(*p));
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    FILE *out = p && c_locale ? open_memstream(&text, n_bytes) : NULL;
    bool has_normals = false;
    if (!out)
        goto done;
    const locale_t before = uselocale(c_locale);
    p->file = f, p->at = f->bytes, p->end = f->bytes + f->n_bytes;
    (void)ply_header(p);
    for (int i = 0; i < p->n_elements; i++) {
        const struct ply_element *e = &p->element[i];
        const bool is_vertex = !strcmp(e->name, "vertex"), is_face = !strcmp(e->name, "face");
        int n_normal = 0;
        for (int k = 0; k < e->n_properties && is_vertex; k++)
            n_normal += e->property[k].name[0] == 'n' && strchr("xyz", e->property[k].name[1]) && !e->property[k].name[2];
        has_normals = has_normals || n_normal == 3;
        for (uint64_t row = 0; row < e->count; row++) {
            if (is_face) {
                put_ply_face(out, p, e, has_normals, &n_uvs, c_locale);
                continue;
            }
            double value[6] = { 0 };
            for (int k = 0; k < e->n_properties; k++) {
                const struct ply_property *q = &e->property[k];
                int64_t n = 1, ignored;
                if (q->list_size)
                    (void)ply_value(p, q->list_size, &n);
                int place = -1;
                for (int w = 0; w < 6 && is_vertex && !q->list_size; w++)
                    place = strcmp(q->name, wanted[w]) ? place : w;
                if (place >= 0)
                    value[place] = ply_number(p, q, c_locale);
                else
                    while (n-- > 0)
                        (void)ply_value(p, q->size, &ignored);
            }
            if (is_vertex)
                fprintf(out, "v %.9g %.9g %.9g\n", value[0], value[1], value[2]);
            if (is_vertex && n_normal == 3)
                fprintf(out, "vn %.9g %.9g %.9g\n", value[3], value[4], value[5]);
        }
    }
    uselocale(before);
    const bool failed = ferror(out);
    if (fclose(out) || failed) {
        free(text);
        text = NULL;
    }
done:
    if (c_locale)
        freelocale(c_locale);
    free(p);
    return text;
}

// ---- glTF ---------------------------------------------------------------------------------------------------------------

static uint32_t u32_at(const char *bytes)
{
    const unsigned char *b = (const unsigned char *)bytes;
    return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

// Is there a whole number from 0 to max at array[index].key? `otherwise` if the key is not there; -1: no.
static int64_t gltf_int(const struct json *doc, const char *array, int64_t index, const char *key, int64_t otherwise,
                        int64_t max)
{
    char path[160];
    int64_t value;
    snprintf(path, sizeof(path), "%s.%" PRId64 ".%s", array, index, key);
    if (!json_get(doc, path))
        return otherwise;
    return json_get_int(doc, path, &value) || value < 0 || value > max ? -1 : value;
}

static int64_t gltf_length(const struct json *doc, const char *array)
{
    const int n = json_length(doc, array);
    return n < 0 ? 0 : n;
}

static int check_gltf_extensions(const struct mesh_file *f, const struct json *doc)
{
    static const char *const refused[] = { "KHR_draco_mesh_compression", "EXT_meshopt_compression" };
    static const char *const lists[] = { "extensionsRequired", "extensionsUsed" };
    for (int l = 0; l < 2; l++)
        for (int64_t i = 0; i < gltf_length(doc, lists[l]); i++) {
            char path[64];
            const char *name;
            snprintf(path, sizeof(path), "%s.%" PRId64, lists[l], i);
            if (json_get_string(doc, path, &name))
                continue;
            for (size_t k = 0; k < sizeof(refused) / sizeof(refused[0]); k++)
                if (!strcmp(name, refused[k]))
                    return refuse(f, -ENOTSUP, "the mesh is compressed with %s, which is not read; export it without mesh "
                                  "compression", name);
        }
    return 0;
}

static int check_gltf_accessor(const struct mesh_file *f, const struct json *doc, int64_t i)
{
    static const struct {
        const char *name;
        int n;
    } types[] = { { "SCALAR", 1 }, { "VEC2", 2 }, { "VEC3", 3 }, { "VEC4", 4 }, { "MAT2", 4 }, { "MAT3", 9 }, { "MAT4", 16 } };
    static const int sizes[] = { 1, 1, 2, 2, 0, 4, 4 }; // of 5120 ...
    char path[64];
    const char *type;
    int64_t n_components = 0;
    snprintf(path, sizeof(path), "accessors.%" PRId64 ".type", i);
    if (!json_get_string(doc, path, &type))
        for (size_t k = 0; k < sizeof(types) / sizeof(types[0]); k++)
            if (!strcmp(type, types[k].name))
                n_components = types[k].n;
    const int64_t component = gltf_int(doc, "accessors", i, "componentType", -1, 5126);
    const int64_t size = component >= 5120 ? n_components * sizes[component - 5120] : 0;
    const int64_t count = gltf_int(doc, "accessors", i, "count", -1, 1 << 28);
    const int64_t offset = gltf_int(doc, "accessors", i, "byteOffset", 0, INT64_C(1) << 40);
    if (size <= 0 || count < 1 || offset < 0)
        return refuse(f, -EINVAL, "accessor %" PRId64 ": type, componentType, count or byteOffset is missing or out of range",
                      i);
    const int64_t n_views = gltf_length(doc, "bufferViews");
    snprintf(path, sizeof(path), "accessors.%" PRId64 ".bufferView", i);
    if (!json_get(doc, path)) // zeros, patched by "sparse"
        return (uint64_t)(count * size) <= 64 * f->n_bytes ? 0
               : refuse(f, -EINVAL, "accessor %" PRId64 ": %" PRId64 " elements without data", i, count);
    const int64_t view = gltf_int(doc, "accessors", i, "bufferView", -1, n_views - 1);
    if (view < 0)
        return refuse(f, -EINVAL, "accessor %" PRId64 ": its bufferView does not exist; there are %" PRId64, i, n_views);
    const int64_t n_bytes = gltf_int(doc, "bufferViews", view, "byteLength", -1, INT64_C(1) << 40);
    const int64_t stride = gltf_int(doc, "bufferViews", view, "byteStride", size, 252);
    if (stride < size || offset + (count - 1) * stride + size > n_bytes)
        return refuse(f, -EINVAL, "accessor %" PRId64 ": %" PRId64 " elements of %" PRId64 " bytes, stride %" PRId64
                      ", from byte %" PRId64 " do not fit bufferView %" PRId64 " of %" PRId64 " bytes", i, count, size, stride,
                      offset, view, n_bytes);
    return 0;
}

// Positions, normals and UVs: 32-bit floats, or (KHR_mesh_quantization) whole numbers of 8 or 16 bits.
static int check_gltf_attribute(struct mesh_file *f, const struct json *doc, const char *primitive, const char *name,
                                const char *type, bool needed)
{
    char path[160];
    int64_t accessor;
    const char *found = "?";
    snprintf(path, sizeof(path), "%s.attributes.%s", primitive, name);
    if (!json_get(doc, path))
        return needed ? refuse(f, -EINVAL, "%s has no %s", primitive, name) : 0;
    if (json_get_int(doc, path, &accessor) || accessor < 0 || accessor >= gltf_length(doc, "accessors"))
        return refuse(f, -EINVAL, "%s: %s: the accessor does not exist", primitive, name);
    const int64_t component = gltf_int(doc, "accessors", accessor, "componentType", -1, 5126);
    snprintf(path, sizeof(path), "accessors.%" PRId64 ".type", accessor);
    (void)json_get_string(doc, path, &found);
    if (component > 5123 && component != 5126)
        return refuse(f, -EINVAL, "%s: %s is of component type %" PRId64 "; expected 32-bit floats (5126), or 8 or 16 bits (5120 to "
                      "5123)", primitive, name, component);
    f->is_quantised = f->is_quantised || component != 5126;
    return strcmp(found, type) ? refuse(f, -EINVAL, "%s: %s is %s; expected %s", primitive, name, found, type) : 0;
}

// How many triangles a primitive promises.
static int64_t gltf_triangles(const struct json *doc, const char *primitive)
{
    char path[192];
    int64_t mode = 4, accessor = -1;
    snprintf(path, sizeof(path), "%s.mode", primitive);
    if (json_get(doc, path) && json_get_int(doc, path, &mode))
        return 0;
    snprintf(path, sizeof(path), "%s.indices", primitive);
    if (!json_get(doc, path))
        snprintf(path, sizeof(path), "%s.attributes.POSITION", primitive);
    if (json_get_int(doc, path, &accessor) || accessor < 0)
        return 0;
    const int64_t n = gltf_int(doc, "accessors", accessor, "count", 0, 1 << 28);
    return mode == 4 ? n / 3 : (mode == 5 || mode == 6) && n > 2 ? n - 2 : 0;
}

static int check_gltf_meshes(struct mesh_file *f, const struct json *doc)
{
    f->n_promised = 0;
    for (int64_t i = 0; i < gltf_length(doc, "meshes"); i++) {
        char path[96]; // far longer than two numbers need
        snprintf(path, sizeof(path), "meshes.%" PRId64 ".primitives", i);
        for (int64_t k = 0, n = gltf_length(doc, path); k < n; k++) {
            snprintf(path, sizeof(path), "meshes.%" PRId64 ".primitives.%" PRId64, i, k);
            int err = check_gltf_attribute(f, doc, path, "POSITION", "VEC3", true);
            if (!err)
                err = check_gltf_attribute(f, doc, path, "NORMAL", "VEC3", false);
            if (!err)
                err = check_gltf_attribute(f, doc, path, "TEXCOORD_0", "VEC2", false);
            if (err)
                return err;
            f->n_promised += gltf_triangles(doc, path);
        }
    }
    return 0;
}

// assimp walks nodes by recursion: they must be a tree, and not a deep one.
static int check_gltf_nodes(const struct mesh_file *f, const struct json *doc)
{
    int err = 0;
    const int64_t n = gltf_length(doc, "nodes");
    int64_t *parent = malloc((size_t)(n + 1) * sizeof(*parent));
    if (!parent)
        return -ENOMEM;
    memset(parent, 0xff, (size_t)(n + 1) * sizeof(*parent));
    for (int64_t i = 0; i < n && !err; i++) {
        char path[64];
        snprintf(path, sizeof(path), "nodes.%" PRId64 ".children", i);
        for (int64_t k = 0, n_children = gltf_length(doc, path); k < n_children && !err; k++) {
            int64_t child;
            snprintf(path, sizeof(path), "nodes.%" PRId64 ".children.%" PRId64, i, k);
            if (json_get_int(doc, path, &child) || child < 0 || child >= n)
                err = refuse(f, -EINVAL, "node %" PRId64 ": child %" PRId64 " does not exist", i, k);
            else if (parent[child] >= 0)
                err = refuse(f, -EINVAL, "node %" PRId64 " is a child of nodes %" PRId64 " and %" PRId64 "; expected a tree",
                             child, parent[child], i);
            else
                parent[child] = i;
        }
    }
    for (int64_t i = 0; i < n && !err; i++) {
        int depth = 0;
        for (int64_t k = i; k >= 0 && depth <= GLTF_MAX_DEPTH; k = parent[k])
            depth++;
        if (depth > GLTF_MAX_DEPTH)
            err = refuse(f, -EINVAL, "node %" PRId64 " is nested more than %d deep, or within itself", i, GLTF_MAX_DEPTH);
    }
    free(parent);
    return err;
}

// %20 and the like, in place.
static void percent_decode(char *s)
{
    char *out = s;
    for (; *s; s++) {
        unsigned value;
        if (s[0] == '%' && s[1] && s[2] && sscanf(s + 1, "%2x", &value) == 1 && value) {
            *out++ = (char)value;
            s += 2;
        } else {
            *out++ = *s;
        }
    }
    *out = 0;
}

char *mesh_path_beside(const char *path, const char *name)
{
    const char *slash = strrchr(path, '/');
    char *full;
    if (asprintf(&full, "%.*s%s", slash ? (int)(slash + 1 - path) : 0, path, name) < 0)
        return NULL;
    if (access(full, F_OK))
        percent_decode(full + (slash ? slash + 1 - path : 0));
    return full;
}

// A GLB's own chunk, base64 text (assimp counts that), or a file beside: long enough for what is promised?
static int check_gltf_buffer(const struct mesh_file *f, const struct json *doc, int64_t i, int64_t n_bytes, int64_t n_bin)
{
    char path[64];
    const char *uri;
    struct stat st;
    if (n_bytes < 0)
        return refuse(f, -EINVAL, "buffer %" PRId64 ": byteLength is missing or out of range", i);
    snprintf(path, sizeof(path), "buffers.%" PRId64 ".uri", i);
    if (json_get_string(doc, path, &uri)) {
        const int64_t n_there = i == 0 ? n_bin : 0;
        return n_bytes <= n_there ? 0 : refuse(f, -EINVAL, "buffer %" PRId64 " has %" PRId64 " bytes, the BIN chunk %" PRId64
                                               ": the file is cut short or broken", i, n_bytes, n_there);
    }
    if (!strncmp(uri, "data:", 5))
        return 0;
    char *full = mesh_path_beside(f->path, uri);
    int err = full ? 0 : -ENOMEM;
    if (full && stat(full, &st))
        err = refuse(f, -EINVAL, "buffer %" PRId64 " is the file '%s': %s", i, full, strerror(errno));
    else if (full && st.st_size < n_bytes)
        err = refuse(f, -EINVAL, "buffer %" PRId64 " is the file '%s' of %" PRId64 " bytes; expected %" PRId64
                     ": it is cut short", i, full, (int64_t)st.st_size, n_bytes);
    free(full);
    return err;
}

static int check_gltf_json(struct mesh_file *f, const char *text, size_t n_text, int64_t n_bin)
{
    struct json *doc;
    int err = json_parse(&doc, text, n_text, f->path);
    if (err)
        return err;
    err = check_gltf_extensions(f, doc);
    const int64_t n_buffers = gltf_length(doc, "buffers");
    int64_t n_total = 0;
    for (int64_t i = 0; i < n_buffers && !err; i++) {
        const int64_t n_bytes = gltf_int(doc, "buffers", i, "byteLength", -1, INT64_C(1) << 40);
        err = check_gltf_buffer(f, doc, i, n_bytes, n_bin);
        n_total += n_bytes; // many buffers may name one file
        if (!err && n_total > (int64_t)max_file_bytes)
            err = refuse(f, -EFBIG, "buffers of more than %zu bytes", max_file_bytes);
    }
    for (int64_t i = 0; i < gltf_length(doc, "bufferViews") && !err; i++) {
        const int64_t buffer = gltf_int(doc, "bufferViews", i, "buffer", -1, n_buffers - 1);
        const int64_t offset = gltf_int(doc, "bufferViews", i, "byteOffset", 0, INT64_C(1) << 40);
        const int64_t n = gltf_int(doc, "bufferViews", i, "byteLength", -1, INT64_C(1) << 40);
        if (buffer < 0 || offset < 0 || n < 1 ||
            offset + n > gltf_int(doc, "buffers", buffer, "byteLength", -1, INT64_C(1) << 40))
            err = refuse(f, -EINVAL, "bufferView %" PRId64 ": %" PRId64 " bytes from %" PRId64 " do not fit buffer %" PRId64, i, n,
                         offset, buffer);
    }
    for (int64_t i = 0; i < gltf_length(doc, "accessors") && !err; i++)
        err = check_gltf_accessor(f, doc, i);
    if (!err)
        err = check_gltf_meshes(f, doc);
    if (!err)
        err = check_gltf_nodes(f, doc);
    json_free(doc);
    return err;
}

static int check_gltf(struct mesh_file *f)
{
    return check_gltf_json(f, f->bytes, f->n_bytes, 0);
}

static int check_glb(struct mesh_file *f)
{
    static const uint32_t json_chunk = 0x4e4f534a, bin_chunk = 0x004e4942;
    if (f->n_bytes < 20)
        return refuse(f, -EINVAL, "%zu bytes; a GLB has at least 20: it is cut short", f->n_bytes);
    const uint32_t version = u32_at(f->bytes + 4), n_total = u32_at(f->bytes + 8), n_json = u32_at(f->bytes + 12);
    if (version != 2)
        return refuse(f, -ENOTSUP, "GLB version %" PRIu32 "; expected 2", version);
    if (n_total != f->n_bytes)
        return refuse(f, -EINVAL, "the header says %" PRIu32 " bytes, the file has %zu: it is cut short or broken", n_total,
                      f->n_bytes);
    if (u32_at(f->bytes + 16) != json_chunk || n_json > f->n_bytes - 20)
        return refuse(f, -EINVAL, "offset 12: a first chunk of %" PRIu32 " bytes; expected JSON of at most %zu", n_json,
                      f->n_bytes - 20);
    int64_t n_bin = 0;
    const size_t at = 20 + (size_t)n_json;
    if (f->n_bytes - at >= 8) {
        n_bin = u32_at(f->bytes + at);
        if (u32_at(f->bytes + at + 4) != bin_chunk || (uint64_t)n_bin > f->n_bytes - at - 8)
            return refuse(f, -EINVAL, "offset %zu: a second chunk of %" PRId64 " bytes; expected BIN of at most %zu", at, n_bin,
                          f->n_bytes - at - 8);
    }
    return check_gltf_json(f, f->bytes + 20, n_json, n_bin);
}

// ---- which format -------------------------------------------------------------------------------------------------------

static size_t n_blanks(const struct mesh_file *f)
{
    size_t i = 0;
    while (i < f->n_bytes && (is_blank(f->bytes[i]) || f->bytes[i] == '\n'))
        i++;
    return i;
}

static bool is_glb(const struct mesh_file *f)
{
    return f->n_bytes >= 4 && !memcmp(f->bytes, "glTF", 4);
}

static bool is_ply(const struct mesh_file *f)
{
    return f->n_bytes >= 4 && !memcmp(f->bytes, "ply", 3) && (f->bytes[3] == '\n' || f->bytes[3] == '\r');
}

static bool is_ply_with_corner_uvs(const struct mesh_file *f)
{
    static const char last[] = "end_header";
    const char *end = is_ply(f) ? memmem(f->bytes, f->n_bytes, last, sizeof(last) - 1) : NULL;
    for (const char *at = f->bytes, *word; end && at < end;) {
        const char *line = at, *stop = memchr(at, '\n', (size_t)(end - at));
        stop = stop ? stop : end;
        size_t n = next_word(&line, stop, &word);
        if (word_is(word, n, "property")) {
            while ((n = next_word(&line, stop, &word)))
                if (word_is(word, n, "texcoord"))
                    return true;
        }
        at = stop + 1;
    }
    return false;
}

static bool is_gltf(const struct mesh_file *f)
{
    const size_t at = n_blanks(f);
    return at < f->n_bytes && f->bytes[at] == '{';
}

// The first line that is neither empty nor a comment begins with a word of OBJ.
static bool is_obj(const struct mesh_file *f)
{
    static const char *const words[] = { "v", "vt", "vn", "f", "o", "g", "s", "mtllib", "usemtl" };
    const char *at = f->bytes, *end = f->bytes + f->n_bytes;
    while (at < end) {
        const char *stop = memchr(at, '\n', (size_t)(end - at)), *word;
        stop = stop ? stop : end;
        const size_t n = next_word(&at, stop, &word);
        if (n > 0 && *word != '#') {
            for (size_t i = 0; i < sizeof(words) / sizeof(words[0]); i++)
                if (word_is(word, n, words[i]))
                    return true;
            return false;
        }
        at = stop < end ? stop + 1 : end;
    }
    return false;
}

static const struct {
    const char *alias; // the name assimp gets to see
    bool (*probe)(const struct mesh_file *f);
    int (*check)(struct mesh_file *f);
    char *(*rewrite)(const struct mesh_file *f, size_t *n_bytes); // NULL: assimp takes the bytes as they are
    bool has_buffers;                                             // may open files beside it
} formats[] = {
    { "mesh.glb", is_glb, check_glb, NULL, true },
    { "mesh.obj", is_ply_with_corner_uvs, check_ply, ply_as_obj, false },
    { "mesh.ply", is_ply, check_ply, NULL, false },
    { "mesh.gltf", is_gltf, check_gltf, NULL, true },
    { "mesh.obj", is_obj, check_obj, obj_with_leading_zeros, false },
};
enum { N_FORMATS = sizeof(formats) / sizeof(formats[0]) };

int mesh_check_file(struct mesh_file *f, int *format)
{
    for (int i = 0; i < N_FORMATS; i++)
        if (formats[i].probe(f)) {
            *format = i;
            f->n_promised = -1;
            return formats[i].check(f);
        }
    return refuse(f, f->n_bytes ? -ENOTSUP : -EINVAL, f->n_bytes ? "not a known mesh format; expected OBJ, PLY, glTF or GLB"
                                                                 : "the file is empty");
}

// ---- assimp -------------------------------------------------------------------------------------------------------------

struct opened { // a file that assimp has open
    struct aiFile file;
    char *owned;
    const char *bytes;
    size_t n_bytes, at;
    struct opened *next;
};

static size_t read_bytes(struct aiFile *file, char *out, size_t size, size_t count)
{
    struct opened *o = (struct opened *)file->UserData;
    const size_t n = size ? (o->n_bytes - o->at) / size : 0;
    count = count < n ? count : n;
    if (count)
        memcpy(out, o->bytes + o->at, size * count);
    o->at += size * count;
    return count;
}

static size_t write_nothing(struct aiFile *file, const char *bytes, size_t size, size_t count)
{
    (void)file, (void)bytes, (void)size, (void)count;
    return 0;
}

static size_t tell(struct aiFile *file)
{
    return ((struct opened *)file->UserData)->at;
}

static size_t file_size(struct aiFile *file)
{
    return ((struct opened *)file->UserData)->n_bytes;
}

static enum aiReturn seek(struct aiFile *file, size_t offset, enum aiOrigin origin)
{
    struct opened *o = (struct opened *)file->UserData;
    const size_t base = origin == aiOrigin_SET ? 0 : origin == aiOrigin_CUR ? o->at : o->n_bytes;
    if (offset > o->n_bytes - base)
        return aiReturn_FAILURE;
    o->at = base + offset;
    return aiReturn_SUCCESS;
}

static void flush_nothing(struct aiFile *file)
{
    (void)file;
}

struct importing {
    const struct mesh_file *file;
    int format;
    struct opened *all; // assimp forgets to close files when it gives up
};

static int read_beside(struct opened *o, const char *path, const char *name)
{
    char *full = mesh_path_beside(path, name);
    const int err = full ? file_read(&o->owned, &o->n_bytes, full, max_file_bytes) : -ENOMEM;
    if (err)
        log_error("mesh: %s: its buffer %s is needed: export the mesh again, or as one GLB", path, name);
    free(full);
    return err;
}

static struct aiFile *open_file(struct aiFileIO *io, const char *name, const char *mode)
{
    struct importing *im = (struct importing *)io->UserData;
    (void)mode;
    struct opened *o = calloc(1, sizeof(*o));
    if (!o)
        return NULL;
    while (!strncmp(name, "./", 2))
        name += 2;
    if (!strcmp(name, formats[im->format].alias)) {
        o->bytes = im->file->bytes, o->n_bytes = im->file->n_bytes;
    } else if (formats[im->format].has_buffers && !read_beside(o, im->file->path, name)) {
        o->bytes = o->owned;
    } else {
        free(o);
        return NULL;
    }
    o->file = (struct aiFile){ read_bytes, write_nothing, tell, file_size, seek, flush_nothing, (char *)o };
    o->next = im->all;
    im->all = o;
    return &o->file;
}

static void close_file(struct aiFileIO *io, struct aiFile *file)
{
    (void)io;
    struct opened *o = (struct opened *)file->UserData;
    free(o->owned);
    o->owned = NULL;
    o->n_bytes = o->at = 0;
}

static void forget_files(struct importing *im)
{
    while (im->all) {
        struct opened *o = im->all;
        im->all = o->next;
        free(o->owned);
        free(o);
    }
}

// What the scene's meshes become, before vertices are told apart.
struct vertex {
    float position_m[3], normal[3], uv[2];
};
struct soup {
    struct vertex *vertex;
    uint32_t (*triangle)[3];
    int64_t n_vertices, n_triangles;
    int64_t n_without_uv; // triangles
};

static void multiply(double out[16], const double a[16], const struct aiMatrix4x4 *m)
{
    const double b[16] = { m->a1, m->a2, m->a3, m->a4, m->b1, m->b2, m->b3, m->b4,
                           m->c1, m->c2, m->c3, m->c4, m->d1, m->d2, m->d3, m->d4 };
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) {
            out[4 * i + j] = 0;
            for (int k = 0; k < 4; k++)
                out[4 * i + j] += a[4 * i + k] * b[4 * k + j];
        }
}

static int add_mesh(struct soup *s, const struct aiMesh *mesh, const double world[16], const struct mesh_file *f)
{
    const double linear[9] = { world[0], world[1], world[2], world[4], world[5], world[6], world[8], world[9], world[10] };
    const double det = mat3_det(linear);
    double cofactor[9]; // transforms normals, up to length and the sign of det
    for (int i = 0; i < 3; i++)
        vec3_cross(cofactor + 3 * i, linear + 3 * ((i + 1) % 3), linear + 3 * ((i + 2) % 3));
    const struct aiVector3D *uv = mesh->mTextureCoords[0];
    const int64_t first = s->n_vertices;
    for (unsigned i = 0; i < mesh->mNumVertices; i++) {
        struct vertex *v = &s->vertex[s->n_vertices++];
        const double p[3] = { mesh->mVertices[i].x, mesh->mVertices[i].y, mesh->mVertices[i].z };
        double q[3];
        mat3_mul_vec(q, linear, p);
        for (int c = 0; c < 3; c++)
            v->position_m[c] = (float)(q[c] + world[4 * c + 3]);
        if (!isfinite(v->position_m[0]) || !isfinite(v->position_m[1]) || !isfinite(v->position_m[2]))
            return refuse(f, -EINVAL, "vertex %u of mesh '%s' is at (%g, %g, %g); expected finite numbers", i,
                          mesh->mName.data, p[0], p[1], p[2]);
        if (mesh->mNormals) {
            const double n[3] = { mesh->mNormals[i].x, mesh->mNormals[i].y, mesh->mNormals[i].z };
            mat3_mul_vec(q, cofactor, n);
            if (det < 0)
                q[0] = -q[0], q[1] = -q[1], q[2] = -q[2];
            const double length = vec3_normalise(q);
            for (int c = 0; c < 3; c++) // a broken normal is replaced by the faces' (zero asks for that)
                v->normal[c] = length > 1e-12 && isfinite(length) ? (float)q[c] : 0;
        }
        if (!uv)
            continue;
        if (!isfinite(uv[i].x) || !isfinite(uv[i].y))
            return refuse(f, -EINVAL, "vertex %u of mesh '%s' has the UV (%g, %g); expected finite numbers", i,
                          mesh->mName.data, (double)uv[i].x, (double)uv[i].y);
        v->uv[0] = uv[i].x, v->uv[1] = uv[i].y;
    }
    for (unsigned i = 0; i < mesh->mNumFaces; i++) {
        const struct aiFace *face = &mesh->mFaces[i];
        if (face->mNumIndices != 3)
            continue; // points and lines
        for (int k = 0; k < 3; k++) {
            if (face->mIndices[k] >= mesh->mNumVertices)
                return refuse(f, -EINVAL, "triangle %u of mesh '%s' uses vertex %u of %u", i, mesh->mName.data,
                              face->mIndices[k], mesh->mNumVertices);
            s->triangle[s->n_triangles][det < 0 ? 2 - k : k] = (uint32_t)(first + face->mIndices[k]);
        }
        s->n_triangles++;
        s->n_without_uv += !uv;
    }
    return 0;
}

// The node tree, depth first without recursion (a hostile file may nest deeply). visit: a mesh in its place.
typedef int visit_mesh(void *arg, const struct aiMesh *mesh, const double world[16]);

static int walk_nodes(const struct aiScene *scene, visit_mesh *visit, void *arg)
{
    int err = 0, n = 0, capacity = 0;
    struct entry {
        const struct aiNode *node;
        double world[16];
    } *stack = NULL;
    struct entry e = { scene->mRootNode, { [0] = 1, [5] = 1, [10] = 1, [15] = 1 } };
    double world[16];
    multiply(world, e.world, &e.node->mTransformation);
    memcpy(e.world, world, sizeof(world));
    for (;;) {
        for (unsigned i = 0; i < e.node->mNumMeshes && !err; i++)
            if (e.node->mMeshes[i] < scene->mNumMeshes)
                err = visit(arg, scene->mMeshes[e.node->mMeshes[i]], e.world);
        for (unsigned i = e.node->mNumChildren; i-- > 0 && !err;) { // backwards: the first child comes off the stack first
            if (n == capacity) {
                capacity = capacity ? 2 * capacity : 64;
                struct entry *bigger = realloc(stack, (size_t)capacity * sizeof(*stack));
                if (!bigger) {
                    free(stack);
                    return -ENOMEM;
                }
                stack = bigger;
            }
            stack[n].node = e.node->mChildren[i];
            multiply(stack[n].world, e.world, &stack[n].node->mTransformation);
            n++;
        }
        if (err || n == 0)
            break;
        e = stack[--n];
    }
    free(stack);
    return err;
}

struct totals {
    int64_t n_vertices, n_triangles;
};

static int count_mesh(void *arg, const struct aiMesh *mesh, const double world[16])
{
    (void)world;
    struct totals *t = arg;
    t->n_vertices += mesh->mNumVertices;
    t->n_triangles += mesh->mNumFaces;
    return t->n_triangles > MAX_TRIANGLES || t->n_vertices > 3 * (int64_t)MAX_TRIANGLES ? -EFBIG : 0;
}

// assimp leaves out faces whose indices are out of range, without a word.
static int check_promise(const struct mesh_file *f, const struct aiScene *scene)
{
    int64_t n = 0;
    for (unsigned i = 0; i < scene->mNumMeshes; i++)
        for (unsigned k = 0; k < scene->mMeshes[i]->mNumFaces; k++)
            n += scene->mMeshes[i]->mFaces[k].mNumIndices == 3;
    return f->n_promised < 0 || n == f->n_promised ? 0
           : refuse(f, -EINVAL, "%" PRId64 " of %" PRId64 " triangles use vertices that do not exist", f->n_promised - n,
                    f->n_promised);
}

struct adding {
    struct soup *soup;
    const struct mesh_file *file;
};

static int add_visited(void *arg, const struct aiMesh *mesh, const double world[16])
{
    const struct adding *a = arg;
    return add_mesh(a->soup, mesh, world, a->file);
}

static int import(struct soup *s, const struct mesh_file *f, int format)
{
    int err;
    struct mesh_file shown = *f;
    struct importing im = { &shown, format, NULL };
    struct aiFileIO io = { open_file, close_file, (char *)&im };
    struct totals totals = { 0, 0 };
    struct adding adding = { s, f };
    char *rewritten = NULL;
    if (f->is_quantised) {
        err = mesh_gltf_floats(&rewritten, &shown.n_bytes, f);
        if (err)
            return err;
        shown.bytes = rewritten;
    } else if (formats[format].rewrite) {
        rewritten = formats[format].rewrite(f, &shown.n_bytes);
        if (!rewritten)
            return -ENOMEM;
        shown.bytes = rewritten;
    }
    const struct aiScene *scene = aiImportFileEx(formats[format].alias, aiProcess_Triangulate, &io);
    if (!scene || !scene->mRootNode || (scene->mFlags & AI_SCENE_FLAGS_INCOMPLETE && !scene->mNumMeshes)) {
        err = refuse(f, -EINVAL, "%s", scene ? "no triangles" : aiGetErrorString());
        goto done;
    }
    err = check_promise(f, scene);
    if (!err)
        err = walk_nodes(scene, count_mesh, &totals);
    if (err == -EFBIG) {
        refuse(f, err, "more than %d triangles; reduce the mesh", MAX_TRIANGLES);
        goto done;
    }
    if (!err && totals.n_triangles == 0)
        err = refuse(f, -EINVAL, "no triangles");
    if (err)
        goto done;
    s->vertex = calloc((size_t)totals.n_vertices + 1, sizeof(*s->vertex));
    s->triangle = malloc((size_t)totals.n_triangles * sizeof(*s->triangle));
    err = s->vertex && s->triangle ? walk_nodes(scene, add_visited, &adding) : -ENOMEM;
    if (!err && s->n_triangles == 0)
        err = refuse(f, -EINVAL, "no triangles, only points or lines");
    else if (!err && s->n_without_uv == s->n_triangles)
        err = refuse(f, -EINVAL, "no UVs: none of %" PRId64 " triangles has any; unwrap the mesh before export",
                     s->n_triangles);
done:
    aiReleaseImport(scene);
    forget_files(&im);
    free(rewritten);
    return err;
}

// Equal vertices become one, triangles without area go, and the arrays become a mesh.
static int finish(struct mesh *out, struct soup *s, int *n_dropped, const struct mesh_file *f)
{
    int err = -ENOMEM;
    struct mesh m = { 0 };
    for (int64_t i = 0; i < s->n_vertices; i++) {
        float *values = s->vertex[i].position_m;
        for (int c = 0; c < 8; c++)
            values[c] += 0.f; // -0 becomes +0
    }
    uint32_t *id = malloc((size_t)s->n_vertices * sizeof(*id));
    if (!id)
        goto fail;
    const int64_t n = mesh_number_distinct(id, s->vertex, sizeof(struct vertex) / 4, (size_t)s->n_vertices);
    if (n < 0)
        goto fail;
    m.n_vertices = (int)n;
    m.position_m = malloc((size_t)n * sizeof(*m.position_m));
    m.normal = malloc((size_t)n * sizeof(*m.normal));
    m.uv = malloc((size_t)n * sizeof(*m.uv));
    m.triangle = s->triangle;
    s->triangle = NULL;
    if (!m.position_m || !m.normal || !m.uv)
        goto fail;
    for (int64_t i = 0; i < s->n_vertices; i++) {
        memcpy(m.position_m[id[i]], s->vertex[i].position_m, sizeof(*m.position_m));
        memcpy(m.normal[id[i]], s->vertex[i].normal, sizeof(*m.normal));
        memcpy(m.uv[id[i]], s->vertex[i].uv, sizeof(*m.uv));
    }
    for (int64_t i = 0; i < s->n_triangles; i++) {
        uint32_t *t = m.triangle[m.n_triangles];
        for (int k = 0; k < 3; k++)
            t[k] = id[m.triangle[i][k]];
        m.n_triangles += mesh_triangle_has_area(&m, m.n_triangles);
    }
    *n_dropped = (int)(s->n_triangles - m.n_triangles);
    free(id);
    if (m.n_triangles == 0) {
        mesh_free(&m);
        return refuse(f, -EINVAL, "none of %d triangles has any area", *n_dropped);
    }
    return mesh_from_arrays(out, m.n_vertices, m.position_m, m.normal, m.uv, m.n_triangles, m.triangle);
fail:
    free(id);
    mesh_free(&m);
    return err;
}

int mesh_read(struct mesh *out, struct mesh_check *check, const char *path)
{
    char *bytes = NULL;
    struct mesh_file f = { .path = path };
    struct soup s = { 0 };
    int format, n_dropped = 0;
    memset(out, 0, sizeof(*out));
    int err = file_read(&bytes, &f.n_bytes, path, max_file_bytes);
    if (err)
        return err;
    f.bytes = bytes;
    err = mesh_check_file(&f, &format);
    if (!err)
        err = import(&s, &f, format);
    if (!err)
        err = finish(out, &s, &n_dropped, &f);
    if (!err && check) {
        mesh_check_run(out, check);
        check->n_zero_area += n_dropped;
    }
    if (err == -ENOMEM)
        log_error("mesh: cannot read %s: %s", path, strerror(ENOMEM));
    free(bytes);
    free(s.vertex);
    free(s.triangle);
    return err;
}
