// solver/compare.c - RMSE and PSNR of two pictures as the paper reports them, over the pixels of a
// mask.
#include "solver/compare.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <string.h>

static double clip(double v)
{
    return v < 0 ? 0 : v > 1 ? 1 : v;
}

static double psnr_db(double rmse_percent)
{
    return -20 * log10(rmse_percent / 100); // infinite for 0
}

static int find_rgb(int at[3], const struct image *image, const char *which)
{
    static const char *const names[3] = {"R", "G", "B"};
    for (int c = 0; c < 3; c++) {
        at[c] = image_channel(image, names[c]);
        if (at[c] >= 0)
            continue;
        log_error("compare: the %s picture has no channel %s: expected R, G and B", which,
                  names[c]);
        return -EINVAL;
    }
    return 0;
}

static int require_size(const struct image *image, const struct image *expected, const char *which)
{
    if (image->width == expected->width && image->height == expected->height)
        return 0;
    log_error("compare: the %s is %dx%d, the first picture %dx%d: expected one size", which,
              image->width, image->height, expected->width, expected->height);
    return -EINVAL;
}

int compare_images(struct comparison *out, const struct image *a, const struct image *b,
                   const struct image *mask)
{
    int at_a[3], at_b[3];
    memset(out, 0, sizeof(*out));
    if (find_rgb(at_a, a, "first") || find_rgb(at_b, b, "second") ||
        require_size(b, a, "second picture") || (mask && require_size(mask, a, "mask")))
        return -EINVAL;
    struct comparison result = {0};
    int64_t n_clipped = 0;
    double clipped = 0, unclipped = 0; // sums of squares
    for (int y = 0; y < a->height; y++) {
        double row_clipped = 0, row_unclipped = 0;
        for (int x = 0; x < a->width; x++) {
            const int64_t i = (int64_t)y * a->width + x;
            if (mask && !(mask->data[i * mask->n_channels] > .5f))
                continue;
            bool over = false;
            for (int c = 0; c < 3; c++) {
                const double va = a->data[i * a->n_channels + at_a[c]];
                const double vb = b->data[i * b->n_channels + at_b[c]];
                if (!isfinite(va) || !isfinite(vb)) {
                    log_error(
                        "compare: column %d, row %d of the %s picture is not finite (channel %c)",
                        x, y, isfinite(va) ? "second" : "first", "RGB"[c]);
                    return -EDOM;
                }
                const double d = va - vb, d_clipped = clip(va) - clip(vb);
                row_clipped += d_clipped * d_clipped;
                row_unclipped += d * d;
                result.max_abs = fmax(result.max_abs, fabs(d));
                over = over || va > 1 || vb > 1;
            }
            n_clipped += over;
            result.n_pixels++;
        }
        clipped += row_clipped;
        unclipped += row_unclipped;
    }
    if (!result.n_pixels) {
        log_error("compare: the mask leaves no pixel to compare: expected a first channel above .5 "
                  "somewhere");
        return -EDOM;
    }
    const double n = (double)result.n_pixels;
    result.rmse_percent = 100 * sqrt(clipped / n / 3);
    result.rmse_unclipped = sqrt(unclipped / n / 3);
    result.psnr_db = psnr_db(result.rmse_percent);
    result.clipped_percent = 100 * (double)n_clipped / n;
    *out = result;
    return 0;
}

// Root of the mean of squares, weighted by pixels.
static double pool(double x, double n_x, double y, double n_y)
{
    return sqrt((x * x * n_x + y * y * n_y) / (n_x + n_y));
}

void compare_add(struct comparison *total, const struct comparison *one)
{
    const double n_total = (double)total->n_pixels, n_one = (double)one->n_pixels;
    if (!one->n_pixels)
        return;
    total->rmse_percent = pool(total->rmse_percent, n_total, one->rmse_percent, n_one);
    total->rmse_unclipped = pool(total->rmse_unclipped, n_total, one->rmse_unclipped, n_one);
    total->psnr_db = psnr_db(total->rmse_percent);
    total->max_abs = fmax(total->max_abs, one->max_abs);
    total->clipped_percent =
        (total->clipped_percent * n_total + one->clipped_percent * n_one) / (n_total + n_one);
    total->n_pixels += one->n_pixels;
}
