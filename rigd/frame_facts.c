// rigd/frame_facts.c - see frame_facts.h.
#include "rigd/frame_facts.h"

#include <errno.h>
#include <string.h>

#define SITES_MAX 4294967296.

static void set_counts(struct json *o, const char *key, const int64_t n[3])
{
    json_set_numbers(o, key, (const double[3]){ (double)n[0], (double)n[1], (double)n[2] }, 3);
}

struct json *frame_facts_json(const struct frame_facts *f)
{
    const struct bracket_statistics *s = &f->light;
    struct json *o = json_new_object();
    json_set_number(o, "exposure_s", s->exposure_s);
    json_set_number(o, "f_number", f->f_number);
    json_set_number(o, "iso", f->iso);
    json_set_string(o, "serial", f->serial);
    set_counts(o, "sites", s->n_sites);
    set_counts(o, "over", s->n_over);
    json_set_numbers(o, "brightest", s->brightest, 3);
    json_set_numbers(o, "first_percentile", s->first_percentile, 3);
    json_set_numbers(o, "median", s->median, 3);
    if (s->plateau_dn)
        json_set_int(o, "plateau_dn", s->plateau_dn);
    return o;
}

static bool get(const struct json *v, const char *key, double *out, int n, double least, double most)
{
    bool good = !json_get_numbers(v, key, out, n);
    for (int i = 0; good && i < n; i++)
        good = out[i] >= least && out[i] <= most; // NaN is not
    return good;
}

int frame_facts_from_json(struct frame_facts *out, const struct json *v)
{
    struct frame_facts f = { 0 };
    struct bracket_statistics *s = &f.light;
    const char *serial = "";
    double sites[3], over[3];
    int64_t plateau = 0;
    memset(out, 0, sizeof(*out));
    if (!v || json_get_string(v, "serial", &serial) || (json_get(v, "plateau_dn") && json_get_int(v, "plateau_dn", &plateau)))
        return -EINVAL;
    if (strlen(serial) >= sizeof(f.serial) || plateau < 0 || plateau > 65535 || !get(v, "exposure_s", &s->exposure_s, 1, 0, 1e5) ||
        !get(v, "f_number", &f.f_number, 1, 0, 1000) || !get(v, "iso", &f.iso, 1, 0, 1e8) || !get(v, "sites", sites, 3, 0, SITES_MAX) ||
        !get(v, "over", over, 3, 0, SITES_MAX) || !get(v, "brightest", s->brightest, 3, -10, 10) ||
        !get(v, "first_percentile", s->first_percentile, 3, -10, 10) || !get(v, "median", s->median, 3, -10, 10))
        return -EINVAL;
    memcpy(f.serial, serial, strlen(serial) + 1);
    for (int c = 0; c < 3; c++) {
        if (over[c] > sites[c])
            return -EINVAL;
        s->n_sites[c] = (int64_t)sites[c];
        s->n_over[c] = (int64_t)over[c];
    }
    s->plateau_dn = (int)plateau;
    *out = f;
    return 0;
}
