// solver/take/image_jpeg.c - JPEG in: 8-bit textures, never views (libjpeg appears only here).
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
// after stdio.h, which it needs
#include <jpeglib.h>

struct jpeg_failure {
    struct jpeg_error_mgr manager; // first: libjpeg hands back a pointer to it
    char message[JMSG_LENGTH_MAX];
    jmp_buf leave;
};

static void keep_and_leave(j_common_ptr jpeg)
{
    struct jpeg_failure *f = (struct jpeg_failure *)jpeg->err;
    f->manager.format_message(jpeg, f->message);
    longjmp(f->leave, 1);
}

static void say_nothing(j_common_ptr jpeg)
{
    (void)jpeg;
}

int image_read_jpeg(struct image *out, const struct image_file *file)
{
    struct jpeg_decompress_struct jpeg = { 0 };
    struct jpeg_failure failure = { .message = "" };
    uint8_t *volatile row = NULL; // volatile: alive across longjmp
    struct image *volatile image = out;
    jpeg.err = jpeg_std_error(&failure.manager);
    failure.manager.error_exit = keep_and_leave;
    failure.manager.output_message = say_nothing;
    if (setjmp(failure.leave)) {
        log_error("image: %s: %s; is the file whole? Write the JPEG again", file->name, failure.message);
        jpeg_destroy_decompress(&jpeg);
        free(row);
        image_free(image);
        return -EINVAL;
    }
    jpeg_create_decompress(&jpeg);
    jpeg_mem_src(&jpeg, file->bytes, file->n_bytes);
    jpeg_read_header(&jpeg, TRUE);
    jpeg.out_color_space = jpeg.num_components == 1 ? JCS_GRAYSCALE : JCS_RGB;
    const int n_channels = jpeg.num_components == 1 ? 1 : 3;
    int err = 0;
    if (jpeg.num_components != 1 && jpeg.num_components != 3) {
        log_error("image: %s: a JPEG of %d components; expected 1 or 3: save it as RGB", file->name, jpeg.num_components);
        err = -ENOTSUP;
    }
    if (!err)
        err = image_check_size(file, jpeg.image_width, jpeg.image_height, n_channels, n_channels);
    if (!err)
        err = image_new_for(image, file, (int)jpeg.image_width, (int)jpeg.image_height, n_channels, NULL);
    if (!err && !(row = malloc((size_t)image->width * (size_t)n_channels))) {
        log_error("image: %s: out of memory", file->name);
        err = -ENOMEM;
    }
    if (!err) {
        jpeg_start_decompress(&jpeg);
        while (jpeg.output_scanline < jpeg.output_height) {
            const size_t n = (size_t)image->width * (size_t)n_channels;
            float *to = image->data + jpeg.output_scanline * n;
            jpeg_read_scanlines(&jpeg, (JSAMPARRAY)&row, 1);
            for (size_t i = 0; i < n; i++)
                to[i] = (float)row[i] / 255;
        }
        jpeg_finish_decompress(&jpeg);
        if (jpeg.err->num_warnings) { // what is cut off, libjpeg fills up with grey
            log_error("image: %s: the JPEG is damaged or cut off; write it again", file->name);
            err = -EINVAL;
        }
    }
    if (err)
        image_free(image);
    jpeg_destroy_decompress(&jpeg);
    free(row);
    return err;
}
