// solver/export_materialx.c - model.mtlx: MaterialX 1.38, node disney_principled.
//
// Its inputs carry Burley's names, which are ours. Colour and maps are linear EXR; a constant map is a value.
#include "solver/export_format.h"
#include "solver/take/atomic_file.h"

#include <errno.h>
#include <locale.h>
#include <stdlib.h>

static void write_image(FILE *f, const char *name, const char *type, const char *file)
{
    fprintf(f,
            "  <image name=\"%s_map\" type=\"%s\">\n"
            "    <input name=\"file\" type=\"filename\" value=\"%s\" colorspace=\"%s\" />\n"
            "    <input name=\"uaddressmode\" type=\"string\" value=\"clamp\" />\n"
            "    <input name=\"vaddressmode\" type=\"string\" value=\"clamp\" />\n"
            "  </image>\n",
            name, type, file, type[0] == 'c' ? "lin_rec709" : "none");
}

static void write_document(FILE *f, const struct export_job *job)
{
    fputs("<?xml version=\"1.0\"?>\n<materialx version=\"1.38\" colorspace=\"lin_rec709\">\n", f);
    write_image(f, "baseColor", "color3", "albedo.exr");
    for (int p = 0; p < DISNEY_N; p++) {
        char file[64];
        snprintf(file, sizeof(file), "maps/%s.exr", disney_parameter_names[p]);
        if (!job->map[p].constant)
            write_image(f, disney_parameter_names[p], "float", file);
    }
    fputs("  <disney_principled name=\"studiorig_shader\" type=\"surfaceshader\">\n"
          "    <input name=\"baseColor\" type=\"color3\" nodename=\"baseColor_map\" />\n", f);
    for (int p = 0; p < DISNEY_N; p++) {
        const char *name = disney_parameter_names[p];
        if (job->map[p].constant)
            fprintf(f, "    <input name=\"%s\" type=\"float\" value=\"%.9g\" />\n", name, (double)job->map[p].value);
        else
            fprintf(f, "    <input name=\"%s\" type=\"float\" nodename=\"%s_map\" />\n", name, name);
    }
    fputs("  </disney_principled>\n"
          "  <surfacematerial name=\"studiorig\" type=\"material\">\n"
          "    <input name=\"surfaceshader\" type=\"surfaceshader\" nodename=\"studiorig_shader\" />\n"
          "  </surfacematerial>\n"
          "</materialx>\n", f);
}

int export_materialx(struct export_job *job)
{
    struct atomic_file f;
    char *path = export_path(job, "model.mtlx");
    int err = path ? atomic_file_open(&f, path) : -ENOMEM;
    free(path);
    if (err)
        return err;
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    if (!c_locale) {
        atomic_file_abandon(&f);
        return -ENOMEM;
    }
    const locale_t before = uselocale(c_locale); // a decimal point, whatever the user's language
    write_document(f.stream, job);
    uselocale(before);
    freelocale(c_locale);
    err = atomic_file_commit(&f);
    return err ? err : export_wrote(job, "model.mtlx");
}
