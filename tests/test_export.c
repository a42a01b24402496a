// tests/test_export.c - what export writes is read back: GLB and OBJ through the mesh importer, GLB's structure by the rules of the glTF
// 2.0 specification, its pictures by the PNG reader, EXR layers to the bit.
#include "solver/export.h"
#include "solver/shapes.h"
#include "solver/take/atomic_file.h"
#include "solver/take/image_formats.h"
#include "solver/take/json.h"
#include "solver/take/log.h"
#include "solver/texels.h"
#include "solver/xml.h"
#include "tests/scratch.h"

#include <errno.h>
#include <math.h>
#include <string.h>
#include <sys/stat.h>

enum { SIZE = 64 };

struct studio {
    struct mesh mesh;
    struct image albedo, parameters;
    struct texels texels;
};
static struct studio studio;

// Varied albedo and roughness; the rest constant, anisotropy among it.
static int set_up(void **unused)
{
    static const double centre_m[3] = { .1, -.2, .3 };
    static const float theta[DISNEY_N] = { .25f, .125f, .5f, 0, .5f, .5f, .25f, .5f, .5f, .75f };
    (void)unused;
    int err = scratch_open();
    if (!err)
        err = shape_make(&studio.mesh, SHAPE_PEBBLE, centre_m, .4, 2000);
    if (!err)
        err = texels_rasterise(&studio.texels, &studio.mesh, SIZE);
    if (!err)
        err = image_new(&studio.albedo, SIZE, SIZE, 3, NULL);
    if (!err)
        err = image_new(&studio.parameters, SIZE, SIZE, DISNEY_N, disney_parameter_names);
    for (int i = 0; !err && i < SIZE * SIZE; i++) {
        for (int c = 0; c < 3; c++)
            studio.albedo.data[3 * i + c] = .1f + .6f * (float)((i * (c + 3)) % SIZE) / SIZE;
        for (int p = 0; p < DISNEY_N; p++)
            studio.parameters.data[DISNEY_N * i + p] = p == DISNEY_ROUGHNESS ? .2f + .7f * (float)(i / SIZE) / SIZE : theta[p];
    }
    log_set_level(LOG_SILENT);
    return err;
}

static int tear_down(void **unused)
{
    (void)unused;
    texels_free(&studio.texels);
    image_free(&studio.albedo), image_free(&studio.parameters);
    mesh_free(&studio.mesh);
    return scratch_close();
}

static struct export_source source_of(void)
{
    return (struct export_source){ .mesh = &studio.mesh, .albedo = &studio.albedo, .parameters = &studio.parameters, .n_threads = 2 };
}

static struct export_summary export_to(const char *name, const struct export_source *source, unsigned formats)
{
    struct export_summary summary;
    assert_int_equal(export_write(&summary, source, formats, scratch_path(name)), 0);
    return summary;
}

static void remove_folder(const char *name)
{
    DIR *d = opendir(scratch_path(name));
    char path[288];
    assert_non_null(d);
    for (struct dirent *e; (e = readdir(d));) {
        if (e->d_name[0] == '.')
            continue;
        snprintf(path, sizeof(path), "%.30s/%.250s", name, e->d_name);
        if (e->d_type == DT_DIR)
            remove_folder(path);
        else
            unlink(scratch_path(path));
    }
    closedir(d);
    assert_int_equal(rmdir(scratch_path(name)), 0); // nothing hidden was left behind
}

// ---- GLB, taken apart -----------------------------------------------------------------------------------------------------

struct glb {
    char *file;
    size_t n_file;
    struct json *doc;
    const uint8_t *bin;
    size_t n_bin;
};

static uint32_t u32(const uint8_t *p)
{
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static int64_t get_int(const struct json *doc, const char *format, int i)
{
    char path[128];
    int64_t value;
    snprintf(path, sizeof(path), format, i);
    if (json_get_int(doc, path, &value))
        fail_msg("%s is not there", path);
    return value;
}

static void open_glb(struct glb *g, const char *name)
{
    assert_int_equal(file_read(&g->file, &g->n_file, scratch_path(name), 1 << 28), 0);
    const uint8_t *b = (const uint8_t *)g->file;
    assert_true(g->n_file > 28 && !memcmp(b, "glTF", 4));
    assert_int_equal(u32(b + 4), 2);
    assert_int_equal(u32(b + 8), g->n_file);
    const size_t n_json = u32(b + 12);
    assert_int_equal(n_json % 4, 0);
    assert_memory_equal(b + 16, "JSON", 4);
    assert_true(20 + n_json + 8 <= g->n_file);
    assert_int_equal(json_parse(&g->doc, g->file + 20, n_json, "GLB"), 0);
    g->n_bin = u32(b + 20 + n_json);
    assert_int_equal(g->n_bin % 4, 0);
    assert_memory_equal(b + 24 + n_json, "BIN\0", 4);
    assert_int_equal(28 + n_json + g->n_bin, g->n_file);
    g->bin = b + 28 + n_json;
}

static void close_glb(struct glb *g)
{
    json_free(g->doc);
    free(g->file);
}

// The values of an accessor, checked against its view.
static const void *accessor(const struct glb *g, int which, int64_t component_type, const char *type, int64_t bytes_each, int64_t *count)
{
    char path[64];
    const char *found;
    const int view = (int)get_int(g->doc, "accessors.%d.bufferView", which);
    assert_int_equal(get_int(g->doc, "accessors.%d.componentType", which), component_type);
    snprintf(path, sizeof(path), "accessors.%d.type", which);
    assert_int_equal(json_get_string(g->doc, path, &found), 0);
    assert_string_equal(found, type);
    *count = get_int(g->doc, "accessors.%d.count", which);
    assert_int_equal(get_int(g->doc, "bufferViews.%d.byteLength", view), *count * bytes_each);
    return g->bin + get_int(g->doc, "bufferViews.%d.byteOffset", view);
}

static void texture(struct image *out, const struct glb *g, const char *index_path)
{
    int64_t index;
    if (json_get_int(g->doc, index_path, &index))
        fail_msg("%s is not there", index_path);
    const int image = (int)get_int(g->doc, "textures.%d.source", (int)index), view = (int)get_int(g->doc, "images.%d.bufferView", image);
    const struct image_file file = { g->bin + get_int(g->doc, "bufferViews.%d.byteOffset", view),
                                     (size_t)get_int(g->doc, "bufferViews.%d.byteLength", view), "texture" };
    assert_int_equal(image_read_memory(out, &file), 0);
    assert_int_equal(out->width, SIZE);
    assert_int_equal(out->height, SIZE);
    assert_int_equal(out->n_channels, 3);
}

#define MATERIAL "materials.0."
#define SPECULAR MATERIAL "extensions.KHR_materials_specular."

static void a_glb_keeps_the_rules_of_its_specification(void **unused)
{
    (void)unused;
    const struct export_source source = source_of();
    struct glb g;
    int64_t n, n_vertices;
    double bounds[2][3];
    export_to("rules", &source, EXPORT_GLB);
    open_glb(&g, "rules/model.glb");
    assert_int_equal(get_int(g.doc, "buffers.0.byteLength", 0), g.n_bin);
    const int n_views = json_length(g.doc, "bufferViews");
    int64_t end = 0;
    for (int i = 0; i < n_views; i++) { // in order, aligned, without overlap, inside
        const int64_t offset = get_int(g.doc, "bufferViews.%d.byteOffset", i);
        assert_int_equal(offset % 4, 0);
        assert_true(offset >= end);
        end = offset + get_int(g.doc, "bufferViews.%d.byteLength", i);
        assert_true(end <= (int64_t)g.n_bin);
    }
    const uint32_t *index = accessor(&g, (int)get_int(g.doc, "meshes.0.primitives.0.indices", 0), 5125, "SCALAR", 4, &n);
    assert_int_equal(n, 3 * studio.mesh.n_triangles);
    const float *p = accessor(&g, (int)get_int(g.doc, "meshes.0.primitives.0.attributes.POSITION", 0), 5126, "VEC3", 12, &n_vertices);
    assert_int_equal(n_vertices, studio.mesh.n_vertices);
    for (int64_t i = 0; i < n; i++)
        assert_true(index[i] < n_vertices);
    assert_int_equal(json_get_numbers(g.doc, "accessors.1.min", bounds[0], 3), 0);
    assert_int_equal(json_get_numbers(g.doc, "accessors.1.max", bounds[1], 3), 0);
    for (int c = 0; c < 3; c++) {
        float least = INFINITY, most = -INFINITY;
        for (int64_t i = 0; i < n_vertices; i++)
            least = fminf(least, p[3 * i + c]), most = fmaxf(most, p[3 * i + c]);
        assert_true(bounds[0][c] == (double)least && bounds[1][c] == (double)most);
    }
    const float *normal = accessor(&g, (int)get_int(g.doc, "meshes.0.primitives.0.attributes.NORMAL", 0), 5126, "VEC3", 12, &n);
    assert_int_equal(n, n_vertices);
    const float *tangent = accessor(&g, (int)get_int(g.doc, "meshes.0.primitives.0.attributes.TANGENT", 0), 5126, "VEC4", 16, &n);
    assert_int_equal(n, n_vertices);
    for (int64_t i = 0; i < n_vertices; i++) {
        const float *a = normal + 3 * i, *t = tangent + 4 * i;
        assert_true(fabsf(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - 1) < 1e-5f);
        assert_true(fabsf(t[0] * t[0] + t[1] * t[1] + t[2] * t[2] - 1) < 1e-5f);
        assert_true(fabsf(a[0] * t[0] + a[1] * t[1] + a[2] * t[2]) < 1e-5f);
        assert_true(t[3] == 1);
    }
    // Every extension that is used is declared, and no other.
    int n_found = 0;
    for (int i = 0; i < json_length(g.doc, "extensionsUsed"); i++) {
        char path[64];
        const char *name;
        snprintf(path, sizeof(path), "extensionsUsed.%d", i);
        assert_int_equal(json_get_string(g.doc, path, &name), 0);
        snprintf(path, sizeof(path), MATERIAL "extensions.%s", name);
        assert_non_null(json_get(g.doc, path));
        n_found++;
    }
    assert_int_equal(n_found, 4); // specular, clearcoat, sheen, anisotropy
    const int n_textures = json_length(g.doc, "textures");
    assert_int_equal(n_textures, json_length(g.doc, "images"));
    for (int i = 0; i < n_textures; i++) {
        const int view = (int)get_int(g.doc, "images.%d.bufferView", i);
        assert_memory_equal(g.bin + get_int(g.doc, "bufferViews.%d.byteOffset", view), "\x89PNG", 4);
    }
    close_glb(&g);
    remove_folder("rules");
}

// The importer goes another way (assimp): what it reads must be the surface that was written, v from the top included.
static void a_glb_comes_back_as_the_same_surface(void **unused)
{
    (void)unused;
    const struct export_source source = source_of();
    struct mesh back;
    export_to("back", &source, EXPORT_GLB);
    assert_int_equal(mesh_read(&back, NULL, scratch_path("back/model.glb")), 0);
    assert_int_equal(back.n_triangles, studio.mesh.n_triangles);
    for (int i = 0; i < back.n_triangles; i++)
        for (int k = 0; k < 3; k++) {
            const uint32_t a = back.triangle[i][k], b = studio.mesh.triangle[i][k];
            for (int c = 0; c < 3; c++) {
                assert_true(fabsf(back.position_m[a][c] - studio.mesh.position_m[b][c]) < 1e-6f);
                assert_true(fabsf(back.normal[a][c] - studio.mesh.normal[b][c]) < 1e-5f);
            }
            for (int c = 0; c < 2; c++)
                assert_true(fabsf(back.uv[a][c] - studio.mesh.uv[b][c]) < 1e-6f);
        }
    mesh_free(&back);
    remove_folder("back");
}

// A world whose up is an axis other than +Y stands upright in glTF's: that axis becomes +Y, nothing is mirrored.
static void the_model_stands_upright(void **unused)
{
    (void)unused;
    for (int axis = 0; axis < 3; axis++)
        for (int sign = -1; sign <= 1; sign += 2) {
            struct export_source source = source_of();
            struct lights lights;
            struct mesh back;
            assert_int_equal(lights_new(&lights, 1), 0);
            // R takes +Y near to the axis, 5 degrees off.
            double *r = lights.world_from_probe;
            memset(r, 0, 9 * sizeof(*r));
            const int next = (axis + 1) % 3, last = (axis + 2) % 3;
            const double c = cos(.09) * sign, s = sin(.09) * sign;
            r[3 * axis + 1] = c, r[3 * next + 1] = s;        // column of +Y
            r[3 * axis + 2] = -s * sign, r[3 * next + 2] = c * sign; // +Z
            r[3 * last] = 1;                                 // +X, one way or the other: only +Y is looked at
            source.lights = &lights;
            export_to("up", &source, EXPORT_GLB);
            assert_int_equal(mesh_read(&back, NULL, scratch_path("up/model.glb")), 0);
            double volume = 0;
            for (int i = 0; i < back.n_triangles; i++) {
                const float *p[3];
                for (int k = 0; k < 3; k++) {
                    p[k] = back.position_m[back.triangle[i][k]];
                    const float *from = studio.mesh.position_m[studio.mesh.triangle[i][k]];
                    assert_true(fabsf(p[k][1] - (float)sign * from[axis]) < 1e-6f);
                }
                volume += (double)(p[0][0] * (p[1][1] * p[2][2] - p[1][2] * p[2][1]) + p[0][1] * (p[1][2] * p[2][0] - p[1][0] * p[2][2]) +
                                   p[0][2] * (p[1][0] * p[2][1] - p[1][1] * p[2][0]));
            }
            assert_true(volume > 0);
            mesh_free(&back);
            lights_free(&lights);
            remove_folder("up");
        }
}

static float linear_of(float byte)
{
    return byte <= .04045f ? byte / 12.92f : powf((byte + .055f) / 1.055f, 2.4f);
}

// A metal's colour is its albedo and its alpha Disney's: textures must carry both, in the curve and the channels that glTF says.
static void textures_hold_what_gltf_expects_of_them(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    struct image metal, base, rough;
    struct glb g;
    assert_int_equal(image_new(&metal, SIZE, SIZE, DISNEY_N, disney_parameter_names), 0);
    for (int i = 0; i < SIZE * SIZE; i++) {
        metal.data[DISNEY_N * i + DISNEY_METALLIC] = 1;
        metal.data[DISNEY_N * i + DISNEY_ROUGHNESS] = studio.parameters.data[DISNEY_N * i + DISNEY_ROUGHNESS];
    }
    source.parameters = &metal;
    const struct export_summary summary = export_to("metal", &source, EXPORT_GLB);
    assert_true(summary.rmse_percent < 1e-6);
    open_glb(&g, "metal/model.glb");
    texture(&base, &g, MATERIAL "pbrMetallicRoughness.baseColorTexture.index");
    texture(&rough, &g, MATERIAL "pbrMetallicRoughness.metallicRoughnessTexture.index");
    assert_null(json_get(g.doc, MATERIAL "extensions.KHR_materials_clearcoat"));
    assert_null(json_get(g.doc, MATERIAL "extensions.KHR_materials_sheen"));
    assert_null(json_get(g.doc, MATERIAL "extensions.KHR_materials_anisotropy"));
    assert_null(json_get(g.doc, "meshes.0.primitives.0.attributes.TANGENT"));
    for (int i = 0; i < studio.texels.n; i++) {
        const uint32_t pixel = studio.texels.pixel[i];
        for (int c = 0; c < 3; c++)
            assert_true(fabsf(linear_of(base.data[3 * pixel + (uint32_t)c]) - studio.albedo.data[3 * pixel + (uint32_t)c]) < .006f);
        assert_true(fabsf(rough.data[3 * pixel + 1] - metal.data[DISNEY_N * pixel + DISNEY_ROUGHNESS]) < .5f / 255 + 1e-6f);
        assert_true(rough.data[3 * pixel + 2] == 1);
    }
    image_free(&base), image_free(&rough), image_free(&metal);
    close_glb(&g);
    remove_folder("metal");
}

static void what_is_constant_becomes_a_factor(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    struct image one, grey;
    struct glb g;
    double value, colour[3];
    assert_int_equal(image_new(&one, SIZE, SIZE, DISNEY_N, disney_parameter_names), 0);
    assert_int_equal(image_new(&grey, SIZE, SIZE, 3, NULL), 0);
    for (int i = 0; i < SIZE * SIZE; i++) {
        one.data[DISNEY_N * i + DISNEY_SPECULAR] = .75f, one.data[DISNEY_N * i + DISNEY_ROUGHNESS] = .4f;
        grey.data[3 * i] = grey.data[3 * i + 1] = grey.data[3 * i + 2] = .5f;
    }
    source.parameters = &one, source.albedo = &grey;
    export_to("constant", &source, EXPORT_GLB | EXPORT_OBJ);
    open_glb(&g, "constant/model.glb");
    assert_null(json_get(g.doc, "textures"));
    assert_int_equal(json_get_number(g.doc, MATERIAL "pbrMetallicRoughness.roughnessFactor", &value), 0);
    assert_true(fabs(value - .4) < 1e-6);
    assert_int_equal(json_get_number(g.doc, MATERIAL "pbrMetallicRoughness.metallicFactor", &value), 0);
    assert_true(value == 0);
    assert_int_equal(json_get_numbers(g.doc, SPECULAR "specularColorFactor", colour, 3), 0);
    for (int c = 0; c < 3; c++)
        assert_true(fabs(colour[c] - 1.5) < 1e-6); // .04 x 1.5 = .08 x .75
    close_glb(&g);
    remove_folder("constant");
    image_free(&one), image_free(&grey);
}

// Values above 1 do not fit a texture: the factor carries the scale.
static void a_strong_specular_colour_is_scaled_by_its_factor(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    struct image strong, colour;
    struct glb g;
    double factor[3];
    assert_int_equal(image_new(&strong, SIZE, SIZE, DISNEY_N, disney_parameter_names), 0);
    for (int i = 0; i < SIZE * SIZE; i++) {
        strong.data[DISNEY_N * i + DISNEY_SPECULAR] = .25f + .75f * (float)(i % SIZE) / SIZE;
        strong.data[DISNEY_N * i + DISNEY_ROUGHNESS] = .5f;
    }
    source.parameters = &strong;
    export_to("strong", &source, EXPORT_GLB);
    open_glb(&g, "strong/model.glb");
    assert_int_equal(json_get_numbers(g.doc, SPECULAR "specularColorFactor", factor, 3), 0);
    texture(&colour, &g, SPECULAR "specularColorTexture.index");
    for (int i = 0; i < studio.texels.n; i++) {
        const uint32_t pixel = studio.texels.pixel[i];
        const double want = 2 * (double)strong.data[DISNEY_N * pixel + DISNEY_SPECULAR];
        assert_true(fabs(factor[0] * (double)linear_of(colour.data[3 * pixel]) - want) < .02);
    }
    image_free(&strong), image_free(&colour);
    close_glb(&g);
    remove_folder("strong");
}

static void a_lambertian_solve_has_no_specular_lobe(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    struct glb g;
    double value;
    source.parameters = NULL;
    const struct export_summary summary = export_to("lambert", &source, EXPORT_ALL);
    assert_true(summary.rmse_percent == 0);
    open_glb(&g, "lambert/model.glb");
    assert_int_equal(json_get_number(g.doc, SPECULAR "specularFactor", &value), 0);
    assert_true(value == 0);
    assert_null(json_get(g.doc, SPECULAR "specularColorTexture"));
    close_glb(&g);
    remove_folder("lambert");
}

// ---- the other formats ----------------------------------------------------------------------------------------------------

static char *text_of(const char *name)
{
    char *text;
    size_t n;
    assert_int_equal(file_read(&text, &n, scratch_path(name), 1 << 24), 0);
    return text;
}

static void layers_leave_as_they_are(void **unused)
{
    (void)unused;
    const struct export_source source = source_of();
    struct image layer, albedo;
    export_to("layers", &source, EXPORT_MTLX);
    assert_int_equal(image_read(&layer, scratch_path("layers/maps/roughness.exr")), 0);
    assert_int_equal(image_read(&albedo, scratch_path("layers/albedo.exr")), 0);
    assert_int_equal(layer.n_channels, 1);
    for (int i = 0; i < SIZE * SIZE; i++)
        assert_true(layer.data[i] == studio.parameters.data[DISNEY_N * i + DISNEY_ROUGHNESS]);
    assert_memory_equal(albedo.data, studio.albedo.data, 3 * SIZE * SIZE * sizeof(float));
    assert_int_equal(access(scratch_path("layers/maps/metallic.exr"), F_OK), -1); // constant
    image_free(&layer), image_free(&albedo);
    remove_folder("layers");
}

static const struct xml_element *child_named(const struct xml_element *e, const char *element, const char *name)
{
    const struct xml_element *c = xml_child(e, element);
    while (c && strcmp(xml_attribute(c, "name"), name))
        c = xml_next(c, element);
    return c;
}

// Every input of disney_principled once, by its own name: a value where the map is constant, else an image whose file is there.
static void materialx_takes_the_layers_one_to_one(void **unused)
{
    (void)unused;
    const struct export_source source = source_of();
    struct xml_element *root;
    int n_inputs = 0;
    export_to("mtlx", &source, EXPORT_MTLX);
    char *text = text_of("mtlx/model.mtlx");
    assert_int_equal(xml_parse(&root, text, strlen(text), "model.mtlx"), 0);
    free(text);
    assert_string_equal(root->name, "materialx");
    assert_string_equal(xml_attribute(root, "version"), "1.38");
    const struct xml_element *shader = xml_child(root, "disney_principled");
    assert_non_null(shader);
    assert_string_equal(xml_attribute(shader, "type"), "surfaceshader");
    for (const struct xml_element *e = xml_child(shader, "input"); e; e = xml_next(e, "input"), n_inputs++) {
        const char *name = xml_attribute(e, "name"), *node = xml_attribute(e, "nodename"), *value = xml_attribute(e, "value");
        const bool colour = !strcmp(name, "baseColor"), varied = colour || !strcmp(name, "roughness");
        char path[128];
        assert_string_equal(xml_attribute(e, "type"), colour ? "color3" : "float");
        if (!varied) {
            int p = 0;
            while (strcmp(disney_parameter_names[p], name))
                assert_in_range(++p, 0, DISNEY_N - 1);
            assert_null(node);
            assert_true(strtof(value, NULL) == studio.parameters.data[p]);
            continue;
        }
        assert_null(value);
        const struct xml_element *image = child_named(root, "image", node);
        assert_non_null(image);
        assert_string_equal(xml_attribute(image, "type"), xml_attribute(e, "type"));
        snprintf(path, sizeof(path), "mtlx/%s", xml_attribute(child_named(image, "input", "file"), "value"));
        assert_int_equal(access(scratch_path(path), F_OK), 0);
    }
    assert_int_equal(n_inputs, 1 + DISNEY_N);
    const struct xml_element *material = xml_child(root, "surfacematerial");
    assert_string_equal(xml_attribute(child_named(material, "input", "surfaceshader"), "nodename"), xml_attribute(shader, "name"));
    xml_free(root);
    remove_folder("mtlx");
}

static void in_the_solves_own_folder_its_files_stay(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    source.in_place = true;
    assert_int_equal(make_directories(scratch_path("own")), 0);
    scratch_write("own/albedo.exr", "mine", 4);
    export_to("own", &source, EXPORT_ALL);
    char *text = text_of("own/albedo.exr");
    assert_string_equal(text, "mine");
    free(text);
    remove_folder("own");
}

static void an_obj_comes_back_and_its_material_names_files_that_are_there(void **unused)
{
    (void)unused;
    const struct export_source source = source_of();
    struct mesh back;
    int n_maps = 0;
    export_to("obj", &source, EXPORT_OBJ);
    assert_int_equal(mesh_read(&back, NULL, scratch_path("obj/model.obj")), 0);
    assert_int_equal(back.n_triangles, studio.mesh.n_triangles);
    for (int i = 0; i < back.n_triangles; i++)
        for (int k = 0; k < 3; k++)
            assert_memory_equal(back.position_m[back.triangle[i][k]], studio.mesh.position_m[studio.mesh.triangle[i][k]], 3 * sizeof(float));
    mesh_free(&back);
    char *obj = text_of("obj/model.obj"), *mtl = text_of("obj/model.mtl"), *save = NULL;
    assert_non_null(strstr(obj, "mtllib model.mtl\n"));
    assert_non_null(strstr(obj, "usemtl studiorig\n"));
    assert_non_null(strstr(mtl, "newmtl studiorig\n"));
    assert_non_null(strstr(mtl, "\nPm 0.25"));
    assert_non_null(strstr(mtl, "\nmap_Pr "));
    for (char *line = strtok_r(mtl, "\n", &save); line; line = strtok_r(NULL, "\n", &save)) {
        char path[128];
        if (strncmp(line, "map_", 4))
            continue;
        snprintf(path, sizeof(path), "obj/%s", strchr(line, ' ') + 1);
        assert_int_equal(access(scratch_path(path), F_OK), 0);
        n_maps++;
    }
    assert_true(n_maps >= 2);
    free(obj);
    free(mtl);
    remove_folder("obj");
}

static void the_report_lists_every_file_and_what_was_lost(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    struct lights lights;
    struct json *doc;
    double rmse, by_name;
    assert_int_equal(lights_new(&lights, 2), 0);
    lights.dir_probe[0][1] = lights.dir_probe[1][2] = 1;
    source.lights = &lights;
    const struct export_summary summary = export_to("report", &source, EXPORT_ALL);
    assert_int_equal(json_read(&doc, scratch_path("report/export.json")), 0);
    int64_t bytes = 0;
    for (int i = 0; i < json_length(doc, "files"); i++) {
        struct stat s;
        char key[32], path[256];
        const char *name;
        snprintf(key, sizeof(key), "files.%d", i);
        assert_int_equal(json_get_string(doc, key, &name), 0);
        snprintf(path, sizeof(path), "report/%s", name);
        assert_int_equal(stat(scratch_path(path), &s), 0);
        bytes += s.st_size;
    }
    assert_int_equal(bytes, summary.bytes);
    assert_int_equal(json_get_number(doc, "refit.rmse_percent", &rmse), 0);
    assert_int_equal(json_get_number(doc, "refit.rmse_by_name_percent", &by_name), 0);
    assert_true(rmse > 0 && rmse < by_name && rmse == summary.rmse_percent);
    assert_true(summary.worst_percent >= summary.rmse_percent);
    json_free(doc);
    lights_free(&lights);
    remove_folder("report");
}

static void threads_do_not_change_a_byte(void **unused)
{
    (void)unused;
    struct export_source source = source_of();
    char *a, *b;
    size_t n_a, n_b;
    source.n_threads = 1;
    export_to("one", &source, EXPORT_GLB);
    source.n_threads = 3;
    export_to("three", &source, EXPORT_GLB);
    assert_int_equal(file_read(&a, &n_a, scratch_path("one/model.glb"), 1 << 28), 0);
    assert_int_equal(file_read(&b, &n_b, scratch_path("three/model.glb"), 1 << 28), 0);
    assert_int_equal(n_a, n_b);
    assert_memory_equal(a, b, n_a);
    free(a);
    free(b);
    remove_folder("one");
    remove_folder("three");
}

static void maps_that_do_not_belong_together_are_refused(void **unused)
{
    static const char *const wrong[] = { "metallic", "roughness" };
    (void)unused;
    struct export_source source = source_of();
    struct export_summary summary;
    struct image other, oblong;
    assert_int_equal(image_new(&other, SIZE / 2, SIZE / 2, DISNEY_N, disney_parameter_names), 0);
    source.parameters = &other;
    assert_int_equal(export_write(&summary, &source, EXPORT_ALL, scratch_path("refused")), -EINVAL);
    image_free(&other);
    assert_int_equal(image_new(&other, SIZE, SIZE, 2, wrong), 0);
    assert_int_equal(export_write(&summary, &source, EXPORT_ALL, scratch_path("refused")), -EINVAL);
    image_free(&other);
    assert_int_equal(image_new(&oblong, SIZE, SIZE / 2, 3, NULL), 0);
    source.parameters = NULL, source.albedo = &oblong;
    assert_int_equal(export_write(&summary, &source, EXPORT_ALL, scratch_path("refused")), -EINVAL);
    image_free(&oblong);
    assert_int_equal(access(scratch_path("refused"), F_OK), -1);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_glb_keeps_the_rules_of_its_specification),
        cmocka_unit_test(a_glb_comes_back_as_the_same_surface),
        cmocka_unit_test(the_model_stands_upright),
        cmocka_unit_test(textures_hold_what_gltf_expects_of_them),
        cmocka_unit_test(what_is_constant_becomes_a_factor),
        cmocka_unit_test(a_strong_specular_colour_is_scaled_by_its_factor),
        cmocka_unit_test(a_lambertian_solve_has_no_specular_lobe),
        cmocka_unit_test(layers_leave_as_they_are),
        cmocka_unit_test(materialx_takes_the_layers_one_to_one),
        cmocka_unit_test(in_the_solves_own_folder_its_files_stay),
        cmocka_unit_test(an_obj_comes_back_and_its_material_names_files_that_are_there),
        cmocka_unit_test(the_report_lists_every_file_and_what_was_lost),
        cmocka_unit_test(threads_do_not_change_a_byte),
        cmocka_unit_test(maps_that_do_not_belong_together_are_refused),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
