// tests/test_image.c - pictures come back as they were written, and broken ones are refused by
// name.
#include "solver/take/image.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"
#include "tests/scratch.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <openexr.h>
#include <png.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <tiffio.h>
#include <jpeglib.h>
#include <unistd.h>
#include <cmocka.h>

// ---- what was logged ------------------------------------------------------------------------

static struct {
    int n_errors;
    char last[1024];
} logged;

static void keep_line(void *arg, enum log_level level, const char *message)
{
    (void)arg;
    if (level != LOG_ERROR)
        return;
    logged.n_errors++;
    snprintf(logged.last, sizeof(logged.last), "%s", message);
}

static void listen(void)
{
    memset(&logged, 0, sizeof(logged));
}

// One error line since listen(), which has every word.
#define assert_logged(...) assert_logged_words((const char *const[]){ __VA_ARGS__, NULL }, __LINE__)
static void assert_logged_words(const char *const *words, int line)
{
    if (logged.n_errors != 1)
        fail_msg("line %d: %d error lines instead of one; the last: %s", line, logged.n_errors,
                 logged.last);
    for (; *words; words++)
        if (!strstr(logged.last, *words))
            fail_msg("line %d: no \"%s\" in: %s", line, *words, logged.last);
}

// ---- helpers --------------------------------------------------------------------------------

static uint8_t *read_all(const char *path, size_t *n)
{
    struct stat st;
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    assert_int_equal(fstat(fileno(f), &st), 0);
    *n = (size_t)st.st_size;
    uint8_t *bytes = malloc(*n + 1);
    assert_non_null(bytes);
    assert_int_equal(fread(bytes, 1, *n, f), *n);
    fclose(f);
    return bytes;
}

static void write_all(const char *path, const void *bytes, size_t n)
{
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(bytes, 1, n, f), n);
    assert_int_equal(fclose(f), 0);
}

static int read_text(struct image *out, const char *text, size_t n)
{
    uint8_t *exact = malloc(n ? n : 1); // so that the sanitizer sees a read past the end
    memcpy(exact, text, n);
    const int err = image_read_memory(out, &(struct image_file){ exact, n, "memory" });
    free(exact);
    return err;
}

static int n_files_in_folder(void)
{
    int n = 0;
    DIR *dir = opendir(scratch_dir);
    for (struct dirent *e; (e = readdir(dir));)
        n += strcmp(e->d_name, ".") && strcmp(e->d_name, "..");
    closedir(dir);
    return n;
}

static float wild_value(uint32_t i)
{
    static const float hard[] = { 0,
                                  -0.f,
                                  1,
                                  -1,
                                  65504,
                                  -65504,
                                  65519,
                                  65520,
                                  65536,
                                  1e30f,
                                  -1e30f,
                                  0x1p-14f,
                                  0x1p-24f,
                                  0x1p-25f,
                                  0x1.001p-25f,
                                  0x3p-25f,
                                  0x5p-26f,
                                  1 + 0x1p-11f,
                                  1 + 0x3p-11f,
                                  0x1.ffep-15f,
                                  0x1.fffp-15f,
                                  3e-8f,
                                  2047.5f,
                                  2048.5f,
                                  4097,
                                  1e-20f,
                                  -3e-6f,
                                  .1f };
    enum { N_HARD = sizeof(hard) / sizeof(hard[0]) };
    if (i % 3 == 0)
        return hard[i / 3 % N_HARD];
    uint32_t h = i * 2654435761u;
    h ^= h >> 15, h *= 2246822519u, h ^= h >> 13;
    return ldexpf((float)(h & 0xffffff) / 0x1p24f - .5f, (int)(h >> 24) % 40 - 24);
}

// The half nearest to x (ties to even, saturating), by arithmetic in double and not by bits.
static double nearest_half(double x)
{
    int e;
    if (x == 0)
        return x;
    frexp(x, &e); // |x| in [2^(e-1), 2^e)
    const double step = ldexp(1, (e < -13 ? -13 : e) - 11);
    const double rounded = nearbyint(x / step) * step;
    return fabs(rounded) > 65504 ? copysign(65504, x) : rounded;
}

static const char *const eleven_names[] = { "R",
                                            "G",
                                            "B",
                                            "subsurface",
                                            "metallic",
                                            "specular",
                                            "clip",
                                            "roughness",
                                            "view.left.N",
                                            "A",
                                            "depth of the scene, metres (32 bits)" };

static struct image make_image(int width, int height, int n_channels)
{
    struct image image;
    assert_int_equal(
        image_new(&image, width, height, n_channels, n_channels == 11 ? eleven_names : NULL), 0);
    for (int i = 0; i < width * height * n_channels; i++)
        image.data[i] = wild_value((uint32_t)i);
    return image;
}

static void assert_same_image(const struct image *a, const struct image *b)
{
    assert_int_equal(a->width, b->width);
    assert_int_equal(a->height, b->height);
    assert_int_equal(a->n_channels, b->n_channels);
    const size_t n = (size_t)a->width * (size_t)a->height;
    for (int c = 0; c < a->n_channels; c++) {
        const int d = image_channel(b, a->names[c]);
        assert_true(d >= 0);
        for (size_t i = 0; i < n; i++) {
            const float x = a->data[i * (size_t)a->n_channels + (size_t)c];
            const float y = b->data[i * (size_t)b->n_channels + (size_t)d];
            if (memcmp(&x, &y, sizeof(x)))
                fail_msg("channel %s, pixel %zu: %.9g is not %.9g", a->names[c], i, (double)x,
                         (double)y);
        }
    }
}

// ---- EXR ------------------------------------------------------------------------------------

static void exr_comes_back_exactly_as_float_and_to_the_nearest_as_half(void **state)
{
    (void)state;
    static const int sizes[][2] = { { 1, 1 }, { 7, 5 }, { 33, 31 }, { 131, 67 }, { 1, 40 } },
                     channels[] = { 1, 3, 4, 11 };
    for (int s = 0; s < 5; s++)
        for (int c = 0; c < 4; c++)
            for (int type = IMAGE_HALF; type <= IMAGE_FLOAT; type++)
                for (int compression = IMAGE_ZIP; compression <= IMAGE_PIZ; compression++) {
                    struct image image = make_image(sizes[s][0], sizes[s][1], channels[c]), back;
                    const char *path = scratch_path("round.exr");
                    assert_int_equal(image_write_exr(&image, path, (enum image_type)type,
                                                     (enum image_compression)compression),
                                     0);
                    assert_int_equal(image_read(&back, path), 0);
                    for (int i = 0;
                         type == IMAGE_HALF && i < image.width * image.height * image.n_channels;
                         i++)
                        image.data[i] = (float)nearest_half((double)image.data[i]);
                    assert_same_image(&image, &back);
                    image_free(&image);
                    image_free(&back);
                }
}

static void half_never_makes_infinities(void **state)
{
    (void)state;
    struct image image, back;
    assert_int_equal(image_new(&image, 2, 1, 1, NULL), 0);
    image.data[0] = INFINITY, image.data[1] = -INFINITY;
    assert_int_equal(image_write_exr(&image, scratch_path("inf.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    assert_int_equal(image_read(&back, scratch_path("inf.exr")), 0);
    assert_true(back.data[0] == 65504 && back.data[1] == -65504);
    image_free(&image);
    image_free(&back);
}

static void colours_come_first_the_others_in_file_order(void **state)
{
    (void)state;
    static const char *const expected[] = { "R",          "G",
                                            "B",          "A",
                                            "clip",       "depth of the scene, metres (32 bits)",
                                            "metallic",   "roughness",
                                            "specular",   "subsurface",
                                            "view.left.N" };
    struct image image = make_image(3, 2, 11), back;
    assert_int_equal(image_write_exr(&image, scratch_path("order.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(image_read(&back, scratch_path("order.exr")), 0);
    for (int c = 0; c < 11; c++)
        assert_string_equal(back.names[c], expected[c]);
    assert_int_equal(image_channel(&back, "roughness"), 7);
    assert_int_equal(image_channel(&back, "no such"), -1);
    image_free(&image);
    image_free(&back);
}

static void equal_pixels_give_equal_bytes(void **state)
{
    (void)state;
    struct image image = make_image(67, 45, 4);
    for (int compression = IMAGE_ZIP; compression <= IMAGE_PIZ; compression++) {
        size_t n[2];
        uint8_t *bytes[2];
        for (int i = 0; i < 2; i++) {
            const char *path = scratch_path(i ? "second name.exr" : "first.exr");
            assert_int_equal(
                image_write_exr(&image, path, IMAGE_HALF, (enum image_compression)compression), 0);
            bytes[i] = read_all(path, &n[i]);
        }
        assert_int_equal(n[0], n[1]);
        assert_memory_equal(bytes[0], bytes[1], n[0]);
        free(bytes[0]);
        free(bytes[1]);
    }
    image_free(&image);
}

static void two_channels_of_one_name_are_refused(void **state)
{
    (void)state;
    struct image image = make_image(2, 2, 3);
    strcpy(image.names[2], "R");
    listen();
    assert_int_equal(image_write_exr(&image, scratch_path("twice.exr"), IMAGE_HALF, IMAGE_ZIP),
                     -EINVAL);
    assert_logged("twice.exr", "two channels", "R");
    assert_int_not_equal(access(scratch_path("twice.exr"), F_OK), 0);
    image_free(&image);
}

static void nan_is_named_by_its_pixel(void **state)
{
    (void)state;
    struct image image = make_image(5, 4, 3);
    image.data[(2 * 5 + 3) * 3 + 1] = NAN; // row 2, column 3, G
    listen();
    assert_int_equal(image_write_exr(&image, scratch_path("nan.exr"), IMAGE_FLOAT, IMAGE_ZIP),
                     -EDOM);
    assert_logged("nan.exr", "channel G", "column 3, row 2");
    assert_int_not_equal(access(scratch_path("nan.exr"), F_OK), 0);

    image.data[(3 * 5 + 4) * 3 + 2] = -INFINITY;
    listen();
    assert_int_equal(image_require_finite(&image, NULL, "view.exr"), -EDOM);
    assert_logged("view.exr", "2 values", "channel G", "column 3, row 2");
    static const char *const red[] = { "R", NULL }, *const blue[] = { "R", "B", "none", NULL };
    assert_int_equal(image_require_finite(&image, red, "view.exr"), 0);
    listen();
    assert_int_equal(image_require_finite(&image, blue, "view.exr"), -EDOM);
    assert_logged("1 values", "channel B", "column 4, row 3");
    image_free(&image);
}

// ---- EXR files that we do not write ourselves -----------------------------------------------

struct exr_kind {
    exr_storage_t storage;
    exr_compression_t compression;
    int tile_width, tile_height;
    exr_tile_level_mode_t levels;
    exr_attr_box2i_t data, display;
    exr_lineorder_t order;
};

// What channel c holds at (x, y) of level 0; coarser levels hold -1.
static double pattern(int c, int x, int y)
{
    return c == 2 ? 3000000000.0 + x + 64 * y
                  : (c + 1) * (x + 17 * y) * .25; // exact in half, float and unsigned
}

static void write_chunk(exr_context_t context, const exr_chunk_info_t *chunk, int x0, int y0,
                        bool base)
{
    const int width = chunk->width, height = chunk->height;
    exr_encode_pipeline_t encode = EXR_ENCODE_PIPELINE_INITIALIZER;
    uint8_t *planes[3];
    assert_int_equal(exr_encoding_initialize(context, 0, chunk, &encode), 0);
    assert_int_equal(encode.channel_count, 3);
    for (int c = 0; c < 3; c++) { // "a" half, "b" float, "c" unsigned: the file's order
        const int size = 4;
        planes[c] = malloc((size_t)(width * height * size));
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++) {
                const double value = base ? pattern(c, x0 + x, y0 + y) : c == 2 ? 1 : -1;
                uint8_t *at = planes[c] + (y * width + x) * size;
                if (c == 2)
                    memcpy(at, &(uint32_t){ (uint32_t)value }, 4);
                else
                    memcpy(at, &(float){ (float)value }, 4);
            }
        encode.channels[c].user_data_type = c == 2 ? EXR_PIXEL_UINT : EXR_PIXEL_FLOAT;
        encode.channels[c].user_bytes_per_element = (int16_t)size;
        encode.channels[c].user_pixel_stride = size;
        encode.channels[c].user_line_stride = size * width;
        encode.channels[c].encode_from_ptr = planes[c];
    }
    assert_int_equal(exr_encoding_choose_default_routines(context, 0, &encode), 0);
    assert_int_equal(exr_encoding_run(context, 0, &encode), 0);
    exr_encoding_destroy(context, &encode);
    for (int c = 0; c < 3; c++)
        free(planes[c]);
}

static void write_foreign_exr(const char *path, const struct exr_kind *kind)
{
    exr_context_t context;
    exr_context_initializer_t settings = EXR_DEFAULT_CONTEXT_INITIALIZER;
    const exr_attr_v2f_t centre = { .x = 0, .y = 0 };
    exr_chunk_info_t chunk;
    int part;
    assert_int_equal(exr_start_write(&context, path, EXR_WRITE_FILE_DIRECTLY, &settings), 0);
    assert_int_equal(exr_add_part(context, NULL, kind->storage, &part), 0);
    assert_int_equal(exr_initialize_required_attr(context, part, &kind->display, &kind->data, 1,
                                                  &centre, 1, kind->order, kind->compression),
                     0);
    if (kind->storage == EXR_STORAGE_TILED)
        assert_int_equal(exr_set_tile_descriptor(context, part, (uint32_t)kind->tile_width,
                                                 (uint32_t)kind->tile_height, kind->levels,
                                                 EXR_TILE_ROUND_DOWN),
                         0);
    assert_int_equal(
        exr_add_channel(context, part, "a", EXR_PIXEL_HALF, EXR_PERCEPTUALLY_LINEAR, 1, 1), 0);
    assert_int_equal(
        exr_add_channel(context, part, "b", EXR_PIXEL_FLOAT, EXR_PERCEPTUALLY_LINEAR, 1, 1), 0);
    assert_int_equal(
        exr_add_channel(context, part, "c", EXR_PIXEL_UINT, EXR_PERCEPTUALLY_LINEAR, 1, 1), 0);
    assert_int_equal(exr_write_header(context), 0);
    if (kind->storage == EXR_STORAGE_SCANLINE) {
        int32_t step;
        assert_int_equal(exr_get_scanlines_per_chunk(context, part, &step), 0);
        for (int y = kind->data.min.y; y <= kind->data.max.y; y += step) {
            assert_int_equal(exr_write_scanline_chunk_info(context, part, y, &chunk), 0);
            write_chunk(context, &chunk, kind->data.min.x, y, true);
        }
    } else {
        int32_t levels_x, levels_y;
        assert_int_equal(exr_get_tile_levels(context, part, &levels_x, &levels_y), 0);
        for (int ly = 0; ly < levels_y; ly++)
            for (int lx = 0; lx < levels_x; lx++) {
                int32_t width, height;
                if (kind->levels == EXR_TILE_MIPMAP_LEVELS && lx != ly)
                    continue;
                assert_int_equal(exr_get_level_sizes(context, part, lx, ly, &width, &height), 0);
                for (int ty = 0; ty * kind->tile_height < height; ty++)
                    for (int tx = 0; tx * kind->tile_width < width; tx++) {
                        assert_int_equal(
                            exr_write_tile_chunk_info(context, part, tx, ty, lx, ly, &chunk), 0);
                        write_chunk(context, &chunk, kind->data.min.x + tx * kind->tile_width,
                                    kind->data.min.y + ty * kind->tile_height, lx == 0 && ly == 0);
                    }
            }
    }
    assert_int_equal(exr_finish(&context), 0);
}

static void assert_pattern(const struct image *image, const struct exr_kind *kind)
{
    assert_int_equal(image->n_channels, 3);
    assert_int_equal(image->width, kind->display.max.x - kind->display.min.x + 1);
    assert_int_equal(image->height, kind->display.max.y - kind->display.min.y + 1);
    for (int y = kind->display.min.y; y <= kind->display.max.y; y++)
        for (int x = kind->display.min.x; x <= kind->display.max.x; x++)
            for (int c = 0; c < 3; c++) {
                const bool inside = x >= kind->data.min.x && x <= kind->data.max.x &&
                                    y >= kind->data.min.y && y <= kind->data.max.y;
                const float expected = inside ? (float)pattern(c, x, y) : 0;
                const float found = image->data[((y - kind->display.min.y) * image->width + x -
                                                 kind->display.min.x) *
                                                    3 +
                                                c];
                if (found != expected)
                    fail_msg("channel %d at (%d, %d): %g is not %g", c, x, y, (double)found,
                             (double)expected);
            }
}

static exr_attr_box2i_t box(int x0, int y0, int x1, int y1)
{
    return (exr_attr_box2i_t){ .min = { .x = x0, .y = y0 }, .max = { .x = x1, .y = y1 } };
}

static void scanlines_tiles_and_mip_maps_of_half_float_and_unsigned_are_read(void **state)
{
    (void)state;
    static const exr_compression_t compressions[] = { EXR_COMPRESSION_NONE, EXR_COMPRESSION_RLE,
                                                      EXR_COMPRESSION_ZIPS, EXR_COMPRESSION_ZIP,
                                                      EXR_COMPRESSION_PIZ };
    struct image image;
    for (size_t i = 0; i < sizeof(compressions) / sizeof(compressions[0]); i++) {
        struct exr_kind kind = { .storage = EXR_STORAGE_SCANLINE,
                                 .compression = compressions[i],
                                 .data = box(0, 0, 36, 40),
                                 .display = box(0, 0, 36, 40) };
        write_foreign_exr(scratch_path("lines.exr"), &kind);
        assert_int_equal(image_read(&image, scratch_path("lines.exr")), 0);
        assert_pattern(&image, &kind);
        image_free(&image);
        kind.storage = EXR_STORAGE_TILED, kind.tile_width = 16, kind.tile_height = 8;
        for (int levels = EXR_TILE_ONE_LEVEL; levels <= EXR_TILE_MIPMAP_LEVELS; levels++) {
            kind.levels = (exr_tile_level_mode_t)levels;
            write_foreign_exr(scratch_path("tiles.exr"), &kind);
            assert_int_equal(image_read(&image, scratch_path("tiles.exr")), 0);
            assert_pattern(&image, &kind);
            image_free(&image);
        }
    }
}

static void the_data_window_is_placed_in_the_display_window(void **state)
{
    (void)state;
    const exr_attr_box2i_t displays[] = { box(0, 0, 39, 39),       box(5, 5, 9, 7),
                                          box(-10, -20, 12, 12),   box(30, 30, 60, 70),
                                          box(100, 100, 103, 102), box(-5, 0, -1, 30) };
    struct image image;
    for (int storage = EXR_STORAGE_SCANLINE; storage <= EXR_STORAGE_TILED; storage++)
        for (size_t i = 0; i < sizeof(displays) / sizeof(displays[0]); i++) {
            const struct exr_kind kind = { .storage = (exr_storage_t)storage,
                                           .compression = EXR_COMPRESSION_ZIP,
                                           .tile_width = 8,
                                           .tile_height = 16,
                                           .data = box(3, 2, 37, 38),
                                           .display = displays[i] };
            write_foreign_exr(scratch_path("window.exr"), &kind);
            assert_int_equal(image_read(&image, scratch_path("window.exr")), 0);
            assert_pattern(&image, &kind);
            image_free(&image);
        }
}

// The value of a fixed-size header attribute, to be overwritten.
static uint8_t *attribute(uint8_t *bytes, size_t n, const char *name, const char *type)
{
    const size_t n_name = strlen(name) + 1, n_type = strlen(type) + 1;
    for (size_t i = 0; i + n_name + n_type + 4 < n; i++)
        if (!memcmp(bytes + i, name, n_name) && !memcmp(bytes + i + n_name, type, n_type))
            return bytes + i + n_name + n_type + 4;
    fail_msg("no attribute %s", name);
    return NULL;
}

static void lossy_compressions_are_refused_by_name(void **state)
{
    (void)state;
    static const struct {
        uint8_t code;
        const char *name;
    } lossy[] = { { 6, "B44" }, { 7, "B44A" }, { 8, "DWAA" }, { 9, "DWAB" } };
    struct image image = make_image(9, 9, 3), back;
    size_t n;
    assert_int_equal(image_write_exr(&image, scratch_path("z.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    uint8_t *bytes = read_all(scratch_path("z.exr"), &n);
    for (int i = 0; i < 4; i++) {
        *attribute(bytes, n, "compression", "compression") = lossy[i].code;
        write_all(scratch_path("lossy.exr"), bytes, n);
        listen();
        assert_int_equal(image_read(&back, scratch_path("lossy.exr")), -ENOTSUP);
        assert_logged("lossy.exr", lossy[i].name, "re-save as ZIP");
        assert_null(back.data);
    }
    free(bytes);
    image_free(&image);
}

// Header only: the library removes a file that lacks its pixels, so it is copied before that.
static void finish_odd_exr(exr_context_t *context, const char *path, const char *copy)
{
    size_t n;
    assert_int_equal(exr_write_header(*context), 0);
    uint8_t *bytes = read_all(path, &n);
    write_all(copy, bytes, n);
    free(bytes);
    exr_finish(context);
}

static void start_odd_exr(exr_context_t *context, const char *path)
{
    exr_context_initializer_t settings = EXR_DEFAULT_CONTEXT_INITIALIZER;
    assert_int_equal(exr_start_write(context, path, EXR_WRITE_FILE_DIRECTLY, &settings), 0);
}

static void deep_multi_part_and_subsampled_are_refused_by_name(void **state)
{
    (void)state;
    struct image back;
    exr_context_t context;
    int part;
    start_odd_exr(&context, scratch_path("tmp.exr"));
    for (int i = 0; i < 2; i++) {
        assert_int_equal(exr_add_part(context, i ? "left" : "right", EXR_STORAGE_SCANLINE, &part),
                         0);
        assert_int_equal(
            exr_initialize_required_attr_simple(context, part, 4, 4, EXR_COMPRESSION_ZIP), 0);
        assert_int_equal(
            exr_add_channel(context, part, "Y", EXR_PIXEL_HALF, EXR_PERCEPTUALLY_LINEAR, 1, 1), 0);
    }
    finish_odd_exr(&context, scratch_path("tmp.exr"), scratch_path("parts.exr"));
    listen();
    assert_int_equal(image_read(&back, scratch_path("parts.exr")), -ENOTSUP);
    assert_logged("parts.exr", "2 parts");

    start_odd_exr(&context, scratch_path("tmp.exr"));
    assert_int_equal(exr_add_part(context, "deep", EXR_STORAGE_DEEP_SCANLINE, &part), 0);
    assert_int_equal(exr_initialize_required_attr_simple(context, part, 4, 4, EXR_COMPRESSION_ZIPS),
                     0);
    assert_int_equal(exr_set_version(context, part, 1), 0);
    assert_int_equal(
        exr_add_channel(context, part, "Z", EXR_PIXEL_HALF, EXR_PERCEPTUALLY_LINEAR, 1, 1), 0);
    finish_odd_exr(&context, scratch_path("tmp.exr"), scratch_path("deep.exr"));
    listen();
    assert_int_equal(image_read(&back, scratch_path("deep.exr")), -ENOTSUP);
    assert_logged("deep.exr", "deep", "flatten");

    start_odd_exr(&context, scratch_path("tmp.exr"));
    assert_int_equal(exr_add_part(context, NULL, EXR_STORAGE_SCANLINE, &part), 0);
    assert_int_equal(exr_initialize_required_attr_simple(context, part, 4, 4, EXR_COMPRESSION_ZIP),
                     0);
    assert_int_equal(
        exr_add_channel(context, part, "BY", EXR_PIXEL_HALF, EXR_PERCEPTUALLY_LINEAR, 2, 2), 0);
    finish_odd_exr(&context, scratch_path("tmp.exr"), scratch_path("yc.exr"));
    listen();
    assert_int_equal(image_read(&back, scratch_path("yc.exr")), -ENOTSUP);
    assert_logged("yc.exr", "BY", "subsampled");
}

static void a_header_that_asks_for_more_than_the_file_can_hold_is_refused(void **state)
{
    (void)state;
    static const int32_t windows[][4] = { { 0, 0, 65535, 4095 },   // 1.6 GB of pixels
                                          { 0, 0, 65536, 3 },      // one side too long
                                          { 0, 0, 2147483646, 0 }, // far too long
                                          { -2147483647, 0, 2147483647, 5 } };
    static const char *const names[] = { "dataWindow", "displayWindow" };
    struct image image = make_image(9, 9, 3), back;
    size_t n;
    assert_int_equal(image_write_exr(&image, scratch_path("z.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    for (int which = 0; which < 2; which++)
        for (int i = 0; i < 4; i++) {
            uint8_t *bytes = read_all(scratch_path("z.exr"), &n);
            memcpy(attribute(bytes, n, names[which], "box2i"), windows[i], 16);
            write_all(scratch_path("huge.exr"), bytes, n);
            free(bytes);
            listen();
            const int err = image_read(&back, scratch_path("huge.exr"));
            // The library itself refuses sides that overflow, as broken.
            assert_true(err == -EFBIG || (i >= 2 && err == -EINVAL));
            assert_logged("huge.exr");
            assert_null(back.data);
        }
    image_free(&image);

    listen();
    assert_int_equal(read_text(&back, "#?RADIANCE\n\n-Y 4000 +X 60000\n", 30), -EFBIG);
    assert_logged("memory", "60000");
    listen();
    assert_int_equal(read_text(&back, "#?RADIANCE\n\n-Y 1 +X 65537\n", 26), -EFBIG);
    listen();
    assert_int_equal(read_text(&back, "#?RADIANCE\n\n-Y 0 +X 5\n", 22), -EINVAL);

    TIFF *tiff = TIFFOpen(scratch_path("huge.tif"), "w");
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, 60000);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, 4000);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, 16);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, 3);
    TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_RGB);
    TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, 4000);
    const char row[12] = { 0 };
    TIFFWriteRawStrip(tiff, 0, (void *)(uintptr_t)row, sizeof(row));
    TIFFClose(tiff);
    listen();
    assert_int_equal(image_read(&back, scratch_path("huge.tif")), -EFBIG);
    assert_logged("huge.tif", "60000", "4000");
}

static void a_large_black_picture_is_not_taken_for_an_attack(void **state)
{
    (void)state;
    struct image image, back;
    assert_int_equal(image_new(&image, 7000, 6400, 1, NULL), 0); // 85 MiB of halves in 100 kB
    assert_int_equal(image_write_exr(&image, scratch_path("black.exr"), IMAGE_HALF, IMAGE_ZIP), 0);
    assert_int_equal(image_read(&back, scratch_path("black.exr")), 0);
    assert_int_equal(back.width, 7000);
    image_free(&back);
    image_free(&image);
    assert_int_equal(image_new(&image, 6000, 4000, 1, NULL), 0);
    assert_int_equal(image_write_png_srgb(&image, scratch_path("black.png"), 0), 0);
    assert_int_equal(image_read(&back, scratch_path("black.png")), 0);
    image_free(&back);
    image_free(&image);
}

// ---- Radiance -------------------------------------------------------------------------------

// Mantissas and exponent as in the Radiance sources: (m + .5) 2^(e - 136).
static void assert_hdr_pixels(const struct image *image, const uint8_t (*rgbe)[4], int n,
                              double scale)
{
    assert_int_equal(image->n_channels, 3);
    assert_int_equal(image->width * image->height, n);
    for (int i = 0; i < n; i++)
        for (int c = 0; c < 3; c++) {
            const double expected =
                rgbe[i][3] ? (rgbe[i][c] + .5) * pow(2, rgbe[i][3] - 136.) * scale : 0;
            assert_true(image->data[3 * i + c] == (float)expected);
        }
}

static size_t hdr_text(char *out, const char *header, const uint8_t *pixels, size_t n)
{
    const size_t n_header = strlen(header);
    memcpy(out, header, n_header);
    memcpy(out + n_header, pixels, n);
    return n_header + n;
}

static void radiance_flat_old_and_new_runs_decode_alike(void **state)
{
    (void)state;
    static const uint8_t expected[10][4] = { { 255, 128, 1, 129 }, { 9, 9, 9, 100 },
                                             { 9, 9, 9, 100 },     { 9, 9, 9, 100 },
                                             { 9, 9, 9, 100 },     { 0, 0, 0, 0 },
                                             { 7, 8, 9, 255 },     { 3, 4, 5, 1 },
                                             { 3, 4, 5, 1 },       { 200, 0, 255, 0 } };
    static const uint8_t old_runs[] = {
        255, 128, 1, 129, 9, 9, 9, 100, 1, 1, 1, 3, 0,   0, 0,   0,
        7,   8,   9, 255, 3, 4, 5, 1,   1, 1, 1, 1, 200, 0, 255, 0
    };
    static const uint8_t new_runs[] = {
        2,       2, 0,   10, 1,   255,     128 + 4, 9, 5, 0,   7,       3, 3, 200, 1, 128,
        128 + 4, 9, 5,   0,  8,   4,       4,       0, 1, 1,   128 + 4, 9, 2, 0,   9, 128 + 2,
        5,       1, 255, 1,  129, 128 + 4, 100,     2, 0, 255, 128 + 2, 1, 1, 0
    };
    static const char header[] = "#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 10\n";
    char text[512];
    struct image image;
    size_t n = hdr_text(text, header, &expected[0][0], sizeof(expected));
    assert_int_equal(read_text(&image, text, n), 0);
    assert_hdr_pixels(&image, expected, 10, 1);
    image_free(&image);
    n = hdr_text(text, header, old_runs, sizeof(old_runs));
    assert_int_equal(read_text(&image, text, n), 0);
    assert_hdr_pixels(&image, expected, 10, 1);
    image_free(&image);
    n = hdr_text(text, header, new_runs, sizeof(new_runs));
    assert_int_equal(read_text(&image, text, n), 0);
    assert_hdr_pixels(&image, expected, 10, 1);
    image_free(&image);
}

static void radiance_old_runs_count_in_bytes_of_rising_weight(void **state)
{
    (void)state;
    static const uint8_t runs[] = { 5, 6, 7, 130, 1, 1, 1, 44, 1, 1, 1, 1 }; // 1 + 44 + 256 pixels
    char text[128];
    struct image image;
    const size_t n = hdr_text(text, "#?RGBE\n\n-Y 1 +X 301\n", runs, sizeof(runs));
    assert_int_equal(read_text(&image, text, n), 0);
    assert_true(image.data[3 * 300 + 2] == 7.5f * 0x1p-6f);
    image_free(&image);
}

static void radiance_exposure_and_colour_correction_are_divided_out(void **state)
{
    (void)state;
    static const uint8_t pixel[1][4] = { { 100, 150, 200, 130 } };
    char text[256];
    struct image image;
    const size_t n = hdr_text(
        text,
        "#?RADIANCE\nEXPOSURE=0.5\nEXPOSURE= 4.0e0\nCOLORCORR=2 4 8\nCOLORCORR= 0.5 .25 0.125\n\n"
        "-Y 1 +X 1\n",
        &pixel[0][0], 4);
    assert_int_equal(read_text(&image, text, n), 0);
    assert_hdr_pixels(&image, pixel, 1, .5);
    image_free(&image);
}

static void radiance_files_of_another_kind_are_refused_by_name(void **state)
{
    (void)state;
    static const struct {
        const char *text;
        int err;
        const char *word;
    } cases[] = {
        { "#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n1234", -ENOTSUP,
          "memory:2: found FORMAT=32-bit_rle_xyze" },
        { "#?RADIANCE\n\n+Y 1 +X 1\n1234", -ENOTSUP, "+Y +X" },
        { "#?RADIANCE\n\n-Y 1 -X 1\n1234", -ENOTSUP, "-Y -X" },
        { "#?RADIANCE\n\n+X 1 -Y 1\n1234", -ENOTSUP, "+X -Y" },
        { "#?RADIANCE\n\n-Y 1 +Y 1\n1234", -EINVAL, "memory:3:" },
        { "#?RADIANCE\n\n-Y 1 +X 1 9\n1234", -EINVAL, "-Y height +X width" },
        { "#?RADIANCE\n\nnonsense\n", -EINVAL, "nonsense" },
        { "#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\n1234", -EINVAL, "memory:2: found \"EXPOSURE=0\"" },
        { "#?RADIANCE\nEXPOSURE=nan\n\n-Y 1 +X 1\n1234", -EINVAL, "EXPOSURE=nan" },
        { "#?RADIANCE\nCOLORCORR=1 2\n\n-Y 1 +X 1\n1234", -EINVAL, "3 positive numbers" },
        { "#?RADIANCE\n\n-Y 1 +X 2\n\1\1\1\1abcd", -EINVAL, "row 0" },
        { "#?RADIANCE\n\n-Y 1 +X 2\nabcd\1\1\1\2", -EINVAL, "leaves its row" },
        { "#?RADIANCE\n\n-Y 1 +X 2\nabcd", -EINVAL, "file ends" },
    };
    struct image image;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        listen();
        assert_int_equal(read_text(&image, cases[i].text, strlen(cases[i].text)), cases[i].err);
        assert_logged("memory", cases[i].word);
        assert_null(image.data);
    }
}

// ---- TIFF -----------------------------------------------------------------------------------

struct tiff_kind {
    int bits, n_samples, tile, planes, compression;
    const char *mode; // "wl", "wb", "w8"
};

static double tiff_value(const struct tiff_kind *kind, int x, int y, int c)
{
    const int i = (x * 7919 + y * 104729 + c * 1299709) & 0x7fffffff;
    return kind->bits == 8 ? i % 256 : kind->bits == 16 ? i % 65536 : i / 100. - 5000;
}

static void put_sample(const struct tiff_kind *kind, uint8_t *at, double value)
{
    if (kind->bits == 8)
        *at = (uint8_t)value;
    else if (kind->bits == 16)
        memcpy(at, &(uint16_t){ (uint16_t)value }, 2);
    else
        memcpy(at, &(float){ (float)value }, 4);
}

static void write_tiff(const char *path, const struct tiff_kind *kind, int width, int height)
{
    TIFF *tiff = TIFFOpen(path, kind->mode);
    assert_non_null(tiff);
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, width);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, height);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, kind->bits);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, kind->n_samples);
    TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT,
                 kind->bits == 32 ? SAMPLEFORMAT_IEEEFP : SAMPLEFORMAT_UINT);
    TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC,
                 kind->n_samples == 1 ? PHOTOMETRIC_MINISBLACK : PHOTOMETRIC_RGB);
    TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, kind->planes);
    TIFFSetField(tiff, TIFFTAG_COMPRESSION, kind->compression);
    if (kind->n_samples == 4)
        TIFFSetField(tiff, TIFFTAG_EXTRASAMPLES, 1, &(uint16_t){ EXTRASAMPLE_UNASSALPHA });
    const int n_planes = kind->planes == PLANARCONFIG_SEPARATE ? kind->n_samples : 1;
    const int n_inside = kind->n_samples / n_planes, size = kind->bits / 8;
    const int step_x = kind->tile ? 16 : width, step_y = kind->tile ? 32 : 3;
    if (kind->tile) {
        TIFFSetField(tiff, TIFFTAG_TILEWIDTH, step_x);
        TIFFSetField(tiff, TIFFTAG_TILELENGTH, step_y);
    } else {
        TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, step_y);
    }
    uint8_t *buffer = malloc((size_t)(step_x * step_y * n_inside * size));
    for (int plane = 0; plane < n_planes; plane++)
        for (int y0 = 0; y0 < height; y0 += step_y)
            for (int x0 = 0; x0 < width; x0 += step_x) {
                for (int y = 0; y < step_y; y++)
                    for (int x = 0; x < step_x; x++)
                        for (int c = 0; c < n_inside; c++)
                            put_sample(kind, buffer + ((y * step_x + x) * n_inside + c) * size,
                                       tiff_value(kind, x0 + x, y0 + y, plane + c));
                if (kind->tile) {
                    assert_true(TIFFWriteTile(tiff, buffer, (uint32_t)x0, (uint32_t)y0, 0,
                                              (uint16_t)plane) > 0);
                    continue;
                }
                const int n_rows = height - y0 < step_y ? height - y0 : step_y;
                assert_true(TIFFWriteEncodedStrip(
                                tiff, TIFFComputeStrip(tiff, (uint32_t)y0, (uint16_t)plane), buffer,
                                n_rows * width * n_inside * size) > 0);
            }
    free(buffer);
    TIFFClose(tiff);
}

static void tiff_of_every_layout_is_read(void **state)
{
    (void)state;
    static const int bits[] = { 8, 16, 32 }, samples[] = { 1, 3, 4 };
    static const int compressions[] = { COMPRESSION_NONE, COMPRESSION_LZW,
                                        COMPRESSION_ADOBE_DEFLATE, COMPRESSION_PACKBITS };
    static const char *const modes[] = { "wl", "wb", "w8" };
    for (int i = 0; i < 3 * 3 * 2 * 2 * 4 * 3; i++) {
        struct image image;
        const struct tiff_kind kind = { bits[i % 3],
                                        samples[i / 3 % 3],
                                        i / 9 % 2,
                                        i / 18 % 2 ? PLANARCONFIG_SEPARATE : PLANARCONFIG_CONTIG,
                                        compressions[i / 36 % 4],
                                        modes[i / 144] };
        write_tiff(scratch_path("t.tif"), &kind, 37, 41);
        assert_int_equal(image_read(&image, scratch_path("t.tif")), 0);
        assert_int_equal(image.width, 37);
        assert_int_equal(image.height, 41);
        assert_int_equal(image.n_channels, kind.n_samples);
        const double white = kind.bits == 8 ? 255 : kind.bits == 16 ? 65535 : 1;
        for (int y = 0; y < 41; y++)
            for (int x = 0; x < 37; x++)
                for (int c = 0; c < kind.n_samples; c++)
                    assert_true(image.data[(y * 37 + x) * kind.n_samples + c] ==
                                (float)((float)tiff_value(&kind, x, y, c) / (float)white));
        image_free(&image);
    }
}

static void set_tags(const char *path, int photometric, int n_samples, int bits, int format)
{
    TIFF *tiff = TIFFOpen(path, "w");
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, 4);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, 1);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, bits);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, n_samples);
    TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, format);
    TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, photometric);
    TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG);
    TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, 1);
    uint8_t row[4 * 5 * 8] = { 0 };
    TIFFWriteEncodedStrip(tiff, 0, row, 4 * n_samples * bits / 8);
    TIFFClose(tiff);
}

static void tiff_of_another_kind_is_refused_by_name(void **state)
{
    (void)state;
    static const struct {
        int photometric, n_samples, bits, format;
        const char *word;
    } cases[] = {
        { PHOTOMETRIC_MINISWHITE, 1, 8, SAMPLEFORMAT_UINT, "photometric interpretation 0" },
        { PHOTOMETRIC_SEPARATED, 4, 8, SAMPLEFORMAT_UINT, "photometric interpretation 5" },
        { PHOTOMETRIC_RGB, 5, 8, SAMPLEFORMAT_UINT, "samples per pixel 5" },
        { PHOTOMETRIC_MINISBLACK, 2, 16, SAMPLEFORMAT_UINT, "samples per pixel 2" },
        { PHOTOMETRIC_MINISBLACK, 1, 32, SAMPLEFORMAT_UINT, "bits per sample 32" },
        { PHOTOMETRIC_MINISBLACK, 1, 16, SAMPLEFORMAT_INT, "bits per sample 16" },
        { PHOTOMETRIC_MINISBLACK, 1, 64, SAMPLEFORMAT_IEEEFP, "float bits per sample 64" },
    };
    struct image image;
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
        set_tags(scratch_path("odd.tif"), cases[i].photometric, cases[i].n_samples, cases[i].bits,
                 cases[i].format);
        listen();
        assert_int_equal(image_read(&image, scratch_path("odd.tif")), -ENOTSUP);
        assert_logged("odd.tif", cases[i].word);
    }
}

// ---- PNG ------------------------------------------------------------------------------------

static void png_comes_back_as_value_over_max(void **state)
{
    (void)state;
    static const int channels[] = { 1, 3, 4 };
    static const char *const first[] = { "Y", "R", "R" };
    uint8_t pixels[13 * 9 * 4];
    struct image image;
    for (size_t i = 0; i < sizeof(pixels); i++)
        pixels[i] = (uint8_t)(i * 37);
    for (int k = 0; k < 3; k++) {
        const int n = channels[k];
        assert_int_equal(image_write_png(scratch_path("p.png"), 13, 9, n, pixels), 0);
        assert_int_equal(image_read(&image, scratch_path("p.png")), 0);
        assert_int_equal(image.n_channels, n);
        assert_string_equal(image.names[0], first[k]);
        for (int i = 0; i < 13 * 9 * n; i++)
            assert_true(image.data[i] == (float)pixels[i] / 255);
        image_free(&image);
    }
    listen();
    assert_int_equal(image_write_png(scratch_path("two.png"), 13, 9, 2, pixels), -EINVAL);
    assert_logged("two.png", "2 channels");
}

// By libpng itself: kinds that we read but never write.
static void write_foreign_png(const char *path, int type, int depth, const uint8_t *rows,
                              size_t row_bytes, int n_rows, int width)
{
    png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, NULL, NULL, NULL);
    png_infop info = png_create_info_struct(png);
    FILE *f = fopen(path, "wb");
    png_init_io(png, f);
    png_set_IHDR(png, info, (png_uint_32)width, (png_uint_32)n_rows, depth, type,
                 PNG_INTERLACE_ADAM7, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    const png_color palette[2] = { { 10, 20, 30 }, { 255, 0, 51 } };
    if (type == PNG_COLOR_TYPE_PALETTE)
        png_set_PLTE(png, info, palette, 2);
    png_write_info(png, info);
    png_bytep pointers[8];
    for (int y = 0; y < n_rows; y++)
        pointers[y] = (png_bytep)(uintptr_t)(rows + (size_t)y * row_bytes);
    png_write_image(png, pointers);
    png_write_end(png, info);
    png_destroy_write_struct(&png, &info);
    fclose(f);
}

static void png_of_sixteen_bits_one_bit_and_palette_is_read(void **state)
{
    (void)state;
    static const uint8_t deep[] = { 0, 1, 255, 255, 18, 52, 128, 0, 0, 0, 1, 0 },
                         bits[] = { 0xa0, 0x40 };
    struct image image;
    write_foreign_png(scratch_path("16.png"), PNG_COLOR_TYPE_RGB, 16, deep, 6, 2, 1);
    assert_int_equal(image_read(&image, scratch_path("16.png")), 0);
    assert_true(image.data[0] == 1.f / 65535 && image.data[1] == 1 &&
                image.data[2] == 0x1234 / 65535.f && image.data[3] == 0x8000 / 65535.f);
    image_free(&image);
    write_foreign_png(scratch_path("1.png"), PNG_COLOR_TYPE_GRAY, 1, bits, 1, 2, 3);
    assert_int_equal(image_read(&image, scratch_path("1.png")), 0);
    const float expected[] = { 1, 0, 1, 0, 1, 0 };
    assert_memory_equal(image.data, expected, sizeof(expected));
    image_free(&image);
    write_foreign_png(scratch_path("palette.png"), PNG_COLOR_TYPE_PALETTE, 1, bits, 1, 2, 3);
    assert_int_equal(image_read(&image, scratch_path("palette.png")), 0);
    assert_int_equal(image.n_channels, 3);
    assert_true(image.data[0] == 1 && image.data[1] == 0 && image.data[2] == .2f &&
                image.data[3] == 10.f / 255);
    image_free(&image);
    write_foreign_png(scratch_path("ga.png"), PNG_COLOR_TYPE_GRAY_ALPHA, 8, deep, 6, 2, 3);
    assert_int_equal(image_read(&image, scratch_path("ga.png")), 0);
    assert_int_equal(image.n_channels, 2);
    assert_string_equal(image.names[1], "A");
    assert_true(image.data[1] == 1.f / 255);
    image_free(&image);
}

static void tone_mapped_png_follows_the_srgb_curve(void **state)
{
    (void)state;
    // Bytes of the sRGB standard for linear values, worked out by hand.
    static const float linear[] = { 0, 1, 2, -1, .5f, .214041f, .0031308f, .001f };
    static const int bytes[] = { 0, 255, 255, 0, 188, 127, 10, 3 };
    struct image image, back;
    assert_int_equal(image_new(&image, 8, 1, 4, NULL), 0);
    for (int i = 0; i < 8; i++)
        image.data[4 * i] = linear[i], image.data[4 * i + 1] = linear[i] / 4,
                       image.data[4 * i + 2] = NAN;
    assert_int_equal(image_write_png_srgb(&image, scratch_path("s.png"), 0), 0);
    assert_int_equal(image_read(&back, scratch_path("s.png")), 0);
    assert_int_equal(back.n_channels, 3);
    for (int i = 0; i < 8; i++) {
        assert_int_equal(lroundf(back.data[3 * i] * 255), bytes[i]);
        assert_true(back.data[3 * i + 2] == 0); // NaN
    }
    image_free(&back);
    assert_int_equal(image_write_png_srgb(&image, scratch_path("s.png"), 2), 0);
    assert_int_equal(image_read(&back, scratch_path("s.png")), 0);
    for (int i = 0; i < 8; i++)
        assert_int_equal(lroundf(back.data[3 * i + 1] * 255), bytes[i]); // two stops up
    image_free(&back);
    image_free(&image);
}

// ---- broken files ---------------------------------------------------------------------------

static int make_sample(const char *kind, uint8_t **bytes, size_t *n)
{
    char name[64];
    snprintf(name, sizeof(name), "sample-%s", kind);
    const char *path = scratch_path(name);
    struct image image = make_image(13, 11, 3);
    for (int i = 0; i < 13 * 11 * 3; i++) // smooth enough for the compressors to do something
        image.data[i] = (float)(i / 9) / 64;
    if (!strcmp(kind, "zip"))
        assert_int_equal(image_write_exr(&image, path, IMAGE_HALF, IMAGE_ZIP), 0);
    else if (!strcmp(kind, "piz"))
        assert_int_equal(image_write_exr(&image, path, IMAGE_FLOAT, IMAGE_PIZ), 0);
    else if (!strcmp(kind, "png"))
        assert_int_equal(image_write_png_srgb(&image, path, 0), 0);
    else if (!strcmp(kind, "rle") || !strcmp(kind, "tiles") || !strcmp(kind, "none"))
        write_foreign_exr(
            path,
            &(struct exr_kind){
                .storage = !strcmp(kind, "tiles") ? EXR_STORAGE_TILED : EXR_STORAGE_SCANLINE,
                .compression = !strcmp(kind, "none") ? EXR_COMPRESSION_NONE : EXR_COMPRESSION_RLE,
                .tile_width = 8,
                .tile_height = 8,
                .levels = EXR_TILE_MIPMAP_LEVELS,
                .data = box(1, 1, 12, 13),
                .display = box(0, 0, 14, 13) });
    else if (!strcmp(kind, "hdr")) {
        static const uint8_t pixels[] = { 2,   2, 0, 10, 138, 9,   138, 8,   138, 7,   138,
                                          130, 2, 2, 0,  10,  10,  1,   2,   3,   4,   5,
                                          6,   7, 8, 9,  10,  138, 8,   138, 7,   138, 130 };
        char text[256];
        write_all(path, text,
                  hdr_text(text, "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n-Y 2 +X 10\n",
                           pixels, sizeof(pixels)));
    } else {
        const struct tiff_kind tiff = { 16,
                                        3,
                                        !strcmp(kind, "tile.tif"),
                                        PLANARCONFIG_CONTIG,
                                        !strcmp(kind, "lzw.tif") ? COMPRESSION_LZW
                                                                 : COMPRESSION_ADOBE_DEFLATE,
                                        "wl" };
        write_tiff(path, &tiff, 13, 11);
    }
    image_free(&image);
    *bytes = read_all(path, n);
    return 0;
}

static const char *const sample_kinds[] = { "zip", "piz", "rle",     "tiles",   "none",
                                            "png", "hdr", "lzw.tif", "tile.tif" };
enum { N_SAMPLE_KINDS = sizeof(sample_kinds) / sizeof(sample_kinds[0]) };

static int read_exactly(struct image *image, const uint8_t *bytes, size_t n)
{
    listen();
    return read_text(image, (const char *)bytes, n);
}

static void every_truncation_is_refused_with_one_line(void **state)
{
    (void)state;
    for (int k = 0; k < N_SAMPLE_KINDS; k++) {
        uint8_t *bytes;
        size_t n;
        struct image whole, image;
        make_sample(sample_kinds[k], &bytes, &n);
        assert_int_equal(read_exactly(&whole, bytes, n), 0);
        for (size_t length = 0; length < n; length++) {
            const int err = read_exactly(&image, bytes, length);
            if (!err) { // only where nothing of the picture is missing
                assert_same_image(&whole, &image);
                image_free(&image);
                continue;
            }
            if (logged.n_errors != 1 || image.data)
                fail_msg("%s cut to %zu of %zu bytes: %d lines: %s", sample_kinds[k], length, n,
                         logged.n_errors, logged.last);
        }
        image_free(&whole);
        free(bytes);
    }
}

static void half_a_picture_is_never_taken_for_a_whole_one(void **state)
{
    (void)state;
    static const char *const kinds[] = {
        "zip", "piz", "rle", "none", "png", "hdr"
    }; // their last bytes are pixels or the end mark
    for (size_t k = 0; k < sizeof(kinds) / sizeof(kinds[0]); k++) {
        uint8_t *bytes;
        size_t n;
        struct image image;
        make_sample(kinds[k], &bytes, &n);
        assert_int_not_equal(read_exactly(&image, bytes, n - 1), 0);
        assert_int_not_equal(read_exactly(&image, bytes, n / 2), 0);
        free(bytes);
    }
}

static void damaged_pixels_of_a_tiff_are_named_by_their_place(void **state)
{
    (void)state;
    static const char *const kinds[] = { "deflate.tif", "lzw.tif", "tile.tif" };
    for (int k = 0; k < 3; k++) {
        uint8_t *bytes;
        size_t n;
        struct image image;
        make_sample(kinds[k], &bytes, &n);
        memset(bytes + 8 + 20, 0xff, 60); // the pixels follow the header of 8 bytes
        assert_int_equal(read_exactly(&image, bytes, n), -EINVAL);
        assert_logged("memory", k == 2 ? "tile at column 0, row 0" : ": row ");
        assert_null(image.data);
        free(bytes);
    }
}

static void no_damaged_byte_crashes_a_reader(void **state)
{
    (void)state;
    static const uint8_t masks[] = { 0xff, 0x80, 0x01 };
    for (int k = 0; k < N_SAMPLE_KINDS; k++) {
        uint8_t *bytes;
        size_t n;
        struct image image;
        int n_refused = 0;
        make_sample(sample_kinds[k], &bytes, &n);
        for (size_t i = 0; i < n; i++)
            for (size_t m = 0; m < sizeof(masks); m++) {
                bytes[i] ^= masks[m];
                const int err = read_exactly(&image, bytes, n);
                if (err)
                    n_refused++;
                else
                    image_free(&image);
                if (err ? logged.n_errors != 1 : logged.n_errors != 0)
                    fail_msg("%s, byte %zu: %d lines: %s", sample_kinds[k], i, logged.n_errors,
                             logged.last);
                bytes[i] ^= masks[m];
            }
        assert_true(n_refused > 0);
        free(bytes);
    }
}

static void what_is_no_picture_is_named(void **state)
{
    (void)state;
    struct image image;
    listen();
    assert_int_equal(image_read(&image, scratch_path("missing.exr")), -ENOENT);
    assert_logged("missing.exr", "No such file");
    listen();
    assert_int_equal(image_read(&image, scratch_dir), -EISDIR);
    assert_logged(scratch_dir);
    write_all(scratch_path("empty.exr"), "", 0);
    listen();
    assert_int_equal(image_read(&image, scratch_path("empty.exr")), -EINVAL);
    assert_logged("empty.exr", "empty");
    listen();
    assert_int_equal(read_text(&image, "\xff\xd8\xff\xe0", 4), -EINVAL);
    assert_logged("JPEG");
    listen();
    assert_int_equal(read_text(&image, "hello", 5), -EINVAL);
    assert_logged("memory", "OpenEXR");
}

// ---- JPEG -----------------------------------------------------------------------------------

static size_t write_jpeg(uint8_t **bytes, int side, int n_channels, const uint8_t *colour)
{
    struct jpeg_compress_struct jpeg;
    struct jpeg_error_mgr manager;
    unsigned long n = 0;
    uint8_t row[3 * 64];
    JSAMPROW rows[] = { row };
    *bytes = NULL;
    jpeg.err = jpeg_std_error(&manager);
    jpeg_create_compress(&jpeg);
    jpeg_mem_dest(&jpeg, bytes, &n);
    jpeg.image_width = jpeg.image_height = (JDIMENSION)side;
    jpeg.input_components = n_channels;
    jpeg.in_color_space = n_channels == 3 ? JCS_RGB : JCS_GRAYSCALE;
    jpeg_set_defaults(&jpeg);
    jpeg_set_quality(&jpeg, 100, TRUE);
    jpeg_start_compress(&jpeg, TRUE);
    for (int i = 0; i < side; i++)
        for (int c = 0; c < n_channels; c++)
            row[i * n_channels + c] = colour[c];
    while (jpeg.next_scanline < jpeg.image_height)
        jpeg_write_scanlines(&jpeg, rows, 1);
    jpeg_finish_compress(&jpeg);
    jpeg_destroy_compress(&jpeg);
    return n;
}

// A JPEG is never a view, but may be a texture; so may a PNG. What is colour has its curve undone.
static void textures_come_from_eight_bits(void **state)
{
    (void)state;
    static const uint8_t colour[3] = { 0, 55, 255 };
    static const double linear[3] = { 0, .0382, 1 };
    struct image image;
    uint8_t *bytes;
    const size_t n = write_jpeg(&bytes, 40, 3, colour);
    write_all(scratch_path("texture.jpg"), (const char *)bytes, n);
    assert_int_equal(image_write_png(scratch_path("texture.png"), 1, 1, 3, colour), 0);
    for (int k = 0; k < 4; k++) {
        const char *path = scratch_path(k % 2 ? "texture.jpg" : "texture.png");
        const double tolerance = k % 2 ? .012 : 1e-4; // JPEG rounds
        assert_int_equal(image_read_texture(&image, path, k < 2), 0);
        assert_true(image.n_channels == 3 && image.width == (k % 2 ? 40 : 1) && image.height == image.width);
        for (int i = 0; i < image.width * image.height; i++)
            for (int c = 0; c < 3; c++)
                assert_true(fabs((double)image.data[3 * i + c] - (k < 2 ? linear[c] : colour[c] / 255.)) < tolerance);
        image_free(&image);
    }
    listen();
    assert_int_equal(image_read(&image, scratch_path("texture.jpg")), -EINVAL);
    assert_logged("JPEG", "not linear");
    for (size_t cut = 2; cut < n; cut += n / 7) { // cut off
        struct image_file file = { bytes, cut, "cut.jpg" };
        listen();
        if (image_read_jpeg(&image, &file) != -EINVAL)
            fail_msg("the first %zu of %zu bytes were read", cut, n);
        assert_logged("cut.jpg");
    }
    free(bytes);
    const size_t n_grey = write_jpeg(&bytes, 64, 1, colour + 1);
    assert_int_equal(image_read_jpeg(&image, &(struct image_file){ bytes, n_grey, "grey.jpg" }), 0);
    assert_true(image.n_channels == 1 && image.width == 64 && fabs((double)image.data[64 * 64 - 1] - 55. / 255) < .004);
    image_free(&image);
    free(bytes);
    unlink(scratch_path("texture.jpg")), unlink(scratch_path("texture.png"));
}

// ---- writing fails cleanly ------------------------------------------------------------------

// In a child that may not write files over limit bytes: what a full disk does. 0 if image_write_*
// failed as it should.
static int write_on_full_disk(const struct image *image, const char *path, bool png)
{
    const pid_t child = fork();
    if (child == 0) {
        signal(SIGXFSZ, SIG_IGN);
        setrlimit(RLIMIT_FSIZE, &(struct rlimit){ 2000, 2000 });
        listen();
        const int err = png ? image_write_png_srgb(image, path, 0)
                            : image_write_exr(image, path, IMAGE_FLOAT, IMAGE_ZIP);
        _exit(err == -EFBIG && logged.n_errors == 1 && strstr(logged.last, path) ? 0 : 1);
    }
    int status = 1;
    waitpid(child, &status, 0);
    return status;
}

static void a_write_that_fails_leaves_the_old_file_and_nothing_else(void **state)
{
    (void)state;
    struct image image = make_image(64, 64, 3), small = make_image(2, 2, 3), back;
    scratch_empty();
    assert_int_equal(image_write_exr(&small, scratch_path("keep.exr"), IMAGE_FLOAT, IMAGE_ZIP), 0);
    assert_int_equal(write_on_full_disk(&image, scratch_path("keep.exr"), false), 0);
    assert_int_equal(write_on_full_disk(&image, scratch_path("keep.png"), true), 0);
    assert_int_equal(n_files_in_folder(), 1);
    assert_int_equal(image_read(&back, scratch_path("keep.exr")), 0);
    assert_same_image(&small, &back);
    image_free(&back);

    listen();
    assert_int_equal(
        image_write_exr(&small, scratch_path("no/such/folder.exr"), IMAGE_HALF, IMAGE_ZIP),
        -ENOENT);
    assert_logged("no/such/folder.exr", "create its folder");
    listen();
    assert_int_equal(
        image_write_exr(&small, scratch_path("keep.exr/below.exr"), IMAGE_HALF, IMAGE_ZIP),
        -ENOTDIR);
    assert_logged("below.exr");
    listen();
    assert_int_equal(image_write_exr(&small, scratch_dir, IMAGE_HALF, IMAGE_ZIP), -EISDIR);
    assert_logged(scratch_dir);
    listen();
    assert_int_equal(image_write_exr(&small, "/dev/null", IMAGE_HALF, IMAGE_ZIP), -EINVAL);
    assert_logged("/dev/null", "device");
    assert_int_equal(n_files_in_folder(), 1);
    image_free(&image);
    image_free(&small);
}

// ---- images in memory -----------------------------------------------------------------------

static void new_images_are_zeroed_named_and_limited(void **state)
{
    (void)state;
    struct image image;
    assert_int_equal(image_new(&image, 3, 2, 4, NULL), 0);
    assert_string_equal(image.names[3], "A");
    for (int i = 0; i < 24; i++)
        assert_true(image.data[i] == 0);
    image_free(&image);
    assert_null(image.data);
    image_free(&image);
    image_free(NULL);
    assert_int_equal(image_new(&image, 1, 1, 1, NULL), 0);
    assert_string_equal(image.names[0], "Y");
    image_free(&image);
    static const int bad[][3] = { { 0, 1, 1 },     { 1, -1, 1 },       { 65537, 1, 1 },
                                  { 1, 65537, 1 }, { 65536, 4097, 1 }, { 1, 1, 0 },
                                  { 1, 1, 65 },    { 1, 1, 2 },        { 1, 1, 5 } };
    for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
        assert_int_equal(image_new(&image, bad[i][0], bad[i][1], bad[i][2], NULL), -EINVAL);
        assert_null(image.data);
    }
    char long_name[IMAGE_NAME_MAX + 1];
    memset(long_name, 'x', IMAGE_NAME_MAX);
    long_name[IMAGE_NAME_MAX] = 0;
    assert_int_equal(image_new(&image, 1, 1, 1, (const char *const[]){ long_name }), -EINVAL);
    assert_int_equal(image_new(&image, 1, 1, 1, (const char *const[]){ long_name + 1 }), 0);
    image_free(&image);
}

static void bilinear_is_exact_at_centres_linear_between_and_clamped(void **state)
{
    (void)state;
    struct image image;
    float out[2];
    assert_int_equal(image_new(&image, 4, 3, 2, (const char *const[]){ "u", "v" }), 0);
    for (int y = 0; y < 3; y++)
        for (int x = 0; x < 4; x++)
            image.data[(y * 4 + x) * 2] = (float)(x + 8 * y),
                                     image.data[(y * 4 + x) * 2 + 1] = (float)(x * y);
    for (double y = .5; y <= 2.5; y += .25)
        for (double x = .5; x <= 3.5; x += .25) {
            image_bilinear(&image, x, y, out);
            assert_true(out[0] == (float)(x - .5 + 8 * (y - .5)));
            assert_true(fabs((double)out[1] - (x - .5) * (y - .5)) <
                        1e-6); // bilinear functions come out exactly
        }
    static const double outside[][2] = { { -5, -5 },       { 99, -1 }, { -1, 99 },
                                         { 1e300, 1e300 }, { 0, 0 },   { NAN, 99 } };
    static const float corners[] = { 0, 3, 16, 19, 0, 16 };
    for (int i = 0; i < 6; i++) {
        image_bilinear(&image, outside[i][0], outside[i][1], out);
        assert_true(out[0] == corners[i]);
    }
    image_free(&image);
}

// ---- real files -----------------------------------------------------------------------------

static void real_panoramas_and_views_read_with_plausible_light(void **state)
{
    (void)state;
    static const struct {
        const char *path;
        int width, height, n_channels;
        double least_mean, most_mean;
    } files[] = {
        { "../shared/data/hdri/OrientationLatLong.exr", 1024, 512, 4, .5, 1 },
        { "../shared/data/hdri/studio_small_03_1k.hdr", 1024, 512, 3, .5, 10 },
        { "../shared/data/hdri/brown_photostudio_02_1k.hdr", 1024, 512, 3, .2, 10 },
        { "../shared/data/studio-pebble/panorama.exr", 2048, 1024, 3, .1, 10 },
        { "../shared/data/studio-vase/panorama.exr", 1024, 512, 3, .1, 10 },
        { "../shared/data/studio-pebble/linear/cam000.exr", 480, 320, 3, .01, 10 },
        { "../shared/data/studio-vase/linear/cam042.exr", 480, 320, 3, .01, 10 },
    };
    if (access("../shared/data", F_OK)) {
        fprintf(stderr, "test_image: no ../shared/data here: real files not tried\n");
        return;
    }
    for (size_t k = 0; k < sizeof(files) / sizeof(files[0]); k++) {
        struct image image;
        double sum = 0;
        assert_int_equal(image_read(&image, files[k].path), 0);
        assert_int_equal(image.width, files[k].width);
        assert_int_equal(image.height, files[k].height);
        assert_int_equal(image.n_channels, files[k].n_channels);
        assert_string_equal(image.names[1], "G");
        assert_int_equal(image_require_finite(&image, NULL, files[k].path), 0);
        for (int i = 0; i < image.width * image.height; i++)
            sum += (double)image.data[i * image.n_channels + 1];
        sum /= image.width * image.height;
        if (sum < files[k].least_mean || sum > files[k].most_mean)
            fail_msg("%s: mean green %g", files[k].path, sum);
        image_free(&image);
    }
}

static int make_folder(void **state)
{
    (void)state;
    log_set_hook(keep_line, NULL);
    log_set_level(LOG_SILENT); // thousands of refusals are provoked here: only the hook hears them
    TIFFSetWarningHandler(NULL);
    return scratch_open();
}

static int remove_folder(void **state)
{
    (void)state;
    scratch_empty();
    return scratch_close();
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(exr_comes_back_exactly_as_float_and_to_the_nearest_as_half),
        cmocka_unit_test(half_never_makes_infinities),
        cmocka_unit_test(colours_come_first_the_others_in_file_order),
        cmocka_unit_test(equal_pixels_give_equal_bytes),
        cmocka_unit_test(two_channels_of_one_name_are_refused),
        cmocka_unit_test(nan_is_named_by_its_pixel),
        cmocka_unit_test(scanlines_tiles_and_mip_maps_of_half_float_and_unsigned_are_read),
        cmocka_unit_test(the_data_window_is_placed_in_the_display_window),
        cmocka_unit_test(lossy_compressions_are_refused_by_name),
        cmocka_unit_test(deep_multi_part_and_subsampled_are_refused_by_name),
        cmocka_unit_test(a_header_that_asks_for_more_than_the_file_can_hold_is_refused),
        cmocka_unit_test(a_large_black_picture_is_not_taken_for_an_attack),
        cmocka_unit_test(radiance_flat_old_and_new_runs_decode_alike),
        cmocka_unit_test(radiance_old_runs_count_in_bytes_of_rising_weight),
        cmocka_unit_test(radiance_exposure_and_colour_correction_are_divided_out),
        cmocka_unit_test(radiance_files_of_another_kind_are_refused_by_name),
        cmocka_unit_test(tiff_of_every_layout_is_read),
        cmocka_unit_test(tiff_of_another_kind_is_refused_by_name),
        cmocka_unit_test(png_comes_back_as_value_over_max),
        cmocka_unit_test(png_of_sixteen_bits_one_bit_and_palette_is_read),
        cmocka_unit_test(tone_mapped_png_follows_the_srgb_curve),
        cmocka_unit_test(every_truncation_is_refused_with_one_line),
        cmocka_unit_test(half_a_picture_is_never_taken_for_a_whole_one),
        cmocka_unit_test(damaged_pixels_of_a_tiff_are_named_by_their_place),
        cmocka_unit_test(no_damaged_byte_crashes_a_reader),
        cmocka_unit_test(what_is_no_picture_is_named),
        cmocka_unit_test(textures_come_from_eight_bits),
        cmocka_unit_test(a_write_that_fails_leaves_the_old_file_and_nothing_else),
        cmocka_unit_test(new_images_are_zeroed_named_and_limited),
        cmocka_unit_test(bilinear_is_exact_at_centres_linear_between_and_clamped),
        cmocka_unit_test(real_panoramas_and_views_read_with_plausible_light),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
