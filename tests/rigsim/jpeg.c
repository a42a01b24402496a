// tests/rigsim/jpeg.c - see jpeg.h. The one file here that knows libjpeg.
#include "tests/rigsim/jpeg.h"

#include <errno.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>

#include <jpeglib.h>

struct failure {
    struct jpeg_error_mgr manager;
    jmp_buf back;
};

static void give_up(j_common_ptr c)
{
    longjmp(((struct failure *)(void *)c->err)->back, 1);
}

int jpeg_encode(struct dataset *out, const uint8_t *rgb, int width, int height)
{
    struct jpeg_compress_struct c;
    struct failure failure;
    unsigned char *bytes = NULL;
    unsigned long n = 0;
    c.err = jpeg_std_error(&failure.manager);
    failure.manager.error_exit = give_up;
    if (setjmp(failure.back)) { // libjpeg fails only for want of memory here
        jpeg_destroy_compress(&c);
        free(bytes);
        return -ENOMEM;
    }
    jpeg_create_compress(&c);
    jpeg_mem_dest(&c, &bytes, &n);
    c.image_width = (JDIMENSION)width;
    c.image_height = (JDIMENSION)height;
    c.input_components = 3;
    c.in_color_space = JCS_RGB;
    jpeg_set_defaults(&c);
    jpeg_set_quality(&c, 85, TRUE);
    jpeg_start_compress(&c, TRUE);
    while (c.next_scanline < c.image_height) {
        JSAMPROW row = (JSAMPROW)(uintptr_t)(rgb + (size_t)c.next_scanline * (size_t)width * 3);
        jpeg_write_scanlines(&c, &row, 1);
    }
    jpeg_finish_compress(&c);
    jpeg_destroy_compress(&c);
    dataset_bytes(out, bytes, n);
    free(bytes);
    return out->failed ? -ENOMEM : 0;
}
