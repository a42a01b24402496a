// solver/take/image_png.c - PNG: pictures for people and pages out, masks in (libpng appears only
// here).
//
// libpng reports errors by longjmp: everything that lives across it sits in one struct outside the
// frame that jumps.
#include "solver/take/atomic_file.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <png.h>
#include <setjmp.h>
#include <stdlib.h>
#include <string.h>

struct png_job {
    png_structp png;
    png_infop info;
    char message[200];
    // Writing.
    FILE *stream;
    int write_err;
    // Reading.
    const struct image_file *file;
    size_t offset;
    png_bytep pixels; // whole picture as libpng gives it
    png_bytepp rows;
};

static void keep_error(png_structp png, png_const_charp message)
{
    struct png_job *job = png_get_error_ptr(png);
    snprintf(job->message, sizeof(job->message), "%s", message);
    png_longjmp(png, 1);
}

static void drop_warning(png_structp png, png_const_charp message)
{
    (void)png,
        (void)message; // "iCCP: known incorrect sRGB profile" and the like do not touch the pixels
}

static void write_bytes(png_structp png, png_bytep bytes, size_t n)
{
    struct png_job *job = png_get_io_ptr(png);
    errno = 0;
    if (fwrite(bytes, 1, n, job->stream) != n) {
        job->write_err = errno ? -errno : -EIO;
        png_error(png, "write failed");
    }
}

static void flush_nothing(png_structp png)
{
    (void)png; // atomic_file_commit does
}

static int encode(struct png_job *job, int width, int height, int n_channels, const uint8_t *pixels)
{
    static const int colour_types[] = {
        [1] = PNG_COLOR_TYPE_GRAY, [3] = PNG_COLOR_TYPE_RGB, [4] = PNG_COLOR_TYPE_RGB_ALPHA
    };
    if (setjmp(png_jmpbuf(job->png)))
        return -EIO;
    png_set_write_fn(job->png, job, write_bytes, flush_nothing);
    png_set_IHDR(job->png, job->info, (png_uint_32)width, (png_uint_32)height, 8,
                 colour_types[n_channels], PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT,
                 PNG_FILTER_TYPE_DEFAULT);
    png_write_info(job->png, job->info);
    for (int y = 0; y < height; y++)
        png_write_row(job->png, pixels + (size_t)y * (size_t)width * (size_t)n_channels);
    png_write_end(job->png, job->info);
    return 0;
}

// To a stream; name is for messages.
static int encode_to(FILE *stream, const char *name, int width, int height, int n_channels,
                     const uint8_t *pixels)
{
    struct png_job job = { .stream = stream };
    if (width < 1 || height < 1 || (n_channels != 1 && n_channels != 3 && n_channels != 4)) {
        log_error("image: %s not written: a PNG of %d x %d pixels and %d channels; expected 1, 3 "
                  "or 4 channels",
                  name, width, height, n_channels);
        return -EINVAL;
    }
    job.png = png_create_write_struct(PNG_LIBPNG_VER_STRING, &job, keep_error, drop_warning);
    job.info = job.png ? png_create_info_struct(job.png) : NULL;
    int err = job.info ? encode(&job, width, height, n_channels, pixels) : -ENOMEM;
    png_destroy_write_struct(&job.png, &job.info);
    if (err) {
        err = job.write_err ? job.write_err : err;
        log_error("image: cannot write %s: %s", name,
                  job.write_err    ? strerror(-job.write_err)
                  : job.message[0] ? job.message
                                   : strerror(-err));
    }
    return err;
}

int image_write_png(const char *path, int width, int height, int n_channels, const uint8_t *pixels)
{
    struct atomic_file f;
    int err = atomic_file_open(&f, path);
    if (err)
        return err;
    err = encode_to(f.stream, path, width, height, n_channels, pixels);
    if (err) {
        atomic_file_abandon(&f);
        return err;
    }
    return atomic_file_commit(&f);
}

int image_encode_png(uint8_t **bytes, size_t *n_bytes, int width, int height, int n_channels,
                     const uint8_t *pixels)
{
    char *memory = NULL;
    size_t n = 0;
    FILE *stream = open_memstream(&memory, &n);
    *bytes = NULL, *n_bytes = 0;
    if (!stream)
        return -ENOMEM;
    int err = encode_to(stream, "a picture in memory", width, height, n_channels, pixels);
    if (fclose(stream) && !err)
        err = -ENOMEM;
    if (err) {
        free(memory);
        return err;
    }
    *bytes = (uint8_t *)memory, *n_bytes = n;
    return 0;
}

static void read_bytes(png_structp png, png_bytep bytes, size_t n)
{
    struct png_job *job = png_get_io_ptr(png);
    if (n > job->file->n_bytes - job->offset)
        png_error(png, "the file ends early");
    memcpy(bytes, job->file->bytes + job->offset, n);
    job->offset += n;
}

static int read_header(struct png_job *job, int *n_channels)
{
    if (setjmp(png_jmpbuf(job->png)))
        return -EINVAL;
    png_set_read_fn(job->png, job, read_bytes);
    png_set_user_limits(job->png, 1 << 24, 1 << 24); // ours, which are smaller and named, follow
    png_set_crc_action(job->png, PNG_CRC_ERROR_QUIT, PNG_CRC_WARN_DISCARD);
    png_read_info(job->png, job->info);
    png_set_expand(job->png); // palette -> RGB, fewer than 8 bits -> 8, tRNS -> alpha
    png_set_interlace_handling(job->png);
    png_read_update_info(job->png, job->info);
    *n_channels = png_get_channels(job->png, job->info);
    return 0;
}

static int read_pixels(struct png_job *job)
{
    if (setjmp(png_jmpbuf(job->png)))
        return -EINVAL;
    png_read_image(job->png, job->rows);
    png_read_end(job->png, NULL);
    return 0;
}

static void convert(const struct png_job *job, struct image *image, int depth)
{
    const size_t n_row = (size_t)image->width * (size_t)image->n_channels;
    for (int y = 0; y < image->height; y++) {
        const uint8_t *from = job->rows[y];
        float *to = image->data + (size_t)y * n_row;
        for (size_t i = 0; i < n_row; i++)
            to[i] = depth == 16 ? (float)(from[2 * i] << 8 | from[2 * i + 1]) / 65535
                                : (float)from[i] / 255;
    }
}

int image_read_png(struct image *out, const struct image_file *file)
{
    static const char *const names[5][4] = {
        [1] = { "Y" }, [2] = { "Y", "A" }, [3] = { "R", "G", "B" }, [4] = { "R", "G", "B", "A" }
    };
    struct png_job job = { .file = file };
    struct image image = { 0 };
    int err, n_channels = 0;
    *out = image;
    job.png = png_create_read_struct(PNG_LIBPNG_VER_STRING, &job, keep_error, drop_warning);
    job.info = job.png ? png_create_info_struct(job.png) : NULL;
    err = job.info ? read_header(&job, &n_channels) : -ENOMEM;
    if (err)
        goto broken;
    const png_uint_32 width = png_get_image_width(job.png, job.info);
    const png_uint_32 height = png_get_image_height(job.png, job.info);
    const int depth = png_get_bit_depth(job.png, job.info);
    err = image_check_size(file, width, height, n_channels, n_channels * (depth == 16 ? 2 : 1));
    if (!err)
        err = image_new_for(&image, file, (int)width, (int)height, n_channels, names[n_channels]);
    if (err)
        goto fail;
    const size_t row_bytes = png_get_rowbytes(job.png, job.info);
    job.pixels = calloc(height, row_bytes);
    job.rows = calloc(height, sizeof(*job.rows));
    if (!job.pixels || !job.rows) {
        err = -ENOMEM;
        goto broken;
    }
    for (png_uint_32 y = 0; y < height; y++)
        job.rows[y] = job.pixels + y * row_bytes;
    err = read_pixels(&job);
    if (err)
        goto broken;
    convert(&job, &image, depth);
    png_destroy_read_struct(&job.png, &job.info, NULL);
    free(job.rows);
    free(job.pixels);
    *out = image;
    return 0;
broken:
    log_error("image: %s: at byte %zu: %s", file->name, job.offset,
              job.message[0] ? job.message : "out of memory");
fail:
    png_destroy_read_struct(&job.png, &job.info, NULL);
    free(job.rows);
    free(job.pixels);
    image_free(&image);
    return err;
}
