// solver/mesh_gltf_floats.c - glTF with quantised attributes (KHR_mesh_quantization), rewritten with 32-bit floats.
//
// assimp takes the bytes of every other component type for floats. So the accessors of positions, normals and UVs get new data: one
// more buffer, in the JSON itself, and all else stays as it is. The scale and offset that undo the quantisation are in the nodes.
#include "solver/mesh_import.h"
#include "solver/take/atomic_file.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_FLOAT_BYTES = 1 << 29 };
static const size_t max_file_bytes = (size_t)8 << 30;

struct rewriting {
    const struct mesh_file *file;
    struct json *doc;
    const char *bin; // a GLB's
    size_t n_bin;
    int64_t n_buffers; // before
    char **buffer;     // [n_buffers] loaded so far
    size_t *n_buffer;
    float *value;
    size_t n_values, capacity;
};

static struct json *at(const struct json *doc, const char *array, int64_t i)
{
    char path[64];
    snprintf(path, sizeof(path), "%s.%" PRId64, array, i);
    return (struct json *)(uintptr_t)json_get(doc, path); // the document is ours to change
}

static int64_t integer(const struct json *v, const char *key, int64_t otherwise)
{
    int64_t value;
    return json_get_int(v, key, &value) ? otherwise : value;
}

static int refuse(const struct mesh_file *f, const char *what, int64_t i)
{
    log_error("mesh: %s: %s %" PRId64, f->path, what, i);
    return -EINVAL;
}

static int base64_digit(char c)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    const char *found = c ? strchr(digits, c) : NULL;
    return found ? (int)(found - digits) : -1;
}

// "data:...;base64,TEXT". NULL: out of memory; stops at what is no digit.
static char *base64_decode(const char *uri, size_t *n_bytes)
{
    const char *text = strchr(uri, ',');
    text = text ? text + 1 : "";
    char *out = malloc(strlen(text) / 4 * 3 + 4);
    uint32_t bits = 0;
    *n_bytes = 0;
    for (int n = 0, digit; out && (digit = base64_digit(*text)) >= 0; text++) {
        bits = bits << 6 | (uint32_t)digit;
        n += 6;
        if (n >= 8)
            n -= 8, out[(*n_bytes)++] = (char)(bits >> n & 0xff);
    }
    return out;
}

static void base64_encode(FILE *f, const unsigned char *bytes, size_t n)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for (size_t i = 0; i < n; i += 3) {
        uint32_t bits = 0;
        for (size_t k = 0; k < 3; k++)
            bits = bits << 8 | (i + k < n ? bytes[i + k] : 0u);
        for (size_t k = 0; k < 4; k++)
            putc(i + k > n ? '=' : digits[bits >> (18 - 6 * k) & 63], f);
    }
}

static int load_buffer(struct rewriting *r, int64_t i)
{
    const char *uri;
    if (r->buffer[i] || (i == 0 && r->bin && json_get_string(at(r->doc, "buffers", i), "uri", &uri)))
        return 0;
    if (json_get_string(at(r->doc, "buffers", i), "uri", &uri))
        return refuse(r->file, "there are no bytes for buffer", i);
    if (!strncmp(uri, "data:", 5)) {
        r->buffer[i] = base64_decode(uri, &r->n_buffer[i]);
        return r->buffer[i] ? 0 : -ENOMEM;
    }
    char *path = mesh_path_beside(r->file->path, uri);
    const int err = path ? file_read(&r->buffer[i], &r->n_buffer[i], path, max_file_bytes) : -ENOMEM;
    free(path);
    return err;
}

static float value_of(const unsigned char *b, int64_t component, bool normalised)
{
    const int16_t word = (int16_t)(uint16_t)(b[0] | (component >= 5122 ? (unsigned)b[1] << 8 : 0));
    const float v = component == 5120   ? (float)(int8_t)b[0]
                    : component == 5121 ? (float)b[0]
                    : component == 5122 ? (float)word
                                        : (float)(uint16_t)word;
    static const float most[4] = { 127, 255, 32767, 65535 };
    return normalised ? fmaxf(v / most[component - 5120], -1) : v;
}

// The accessor's numbers as floats, and the accessor turned to them. Ranges are as mesh_check_file() found them.
static int convert(struct rewriting *r, int64_t i)
{
    struct json *accessor = at(r->doc, "accessors", i);
    const int64_t component = integer(accessor, "componentType", 0), count = integer(accessor, "count", 0);
    const int64_t view_index = integer(accessor, "bufferView", -1);
    const char *type = "";
    bool normalised = false;
    if (component == 5126) // or done already
        return 0;
    (void)json_get_string(accessor, "type", &type);
    (void)json_get_bool(accessor, "normalized", &normalised);
    const int n_components = !strcmp(type, "VEC2") ? 2 : 3, size = component < 5122 ? 1 : 2;
    if (view_index < 0 || json_get(accessor, "sparse"))
        return refuse(r->file, "quantised and sparse, which is not read together; export 32-bit floats: accessor", i);
    const struct json *view = at(r->doc, "bufferViews", view_index);
    const int64_t buffer = integer(view, "buffer", 0), stride = integer(view, "byteStride", (int64_t)size * n_components);
    const int64_t first = integer(view, "byteOffset", 0) + integer(accessor, "byteOffset", 0);
    int err = load_buffer(r, buffer);
    if (err)
        return err;
    const char *bytes = r->buffer[buffer] ? r->buffer[buffer] : r->bin;
    const size_t n_bytes = r->buffer[buffer] ? r->n_buffer[buffer] : r->n_bin;
    if ((uint64_t)(first + (count - 1) * stride + (int64_t)size * n_components) > n_bytes)
        return refuse(r->file, "the bytes end within accessor", i);
    const size_t n_values = (size_t)count * (size_t)n_components, begin = r->n_values;
    if ((begin + n_values) * sizeof(float) > MAX_FLOAT_BYTES) {
        log_error("mesh: %s: more than %d bytes of quantised attributes, as floats; reduce the mesh", r->file->path, MAX_FLOAT_BYTES);
        return -EFBIG;
    }
    if (begin + n_values > r->capacity) {
        r->capacity = 2 * (begin + n_values);
        float *larger = realloc(r->value, r->capacity * sizeof(*larger));
        if (!larger)
            return -ENOMEM;
        r->value = larger;
    }
    for (int64_t k = 0; k < count; k++)
        for (int c = 0; c < n_components; c++)
            r->value[r->n_values++] = value_of((const unsigned char *)bytes + first + k * stride + c * size, component, normalised);
    struct json *new_view = json_object();
    json_set_int(new_view, "buffer", r->n_buffers);
    json_set_int(new_view, "byteOffset", (int64_t)(begin * sizeof(float)));
    json_set_int(new_view, "byteLength", (int64_t)(n_values * sizeof(float)));
    json_set_int(accessor, "bufferView", json_length(r->doc, "bufferViews"));
    json_set_int(accessor, "byteOffset", 0);
    json_set_int(accessor, "componentType", 5126);
    json_set_bool(accessor, "normalized", false);
    json_append((struct json *)(uintptr_t)json_get(r->doc, "bufferViews"), new_view);
    return 0;
}

static int convert_meshes(struct rewriting *r)
{
    static const char *const attributes[] = { "POSITION", "NORMAL", "TEXCOORD_0" };
    int err = 0;
    for (int64_t i = 0, n = json_length(r->doc, "meshes"); i < n && !err; i++) {
        const struct json *mesh = at(r->doc, "meshes", i);
        for (int64_t k = 0, n_primitives = json_length(mesh, "primitives"); k < n_primitives && !err; k++)
            for (int a = 0; a < 3 && !err; a++) {
                char path[64];
                int64_t accessor;
                snprintf(path, sizeof(path), "attributes.%s", attributes[a]);
                if (!json_get_int(at(mesh, "primitives", k), path, &accessor))
                    err = convert(r, accessor);
            }
    }
    return err;
}

static int add_buffer(struct rewriting *r)
{
    char *uri = NULL;
    size_t n_uri;
    FILE *f = open_memstream(&uri, &n_uri);
    if (!f)
        return -ENOMEM;
    fputs("data:application/octet-stream;base64,", f);
    for (size_t i = 0; i < r->n_values; i += 3) { // 12 bytes: whole groups of three until the last
        unsigned char bytes[12];
        const size_t n = r->n_values - i < 3 ? r->n_values - i : 3;
        for (size_t k = 0; k < n; k++) {
            uint32_t bits;
            memcpy(&bits, &r->value[i + k], 4);
            for (size_t b = 0; b < 4; b++)
                bytes[4 * k + b] = (unsigned char)(bits >> 8 * b);
        }
        base64_encode(f, bytes, 4 * n);
    }
    const bool failed = ferror(f);
    if (fclose(f) || failed) {
        free(uri);
        return -ENOMEM;
    }
    struct json *buffer = json_object();
    json_set_int(buffer, "byteLength", (int64_t)(r->n_values * sizeof(float)));
    json_set_string(buffer, "uri", uri);
    json_append((struct json *)(uintptr_t)json_get(r->doc, "buffers"), buffer);
    free(uri);
    return 0;
}

static void put_u32(char *out, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        out[i] = (char)(value >> 8 * i);
}

// The changed JSON, and for a GLB its BIN chunk after it.
static int put_together(char **out, size_t *n_out, const struct rewriting *r, bool is_glb)
{
    char *text = json_text(r->doc);
    if (!text)
        return -ENOMEM;
    const size_t n_text = strlen(text), n_json = (n_text + 3) / 4 * 4, n_bin = (r->n_bin + 3) / 4 * 4;
    const size_t n = is_glb ? 20 + n_json + (r->bin ? 8 + n_bin : 0) : n_text;
    char *bytes = n < UINT32_MAX ? calloc(n + 1, 1) : NULL;
    if (bytes && is_glb) {
        memcpy(bytes, "glTF", 4);
        put_u32(bytes + 4, 2);
        put_u32(bytes + 8, (uint32_t)n);
        put_u32(bytes + 12, (uint32_t)n_json);
        memcpy(bytes + 16, "JSON", 4);
        memset(bytes + 20, ' ', n_json);
        memcpy(bytes + 20, text, n_text);
        if (r->bin) {
            put_u32(bytes + 20 + n_json, (uint32_t)n_bin);
            memcpy(bytes + 24 + n_json, "BIN", 4);
            memcpy(bytes + 28 + n_json, r->bin, r->n_bin);
        }
    } else if (bytes) {
        memcpy(bytes, text, n_text);
    }
    free(text);
    if (!bytes)
        return -ENOMEM;
    *out = bytes, *n_out = n;
    return 0;
}

int mesh_gltf_floats(char **out, size_t *n_out, const struct mesh_file *f)
{
    struct rewriting r = { .file = f };
    const bool is_glb = f->n_bytes >= 20 && !memcmp(f->bytes, "glTF", 4);
    const unsigned char *head = (const unsigned char *)f->bytes;
    size_t n_json = f->n_bytes;
    *out = NULL, *n_out = 0;
    if (is_glb) {
        n_json = head[12] | (size_t)head[13] << 8 | (size_t)head[14] << 16 | (size_t)head[15] << 24;
        if (f->n_bytes - 20 - n_json >= 8) {
            const unsigned char *chunk = head + 20 + n_json;
            r.bin = f->bytes + 28 + n_json;
            r.n_bin = chunk[0] | (size_t)chunk[1] << 8 | (size_t)chunk[2] << 16 | (size_t)chunk[3] << 24;
        }
    }
    int err = json_parse(&r.doc, is_glb ? f->bytes + 20 : f->bytes, n_json, f->path);
    if (err)
        return err;
    const int n_buffers = json_length(r.doc, "buffers");
    r.n_buffers = n_buffers > 0 ? n_buffers : 0;
    r.buffer = calloc((size_t)r.n_buffers + 1, sizeof(*r.buffer));
    r.n_buffer = calloc((size_t)r.n_buffers + 1, sizeof(*r.n_buffer));
    err = r.buffer && r.n_buffer ? convert_meshes(&r) : -ENOMEM;
    if (!err)
        err = add_buffer(&r);
    if (!err)
        err = put_together(out, n_out, &r, is_glb);
    for (int64_t i = 0; r.buffer && i < r.n_buffers; i++)
        free(r.buffer[i]);
    free(r.buffer);
    free(r.n_buffer);
    free(r.value);
    json_free(r.doc);
    return err;
}
