// solver/commands/synth.c - rigsolve synth: a synthetic studio on disk, with its known answer.
#include "solver/commands/arguments.h"
#include "solver/commands/commands.h"
#include "solver/commands/output.h"
#include "solver/disney.h"
#include "solver/synth.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <argp.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <string.h>

enum {
    KEY_SEED = 256,
    KEY_LIGHTS,
    KEY_NOISE,
    KEY_SIZE,
    KEY_VIEWS,
    KEY_DIRECTIONAL,
    KEY_UNIFORM,
    KEY_MISSING,
    KEY_SHAPE,
    KEY_TEXTURE,
    KEY_SAMPLES,
    KEY_PANORAMA,
    KEY_FLOAT,
    KEY_MESH,
    KEY_FLIP_V,
    KEY_COLOUR,
    KEY_MATERIAL,
    KEY_THETA,
    KEY_LIGHT_FROM,
    KEY_RELIGHT_FROM,
    KEY_THREADS,
    KEY_JSON
};

static const struct argp_option options[] = {
    {"output", 'o', "DIR", 0, "The folder to make (new or empty)", 0},
    {"seed", KEY_SEED, "N", 0, "Jitter of the lights, rotation, lenses, noise (1)", 0},
    {"true-lights", KEY_LIGHTS, "N", 0, "Point lights on the cuboid, 16 to 65536 (65536)", 0},
    {"noise", KEY_NOISE, "S", 0, "Standard deviation of Gaussian noise, white = 1 (0)", 0},
    {"size", KEY_SIZE, "WxH", 0, "Pixels of a view (360x240)", 0},
    {"views", KEY_VIEWS, "N", 0, "How many views, on five rings (85)", 0},
    {"samples", KEY_SAMPLES, "N", 0, "Rays per pixel and side (2)", 0},
    {"texture", KEY_TEXTURE, "N", 0,
     "Side of the true textures (D1, D2: 64; D3, D4: 512; D5: 2048)", 0},
    {"panorama-width", KEY_PANORAMA, "N", 0, "Pixels (2048)", 0},
    {"shape", KEY_SHAPE, "NAME", 0, "pebble, vase, knot or bowl instead of the data set's own", 0},
    {"directional", KEY_DIRECTIONAL, 0, 0, "Render with all lights at infinity", 0},
    {"uniform", KEY_UNIFORM, 0, 0, "All walls equally bright, no panels", 0},
    {"missing-panel", KEY_MISSING, 0, 0, "Leave one panel out of the panorama (it still shines)",
     0},
    {"float", KEY_FLOAT, 0, 0, "Views as 32-bit floats instead of half", 0},
    {0, 0, 0, 0, "Own objects and rooms", 1},
    {"mesh", KEY_MESH, "FILE", 0, "own: OBJ, PLY, glTF or GLB with UVs; scaled to a radius of .3 m", 1},
    {"flip-v", KEY_FLIP_V, 0, 0, "own: the mesh's v runs the other way than its format says", 1},
    {"colour", KEY_COLOUR, "FILE", 0, "own: base colour (JPEG and PNG in sRGB, EXR and TIFF linear); default: grey", 1},
    {"material", KEY_MATERIAL, "FILE", 0, "own: green is roughness, blue metallic, as in glTF", 1},
    {"theta", KEY_THETA, "NAME=V,...", 0, "own: the other parameters (specular=.5,roughness=.5)", 1},
    {"light-from", KEY_LIGHT_FROM, "FILE", 0, "A panorama that shines from the cuboid's walls, in place of panels", 1},
    {"relight-from", KEY_RELIGHT_FROM, "FILE", 0, "Another one, for relit/", 1},
    {0, 0, 0, 0, "", 2},
    {"threads", KEY_THREADS, "N", 0, "Default: all cores. The result does not depend on it", 2},
    {"json", KEY_JSON, 0, 0, "Print the report (truth/report.json) on standard output", 2},
    {0},
};

struct arguments {
    struct synth_settings settings; // data_set, texture_size: 0 until known
    const char *dir;
    bool json;
};

// name=value,...
static void parse_theta(const struct argp_state *state, char *text, float theta[DISNEY_N])
{
    for (char *save, *word = strtok_r(text, ",", &save); word; word = strtok_r(NULL, ",", &save)) {
        char *value = strchr(word, '=');
        int p = 0;
        if (value)
            *value++ = 0;
        while (p < DISNEY_N && strcmp(disney_parameter_names[p], word))
            p++;
        if (!value || p == DISNEY_N)
            argp_error(state, "--theta: '%s' is not NAME=VALUE with a Disney parameter's name (roughness, specular, ...)", word);
        theta[p] = (float)argument_number(state, "--theta", value, "a number", 0, 1);
    }
}

static error_t parse(int key, char *text, struct argp_state *state)
{
    struct arguments *a = state->input;
    struct synth_settings *s = &a->settings;
    switch (key) {
    case 'o':
        a->dir = text;
        return 0;
    case KEY_SEED:
        s->seed = (uint64_t)argument_integer(state, "--seed", text, 0, INT64_MAX);
        return 0;
    case KEY_LIGHTS:
        s->n_true_lights = (int)argument_integer(state, "--true-lights", text, 16, 65536);
        return 0;
    case KEY_NOISE:
        s->noise = argument_number(state, "--noise", text, "a number", 0, 1);
        return 0;
    case KEY_SIZE:
        argument_size(state, "--size", text, 16, 8192, &s->width_px, &s->height_px);
        return 0;
    case KEY_VIEWS:
        s->n_views = (int)argument_integer(state, "--views", text, 1, 999);
        return 0;
    case KEY_SAMPLES:
        s->samples = (int)argument_integer(state, "--samples", text, 1, 16);
        return 0;
    case KEY_TEXTURE:
        s->texture_size = (int)argument_integer(state, "--texture", text, 32, 8192);
        return 0;
    case KEY_PANORAMA:
        s->panorama_width_px = (int)argument_integer(state, "--panorama-width", text, 32, 16384);
        return 0;
    case KEY_SHAPE:
        s->shape = text;
        return 0;
    case KEY_DIRECTIONAL:
        s->directional = true;
        return 0;
    case KEY_UNIFORM:
        s->uniform_cuboid = true;
        return 0;
    case KEY_MISSING:
        s->one_panel_missing_from_panorama = true;
        return 0;
    case KEY_FLOAT:
        s->final_float = true;
        return 0;
    case KEY_MESH:
        s->mesh_path = text;
        return 0;
    case KEY_FLIP_V:
        s->flip_v = true;
        return 0;
    case KEY_COLOUR:
        s->colour_path = text;
        return 0;
    case KEY_MATERIAL:
        s->material_path = text;
        return 0;
    case KEY_THETA:
        parse_theta(state, text, s->own_theta);
        return 0;
    case KEY_LIGHT_FROM:
        s->panorama_path = text;
        return 0;
    case KEY_RELIGHT_FROM:
        s->relit_panorama_path = text;
        return 0;
    case KEY_THREADS:
        s->n_threads = (int)argument_integer(state, "--threads", text, 1, 256);
        return 0;
    case KEY_JSON:
        a->json = true;
        return 0;
    case ARGP_KEY_ARG:
        if (s->data_set || (strcmp(text, "own") && (strlen(text) != 2 || (text[0] != 'D' && text[0] != 'd') || text[1] < '1' || text[1] > '5')))
            argp_error(state, "'%s' is not one of D1, D2, D3, D4, D5, own (one of them)", text);
        s->data_set = !strcmp(text, "own") ? SYNTH_OWN : text[1] - '0';
        return 0;
    case ARGP_KEY_END:
        if (!s->data_set)
            argp_error(state, "which data set? One of D1, D2, D3, D4, D5, own");
        if (s->data_set == SYNTH_OWN ? !s->mesh_path : s->mesh_path || s->colour_path || s->material_path)
            argp_error(state, "own needs --mesh, and only own takes --mesh, --colour and --material");
        if (!a->dir)
            argp_error(state, "where to? -o DIR is needed");
        return 0;
    default:
        return ARGP_ERR_UNKNOWN;
    }
}

static const struct argp argp = {
    options,
    parse,
    "D1|D2|D3|D4|D5 -o DIR\nown --mesh FILE -o DIR",
    "Make a synthetic studio: a take (views, mesh, cameras, panorama), its known answer in truth/, "
    "and views under another "
    "light in relit/.\v"
    "Light comes from point lights on a cuboid of 3.6 x 2.4 x 1.2 m with four bright panels.\n"
    "  D1  diffuse pebble at the light probe's place\n"
    "  D2  the same, off centre\n"
    "  D3  as D2 with a Disney material and a coloured, smooth albedo\n"
    "  D4  D3's material on a knot, with shadows and one bounce\n"
    "  D5  vase of four materials with sharp borders, with shadows\n"
    "  own a mesh and textures of yours, with shadows and one bounce\n"
    "A view is clipped at 1, and says where in its channel 'clip'. truth/ is for judging only: "
    "never give it to a solver.",
    0,
    0,
    0,
};

int command_synth(int argc, char **argv)
{
    struct arguments a = {.settings = synth_defaults(0)};
    a.settings.texture_size = 0;
    argp_parse(&argp, argc, argv, 0, 0, &a);
    if (!a.settings.texture_size)
        a.settings.texture_size = synth_defaults(a.settings.data_set).texture_size;
    const int err = synth_write(&a.settings, a.dir);
    if (err == -ENOMEM)
        log_error("synth: out of memory");
    if (err)
        return EXIT_FAILED;
    if (!a.json)
        return EXIT_DONE;
    char path[PATH_MAX];
    struct json *report;
    if (snprintf(path, sizeof(path), "%s/truth/report.json", a.dir) >= (int)sizeof(path) ||
        json_read(&report, path))
        return EXIT_FAILED;
    return output_json("synth", report) ? EXIT_FAILED : EXIT_DONE;
}
