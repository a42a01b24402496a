// solver/export_glb.c - model.glb: glTF 2.0 in one binary file.
//
// By hand, because assimp 5.2.5 writes neither KHR_materials_specular nor _anisotropy. Layout: header, JSON chunk, binary chunk with
// indices, positions, normals, UVs (v from the top), tangents where anisotropy is used, then the PNGs; each begins at 4 bytes.
#include "solver/export_format.h"
#include "solver/take/atomic_file.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { GL_FLOAT = 5126, GL_UNSIGNED_INT = 5125, GL_ARRAY_BUFFER = 34962, GL_ELEMENT_ARRAY_BUFFER = 34963 };
static const uint32_t magic_gltf = 0x46546c67, chunk_json = 0x4e4f534a, chunk_bin = 0x004e4942;

struct glb {
    struct export_job *job;
    uint8_t *bytes; // the binary chunk
    size_t n, capacity;
    struct json *views, *accessors, *images, *textures, *used;
    int n_views, n_accessors, n_textures;
};

// ---- the binary chunk -----------------------------------------------------------------------------------------------------

static int reserve(struct glb *g, size_t more)
{
    if (g->n + more <= g->capacity)
        return 0;
    size_t capacity = g->capacity ? g->capacity : 1 << 20;
    while (capacity < g->n + more)
        capacity *= 2;
    uint8_t *bytes = realloc(g->bytes, capacity);
    if (!bytes)
        return -ENOMEM;
    g->bytes = bytes, g->capacity = capacity;
    return 0;
}

// Append n bytes as a bufferView; target 0: a picture.
static int add_view(struct glb *g, const void *bytes, size_t n, int target)
{
    const size_t padded = (n + 3) & ~(size_t)3;
    const int err = reserve(g, padded);
    if (err)
        return err;
    memcpy(g->bytes + g->n, bytes, n);
    memset(g->bytes + g->n + n, 0, padded - n);
    struct json *view = json_object();
    json_set_int(view, "buffer", 0);
    json_set_int(view, "byteOffset", (int64_t)g->n);
    json_set_int(view, "byteLength", (int64_t)n);
    if (target)
        json_set_int(view, "target", target);
    json_append(g->views, view);
    g->n += padded, g->n_views++;
    return 0;
}

// Floats of n x width; bounds: with min and max.
static int add_floats(struct glb *g, const float *values, int n, int width, const char *type, bool bounds)
{
    const int err = add_view(g, values, (size_t)n * (size_t)width * sizeof(*values), GL_ARRAY_BUFFER);
    if (err)
        return err;
    struct json *a = json_object();
    json_set_int(a, "bufferView", g->n_views - 1);
    json_set_int(a, "componentType", GL_FLOAT);
    json_set_int(a, "count", n);
    json_set_string(a, "type", type);
    if (bounds) {
        double least[4], most[4];
        for (int c = 0; c < width; c++) {
            least[c] = INFINITY, most[c] = -INFINITY;
            for (int i = 0; i < n; i++) {
                least[c] = fmin(least[c], (double)values[i * width + c]);
                most[c] = fmax(most[c], (double)values[i * width + c]);
            }
        }
        json_set_numbers(a, "min", least, width);
        json_set_numbers(a, "max", most, width);
    }
    json_append(g->accessors, a);
    g->n_accessors++;
    return 0;
}

static int add_indices(struct glb *g, const struct mesh *mesh)
{
    const int err = add_view(g, mesh->triangle, (size_t)mesh->n_triangles * sizeof(*mesh->triangle), GL_ELEMENT_ARRAY_BUFFER);
    if (err)
        return err;
    struct json *a = json_object();
    json_set_int(a, "bufferView", g->n_views - 1);
    json_set_int(a, "componentType", GL_UNSIGNED_INT);
    json_set_int(a, "count", 3 * (int64_t)mesh->n_triangles);
    json_set_string(a, "type", "SCALAR");
    json_append(g->accessors, a);
    g->n_accessors++;
    return 0;
}

// ---- geometry -------------------------------------------------------------------------------------------------------------

// Per vertex: along +u, the area-weighted mean of its triangles, across the normal; the solver's bitangent is normal x tangent, so w
// is 1 everywhere.
static float (*find_tangents(const struct mesh *m))[4]
{
    float(*out)[4] = calloc((size_t)m->n_vertices, sizeof(*out));
    if (!out)
        return NULL;
    for (int i = 0; i < m->n_triangles; i++) {
        const uint32_t *t = m->triangle[i];
        double e[2][3], d[2][2], u[3], cross[3];
        for (int k = 0; k < 2; k++) {
            for (int c = 0; c < 3; c++)
                e[k][c] = (double)m->position_m[t[k + 1]][c] - (double)m->position_m[t[0]][c];
            for (int c = 0; c < 2; c++)
                d[k][c] = (double)m->uv[t[k + 1]][c] - (double)m->uv[t[0]][c];
        }
        const double area2 = d[0][0] * d[1][1] - d[1][0] * d[0][1], sign = area2 < 0 ? -1 : area2 > 0;
        for (int c = 0; c < 3; c++)
            u[c] = sign * (d[1][1] * e[0][c] - d[0][1] * e[1][c]);
        vec3_normalise(u);
        vec3_cross(cross, e[0], e[1]);
        const double weight = vec3_norm(cross);
        for (int k = 0; k < 3; k++)
            for (int c = 0; c < 3; c++)
                out[t[k]][c] += (float)(weight * u[c]);
    }
    for (int i = 0; i < m->n_vertices; i++) {
        const double n[3] = { m->normal[i][0], m->normal[i][1], m->normal[i][2] };
        double t[3] = { out[i][0], out[i][1], out[i][2] };
        vec3_normalise(t);
        vec3_add_scaled(t, t, -vec3_dot(t, n), n);
        if (vec3_normalise(t) < 1e-6) { // none: any across the normal
            const double axis[3] = { fabs(n[0]) < .6, fabs(n[0]) >= .6, 0 };
            vec3_cross(t, n, axis);
            vec3_normalise(t);
        }
        for (int c = 0; c < 3; c++)
            out[i][c] = (float)t[c];
        out[i][3] = 1;
    }
    return out;
}

// Normals that are unit to float's rounding, whatever the mesh's file said.
static float (*find_normals(const struct mesh *m))[3]
{
    float(*out)[3] = malloc((size_t)m->n_vertices * sizeof(*out));
    for (int i = 0; out && i < m->n_vertices; i++) {
        double n[3] = { m->normal[i][0], m->normal[i][1], m->normal[i][2] };
        if (!(vec3_normalise(n) > 0))
            n[2] = 1;
        for (int c = 0; c < 3; c++)
            out[i][c] = (float)n[c];
    }
    return out;
}

static int add_geometry(struct glb *g, struct json *attributes, bool tangents)
{
    const struct mesh *m = g->job->source->mesh;
    float(*normal)[3] = find_normals(m), (*uv)[2] = malloc((size_t)m->n_vertices * sizeof(*uv)),
    (*tangent)[4] = tangents ? find_tangents(m) : NULL;
    int err = normal && uv && (tangent || !tangents) ? 0 : -ENOMEM;
    for (int i = 0; !err && i < m->n_vertices; i++)
        uv[i][0] = m->uv[i][0], uv[i][1] = 1 - m->uv[i][1];
    if (!err)
        err = add_indices(g, m);
    if (!err)
        err = add_floats(g, m->position_m[0], m->n_vertices, 3, "VEC3", true);
    if (!err)
        err = add_floats(g, normal[0], m->n_vertices, 3, "VEC3", false);
    if (!err)
        err = add_floats(g, uv[0], m->n_vertices, 2, "VEC2", false);
    if (!err && tangents)
        err = add_floats(g, tangent[0], m->n_vertices, 4, "VEC4", false);
    json_set_int(attributes, "POSITION", 1);
    json_set_int(attributes, "NORMAL", 2);
    json_set_int(attributes, "TEXCOORD_0", 3);
    if (tangents)
        json_set_int(attributes, "TANGENT", 4);
    free(normal);
    free(uv);
    free(tangent);
    return err;
}

// The node's rotation: the world's axis nearest to the probe's +Y becomes +Y. Quaternion x y z w; false: it is already.
static bool find_upright(double out[4], const struct lights *lights)
{
    static const double half = 0.70710678118654752;
    static const double rotations[6][4] = {
        { 0, 0, half, half }, { 0, 0, -half, half }, // +x, -x
        { 0, 0, 0, 1 },       { 1, 0, 0, 0 },        // +y, -y
        { -half, 0, 0, half }, { half, 0, 0, half }, // +z, -z
    };
    if (!lights)
        return false;
    const double *r = lights->world_from_probe, up[3] = { r[1], r[4], r[7] };
    int axis = 1;
    for (int c = 0; c < 3; c++)
        axis = fabs(up[c]) > fabs(up[axis]) ? c : axis;
    const int which = 2 * axis + (up[axis] < 0);
    memcpy(out, rotations[which], sizeof(rotations[which]));
    return which != 2;
}

// ---- material -------------------------------------------------------------------------------------------------------------

// The picture as a texture; its textureInfo is added to object under key. Where key_too is given, the same texture there as well.
static int add_texture(struct glb *g, struct json *object, const char *key, const char *key_too, int which)
{
    const struct export_job *job = g->job;
    uint8_t *png;
    size_t n;
    int err = image_encode_png(&png, &n, job->size, job->size, 3, job->picture[which].pixels[0]);
    if (!err)
        err = add_view(g, png, n, 0);
    free(png);
    if (err)
        return err;
    struct json *image = json_object(), *texture = json_object();
    json_set_int(image, "bufferView", g->n_views - 1);
    json_set_string(image, "mimeType", "image/png");
    json_append(g->images, image);
    json_set_int(texture, "sampler", 0);
    json_set_int(texture, "source", g->n_textures);
    json_append(g->textures, texture);
    for (int i = 0; i < (key_too ? 2 : 1); i++) {
        struct json *info = json_object();
        json_set_int(info, "index", g->n_textures);
        json_set(object, i ? key_too : key, info);
    }
    g->n_textures++;
    return 0;
}

static struct json *add_extension(struct glb *g, struct json *extensions, const char *name)
{
    struct json *e = json_object();
    json_set(extensions, name, e);
    json_append_string(g->used, name);
    return e;
}

// A colour: a factor where the picture is constant, else a texture with scale as its factor.
static int set_color(struct glb *g, struct json *object, int which, const char *factor, const char *texture, double scale)
{
    const struct export_picture *p = &g->job->picture[which];
    const double scales[3] = { scale, scale, scale };
    json_set_numbers(object, factor, p->constant ? p->value : scales, 3);
    return p->constant ? 0 : add_texture(g, object, texture, NULL, which);
}

static int add_extensions(struct glb *g, struct json *extensions)
{
    const struct export_job *job = g->job;
    const struct export_picture *coat = &job->picture[PICTURE_COAT], *sheen = &job->picture[PICTURE_SHEEN],
                                *anisotropy = &job->picture[PICTURE_ANISOTROPY];
    struct json *e = add_extension(g, extensions, "KHR_materials_specular");
    int err = 0;
    json_set_number(e, "specularFactor", job->specular_factor);
    if (job->specular_factor > 0)
        err = set_color(g, e, PICTURE_SPECULAR, "specularColorFactor", "specularColorTexture", job->specular_scale);
    if (!err && coat->most[0]) {
        e = add_extension(g, extensions, "KHR_materials_clearcoat");
        json_set_number(e, "clearcoatFactor", coat->constant ? coat->value[0] : 1);
        json_set_number(e, "clearcoatRoughnessFactor", coat->constant ? coat->value[1] : 1);
        if (!coat->constant)
            err = add_texture(g, e, "clearcoatTexture", "clearcoatRoughnessTexture", PICTURE_COAT);
    }
    if (!err && (sheen->most[0] || sheen->most[1] || sheen->most[2])) {
        e = add_extension(g, extensions, "KHR_materials_sheen");
        json_set_number(e, "sheenRoughnessFactor", job->sheen_roughness);
        err = set_color(g, e, PICTURE_SHEEN, "sheenColorFactor", "sheenColorTexture", 1);
    }
    if (!err && anisotropy->most[2]) {
        e = add_extension(g, extensions, "KHR_materials_anisotropy");
        json_set_number(e, "anisotropyStrength", anisotropy->constant ? anisotropy->value[2] : 1);
        if (!anisotropy->constant)
            err = add_texture(g, e, "anisotropyTexture", NULL, PICTURE_ANISOTROPY);
    }
    return err;
}

static int add_material(struct glb *g, struct json *material)
{
    const struct export_picture *base = &g->job->picture[PICTURE_BASE], *rough = &g->job->picture[PICTURE_METALLIC_ROUGHNESS];
    struct json *pbr = json_object(), *extensions = json_object();
    int err = 0;
    json_set_string(material, "name", "studiorig");
    if (base->constant) {
        const double rgba[4] = { base->value[0], base->value[1], base->value[2], 1 };
        json_set_numbers(pbr, "baseColorFactor", rgba, 4);
    } else {
        err = add_texture(g, pbr, "baseColorTexture", NULL, PICTURE_BASE);
    }
    json_set_number(pbr, "metallicFactor", rough->constant ? rough->value[2] : 1);
    json_set_number(pbr, "roughnessFactor", rough->constant ? rough->value[1] : 1);
    if (!err && !rough->constant)
        err = add_texture(g, pbr, "metallicRoughnessTexture", NULL, PICTURE_METALLIC_ROUGHNESS);
    json_set(material, "pbrMetallicRoughness", pbr);
    if (!err)
        err = add_extensions(g, extensions);
    json_set(material, "extensions", extensions);
    return err;
}

// ---- the document ---------------------------------------------------------------------------------------------------------

static struct json *list_of(struct json *one)
{
    struct json *list = json_array();
    json_append(list, one);
    return list;
}

static struct json *make_document(struct glb *g, struct json *attributes, struct json *material)
{
    struct json *doc = json_object(), *asset = json_object(), *scene = json_object(), *node = json_object(), *mesh = json_object(),
                *primitive = json_object(), *buffer = json_object(), *sampler = json_object();
    struct json *first = NULL;
    double upright[4];
    (void)json_parse(&first, "[0]", 3, "model.glb"); // a list of whole numbers; without memory: NULL, which json_set remembers
    json_set_string(asset, "version", "2.0");
    json_set_string(asset, "generator", "studiorig rigsolve " STUDIORIG_VERSION);
    json_set(doc, "asset", asset);
    json_set(doc, "extensionsUsed", g->used);
    json_set_int(doc, "scene", 0);
    json_set(scene, "nodes", first);
    json_set(doc, "scenes", list_of(scene));
    json_set_string(node, "name", "model");
    json_set_int(node, "mesh", 0);
    if (find_upright(upright, g->job->source->lights))
        json_set_numbers(node, "rotation", upright, 4);
    json_set(doc, "nodes", list_of(node));
    json_set(primitive, "attributes", attributes);
    json_set_int(primitive, "indices", 0);
    json_set_int(primitive, "material", 0);
    json_set_int(primitive, "mode", 4);
    json_set_string(mesh, "name", "model");
    json_set(mesh, "primitives", list_of(primitive));
    json_set(doc, "meshes", list_of(mesh));
    json_set(doc, "materials", list_of(material));
    if (g->n_textures) {
        json_set_int(sampler, "magFilter", 9729); // linear
        json_set_int(sampler, "minFilter", 9987); // linear, linear between mip maps
        json_set_int(sampler, "wrapS", 33071);    // clamp
        json_set_int(sampler, "wrapT", 33071);
        json_set(doc, "samplers", list_of(sampler));
        json_set(doc, "textures", g->textures);
        json_set(doc, "images", g->images);
    } else {
        json_free(sampler), json_free(g->textures), json_free(g->images);
    }
    json_set(doc, "accessors", g->accessors);
    json_set(doc, "bufferViews", g->views);
    json_set_int(buffer, "byteLength", (int64_t)g->n);
    json_set(doc, "buffers", list_of(buffer));
    return doc;
}

static void put_u32(FILE *f, uint32_t v)
{
    const uint8_t bytes[4] = { v & 255, v >> 8 & 255, v >> 16 & 255, v >> 24 };
    fwrite(bytes, 1, 4, f);
}

static int write_glb(const struct glb *g, const char *text, const char *path)
{
    struct atomic_file f;
    const size_t n_text = strlen(text), n_json = (n_text + 3) & ~(size_t)3;
    if (g->n + n_json + 28 > UINT32_MAX) {
        log_error("export: %s not written: %zu bytes; a GLB holds at most 4 GiB; export with a smaller texture", path, g->n);
        return -EFBIG;
    }
    const int err = atomic_file_open(&f, path);
    if (err)
        return err;
    put_u32(f.stream, magic_gltf), put_u32(f.stream, 2), put_u32(f.stream, (uint32_t)(12 + 8 + n_json + 8 + g->n));
    put_u32(f.stream, (uint32_t)n_json), put_u32(f.stream, chunk_json);
    fwrite(text, 1, n_text, f.stream);
    fwrite("   ", 1, n_json - n_text, f.stream);
    put_u32(f.stream, (uint32_t)g->n), put_u32(f.stream, chunk_bin);
    fwrite(g->bytes, 1, g->n, f.stream);
    return atomic_file_commit(&f);
}

int export_glb(struct export_job *job)
{
    struct glb g = { .job = job, .views = json_array(), .accessors = json_array(), .images = json_array(),
                     .textures = json_array(), .used = json_array() };
    struct json *attributes = json_object(), *material = json_object();
    int err = add_geometry(&g, attributes, job->picture[PICTURE_ANISOTROPY].most[2] > 0);
    if (!err)
        err = add_material(&g, material);
    struct json *doc = make_document(&g, attributes, material);
    char *text = json_text(doc), *path = export_path(job, "model.glb");
    if (!err)
        err = text && path ? write_glb(&g, text, path) : -ENOMEM;
    json_free(doc);
    free(text);
    free(path);
    free(g.bytes);
    return err ? err : export_wrote(job, "model.glb");
}
