// solver/take/image_exr.c - OpenEXR in and out, through the C core library (which appears only
// here).
//
// The library parses headers, finds chunks and (de)compresses them; samples are placed and
// converted here, so that every index is checked by our own arithmetic and half <-> float is ours:
// nearest even, saturating.
#include "solver/take/atomic_file.h"
#include "solver/take/half.h"
#include "solver/take/image_formats.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <openexr.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

// The core library itself refuses larger sides: keeps its 32-bit arithmetic far from overflow. Ours
// are smaller (image.h).
enum { LIBRARY_MAX_SIDE_PX = 1 << 24 };

// ---- what both directions share -------------------------------------------------------------

struct stream {
    const struct image_file *file; // reading
    int fd;                        // writing
    int write_err;                 // -errno of the first write that failed
    char message[200];             // the library's first complaint
};

static void keep_message(exr_const_context_t context, exr_result_t code, const char *message)
{
    void *p = NULL;
    (void)code;
    if (!context || exr_get_user_data(context, &p) != EXR_ERR_SUCCESS || !p)
        return;
    struct stream *s = p;
    if (!s->message[0])
        snprintf(s->message, sizeof(s->message), "%s", message);
}

static int errno_of(exr_result_t code)
{
    return code == EXR_ERR_OUT_OF_MEMORY ? -ENOMEM : -EINVAL;
}

// ---- reading --------------------------------------------------------------------------------

struct reader {
    struct stream stream;
    exr_context_t context;
    struct image *image;
    exr_attr_box2i_t data_window, display_window;
    const exr_attr_chlist_t *channels;
    int target[IMAGE_MAX_CHANNELS]; // file's channel -> image's channel
    int64_t chunk_x, chunk_y;       // first pixel of the chunk in hand
};

static int64_t read_bytes(exr_const_context_t context, void *user, void *buffer, uint64_t n,
                          uint64_t offset, exr_stream_error_func_ptr_t complain)
{
    const struct stream *s = user;
    const uint64_t size = s->file->n_bytes;
    if (offset > size) {
        complain(context, EXR_ERR_READ_IO, "offset %llu lies beyond the end",
                 (unsigned long long)offset);
        return -1;
    }
    if (n > size - offset)
        n = size - offset;
    memcpy(buffer, s->file->bytes + offset, n);
    return (int64_t)n;
}

static int64_t count_bytes(exr_const_context_t context, void *user)
{
    (void)context;
    return (int64_t)((const struct stream *)user)->file->n_bytes;
}

static const char *unreadable_compression(exr_compression_t compression)
{
    switch (compression) {
    case EXR_COMPRESSION_B44:
        return "B44 (lossy)";
    case EXR_COMPRESSION_B44A:
        return "B44A (lossy)";
    case EXR_COMPRESSION_DWAA:
        return "DWAA (lossy)";
    case EXR_COMPRESSION_DWAB:
        return "DWAB (lossy)";
    default:
        return NULL;
    }
}

// Refuse by name what is not read.
static int check_kind(const struct reader *r)
{
    const char *name = r->stream.file->name;
    int n_parts = 0;
    exr_storage_t storage;
    exr_compression_t compression;
    if (exr_get_count(r->context, &n_parts) || exr_get_storage(r->context, 0, &storage) ||
        exr_get_compression(r->context, 0, &compression)) {
        log_error("image: %s: broken EXR header", name);
        return -EINVAL;
    }
    if (n_parts != 1) {
        log_error("image: %s: found %d parts, expected a single-part EXR; save the part you need "
                  "to its own file",
                  name, n_parts);
        return -ENOTSUP;
    }
    if (storage != EXR_STORAGE_SCANLINE && storage != EXR_STORAGE_TILED) {
        log_error(
            "image: %s: found deep pixels, expected a flat EXR; flatten it and re-save as ZIP",
            name);
        return -ENOTSUP;
    }
    const char *bad = unreadable_compression(compression);
    if (bad) {
        log_error("image: %s: %s compression is not read; re-save as ZIP", name, bad);
        return -ENOTSUP;
    }
    return 0;
}

static int check_channels(const struct reader *r, int *stored_bytes)
{
    const char *name = r->stream.file->name;
    *stored_bytes = 0;
    if (r->channels->num_channels < 1 || r->channels->num_channels > IMAGE_MAX_CHANNELS) {
        log_error("image: %s: found %d channels, expected 1 to %d", name, r->channels->num_channels,
                  IMAGE_MAX_CHANNELS);
        return r->channels->num_channels < 1 ? -EINVAL : -EFBIG;
    }
    for (int c = 0; c < r->channels->num_channels; c++) {
        const exr_attr_chlist_entry_t *channel = &r->channels->entries[c];
        if (channel->name.length < 1 || channel->name.length >= IMAGE_NAME_MAX) {
            log_error("image: %s: channel %d has a name of %d bytes, expected 1 to %d", name, c,
                      channel->name.length, IMAGE_NAME_MAX - 1);
            return -ENOTSUP;
        }
        if (channel->x_sampling != 1 || channel->y_sampling != 1) {
            log_error("image: %s: channel %s is subsampled (%d x %d), expected every channel at "
                      "full size; "
                      "re-save as RGB",
                      name, channel->name.str, channel->x_sampling, channel->y_sampling);
            return -ENOTSUP;
        }
        if (channel->pixel_type != EXR_PIXEL_HALF && channel->pixel_type != EXR_PIXEL_FLOAT &&
            channel->pixel_type != EXR_PIXEL_UINT) {
            log_error("image: %s: channel %s has unknown sample type %d", name, channel->name.str,
                      (int)channel->pixel_type);
            return -EINVAL;
        }
        *stored_bytes += channel->pixel_type == EXR_PIXEL_HALF ? 2 : 4;
    }
    return 0;
}

// R, G, B, A first, then the file's order.
static void order_channels(struct reader *r, const char *names[IMAGE_MAX_CHANNELS])
{
    static const char *const first[] = { "R", "G", "B", "A" };
    bool taken[IMAGE_MAX_CHANNELS] = { false };
    int n = 0;
    for (int i = 0; i < 4; i++)
        for (int c = 0; c < r->channels->num_channels; c++)
            if (!taken[c] && !strcmp(r->channels->entries[c].name.str, first[i])) {
                taken[c] = true;
                r->target[c] = n;
                names[n++] = r->channels->entries[c].name.str;
                break;
            }
    for (int c = 0; c < r->channels->num_channels; c++)
        if (!taken[c]) {
            r->target[c] = n;
            names[n++] = r->channels->entries[c].name.str;
        }
}

// Little-endian samples of one channel in one row.
static void convert_row(const uint8_t *from, exr_pixel_type_t type, float *to, int64_t n,
                        int stride)
{
    if (type == EXR_PIXEL_HALF) {
        for (int64_t i = 0; i < n; i++)
            to[i * stride] = float_from_half((uint16_t)(from[2 * i] | from[2 * i + 1] << 8));
        return;
    }
    for (int64_t i = 0; i < n; i++, from += 4) {
        union {
            uint32_t bits;
            float value;
        } f = { (uint32_t)from[0] | (uint32_t)from[1] << 8 | (uint32_t)from[2] << 16 |
                (uint32_t)from[3] << 24 };
        to[i * stride] = type == EXR_PIXEL_FLOAT ? f.value : (float)f.bits;
    }
}

// The pipeline's last step: decompressed rows, each channel after channel, into the image.
static exr_result_t place_chunk(exr_decode_pipeline_t *decode)
{
    const struct reader *r = decode->decoding_user_data;
    struct image *image = r->image;
    const int64_t width = decode->chunk.width, height = decode->chunk.height;
    const uint8_t *from = decode->unpacked_buffer;
    uint64_t pixel_bytes = 0;
    for (int c = 0; c < r->channels->num_channels; c++)
        pixel_bytes += r->channels->entries[c].pixel_type == EXR_PIXEL_HALF ? 2 : 4;
    if (!from && decode->chunk.packed_size == decode->chunk.unpacked_size)
        from = decode->packed_buffer; // stored without compression
    if (!from || width < 0 || height < 0 ||
        decode->chunk.unpacked_size != (uint64_t)width * (uint64_t)height * pixel_bytes)
        return EXR_ERR_CORRUPT_CHUNK;
    // In the display window; what falls outside is dropped.
    const int64_t x0 = r->chunk_x - r->display_window.min.x,
                  y0 = r->chunk_y - r->display_window.min.y;
    const int64_t skip = x0 < 0 ? (-x0 < width ? -x0 : width) : 0;
    int64_t n = x0 + width <= image->width ? width - skip : image->width - x0 - skip;
    if (n < 0)
        n = 0;
    for (int64_t row = 0; row < height; row++) {
        const int64_t y = y0 + row;
        for (int c = 0; c < r->channels->num_channels; c++) {
            const exr_pixel_type_t type = r->channels->entries[c].pixel_type;
            const int64_t sample_bytes = type == EXR_PIXEL_HALF ? 2 : 4;
            if (y >= 0 && y < image->height && n > 0)
                convert_row(from + skip * sample_bytes, type,
                            image->data + (y * image->width + x0 + skip) * image->n_channels +
                                r->target[c],
                            n, image->n_channels);
            from += width * sample_bytes;
        }
    }
    return EXR_ERR_SUCCESS;
}

static exr_result_t decode_chunk(struct reader *r, exr_decode_pipeline_t *decode, bool first,
                                 const exr_chunk_info_t *chunk)
{
    exr_result_t code = first ? exr_decoding_initialize(r->context, 0, chunk, decode)
                              : exr_decoding_update(r->context, 0, chunk, decode);
    if (code == EXR_ERR_SUCCESS && first)
        code = exr_decoding_choose_default_routines(r->context, 0, decode);
    if (code != EXR_ERR_SUCCESS)
        return code;
    decode->decoding_user_data = r;
    decode->unpack_and_convert_fn = place_chunk;
    return exr_decoding_run(r->context, 0, decode);
}

static int chunk_failed(const struct reader *r, const char *kind, int64_t x, int64_t y,
                        exr_result_t code)
{
    const char *why =
        r->stream.message[0] ? r->stream.message : exr_get_default_error_message(code);
    log_error("image: %s: %s at column %lld, row %lld: %s: the file is broken or cut short; copy "
              "or render it again",
              r->stream.file->name, kind, (long long)x, (long long)y, why);
    return errno_of(code);
}

static int read_scanlines(struct reader *r, exr_decode_pipeline_t *decode)
{
    int32_t step = 0;
    exr_result_t code = exr_get_scanlines_per_chunk(r->context, 0, &step);
    if (code != EXR_ERR_SUCCESS || step < 1)
        return chunk_failed(r, "lines", r->data_window.min.x, r->data_window.min.y, code);
    for (int64_t y = r->data_window.min.y; y <= r->data_window.max.y; y += step) {
        exr_chunk_info_t chunk;
        const int64_t expected =
            r->data_window.max.y - y + 1 < step ? r->data_window.max.y - y + 1 : step;
        code = exr_read_scanline_chunk_info(r->context, 0, (int)y, &chunk);
        if (code == EXR_ERR_SUCCESS &&
            (chunk.width != (int64_t)r->data_window.max.x - r->data_window.min.x + 1 ||
             chunk.height != expected))
            code = EXR_ERR_CORRUPT_CHUNK;
        r->chunk_x = r->data_window.min.x;
        r->chunk_y = y;
        if (code == EXR_ERR_SUCCESS)
            code = decode_chunk(r, decode, y == r->data_window.min.y, &chunk);
        if (code != EXR_ERR_SUCCESS)
            return chunk_failed(r, "lines", r->chunk_x, y, code);
    }
    return 0;
}

static int read_tiles(struct reader *r, exr_decode_pipeline_t *decode)
{
    int32_t tile_width = 0, tile_height = 0;
    const int64_t width = (int64_t)r->data_window.max.x - r->data_window.min.x + 1;
    const int64_t height = (int64_t)r->data_window.max.y - r->data_window.min.y + 1;
    exr_result_t code = exr_get_tile_sizes(r->context, 0, 0, 0, &tile_width, &tile_height);
    if (code != EXR_ERR_SUCCESS || tile_width < 1 || tile_height < 1)
        return chunk_failed(r, "tile", r->data_window.min.x, r->data_window.min.y, code);
    for (int64_t y = 0; y < height; y += tile_height)
        for (int64_t x = 0; x < width; x += tile_width) {
            exr_chunk_info_t chunk;
            const int64_t expected_width = width - x < tile_width ? width - x : tile_width;
            const int64_t expected_height = height - y < tile_height ? height - y : tile_height;
            code = exr_read_tile_chunk_info(r->context, 0, (int)(x / tile_width),
                                            (int)(y / tile_height), 0, 0, &chunk);
            if (code == EXR_ERR_SUCCESS &&
                (chunk.width != expected_width || chunk.height != expected_height))
                code = EXR_ERR_CORRUPT_CHUNK;
            r->chunk_x = r->data_window.min.x + x;
            r->chunk_y = r->data_window.min.y + y;
            if (code == EXR_ERR_SUCCESS)
                code = decode_chunk(r, decode, x == 0 && y == 0, &chunk);
            if (code != EXR_ERR_SUCCESS)
                return chunk_failed(r, "tile", r->chunk_x, r->chunk_y, code);
        }
    return 0;
}

int image_read_exr(struct image *out, const struct image_file *file)
{
    const char *names[IMAGE_MAX_CHANNELS];
    struct image image = { 0 };
    struct reader r = { .stream = { .file = file, .fd = -1 }, .image = &image };
    exr_decode_pipeline_t decode = EXR_DECODE_PIPELINE_INITIALIZER;
    exr_context_initializer_t settings = EXR_DEFAULT_CONTEXT_INITIALIZER;
    exr_storage_t storage;
    int stored_bytes, err;
    settings.error_handler_fn = keep_message;
    settings.user_data = &r.stream;
    settings.read_fn = read_bytes;
    settings.size_fn = count_bytes;
    settings.max_image_width = settings.max_image_height = LIBRARY_MAX_SIDE_PX;
    settings.max_tile_width = settings.max_tile_height = LIBRARY_MAX_SIDE_PX;
    settings.flags = EXR_CONTEXT_FLAG_DISABLE_CHUNK_RECONSTRUCTION;
    *out = (struct image){ 0 };

    exr_result_t code = exr_start_read(&r.context, file->name, &settings);
    if (code != EXR_ERR_SUCCESS) {
        r.context = NULL;
        log_error("image: %s: broken EXR header: %s; copy or render the file again", file->name,
                  r.stream.message[0] ? r.stream.message : exr_get_default_error_message(code));
        err = errno_of(code);
        goto fail;
    }
    err = check_kind(&r);
    if (err)
        goto fail;
    if (exr_get_storage(r.context, 0, &storage) ||
        exr_get_data_window(r.context, 0, &r.data_window) ||
        exr_get_display_window(r.context, 0, &r.display_window) ||
        exr_get_channels(r.context, 0, &r.channels)) {
        log_error("image: %s: broken EXR header: windows or channels are missing", file->name);
        err = -EINVAL;
        goto fail;
    }
    err = check_channels(&r, &stored_bytes);
    if (err)
        goto fail;
    const exr_attr_box2i_t *data = &r.data_window, *display = &r.display_window;
    err = image_check_size(file, (int64_t)data->max.x - data->min.x + 1,
                           (int64_t)data->max.y - data->min.y + 1, r.channels->num_channels,
                           stored_bytes);
    if (!err)
        err = image_check_size(file, (int64_t)display->max.x - display->min.x + 1,
                               (int64_t)display->max.y - display->min.y + 1,
                               r.channels->num_channels, stored_bytes);
    if (err)
        goto fail;
    order_channels(&r, names);
    err = image_new_for(&image, file, (int)((int64_t)display->max.x - display->min.x + 1),
                        (int)((int64_t)display->max.y - display->min.y + 1),
                        r.channels->num_channels, names);
    if (err)
        goto fail;
    err = storage == EXR_STORAGE_TILED ? read_tiles(&r, &decode) : read_scanlines(&r, &decode);
    if (err)
        goto fail;
    exr_decoding_destroy(r.context, &decode);
    exr_finish(&r.context);
    *out = image;
    return 0;
fail:
    if (r.context) {
        exr_decoding_destroy(r.context, &decode);
        exr_finish(&r.context);
    }
    image_free(&image);
    return err;
}

// ---- writing --------------------------------------------------------------------------------

static int64_t write_bytes(exr_const_context_t context, void *user, const void *buffer, uint64_t n,
                           uint64_t offset, exr_stream_error_func_ptr_t complain)
{
    struct stream *s = user;
    (void)context, (void)complain;
    for (uint64_t done = 0; done < n;) {
        const ssize_t got =
            pwrite(s->fd, (const char *)buffer + done, n - done, (off_t)(offset + done));
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0) {
            if (!s->write_err)
                s->write_err = got < 0 ? -errno : -EIO;
            return -1;
        }
        done += (uint64_t)got;
    }
    return (int64_t)n;
}

static int refuse_nan(const struct image_rows *image, const char *path, int y, const float *row)
{
    for (int64_t i = 0; i < (int64_t)image->width * image->n_channels; i++)
        if (isnan(row[i])) {
            log_error("image: %s not written: channel %s is NaN at column %d, row %d", path, image->names[i % image->n_channels], (int)(i / image->n_channels), y);
            return -EDOM;
        }
    return 0;
}

// EXR wants channels in the order of their names: order[i] is the image's channel of the file's
// i-th.
static int sort_channels(const struct image_rows *image, const char *path, int order[IMAGE_MAX_CHANNELS])
{
    for (int c = 0; c < image->n_channels; c++) {
        int i = c;
        for (; i > 0 && strcmp(image->names[order[i - 1]], image->names[c]) > 0; i--)
            order[i] = order[i - 1];
        order[i] = c;
        if (i > 0 && !strcmp(image->names[order[i - 1]], image->names[c])) {
            log_error("image: %s not written: two channels are named %s", path, image->names[c]);
            return -EINVAL;
        }
    }
    return 0;
}

static exr_result_t write_notes(exr_context_t context, int part, const struct image_note *notes, int n_notes)
{
    exr_result_t code = EXR_ERR_SUCCESS;
    for (int i = 0; i < n_notes && code == EXR_ERR_SUCCESS; i++)
        code = notes[i].text ? exr_attr_set_string(context, part, notes[i].name, notes[i].text)
                             : exr_attr_set_float(context, part, notes[i].name, (float)notes[i].number);
    return code;
}

static exr_result_t write_header(exr_context_t context, const struct image_rows *image, const int order[IMAGE_MAX_CHANNELS],
                                 enum image_type type, enum image_compression compression, const struct image_note *notes, int n_notes)
{
    static const exr_compression_t method[] = { [IMAGE_ZIP] = EXR_COMPRESSION_ZIP, [IMAGE_PIZ] = EXR_COMPRESSION_PIZ, [IMAGE_STORED] = EXR_COMPRESSION_NONE };
    int part = 0;
    exr_result_t code = exr_set_longname_support(context, 1);
    if (code == EXR_ERR_SUCCESS)
        code = exr_add_part(context, NULL, EXR_STORAGE_SCANLINE, &part);
    if (code == EXR_ERR_SUCCESS)
        code = exr_initialize_required_attr_simple(context, part, image->width, image->height, method[compression]);
    for (int i = 0; i < image->n_channels && code == EXR_ERR_SUCCESS; i++)
        code = exr_add_channel(context, part, image->names[order[i]],
                               type == IMAGE_HALF ? EXR_PIXEL_HALF : EXR_PIXEL_FLOAT,
                               EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1);
    if (code == EXR_ERR_SUCCESS)
        code = write_notes(context, part, notes, n_notes);
    return code == EXR_ERR_SUCCESS ? exr_write_header(context) : code;
}

// A chunk's rows, asked for in order: as floats in from, as halves in half (NULL: not wanted).
struct row_buffer {
    float *from;
    uint16_t *half;
    int err; // -errno of who makes the rows
};

static exr_result_t write_lines(exr_context_t context, const struct image_rows *image, const char *path, const int order[IMAGE_MAX_CHANNELS],
                                int step, exr_encode_pipeline_t *encode, struct row_buffer *buffer)
{
    const size_t n_row = (size_t)image->width * (size_t)image->n_channels;
    const int sample_bytes = buffer->half ? 2 : 4;
    for (int y = 0; y < image->height; y += step) {
        exr_chunk_info_t chunk;
        const int n_lines = image->height - y < step ? image->height - y : step;
        for (int i = 0; i < n_lines && !buffer->err; i++) {
            buffer->err = image->row(image->arg, y + i, buffer->from + (size_t)i * n_row);
            if (!buffer->err)
                buffer->err = refuse_nan(image, path, y + i, buffer->from + (size_t)i * n_row);
        }
        if (buffer->err)
            return EXR_ERR_INVALID_ARGUMENT;
        exr_result_t code = exr_write_scanline_chunk_info(context, 0, y, &chunk);
        if (code == EXR_ERR_SUCCESS)
            code = y == 0 ? exr_encoding_initialize(context, 0, &chunk, encode)
                          : exr_encoding_update(context, 0, &chunk, encode);
        if (code != EXR_ERR_SUCCESS)
            return code;
        for (size_t i = 0; buffer->half && i < (size_t)n_lines * n_row; i++)
            buffer->half[i] = half_from_float(buffer->from[i]);
        const uint8_t *bytes = buffer->half ? (const uint8_t *)buffer->half : (const uint8_t *)buffer->from;
        for (int i = 0; i < image->n_channels; i++) {
            exr_coding_channel_info_t *channel = &encode->channels[i];
            channel->user_data_type = buffer->half ? EXR_PIXEL_HALF : EXR_PIXEL_FLOAT;
            channel->user_bytes_per_element = (int16_t)sample_bytes;
            channel->user_pixel_stride = image->n_channels * sample_bytes;
            channel->user_line_stride = (int32_t)n_row * sample_bytes;
            channel->encode_from_ptr = bytes + order[i] * sample_bytes;
        }
        if (y == 0)
            code = exr_encoding_choose_default_routines(context, 0, encode);
        if (code == EXR_ERR_SUCCESS)
            code = exr_encoding_run(context, 0, encode);
        if (code != EXR_ERR_SUCCESS)
            return code;
    }
    return EXR_ERR_SUCCESS;
}

int image_write_exr_rows(const struct image_rows *image, const struct image_note *notes, int n_notes, const char *path,
                         enum image_type type, enum image_compression compression)
{
    struct atomic_file f = { 0 };
    struct stream stream = { .fd = -1 };
    struct row_buffer buffer = { 0 };
    exr_context_t context = NULL;
    exr_encode_pipeline_t encode = EXR_ENCODE_PIPELINE_INITIALIZER;
    exr_context_initializer_t settings = EXR_DEFAULT_CONTEXT_INITIALIZER;
    int32_t step = 0;
    int order[IMAGE_MAX_CHANNELS];
    int err = sort_channels(image, path, order);
    if (!err)
        err = atomic_file_open(&f, path);
    if (err)
        return err;
    stream.fd = fileno(f.stream);
    settings.error_handler_fn = keep_message;
    settings.user_data = &stream;
    settings.write_fn = write_bytes;

    exr_result_t code = exr_start_write(&context, path, EXR_WRITE_FILE_DIRECTLY, &settings);
    if (code == EXR_ERR_SUCCESS)
        code = write_header(context, image, order, type, compression, notes, n_notes);
    if (code == EXR_ERR_SUCCESS)
        code = exr_get_scanlines_per_chunk(context, 0, &step);
    if (code == EXR_ERR_SUCCESS) {
        const size_t n = (size_t)step * (size_t)image->width * (size_t)image->n_channels;
        buffer.from = malloc(n * sizeof(buffer.from[0]));
        buffer.half = type == IMAGE_HALF ? malloc(n * sizeof(buffer.half[0])) : NULL;
        if (!buffer.from || (type == IMAGE_HALF && !buffer.half))
            code = EXR_ERR_OUT_OF_MEMORY;
    }
    if (code == EXR_ERR_SUCCESS)
        code = write_lines(context, image, path, order, step, &encode, &buffer);
    free(buffer.from);
    free(buffer.half);
    if (context) {
        exr_encoding_destroy(context, &encode);
        const exr_result_t finish_code = exr_finish(&context); // writes the table of chunks
        if (code == EXR_ERR_SUCCESS)
            code = finish_code;
    }
    if (buffer.err) { // said where it happened
        atomic_file_abandon(&f);
        return buffer.err;
    }
    if (code != EXR_ERR_SUCCESS || stream.write_err) {
        err = stream.write_err ? stream.write_err : errno_of(code);
        log_error("image: cannot write %s: %s", path,
                  stream.write_err    ? strerror(-stream.write_err)
                  : stream.message[0] ? stream.message
                                      : exr_get_default_error_message(code));
        atomic_file_abandon(&f);
        return err;
    }
    return atomic_file_commit(&f);
}

static int row_of_image(void *arg, int y, float *row)
{
    const struct image *image = arg;
    const size_t n_row = (size_t)image->width * (size_t)image->n_channels;
    memcpy(row, image->data + (size_t)y * n_row, n_row * sizeof(row[0]));
    return 0;
}

int image_write_exr(const struct image *image, const char *path, enum image_type type, enum image_compression compression)
{
    return image_write_exr_noted(image, NULL, 0, path, type, compression);
}

int image_write_exr_noted(const struct image *image, const struct image_note *notes, int n_notes, const char *path, enum image_type type,
                          enum image_compression compression)
{
    const char *names[IMAGE_MAX_CHANNELS];
    for (int c = 0; c < image->n_channels; c++)
        names[c] = image->names[c];
    return image_write_exr_rows(&(struct image_rows){ image->width, image->height, image->n_channels, names, row_of_image, (void *)(uintptr_t)image },
                                notes, n_notes, path, type, compression);
}

// ---- notes ----------------------------------------------------------------------------------

// The table of chunks says where each lies; the last one's bytes are there if the file was not cut.
static int check_last_chunk(exr_context_t context)
{
    exr_attr_box2i_t window;
    exr_chunk_info_t chunk;
    exr_storage_t storage;
    int32_t step = 0;
    if (exr_get_storage(context, 0, &storage) || storage != EXR_STORAGE_SCANLINE || exr_get_data_window(context, 0, &window) ||
        exr_get_scanlines_per_chunk(context, 0, &step) || step < 1 || window.max.y < window.min.y)
        return -EINVAL;
    const int64_t last = window.min.y + ((int64_t)window.max.y - window.min.y) / step * step;
    exr_result_t code = exr_read_scanline_chunk_info(context, 0, (int)last, &chunk);
    char *packed = code == EXR_ERR_SUCCESS && chunk.packed_size < (uint64_t)1 << 30 ? malloc(chunk.packed_size ? chunk.packed_size : 1) : NULL;
    if (packed)
        code = exr_read_chunk(context, 0, &chunk, packed);
    else
        code = code == EXR_ERR_SUCCESS ? EXR_ERR_CORRUPT_CHUNK : code;
    free(packed);
    return code == EXR_ERR_SUCCESS ? 0 : -EINVAL;
}

static void ignore_message(exr_const_context_t context, exr_result_t code, const char *message)
{
    (void)context, (void)code, (void)message;
}

int image_read_note(const char *path, const char *name, char *text, size_t room)
{
    exr_context_t context = NULL;
    exr_context_initializer_t settings = EXR_DEFAULT_CONTEXT_INITIALIZER;
    int32_t n = 0;
    const char *found = NULL;
    text[0] = 0;
    if (access(path, R_OK))
        return -errno;
    settings.error_handler_fn = ignore_message;
    settings.flags = EXR_CONTEXT_FLAG_DISABLE_CHUNK_RECONSTRUCTION;
    settings.max_image_width = LIBRARY_MAX_SIDE_PX;
    settings.max_image_height = LIBRARY_MAX_SIDE_PX;
    int err = exr_start_read(&context, path, &settings) == EXR_ERR_SUCCESS ? check_last_chunk(context) : -EINVAL;
    if (!err && exr_attr_get_string(context, 0, name, &n, &found) != EXR_ERR_SUCCESS)
        err = -ENODATA;
    if (!err && (n < 0 || (size_t)n >= room))
        err = -EFBIG;
    if (!err) {
        memcpy(text, found, (size_t)n);
        text[n] = 0;
    }
    if (context)
        exr_finish(&context);
    return err;
}
