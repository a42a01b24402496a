// rigd/calibrate.c - robust mean of lags, the delays that even them out, and how well one shot went.
#include "rigd/calibrate.h"
#include "solver/take/json.h"
#include "solver/take/log.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int compare_doubles(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double median(double *v, int n) // sorts v
{
    qsort(v, (size_t)n, sizeof(*v), compare_doubles);
    return n & 1 ? v[n / 2] : .5 * (v[n / 2 - 1] + v[n / 2]);
}

// What the normal distribution's quantile z is for Student's t with v degrees of freedom: Cornish and Fisher's series.
static double student_series(double z, double v)
{
    return z + (z * z * z + z) / (4 * v) + (5 * pow(z, 5) + 16 * pow(z, 3) + 3 * z) / (96 * v * v);
}

// Two-sided 95 % quantile of Student's t for n - 1 degrees of freedom; the series is within 1 % from 4 on, tabled below.
static double student(int n)
{
    static const double few[] = { 12.706, 4.303, 3.182, 2.776, 2.571 };
    return n - 1 <= 5 ? few[n - 2] : student_series(1.959964, n - 1);
}

int lag_estimate(struct lag *out, const double *lag_ms, int n)
{
    enum { REJECT_SIGMAS = 5 };
    const double least_sigma_ms = .05; // a body that always answers alike: do not reject its rounding
    *out = (struct lag){ 0 };
    if (n < 3)
        return -ENODATA;
    double *v = malloc((size_t)n * sizeof(*v));
    if (!v)
        return -ENOMEM;
    memcpy(v, lag_ms, (size_t)n * sizeof(*v));
    const double middle = median(v, n);
    for (int i = 0; i < n; i++)
        v[i] = fabs(lag_ms[i] - middle);
    const double sigma = fmax(1.4826 * median(v, n), least_sigma_ms); // of a normal distribution, from the median deviation
    double sum = 0, squares = 0;
    for (int i = 0; i < n; i++)
        if (fabs(lag_ms[i] - middle) <= REJECT_SIGMAS * sigma) {
            sum += lag_ms[i] - middle;
            out->n++;
        }
    const double mean = sum / out->n;
    for (int i = 0; i < n; i++)
        if (fabs(lag_ms[i] - middle) <= REJECT_SIGMAS * sigma)
            squares += (lag_ms[i] - middle - mean) * (lag_ms[i] - middle - mean);
    free(v);
    out->mean_ms = middle + mean;
    out->n_rejected = n - out->n;
    if (out->n > 1) {
        out->std_ms = sqrt(squares / (out->n - 1));
        out->error_ms = student(out->n) * out->std_ms / sqrt(out->n);
    }
    return 0;
}

int lag_more_shots(const struct lag *lag, int n_cameras, double within_ms, int most)
{
    enum { TELLING = 10 }; // fewer shots do not tell how much a body scatters
    int n_measured = 0, more = 0;
    for (int i = 0; i < n_cameras; i++)
        n_measured += lag[i].n > 0;
    if (!n_measured || !(within_ms > 0))
        return 0;
    double z = 0, above = 8; // two-sided, and one of all may be the one in a hundred
    for (int k = 0; k < 50; k++) {
        const double middle = .5 * (z + above);
        if (erfc(middle / sqrt(2)) > .01 / n_measured)
            z = middle;
        else
            above = middle;
    }
    for (int i = 0; i < n_cameras; i++) {
        if (!lag[i].n)
            continue;
        const double sigmas = lag[i].n < TELLING ? 0 : student_series(z, lag[i].n - 1);
        const double needed = fmax(TELLING, ceil(pow(sigmas * lag[i].std_ms / within_ms, 2)));
        if (needed > lag[i].n + more && needed <= lag[i].n + most)
            more = (int)needed - lag[i].n;
    }
    return more;
}

int lag_delays(const struct lag *lag, int n_cameras, uint32_t max_us, uint32_t *delay_us)
{
    double sum = 0, slowest = -INFINITY;
    int n = 0, n_clipped = 0;
    for (int i = 0; i < n_cameras; i++)
        if (lag[i].n) {
            sum += lag[i].mean_ms;
            slowest = fmax(slowest, lag[i].mean_ms);
            n++;
        }
    for (int i = 0; i < n_cameras; i++) {
        const double us = n ? 1000 * (slowest - (lag[i].n ? lag[i].mean_ms : sum / n)) : 0;
        n_clipped += us > max_us;
        delay_us[i] = us > max_us ? max_us : (uint32_t)(us + .5);
    }
    return n_clipped;
}

static int compare_times(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

void shot_timing(struct shot_timing *out, const int64_t *at_ns, int n_cameras, int64_t late_ns)
{
    int64_t v[CONFIG_CAMERAS_MAX];
    int n = 0;
    *out = (struct shot_timing){ 0 };
    for (int i = 0; i < n_cameras; i++)
        if (at_ns[i] != INT64_MIN)
            v[n++] = at_ns[i];
    out->n_measured = n;
    if (!n)
        return;
    qsort(v, (size_t)n, sizeof(*v), compare_times);
    const int64_t middle = v[n / 2];
    out->spread_ns = v[n - 1] - v[0];
    double sum = 0, squares = 0;
    for (int i = 0; i < n; i++)
        sum += (double)(v[i] - middle);
    for (int i = 0; i < n; i++)
        squares += pow((double)(v[i] - middle) - sum / n, 2);
    out->sigma_ns = n > 1 ? llround(sqrt(squares / (n - 1))) : 0;
    for (int i = 0; i < n_cameras; i++)
        if (at_ns[i] != INT64_MIN && llabs(at_ns[i] - middle) > late_ns) {
            out->late[i / 64] |= UINT64_C(1) << i % 64;
            out->n_late++;
        }
}

int lag_write(const char *path, const struct config *config, const char *const *serial, const struct lag *lag, const char *measured)
{
    struct json *doc = json_new_object(), *list = json_new_array();
    json_set_string(doc, "format", "studiorig lag 1");
    json_set_string(doc, "measured", measured);
    for (int i = 0; i < config->n_cameras; i++) {
        if (!lag[i].n)
            continue;
        struct json *o = json_new_object();
        json_set_string(o, "camera", config->camera[i].name);
        json_set_string(o, "serial", serial[i][0] ? serial[i] : config->camera[i].serial); // one that is off says none
        json_set_number(o, "mean_ms", lag[i].mean_ms);
        json_set_number(o, "std_ms", lag[i].std_ms);
        json_set_number(o, "error_ms", lag[i].error_ms);
        json_set_int(o, "n", lag[i].n);
        json_set_int(o, "n_rejected", lag[i].n_rejected);
        json_append(list, o);
    }
    json_set(doc, "lag", list);
    const int err = json_write(doc, path);
    json_free(doc);
    return err;
}

int lag_read(const char *path, const struct config *config, struct lag *lag)
{
    struct json *doc = NULL;
    char key[40];
    memset(lag, 0, (size_t)config->n_cameras * sizeof(*lag));
    if (access(path, F_OK))
        return -errno;
    const int err = json_read(&doc, path);
    if (err)
        return err;
    const int n = json_length(doc, "lag");
    for (int k = 0; k < n; k++) {
        const char *serial = "", *name = "";
        struct lag l = { 0 };
        int64_t n_used = 0, n_rejected = 0;
        snprintf(key, sizeof(key), "lag.%d", k);
        const struct json *o = json_get(doc, key);
        json_get_string(o, "serial", &serial);
        json_get_string(o, "camera", &name);
        if (json_get_number(o, "mean_ms", &l.mean_ms) || json_get_number(o, "std_ms", &l.std_ms) || json_get_number(o, "error_ms", &l.error_ms) ||
            json_get_int(o, "n", &n_used) || json_get_int(o, "n_rejected", &n_rejected) || n_used < 1 || n_used > 100000 || n_rejected < 0 ||
            n_rejected > 100000 || !(fabs(l.mean_ms) < 10000) || !(l.std_ms >= 0 && l.std_ms < 10000)) {
            log_error("calibrate: %s: lag.%d: found no lag in milliseconds with n; remove the file and run rigctl calibrate lag", path, k);
            memset(lag, 0, (size_t)config->n_cameras * sizeof(*lag));
            json_free(doc);
            return -EINVAL;
        }
        l.n = (int)n_used, l.n_rejected = (int)n_rejected;
        for (int i = 0; i < config->n_cameras; i++) { // the body, wherever it hangs now; by name where rigd.conf has no serial
            const char *wanted = config->camera[i].serial;
            if (wanted[0] ? !strcmp(wanted, serial) : !strcmp(config->camera[i].name, name))
                lag[i] = l;
        }
    }
    json_free(doc);
    return 0;
}
