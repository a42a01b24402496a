// solver/export.h - a solved material in the files that other programs read.
//
//   EXPORT_GLB      model.glb: metallic-roughness with KHR_materials_specular, _clearcoat, _sheen, _anisotropy as needed; re-fitted
//                   (gltf_brdf.h), 8-bit PNGs inside, the mesh upright (the axis nearest to the probe's +Y becomes glTF's +Y)
//   EXPORT_MTLX     model.mtlx: MaterialX 1.38 disney_principled; the parameters as they are, albedo.exr and maps/<name>.exr
//   EXPORT_OBJ      model.obj, model.mtl, model_*.png: the PBR keys of MTL; re-fitted as GLB is
//   EXPORT_BLENDER  model.obj, albedo.exr, maps/, lights.json for config/blender/import_studiorig.py, which reads export.json
//
// and export.json beside them: {formats, files[], material: {albedo, <parameter>: number or file}, refit: {rmse_percent, ...}, notes[]}.
// A map whose covered texels all agree is written as its number. Every file is whole or not there.
#pragma once
#include "solver/disney.h"
#include "solver/lights.h"
#include "solver/mesh.h"
#include "solver/take/image.h"
#include <stdbool.h>
#include <stdint.h>

enum { EXPORT_GLB = 1, EXPORT_MTLX = 2, EXPORT_OBJ = 4, EXPORT_BLENDER = 8, EXPORT_ALL = 15 };

struct export_source {
    const struct mesh *mesh;
    const struct image *albedo;     // R, G, B; square
    const struct image *parameters; // the ten of disney.h by name, of albedo's size; NULL: Lambertian
    enum disney_variant variant;
    const struct lights *lights; // NULL: none
    bool in_place;               // dir is the solve's own folder: its albedo.exr and lights.json stay as they are
    int n_threads;
};

struct export_summary {
    unsigned formats;
    int n_texels;                                  // covered
    double rmse_percent, rmse_by_name_percent;     // of the fit to glTF's reflectance, and of the mapping by name; 0: Lambertian
    double worst_percent;                          // of a texel
    int64_t bytes;                                 // of all files
};

// dir is made if need be. 0; logged: -EINVAL (a texture that is not square or lacks a channel, sizes that differ), -errno; -ENOMEM.
int export_write(struct export_summary *out, const struct export_source *source, unsigned formats, const char *dir);
