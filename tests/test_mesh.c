// tests/test_mesh.c - one meaning for every mesh format, and a name for everything that can be wrong with one.
#include "solver/mesh.h"
#include "solver/take/log.h"
#include "solver/vec3.h"
#include "solver/take/atomic_file.h"
#include "tests/scratch.h"

#include <errno.h>
#include <locale.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <cmocka.h>

// ---- helpers ------------------------------------------------------------------------------------------------------------

static char errors[2048], warnings[8192];

static void keep_lines(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level == LOG_ERROR)
        snprintf(errors, sizeof(errors), "%s", message);
    if (level == LOG_WARNING)
        snprintf(warnings + strlen(warnings), sizeof(warnings) - strlen(warnings), "%s\n", message);
}

static int set_up(void **state)
{
    (void)state;
    log_set_hook(keep_lines, NULL);
    return scratch_open();
}

static int tear_down(void **state)
{
    (void)state;
    log_set_hook(NULL, NULL);
    scratch_empty();
    return scratch_close();
}

static int read_bytes(struct mesh *out, struct mesh_check *check, const char *name, const void *bytes, size_t n)
{
    scratch_write(name, bytes, n);
    errors[0] = 0;
    return mesh_read(out, check, scratch_path(name));
}

static int read_text(struct mesh *out, struct mesh_check *check, const char *name, const char *text)
{
    return read_bytes(out, check, name, text, strlen(text));
}

// ---- one textured quad in every format ----------------------------------------------------------------------------------

// Metres; the UVs differ in every corner and are no mirror images of each other. Origin bottom-left.
static const float quad_position[4][3] = { { 0, 0, 0 }, { 2, 0, 0 }, { 2, 1, 0 }, { 0, 1, 0 } };
static const float quad_uv[4][2] = { { .125f, .25f }, { .75f, .25f }, { .75f, .5f }, { .125f, .5f } };

static const char quad_obj[] = "# a quad\nmtllib ../none there.mtl\no quad\nv 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
                               "vt .125 .25\nvt .75 .25 0\nvt .75 5e-1\nvt +.125 0.5\nusemtl stone\ns off\nf 1/1 2/2 3/3 -1/-1\n";
static const char quad_ply[] = "ply\nformat ascii 1.0\ncomment TextureFile none.png\nelement vertex 4\nproperty float x\n"
                               "property float y\nproperty float z\nproperty float u\nproperty float v\nelement face 1\n"
                               "property list uchar int vertex_indices\nend_header\n"
                               "0 0 0 .125 .25\n2 0 0 .75 .25\n2 1 0 .75 .5\n0 1 0 .125 .5\n4 0 1 2 3\n";

// glTF: v points down. Positions, UVs, indices.
static size_t quad_buffer(unsigned char *out)
{
    static const uint16_t indices[6] = { 0, 1, 2, 0, 2, 3 };
    float uv[4][2];
    for (int i = 0; i < 4; i++)
        uv[i][0] = quad_uv[i][0], uv[i][1] = 1 - quad_uv[i][1];
    memcpy(out, quad_position, 48);
    memcpy(out + 48, uv, 32);
    memcpy(out + 80, indices, 12);
    return 92;
}

#define GLTF(NODES, BUFFER, MORE)                                                                                             \
    "{\"asset\":{\"version\":\"2.0\"}," MORE "\"scene\":0," NODES                                                             \
    ",\"meshes\":[{\"primitives\":[{\"attributes\":{\"POSITION\":0,\"TEXCOORD_0\":1},\"indices\":2}]}],"                      \
    "\"accessors\":[{\"bufferView\":0,\"componentType\":5126,\"count\":4,\"type\":\"VEC3\",\"min\":[0,0,0],\"max\":[2,1,0]}," \
    "{\"bufferView\":1,\"componentType\":5126,\"count\":4,\"type\":\"VEC2\"},"                                                \
    "{\"bufferView\":2,\"componentType\":5123,\"count\":6,\"type\":\"SCALAR\"}],"                                             \
    "\"bufferViews\":[{\"buffer\":0,\"byteLength\":48},{\"buffer\":0,\"byteOffset\":48,\"byteLength\":32},"                   \
    "{\"buffer\":0,\"byteOffset\":80,\"byteLength\":12}],\"buffers\":[{" BUFFER "\"byteLength\":92}]}"
#define ONE_NODE "\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"mesh\":0}]"

static void put_u32(unsigned char *out, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        out[i] = (unsigned char)(value >> 8 * i);
}

static size_t make_glb(unsigned char *out, const char *json)
{
    const size_t n = strlen(json), n_json = (n + 3) / 4 * 4;
    memset(out + 20, ' ', n_json);
    memcpy(out + 20, json, n);
    memcpy(out, "glTF", 4);
    memcpy(out + 16, "JSON", 4);
    put_u32(out + 4, 2);
    put_u32(out + 12, (uint32_t)n_json);
    unsigned char *bin = out + 20 + n_json;
    const size_t n_bin = quad_buffer(bin + 8);
    put_u32(bin, (uint32_t)n_bin);
    memcpy(bin + 4, "BIN", 4);
    const size_t total = 20 + n_json + 8 + n_bin;
    put_u32(out + 8, (uint32_t)total);
    return total;
}

static size_t make_binary_ply(unsigned char *out, bool big_endian)
{
    size_t n = (size_t)sprintf((char *)out, "ply\nformat binary_%s_endian 1.0\nelement vertex 4\nproperty double x\n"
                               "property float y\nproperty float z\nproperty uchar red\nproperty float s\nproperty float t\n"
                               "element face 1\nproperty list uchar uint vertex_index\nproperty uchar flags\nend_header\n",
                               big_endian ? "big" : "little");
    unsigned char value[8];
#define PUT(VARIABLE)                                                              \
    do {                                                                           \
        memcpy(value, &(VARIABLE), sizeof(VARIABLE));                              \
        for (size_t b = 0; b < sizeof(VARIABLE); b++)                              \
            out[n++] = value[big_endian ? sizeof(VARIABLE) - 1 - b : b];           \
    } while (0)
    for (int i = 0; i < 4; i++) {
        const double x = quad_position[i][0];
        PUT(x);
        PUT(quad_position[i][1]);
        PUT(quad_position[i][2]);
        out[n++] = 255;
        PUT(quad_uv[i][0]);
        PUT(quad_uv[i][1]);
    }
    out[n++] = 4;
    for (uint32_t i = 0; i < 4; i++)
        PUT(i);
#undef PUT
    out[n++] = 1;
    return n;
}

static void assert_is_the_quad(const struct mesh *m, const struct mesh_check *check)
{
    assert_int_equal(m->n_triangles, 2);
    assert_int_equal(m->n_vertices, 4);
    assert_int_equal(m->n_points, 4);
    assert_int_equal(m->n_charts, 1);
    for (int i = 0; i < 4; i++) {
        int k = 0; // which corner
        while (k < 4 && memcmp(m->position_m[i], quad_position[k], sizeof(quad_position[k])))
            k++;
        assert_true(k < 4);
        assert_memory_equal(m->uv[i], quad_uv[k], sizeof(quad_uv[k])); // exactly
        assert_true(m->normal[i][0] == 0 && m->normal[i][1] == 0 && m->normal[i][2] == 1); // wound counter-clockwise
    }
    assert_int_equal(check->n_mirrored_uv, 0);
    assert_int_equal(check->n_boundary_edges, 4);
    assert_true(check->overlap_fraction == 0 && !check->n_zero_area && !check->n_zero_area_uv && !check->n_missing_uv &&
                !check->n_out_of_range_uv && !check->n_non_manifold_edges);
    assert_true(m->bounds_m[0][0] == 0 && m->bounds_m[1][0] == 2 && m->bounds_m[1][1] == 1 && m->bounds_m[1][2] == 0);
}

static void every_format_gives_the_same_uvs(void **state)
{
    (void)state;
    static const char *const no_locale = "C";
    struct mesh m;
    struct mesh_check check;
    unsigned char bytes[4096], buffer[128];
    const size_t n_buffer = quad_buffer(buffer);
    if (!setlocale(LC_ALL, "de_DE.UTF-8")) // decimal commas, where the machine has them
        setlocale(LC_ALL, no_locale);
    for (int variant = 0; variant < 8; variant++) {
        int err;
        switch (variant) {
        case 0:
            err = read_text(&m, &check, "quad.obj", quad_obj);
            break;
        case 1:
            err = read_text(&m, &check, "quad.ply", quad_ply);
            break;
        case 2:
        case 3:
            err = read_bytes(&m, &check, "quad.ply", bytes, make_binary_ply(bytes, variant == 3));
            break;
        case 4:
            err = read_bytes(&m, &check, "quad.glb", bytes, make_glb(bytes, GLTF(ONE_NODE, "", "")));
            break;
        case 5: // beside the file, with a blank in its name
            scratch_write("the quad.bin", buffer, n_buffer);
            err = read_text(&m, &check, "quad.gltf", GLTF(ONE_NODE, "\"uri\":\"the%20quad.bin\",", ""));
            break;
        case 6: { // in the file
            static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
            char base64[160], text[2048], uri[256];
            size_t n = 0;
            memset(buffer + n_buffer, 0, 3);
            for (size_t i = 0; i < n_buffer; i += 3)
                for (int k = 0; k < 4; k++) {
                    const unsigned bits = (unsigned)buffer[i] << 16 | (unsigned)buffer[i + 1] << 8 | buffer[i + 2];
                    base64[n++] = i * 8 + (size_t)k * 6 >= n_buffer * 8 ? '=' : digits[bits >> (18 - 6 * k) & 63];
                }
            base64[n] = 0;
            snprintf(uri, sizeof(uri), "\"uri\":\"data:application/octet-stream;base64,%s\",", base64);
            const char *json = GLTF(ONE_NODE, "@", ""), *at = strchr(json, '@');
            snprintf(text, sizeof(text), "%.*s%s%s", (int)(at - json), json, uri, at + 1);
            err = read_text(&m, &check, "quad.gltf", text);
            break;
        }
        default: // by content, not by name
            err = read_text(&m, &check, "quad.fbx", quad_obj);
        }
        if (err)
            fail_msg("variant %d: %d %s", variant, err, errors);
        assert_is_the_quad(&m, &check);
        mesh_free(&m);
    }
    setlocale(LC_ALL, no_locale);
}

// The quad as gltfpack leaves it: positions in 16 bits, scaled by their node; UVs in 16 bits, normalised, or 8; normals in 8; strides
// padded to 4 bytes. Once as GLB, once with its buffer beside, once with its buffer inside the text.
static void quantised_gltf_is_read(void **state)
{
    (void)state;
    static const char format[] = "{\"asset\":{\"version\":\"2.0\"},\"extensionsRequired\":[\"KHR_mesh_quantization\"],\"extensionsUsed\":"
        "[\"KHR_mesh_quantization\"],\"scene\":0,\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"mesh\":0,\"scale\":[0.5,0.25,1],"
        "\"translation\":[1,0.5,0]}],\"meshes\":[{\"primitives\":[{\"attributes\":{\"POSITION\":0,\"TEXCOORD_0\":1,\"NORMAL\":2},"
        "\"indices\":3}]}],\"accessors\":[{\"bufferView\":0,\"componentType\":5122,\"count\":4,\"type\":\"VEC3\"},"
        "{\"bufferView\":1,\"componentType\":5121,\"normalized\":true,\"count\":4,\"type\":\"VEC2\"},"
        "{\"bufferView\":2,\"componentType\":5120,\"normalized\":true,\"count\":4,\"type\":\"VEC3\"},"
        "{\"bufferView\":3,\"componentType\":5123,\"count\":6,\"type\":\"SCALAR\"}],\"bufferViews\":["
        "{\"buffer\":0,\"byteLength\":32,\"byteStride\":8},{\"buffer\":0,\"byteOffset\":32,\"byteLength\":16,\"byteStride\":4},"
        "{\"buffer\":0,\"byteOffset\":48,\"byteLength\":16,\"byteStride\":4},{\"buffer\":0,\"byteOffset\":64,\"byteLength\":12}],"
        "\"buffers\":[{%s\"byteLength\":76}]}";
    static const int16_t corner[4][4] = { { -2, -2, 0, 99 }, { 2, -2, 0, 99 }, { 2, 2, 0, 99 }, { -2, 2, 0, 99 } };
    static const unsigned char uv[4][4] = { { 51, 204, 99, 99 }, { 255, 204, 99, 99 }, { 255, 0, 99, 99 }, { 51, 0, 99, 99 } };
    static const signed char normal[4] = { 0, 0, 127, 99 };
    static const uint16_t indices[6] = { 0, 1, 2, 0, 2, 3 };
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    unsigned char buffer[78] = { 0 }, bytes[4096];
    char json[3000], uri[200] = "\"uri\":\"data:;base64,";
    memcpy(buffer, corner, 32);
    memcpy(buffer + 32, uv, 16);
    for (int i = 0; i < 4; i++)
        memcpy(buffer + 48 + 4 * i, normal, 4);
    memcpy(buffer + 64, indices, 12);
    size_t n_uri = strlen(uri);
    for (size_t i = 0; i < 76; i += 3)
        for (size_t k = 0; k < 4; k++)
            uri[n_uri++] = i + k > 76 ? '=' : digits[((unsigned)buffer[i] << 16 | (unsigned)buffer[i + 1] << 8 | buffer[i + 2]) >> (18 - 6 * k) & 63];
    strcpy(uri + n_uri, "\",");
    for (int variant = 0; variant < 3; variant++) {
        struct mesh m;
        struct mesh_check check;
        int err;
        snprintf(json, sizeof(json), format, variant == 0 ? "" : variant == 1 ? "\"uri\":\"the%20quad.bin\"," : uri);
        scratch_write("the quad.bin", buffer, 76);
        if (variant == 0) {
            const size_t n = strlen(json), n_json = (n + 3) / 4 * 4;
            memcpy(bytes, "glTF\2\0\0\0", 8);
            put_u32(bytes + 8, (uint32_t)(20 + n_json + 8 + 76));
            put_u32(bytes + 12, (uint32_t)n_json);
            memcpy(bytes + 16, "JSON", 4);
            memset(bytes + 20, ' ', n_json);
            memcpy(bytes + 20, json, n);
            put_u32(bytes + 20 + n_json, 76);
            memcpy(bytes + 24 + n_json, "BIN", 4);
            memcpy(bytes + 28 + n_json, buffer, 76);
            err = read_bytes(&m, &check, "quad.glb", bytes, 28 + n_json + 76);
        } else {
            err = read_text(&m, &check, "quad.gltf", json);
        }
        if (err)
            fail_msg("variant %d: %d %s", variant, err, errors);
        assert_true(m.n_triangles == 2 && m.n_vertices == 4 && m.n_points == 4 && m.n_charts == 1);
        for (int i = 0; i < 6; i++) {
            const int k = indices[i];
            const uint32_t v = m.triangle[i / 3][i % 3];
            assert_true(m.position_m[v][0] == (k == 1 || k == 2 ? 2 : 0) && m.position_m[v][1] == (k > 1) && m.position_m[v][2] == 0);
            assert_true(fabsf(m.uv[v][0] - (k == 1 || k == 2 ? 1 : .2f)) < 1e-6f && fabsf(m.uv[v][1] - (k > 1 ? 1 : .2f)) < 1e-6f);
            assert_true(m.normal[v][2] == 1);
        }
        mesh_free(&m);
    }
    snprintf(json, sizeof(json), format, "\"uri\":\"data:;base64,AAAA\","); // says 76 bytes, has 3
    struct mesh m;
    assert_int_equal(read_text(&m, NULL, "quad.gltf", json), -EINVAL);
    assert_non_null(strstr(errors, "the bytes end within accessor 0"));
}

// A square of two triangles that share two corners in space but not in the atlas, as Metashape and MeshLab write them. The second
// face names its corners after its UVs; a property of another kind lies between.
static void ply_with_uvs_per_corner_keeps_its_seams(void **state)
{
    (void)state;
    static const float position[4][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 1, 1, .25f }, { -1e-7f, 1, 0 } };
    static const float uv[2][6] = { { .125f, 0, .25f, 0, .25f, .5f }, { .75f, .5f, 1, 1, .5f, 1 } };
    static const int corner[2][3] = { { 0, 1, 2 }, { 0, 2, 3 } };
    static const char *const encodings[3] = { "ascii", "binary_little_endian", "binary_big_endian" };
    if (!setlocale(LC_ALL, "de_DE.UTF-8")) // decimal commas, where the machine has them
        setlocale(LC_ALL, "C");
    for (int encoding = 0; encoding < 3; encoding++) {
        unsigned char bytes[2048];
        int n = sprintf((char *)bytes, "ply\r\nformat %s 1.0\r\ncomment TextureFile a.png\nelement vertex 4\nproperty float x\n"
                                       "property float y\nproperty float z\nproperty uchar red\nelement face 2\nproperty uchar flags\n"
                                       "property list uchar float texcoord\nproperty list uchar int vertex_indices\n"
                                       "property int texnumber\nend_header\n", encodings[encoding]);
        for (int i = 0; i < 4 && encoding == 0; i++)
            n += sprintf((char *)bytes + n, "%d.%02de0 %d %d.%d 7\n", (int)position[i][0], 0, (int)position[i][1], 0, i == 2 ? 25 : 0);
        for (int i = 0; i < 2 && encoding == 0; i++) {
            n += sprintf((char *)bytes + n, "1 6");
            for (int k = 0; k < 6; k++)
                n += sprintf((char *)bytes + n, " %d.%03d", (int)uv[i][k], (int)(1000 * uv[i][k]) % 1000);
            n += sprintf((char *)bytes + n, " 3 %d %d %d -1\n", corner[i][0], corner[i][1], corner[i][2]);
        }
        unsigned char *at = bytes + n;
#define PUT(value) do { uint32_t w; memcpy(&w, &(value), 4); for (int b = 0; b < 4; b++) \
        *at++ = (unsigned char)(w >> 8 * (encoding == 1 ? b : 3 - b)); } while (0)
        for (int i = 0; i < 4 && encoding > 0; i++) {
            for (int k = 0; k < 3; k++)
                PUT(position[i][k]);
            *at++ = 7;
        }
        for (int i = 0; i < 2 && encoding > 0; i++) {
            *at++ = 1, *at++ = 6;
            for (int k = 0; k < 6; k++)
                PUT(uv[i][k]);
            *at++ = 3;
            for (int k = 0; k < 3; k++)
                PUT(corner[i][k]);
            PUT(corner[0][0]);
        }
#undef PUT
        struct mesh m;
        struct mesh_check check;
        const int err = read_bytes(&m, &check, "corners.ply", bytes, (size_t)(at - bytes));
        if (err)
            fail_msg("%s: %d %s", encodings[encoding], err, errors);
        assert_true(m.n_triangles == 2 && m.n_points == 4 && m.n_vertices == 6 && m.n_charts == 2);
        for (int i = 0; i < 2; i++)
            for (int k = 0; k < 3; k++) {
                const uint32_t v = m.triangle[i][k];
                for (int c = 0; c < 2; c++)
                    assert_true(m.uv[v][c] == uv[i][2 * k + c]);
                for (int c = 0; c < 3; c++)
                    assert_true(fabsf(m.position_m[v][c] - position[corner[i][k]][c]) < 2e-7f);
            }
        mesh_free(&m);
    }
    setlocale(LC_ALL, "C");
}

static void node_transforms_are_applied_and_mirrors_keep_their_outside(void **state)
{
    (void)state;
    // One mesh twice: moved and scaled, below a node that turns by 90 degrees about x; and mirrored.
    const char *json = GLTF("\"scenes\":[{\"nodes\":[0,2]}],\"nodes\":[{\"children\":[1],\"rotation\":[0.70710678118654757,0,0,"
                            "0.70710678118654757]},{\"mesh\":0,\"translation\":[10,20,30],\"scale\":[2,3,1]},"
                            "{\"mesh\":0,\"scale\":[-1,1,1]}]", "", "");
    unsigned char bytes[4096];
    struct mesh m;
    assert_int_equal(read_bytes(&m, NULL, "nodes.glb", bytes, make_glb(bytes, json)), 0);
    assert_int_equal(m.n_triangles, 4);
    for (int i = 0; i < 4; i++) {
        const bool is_mirrored = i >= 2;
        double a[3], b[3], n[3], p[3][3];
        for (int k = 0; k < 3; k++)
            for (int c = 0; c < 3; c++)
                p[k][c] = m.position_m[m.triangle[i][k]][c];
        vec3_sub(a, p[1], p[0]);
        vec3_sub(b, p[2], p[0]);
        vec3_cross(n, a, b);
        vec3_normalise(n);
        // the front stays in front: +z, turned to -y by the first node; a mirror along x leaves it
        const double front[2][3] = { { 0, -1, 0 }, { 0, 0, 1 } };
        for (int c = 0; c < 3; c++)
            assert_true(fabs(n[c] - front[is_mirrored][c]) < 1e-6);
        for (int k = 0; k < 3; k++)
            for (int q = 0; q < 4; q++)
                if (!memcmp(m.uv[m.triangle[i][k]], quad_uv[q], sizeof(quad_uv[q]))) {
                    const double x = quad_position[q][0], y = quad_position[q][1];
                    const double turned[3] = { 10 + 2 * x, -30, 20 + 3 * y }, flipped[3] = { -x, y, 0 };
                    for (int c = 0; c < 3; c++)
                        assert_true(fabs(p[k][c] - (is_mirrored ? flipped : turned)[c]) < 1e-5);
                }
    }
    mesh_free(&m);
}

// ---- what follows from the triangles ------------------------------------------------------------------------------------

// A cube of side 2 about the origin as six quads in six charts; 24 vertices.
static void make_cube(struct mesh *m, bool broken_normals)
{
    float(*position)[3] = calloc(24, sizeof(*position)), (*uv)[2] = calloc(24, sizeof(*uv));
    float(*normal)[3] = broken_normals ? calloc(24, sizeof(*normal)) : NULL;
    uint32_t(*triangle)[3] = calloc(12, sizeof(*triangle));
    for (int face = 0; face < 6; face++) {
        const int axis = face / 2, side = face % 2 ? 1 : -1;
        for (int k = 0; k < 4; k++) {
            const int a = k == 1 || k == 2, b = k >= 2; // around the face
            float *p = position[4 * face + k];
            p[axis] = (float)side;
            p[(axis + 1) % 3] = (float)(side * (2 * a - 1));
            p[(axis + 2) % 3] = (float)(2 * b - 1);
            uv[4 * face + k][0] = (float)((face % 3 + .1 + .8 * a) / 3);
            uv[4 * face + k][1] = (float)((face / 3 + .1 + .8 * b) / 2);
        }
        const uint32_t from = face == 0 || face == 3; // which diagonal: uneven, so that corners have 3 to 6 triangles
        for (uint32_t k = 0; k < 2; k++) {
            triangle[2 * face + (int)k][0] = 4 * (uint32_t)face + from;
            triangle[2 * face + (int)k][1] = 4 * (uint32_t)face + from + 1 + k;
            triangle[2 * face + (int)k][2] = 4 * (uint32_t)face + (from + 2 + k) % 4;
        }
    }
    for (int i = 0; i < 24 && broken_normals; i++)
        normal[i][0] = i == 3 ? NAN : i == 7 ? INFINITY : i == 9 ? 3e-8f : i == 5 ? 10 : 0;
    assert_int_equal(mesh_from_arrays(m, 24, position, normal, uv, 12, triangle), 0);
}

static void seams_are_no_creases(void **state)
{
    (void)state;
    for (int broken = 0; broken < 2; broken++) {
        struct mesh m;
        struct mesh_check check;
        make_cube(&m, broken);
        assert_int_equal(m.n_points, 8);
        assert_int_equal(m.n_charts, 6);
        for (int i = 0; i < 24; i++) // three equal angles meet in a corner, however the faces are cut
            for (int c = 0; c < 3; c++) {
                const double expected = broken && i == 5 ? c == 0 : m.position_m[i][c] / sqrt(3); // 5 has a good one: kept
                assert_true(fabs(m.normal[i][c] - expected) < 1e-6);
            }
        for (int i = 0; i < 12; i++)
            assert_int_equal(m.chart[i], i / 2);
        mesh_check_run(&m, &check);
        assert_int_equal(check.n_boundary_edges, 0);
        assert_int_equal(check.n_non_manifold_edges, 0);
        assert_int_equal(check.n_mirrored_uv, 0);
        assert_true(check.overlap_fraction == 0);
        warnings[0] = 0;
        mesh_check_log(&check, &m, "cube");
        assert_string_equal(warnings, "");
        mesh_free(&m);
    }
}

static void charts_join_where_edges_meet_in_space_and_atlas(void **state)
{
    (void)state;
    // Four triangles in a row. 0-1 share an edge and its UVs; 1-2 share the edge, but not the UVs; 2-3 the UVs, but not the
    // normals, so that vertices are split and the chart is not.
    const char *obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\n"
                      "vt 0 0\nvt .2 0\nvt 0 .2\nvt .2 .2\nvt .5 0\nvt .7 0\nvt .7 .2\nvt .5 .2\nvn 0 0 1\nvn 0 1 0\n"
                      "f 1/1 2/2 3/3\nf 2/2 4/4 3/3\nf 3/5/1 4/6/1 5/7/1\nf 3/5/2 5/7/2 6/8/2\n";
    struct mesh m;
    assert_int_equal(read_text(&m, NULL, "charts.obj", obj), 0);
    assert_int_equal(m.n_charts, 2);
    const int32_t expected[4] = { 0, 0, 1, 1 };
    assert_memory_equal(m.chart, expected, sizeof(expected));
    assert_int_equal(m.n_points, 6);
    assert_int_equal(m.n_vertices, 4 + 3 + 3);
    mesh_free(&m);
}

static void polygons_are_cut_inside_even_where_they_are_concave(void **state)
{
    (void)state;
    // An arrow head (its second corner is the notch), then an L of six corners, flat, UV = position.
    const char *obj = "v 0 0 0\nv .1 .3 0\nv 0 1 0\nv .45 .3 0\nv .5 .5 0\nv 1 .5 0\nv 1 .6 0\nv .6 .6 0\nv .6 1 0\nv .5 1 0\n"
                      "vt 0 0\nvt .1 .3\nvt 0 1\nvt .45 .3\nvt .5 .5\nvt 1 .5\nvt 1 .6\nvt .6 .6\nvt .6 1\nvt .5 1\n"
                      "f 4/4 3/3 2/2 1/1\nf 5/5 6/6 7/7 8/8 9/9 10/10\n";
    struct mesh m;
    struct mesh_check check;
    assert_int_equal(read_text(&m, &check, "concave.obj", obj), 0);
    assert_int_equal(m.n_triangles, 6);
    assert_int_equal(check.n_mirrored_uv, 0);
    assert_true(check.overlap_fraction == 0);
    double area = 0;
    for (int i = 0; i < 6; i++) {
        const float *a = m.uv[m.triangle[i][0]], *b = m.uv[m.triangle[i][1]], *c = m.uv[m.triangle[i][2]];
        area += .5 * fabs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]));
    }
    assert_true(fabs(area - (.175 + .09)) < 1e-6);
    mesh_free(&m);
}

// ---- what is wrong ------------------------------------------------------------------------------------------------------

static void the_check_counts_and_names_each_defect(void **state)
{
    (void)state;
    const char *obj =
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 2 0 0\nv 0 2 0\n"
        "vt 0 0\nvt .5 0\nvt .5 .5\nvt 0 .5\nvt 1.5 .1\nvt .9 .9\nvt .8 .8\nvt .6 .6\n"
        "f 1/1 2/2 3/3\n"           // good
        "f 1/1 3/3 4/4\n"           // good
        "f 1/1 2/2 4/4\n"           // over the first two
        "f 1/1 3/4 5/2\n"           // over the same half, mirrored; the third triangle at edge 1-3
        "f 1/8 2/6 6/7\n"           // on a line in 3-D (1, 2, 6): dropped
        "f 2/6 2/7 3/8\n"           // twice the same corner: dropped
        "f 2/2 6/5 3/3\n"           // out of range
        "f 3/6 4/6 7/6\n"           // no area in UV
        "f 4 5 7\n";                // no UVs
    struct mesh m;
    struct mesh_check check;
    assert_int_equal(read_text(&m, &check, "defects.obj", obj), 0);
    assert_int_equal(m.n_triangles, 7);
    assert_int_equal(check.n_zero_area, 2);
    assert_int_equal(check.n_mirrored_uv, 1);
    assert_int_equal(check.n_out_of_range_uv, 1);
    assert_int_equal(check.n_zero_area_uv, 1);
    assert_int_equal(check.n_missing_uv, 1);
    // edges: 12:2 23:2 13:3 34:2 14:2 24:1 35:1 15:1 26:1 36:1 47:2 37:1 45:1 57:1
    assert_int_equal(check.n_non_manifold_edges, 1);
    assert_int_equal(check.n_boundary_edges, 8);
    assert_int_equal(check.n_charts, m.n_charts);
    // Of the quarter below .5 (once) and the out-of-range triangle's part within 1 (.1875), half the quarter is covered again.
    assert_true(fabs(check.overlap_fraction - .125 / (.25 + .1875)) < .005);
    warnings[0] = 0;
    mesh_check_log(&check, &m, "defects.obj");
    static const char *const says[] = { "2 triangles without area in 3-D", "1 of 7 triangles have no UVs",
                                        "1 of 7 triangles have no area in UV", "1 of 7 triangles have UVs outside",
                                        "1 of 7 triangles have mirrored UVs", "is covered by several triangles",
                                        "1 edges belong to more than two", "8 edges belong to one triangle only" };
    for (size_t i = 0; i < sizeof(says) / sizeof(says[0]); i++)
        assert_non_null(strstr(warnings, says[i]));
    mesh_free(&m);
}

static void overlap_is_the_share_of_covered_texels(void **state)
{
    (void)state;
    // [0,.5]^2 twice, apart in space, and [.5,1]^2 once: half of what is covered is covered twice
    const char *obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 5\nv 1 0 5\nv 1 1 5\nv 0 1 5\nv 3 0 0\nv 4 0 0\nv 4 1 0\nv 3 1 0\n"
                      "vt 0 0\nvt .5 0\nvt .5 .5\nvt 0 .5\nvt 1 .5\nvt 1 1\nvt .5 1\n"
                      "f 1/1 2/2 3/3 4/4\nf 5/1 6/2 7/3 8/4\nf 9/3 10/5 11/6 12/7\n";
    struct mesh m;
    struct mesh_check check;
    assert_int_equal(read_text(&m, &check, "overlap.obj", obj), 0);
    assert_true(fabs(check.overlap_fraction - .5) < 1e-12);
    mesh_free(&m);
}

static void broken_files_are_refused_with_their_place(void **state)
{
    (void)state;
#define V "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
#define VT "vt 0 0\nvt 1 0\nvt 0 1\n"
#define PLY "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float u\n" \
            "property float v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
#define PLY_V "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n"
    static const struct {
        const char *text;
        int err;
        const char *says;
    } cases[] = {
        { "", -EINVAL, "empty" },
        { "hello\n", -ENOTSUP, "not a known mesh format" },
        { "Kaydara FBX Binary  \n", -ENOTSUP, "not a known mesh format" },
        { V VT, -EINVAL, "no faces" },
        { V "f 1 2 3\n", -EINVAL, "no UVs: none of 1 triangles" },
        { V VT "f 1/1 2/2 4/3\n", -EINVAL, "line 7: a face uses v 4; the file has 3" },
        { V VT "f 1/1 2/2 3/4\n", -EINVAL, "line 7: a face uses vt 4; the file has 3" },
        { V VT "f 1/1/1 2/2/1 3/3/1\n", -EINVAL, "line 7: a face uses vn 1; the file has 0" },
        { V VT "f 0/1 2/2 3/3\n", -EINVAL, "line 7: a face uses v 0" },
        { V VT "f -4/1 2/2 3/3\n", -EINVAL, "line 7: a face uses v -4" },
        { V VT "f 1/1 2/2\n", -EINVAL, "line 7: a face with 2 corners" },
        { V VT "f 1/1 2/2 3\n", -EINVAL, "line 7: 2 of 3 corners have UVs" },
        { V VT "f 1/1 2/2 /3\n", -EINVAL, "line 7: a corner without a vertex" },
        { V VT "f 1/1 2/x 3/3\n", -EINVAL, "line 7: 'x' is not an index" },
        { V VT "f 1/1 2/2 99999999999999999999/3\n", -EINVAL, "is not an index" },
        { V VT "f 1/1 2/2 3/3", -EINVAL, "cut short" },
        { V VT "f 1/1 2/2 \\\n3/3\n", -ENOTSUP, "continued" },
        { "v 0 0 0\nv 1 nan 0\nv 0 1 0\n" VT "f 1/1 2/2 3/3\n", -EINVAL, "line 2: 'nan' is not a finite number (v number 2)" },
        { "v 0 0 0\nv 1 1e999 0\nv 0 1 0\n" VT "f 1/1 2/2 3/3\n", -EINVAL, "expected finite numbers" },
        { "v 0 0 0\nv 1 0\nv 0 1 0\n" VT "f 1/1 2/2 3/3\n", -EINVAL, "line 2: v with 2 numbers" },
        { V "vt 0 0\nvt inf 0\nvt 0 1\nf 1/1 2/2 3/3\n", -EINVAL, "line 5: 'inf'" },
        { "v 0 0 0\nv 1 0 0\nv 2 0 0\n" VT "f 1/1 2/2 3/3\n", -EINVAL, "none of 1 triangles has any area" },
        { PLY PLY_V "3 0 1 3\n", -EINVAL, "face 0 uses vertex 3 of 3" },
        { PLY PLY_V "3 0 1 -1\n", -EINVAL, "face 0 uses vertex -1" },
        { PLY PLY_V "2 0 1\n", -EINVAL, "face 0 has 2 corners" },
        { PLY PLY_V "3 0 1 2", -EINVAL, "cut short" },
        { PLY "0 0 0 0 0\n1 0 nan 1 0\n0 1 0 0 1\n3 0 1 2\n", -EINVAL, "within vertex 2 of 3" },
        { PLY PLY_V, -EINVAL, "within face 1 of 1" },
        { "ply\nformat ascii 1.0\nelement vertex 9223372036854775808\nproperty float x\nend_header\n", -EINVAL, "count" },
        { "ply\nformat ascii 1.0\nelement vertex 9999999999\nproperty float x\nend_header\n", -EINVAL, "announced" },
        { "ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", -EINVAL, "0 properties" },
        { "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", -EINVAL, "point cloud" },
        { "ply\nformat ascii 1.0\nelement face 1\nproperty list float int vertex_indices\nend_header\n", -EINVAL, "'float'" },
        { "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
          "property list uchar int texcoord\nend_header\n", -EINVAL, "texcoord is of whole numbers" },
        { "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar "
          "int vertex_indices\nproperty list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 4 0 0 1 0\n", -EINVAL,
          "face 0 has 4 numbers in texcoord" },
        { "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar "
          "int vertex_indices\nproperty list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 nan 0 1\n", -EINVAL,
          "within face 1 of 1" },
        { "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar "
          "int vertex_indices\nproperty list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 0\n", -EINVAL, "no UVs" },
        { "ply\nformat ternary 1.0\n", -EINVAL, "'ternary'" },
        { "ply\nproperty float x\n", -EINVAL, "before any element" },
        { "ply\nformat ascii 1.0\nelement vertex 3\n", -EINVAL, "before end_header" },
        { "{\"asset\":", -EINVAL, "" },
        { GLTF(ONE_NODE, "", ""), -EINVAL, "buffer 0 has 92 bytes, the BIN chunk 0" },
        { GLTF(ONE_NODE, "\"uri\":\"nowhere.bin\",", ""), -EINVAL, "nowhere.bin': No such file" },
        { GLTF(ONE_NODE, "\"uri\":\"nowhere.bin\",", "\"extensionsRequired\":[\"KHR_draco_mesh_compression\"],"), -ENOTSUP,
          "KHR_draco_mesh_compression" },
        { GLTF(ONE_NODE, "\"uri\":\"nowhere.bin\",", "\"extensionsUsed\":[\"A\",\"EXT_meshopt_compression\"],"), -ENOTSUP,
          "EXT_meshopt_compression" },
        { GLTF("\"nodes\":[{\"children\":[1]},{\"children\":[0]}]", "\"uri\":\"data:,\",", ""), -EINVAL, "within itself" },
        { GLTF("\"nodes\":[{\"children\":[2]},{\"children\":[2]},{\"mesh\":0}]", "\"uri\":\"data:,\",", ""), -EINVAL, "a tree" },
        { GLTF("\"nodes\":[{\"children\":[7]}]", "\"uri\":\"data:,\",", ""), -EINVAL, "does not exist" },
    };
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        struct mesh m;
        struct mesh_check check;
        const int err = read_text(&m, &check, "broken", cases[i].text);
        if (err != cases[i].err || !errors[0] || !strstr(errors, cases[i].says))
            fail_msg("case %zu, \"%.60s\": %d, %s", i, cases[i].text, err, errors);
        assert_true(!m.position_m && !m.triangle);
    }
    struct mesh m;
    assert_int_equal(mesh_read(&m, NULL, scratch_path("nothing")), -ENOENT);
    assert_int_equal(mesh_read(&m, NULL, scratch_dir), -EISDIR);
    assert_int_equal(mesh_read(&m, NULL, "/dev/zero"), -EINVAL);
}

// The good GLB with one spot changed.
static void broken_glbs_are_refused_with_their_place(void **state)
{
    (void)state;
    static const struct {
        const char *find, *put;
        int err;
        const char *says;
    } cases[] = {
        { "\"count\":4,\"type\":\"VEC3\"", "\"count\":5,\"type\":\"VEC3\"", -EINVAL, "accessor 0: 5 elements" },
        { "\"count\":6", "\"count\":7", -EINVAL, "accessor 2" },
        { "\"componentType\":5126,\"count\":4,\"type\":\"VEC2\"", "\"componentType\":5125,\"count\":4,\"type\":\"VEC2\"", -EINVAL,
          "TEXCOORD_0 is of component type 5125" },
        { "\"type\":\"VEC3\"", "\"type\":\"VEC2\"", -EINVAL, "POSITION is VEC2; expected VEC3" },
        { "\"POSITION\":0", "\"POSITION\":9", -EINVAL, "POSITION: the accessor does not exist" },
        { "\"byteOffset\":80", "\"byteOffset\":81", -EINVAL, "bufferView 2" },
        { "\"byteLength\":92", "\"byteLength\":99", -EINVAL, "buffer 0 has 99 bytes, the BIN chunk 92" },
        { "\"bufferView\":1", "\"bufferView\":3", -EINVAL, "bufferView does not exist" },
        { "\"count\":6", "\"count\":-", -EINVAL, "" },
        { "TEXCOORD_0", "_EXCOORD_0", -EINVAL, "no UVs" },
    };
    unsigned char bytes[4096];
    struct mesh m;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        char json[2048];
        snprintf(json, sizeof(json), "%s", GLTF(ONE_NODE, "", ""));
        char *at = strstr(json, cases[i].find);
        assert_non_null(at);
        memcpy(at, cases[i].put, strlen(cases[i].put));
        const int err = read_bytes(&m, NULL, "broken.glb", bytes, make_glb(bytes, json));
        if (err != cases[i].err || !errors[0] || !strstr(errors, cases[i].says))
            fail_msg("case %zu, \"%s\": %d, %s", i, cases[i].put, err, errors);
    }
    // positions, UVs and indices that the JSON cannot show
    const float nan = NAN;
    const uint16_t beyond = 4;
    const size_t n = make_glb(bytes, GLTF(ONE_NODE, "", ""));
    memcpy(bytes + n - 92 + 12, &nan, 4);
    assert_int_equal(read_bytes(&m, NULL, "broken.glb", bytes, n), -EINVAL);
    assert_non_null(strstr(errors, "vertex 1 "));
    make_glb(bytes, GLTF(ONE_NODE, "", ""));
    memcpy(bytes + n - 92 + 48 + 16, &nan, 4);
    assert_int_equal(read_bytes(&m, NULL, "broken.glb", bytes, n), -EINVAL);
    assert_non_null(strstr(errors, "vertex 2 "));
    make_glb(bytes, GLTF(ONE_NODE, "", ""));
    memcpy(bytes + n - 2, &beyond, 2);
    assert_int_equal(read_bytes(&m, NULL, "broken.glb", bytes, n), -EINVAL);
    assert_non_null(strstr(errors, "1 of 2 triangles use vertices that do not exist"));
    make_glb(bytes, GLTF(ONE_NODE, "", ""));
    assert_int_equal(read_bytes(&m, NULL, "broken.glb", bytes, n + 4), -EINVAL);
    assert_non_null(strstr(errors, "the header says"));
    bytes[4] = 1;
    assert_int_equal(read_bytes(&m, NULL, "broken.glb", bytes, n), -ENOTSUP);
    assert_non_null(strstr(errors, "version 1"));
}

static void cut_files_are_refused(void **state)
{
    (void)state;
    unsigned char bytes[4096];
    for (int variant = 0; variant < 6; variant++) {
        size_t n = 0;
        switch (variant) {
        case 0:
        case 1:
        case 2:
            n = strlen(variant == 0 ? quad_obj : variant == 1 ? quad_ply : GLTF(ONE_NODE, "\"uri\":\"the%20quad.bin\",", ""));
            memcpy(bytes, variant == 0 ? quad_obj : variant == 1 ? quad_ply : GLTF(ONE_NODE, "\"uri\":\"the%20quad.bin\",", ""),
                   n);
            break;
        case 3:
        case 4:
            n = make_binary_ply(bytes, variant == 4);
            break;
        default:
            n = make_glb(bytes, GLTF(ONE_NODE, "", ""));
        }
        for (size_t cut = 0; cut < n; cut++) {
            struct mesh m;
            const int err = read_bytes(&m, NULL, "cut", bytes, cut);
            if (!err || !errors[0])
                fail_msg("variant %d cut at %zu of %zu: %d %s", variant, cut, n, err, errors);
        }
    }
}

static void buffer_cut_short_is_refused(void **state)
{
    (void)state;
    unsigned char buffer[128];
    const size_t n = quad_buffer(buffer);
    for (size_t cut = 0; cut <= n; cut++) {
        struct mesh m;
        scratch_write("cut.bin", buffer, cut);
        const int err = read_text(&m, NULL, "cut.gltf", GLTF(ONE_NODE, "\"uri\":\"cut.bin\",", ""));
        assert_int_equal(err, cut < n ? -EINVAL : 0);
        assert_int_equal(cut < n, errors[0] != 0);
        mesh_free(&m);
    }
}

static void arrays_are_checked_and_taken_over_even_on_failure(void **state)
{
    (void)state;
    for (int wrong = 0; wrong < 6; wrong++) {
        float(*position)[3] = calloc(3, sizeof(*position)), (*uv)[2] = calloc(3, sizeof(*uv));
        uint32_t(*triangle)[3] = calloc(1, sizeof(*triangle));
        position[1][0] = position[2][1] = uv[1][0] = uv[2][1] = 1;
        triangle[0][1] = 1, triangle[0][2] = 2;
        if (wrong == 1)
            position[2][2] = NAN;
        if (wrong == 2)
            uv[1][1] = INFINITY;
        if (wrong == 3)
            triangle[0][2] = 3;
        struct mesh m;
        const int err = mesh_from_arrays(&m, wrong == 4 ? 0 : 3, position, NULL, uv, wrong == 5 ? -1 : 1, triangle);
        assert_int_equal(err, wrong ? -EINVAL : 0);
        if (wrong)
            assert_true(!m.position_m && !m.triangle); // freed: the address sanitizer would tell
        mesh_free(&m);
        mesh_free(&m);
    }
    mesh_free(NULL);
}

static void written_obj_reads_back(void **state)
{
    (void)state;
    struct mesh cube, back;
    make_cube(&cube, true);
    for (int i = 0; i < 24; i++)
        for (int c = 0; c < 3; c++)
            cube.position_m[i][c] *= c == 0 ? .1234567f : c == 1 ? 12345.678f : 3.3e-5f;
    if (!setlocale(LC_ALL, "de_DE.UTF-8"))
        setlocale(LC_ALL, "C");
    assert_int_equal(mesh_write_obj(&cube, scratch_path("back.obj")), 0);
    assert_int_equal(mesh_read(&back, NULL, scratch_path("back.obj")), 0);
    setlocale(LC_ALL, "C");
    assert_int_equal(back.n_vertices, cube.n_vertices);
    assert_int_equal(back.n_triangles, cube.n_triangles);
    assert_int_equal(back.n_points, cube.n_points);
    assert_int_equal(back.n_charts, cube.n_charts);
    for (int i = 0; i < cube.n_triangles; i++)
        for (int k = 0; k < 3; k++) {
            const uint32_t a = cube.triangle[i][k], b = back.triangle[i][k];
            for (int c = 0; c < 3; c++) { // assimp reads to about two units in the last place of a float
                assert_true(fabsf(cube.position_m[a][c] - back.position_m[b][c]) <= 2.4e-7f * fabsf(cube.position_m[a][c]));
                assert_true(fabsf(cube.normal[a][c] - back.normal[b][c]) < 3e-7f);
                assert_true(c == 2 || fabsf(cube.uv[a][c] - back.uv[b][c]) < 2.4e-7f);
            }
        }
    mesh_free(&cube);
    mesh_free(&back);
    assert_int_not_equal(mesh_write_obj(&cube, "/nonexistent folder/a.obj"), 0);
}

static void real_meshes_load(void **state)
{
    (void)state;
    static const struct {
        const char *path;
        int n_triangles, n_mirrored;
    } files[] = {
        { "mesh/LeePerrySmith/LeePerrySmith.glb", 17684, 17011 }, // written with v upwards, against the format
        { "mesh/MaterialsVariantsShoe/MaterialsVariantsShoe.gltf", 22700, 0 },
        { "studio-pebble/geometry/mesh.obj", 20480, 0 },
        { "studio-vase/geometry/mesh.obj", 26704, 0 },
    };
    if (access("../shared/data", F_OK)) {
        fprintf(stderr, "test_mesh: no ../shared/data here: real files are not tried\n");
        return;
    }
    for (size_t i = 0; i < sizeof(files) / sizeof(files[0]); i++) {
        char path[256];
        struct mesh m;
        struct mesh_check check;
        snprintf(path, sizeof(path), "../shared/data/%s", files[i].path);
        assert_int_equal(mesh_read(&m, &check, path), 0);
        assert_int_equal(m.n_triangles, files[i].n_triangles);
        assert_int_equal(check.n_mirrored_uv, files[i].n_mirrored);
        assert_int_equal(check.n_missing_uv + check.n_out_of_range_uv + check.n_zero_area, 0);
        assert_true(check.overlap_fraction < .001);
        mesh_free(&m);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_format_gives_the_same_uvs),
        cmocka_unit_test(quantised_gltf_is_read),
        cmocka_unit_test(ply_with_uvs_per_corner_keeps_its_seams),
        cmocka_unit_test(node_transforms_are_applied_and_mirrors_keep_their_outside),
        cmocka_unit_test(seams_are_no_creases),
        cmocka_unit_test(charts_join_where_edges_meet_in_space_and_atlas),
        cmocka_unit_test(polygons_are_cut_inside_even_where_they_are_concave),
        cmocka_unit_test(the_check_counts_and_names_each_defect),
        cmocka_unit_test(overlap_is_the_share_of_covered_texels),
        cmocka_unit_test(broken_files_are_refused_with_their_place),
        cmocka_unit_test(broken_glbs_are_refused_with_their_place),
        cmocka_unit_test(cut_files_are_refused),
        cmocka_unit_test(buffer_cut_short_is_refused),
        cmocka_unit_test(arrays_are_checked_and_taken_over_even_on_failure),
        cmocka_unit_test(written_obj_reads_back),
        cmocka_unit_test(real_meshes_load),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
