// solver/export_format.h - private to export*.c: what the writers of one format share.
#pragma once
#include "solver/export.h"
#include "solver/take/json.h"

// A texture as glTF stores it: three bytes a texel, or one value where all covered texels have the same bytes.
enum { PICTURE_BASE, PICTURE_METALLIC_ROUGHNESS, PICTURE_SPECULAR, PICTURE_COAT, PICTURE_SHEEN, PICTURE_ANISOTROPY, PICTURE_N };
struct export_picture {
    uint8_t (*pixels)[3]; // [size * size], top row first: base, specular, sheen sRGB-encoded; metallic-roughness (0, roughness,
                          // metallic), coat (factor, roughness, 0), anisotropy (direction 255, 128; strength) linear
    bool constant, channel_constant[3]; // all three; each
    double value[3]; // the constant, linear, not rounded; specular: multiply by nothing
    uint8_t most[3]; // the largest bytes
};

// A Disney parameter as it is.
struct export_map {
    bool constant;
    float value;
};

struct export_job {
    const struct export_source *source;
    const char *dir;
    int size, n_texels;
    struct export_picture picture[PICTURE_N];
    double specular_scale;  // specular_color = scale * picture
    double specular_factor; // 0: Lambertian, 1
    double sheen_roughness;
    struct export_map map[DISNEY_N];
    struct json *files; // names below dir, as written
    struct export_summary summary;
};

// dir/name, malloc'd; NULL without memory.
char *export_path(const struct export_job *job, const char *name);
// Note a file that was written.
int export_wrote(struct export_job *job, const char *name);

int export_glb(struct export_job *job);
int export_materialx(struct export_job *job);
int export_obj(struct export_job *job, bool with_material); // false: the mesh alone
