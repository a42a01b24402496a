// solver/render.h - pictures of a known object under known lights: Eq. 5 per pixel, with shadows
// and one bounce on request.
#pragma once
#include "solver/cameras.h"
#include "solver/kernels/kernels.h"
#include "solver/mesh.h"
#include "solver/rays.h"
#include "solver/take/image.h"

// A material: textures over the mesh's atlas, or constants where a texture is NULL.
struct render_material {
    enum reflectance model;
    enum disney_variant variant;
    const struct image *albedo;     // R, G, B
    const struct image *parameters; // ten channels named as disney_parameter_names
    float constant_albedo[3];
    float constant_theta[DISNEY_N];
    bool nearest; // textures with sharp borders: nearest texel instead of bilinear
};

struct render_settings {
    int samples;             // per pixel side: samples^2 rays on a regular grid (box filter)
    bool shade_every_sample; // false: where all samples lie on one smooth piece of one material,
                             // the pixel is shaded once, at its centre, with the samples' mean
                             // albedo (an error of second order in the pixel's size)
    bool shadows;
    int shadow_rays; // 0: one ray per light; else lights are put in <= 256 groups of neighbours,
                     // this many rays per group are spent on lights drawn by their energy, and the
                     // share that arrives scales the group (seed decides)
    int bounce_rays; // 0: no indirect light; else diffuse interreflection gathered with this many
                     // rays per sample
    int bounce_texture; // size of the radiosity texture (e.g. 256)
    uint64_t seed;
    int n_threads;
    bool count_rows; // each row of a picture that is done is a progress_add(1)
};

struct renderer;
// Keeps pointers to mesh, rays and material's textures until renderer_free(). Precomputes the
// radiosity texture when bouncing. 0, -ENOMEM, -EINVAL (a texture without the channels it must
// have: logged).
int renderer_new(struct renderer **out, const struct mesh *mesh, const struct rays *rays,
                 const struct lights *lights, const struct render_material *material,
                 const struct render_settings *settings);
// R, G, B, A (A: share of the pixel covered by the object). Same seed, same bytes, any thread
// count. 0 or -ENOMEM.
int render_view(const struct renderer *r, const struct camera *camera, struct image *out);
void renderer_free(struct renderer *r);
