// tests/rig_files.h - writes cameras as each photogrammetry tool does, from the formats' descriptions: the other half of round trips.
#pragma once
#include "solver/cameras.h"
#include "solver/vec3.h"

#include <stdio.h>
#include <string.h>

// ---- Metashape ----------------------------------------------------------------------------------------------------------

struct rig_transform { // world = scale rotation chunk + translation
    double scale, rotation[9], translation[3];
};

static inline void put_numbers(FILE *f, const double *v, int n)
{
    for (int i = 0; i < n; i++)
        fprintf(f, "%s%.17g", i ? " " : "", v[i]);
}

// Every view a sensor of its own, every second one in a group in a group. s NULL: without a component.
static inline void put_metashape(FILE *f, const struct cameras *c, const struct rig_transform *s)
{
    fprintf(f, "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<document version=\"2.0.0\">\n <chunk label=\"Chunk 1\" enabled=\"true\">\n"
               "  <sensors next_id=\"%d\">\n", c->n);
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        const char *type = v->model == CAMERA_FISHEYE ? "fisheye" : "frame";
        fprintf(f, "   <sensor id=\"%d\" label=\"unknown\" type=\"%s\"><resolution width=\"%d\" height=\"%d\"/>\n"
                   "    <calibration type=\"%s\" class=\"initial\"><f>1</f></calibration>\n"
                   "    <calibration type=\"%s\" class=\"adjusted\"><resolution width=\"%d\" height=\"%d\"/><f>%.17g</f>"
                   "<cx>%.17g</cx><cy>%.17g</cy>", i, type, v->width_px, v->height_px, type, type, v->width_px, v->height_px, v->fy,
                v->cx - .5 * v->width_px, v->cy - .5 * v->height_px);
        const struct {
            const char *tag;
            double value;
        } tags[] = { { "b1", v->fx - v->fy }, { "b2", v->skew }, { "k1", v->k[0] }, { "k2", v->k[1] }, { "k3", v->k[2] },
                     { "k4", v->k[3] }, { "p1", v->p[1] }, { "p2", v->p[0] }, { "p3", v->p[2] }, { "p4", v->p[3] } };
        for (size_t k = 0; k < sizeof(tags) / sizeof(tags[0]); k++)
            if (tags[k].value != 0)
                fprintf(f, "<%s>%.17g</%s>", tags[k].tag, tags[k].value, tags[k].tag);
        fprintf(f, "</calibration>\n   </sensor>\n");
    }
    fprintf(f, "  </sensors>\n");
    if (s) {
        fprintf(f, "  <components next_id=\"1\" active_id=\"0\"><component id=\"0\"><transform><rotation locked=\"true\">");
        put_numbers(f, s->rotation, 9);
        fprintf(f, "</rotation><translation>");
        put_numbers(f, s->translation, 3);
        fprintf(f, "</translation><scale>%.17g</scale></transform></component></components>\n", s->scale);
    }
    fprintf(f, "  <cameras next_id=\"%d\">\n", c->n + 1);
    fprintf(f, "   <camera id=\"9999\" sensor_id=\"0\" label=\"not aligned\"/>\n");
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        double R[9], centre[3] = { v->centre_m[0], v->centre_m[1], v->centre_m[2] }, m[16] = { [15] = 1 };
        for (int k = 0; k < 9; k++)
            R[k] = v->cam_from_world[3 * (k % 3) + k / 3];
        if (s) {
            double inverse[9];
            for (int k = 0; k < 9; k++)
                inverse[k] = s->rotation[3 * (k % 3) + k / 3];
            mat3_mul(R, inverse, R);
            vec3_sub(centre, centre, s->translation);
            mat3_mul_vec(centre, inverse, centre);
            for (int k = 0; k < 3; k++)
                centre[k] /= s->scale;
        }
        for (int k = 0; k < 3; k++) {
            memcpy(m + 4 * k, R + 3 * k, 3 * sizeof(*R));
            m[4 * k + 3] = centre[k];
        }
        fprintf(f, "%s   <camera id=\"%d\" sensor_id=\"%d\"%s label=\"C:\\photos\\%s.JPG\"><transform>",
                i & 1 ? "   <group id=\"0\" label=\"a\" type=\"folder\"><group id=\"1\" label=\"b\">\n" : "", i, i,
                s ? " component_id=\"0\"" : "", v->name);
        put_numbers(f, m, 16);
        fprintf(f, "</transform><orientation>1</orientation></camera>\n%s", i & 1 ? "   </group></group>\n" : "");
    }
    fprintf(f, "  </cameras>\n </chunk>\n</document>\n");
}

// ---- RealityCapture -----------------------------------------------------------------------------------------------------

static inline const char *xmp_model(const struct camera *v)
{
    const bool tangential = v->p[0] != 0 || v->p[1] != 0;
    if (v->k[3] != 0)
        return tangential ? "brown4t2" : "brown4";
    if (tangential)
        return "brown3t2";
    return v->k[0] != 0 || v->k[1] != 0 || v->k[2] != 0 ? "brown3" : "perspective";
}

// Fields as attributes, or those that have many numbers as elements: both occur.
static inline void put_xmp(FILE *f, const struct camera *v, bool as_elements)
{
    const double longer = v->width_px > v->height_px ? v->width_px : v->height_px;
    const double d[6] = { v->k[0], v->k[1], v->k[2], v->k[3], v->p[1], v->p[0] };
    fprintf(f, "<x:xmpmeta xmlns:x=\"adobe:ns:meta/\">\n <rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">\n"
               "  <rdf:Description xcr:Version=\"3\" xcr:PosePrior=\"exact\" xcr:Coordinates=\"absolute\" xcr:DistortionModel=\"%s\" "
               "xcr:FocalLength35mm=\"%.17g\" xcr:Skew=\"0\" xcr:AspectRatio=\"1\" xcr:PrincipalPointU=\"%.17g\" "
               "xcr:PrincipalPointV=\"%.17g\" xcr:CalibrationPrior=\"exact\" xcr:InTexturing=\"1\" xcr:InMeshing=\"1\" "
               "xmlns:xcr=\"http://www.capturingreality.com/ns/xcr/1.1#\"", xmp_model(v), v->fx * 36 / longer,
            (v->cx - .5 * v->width_px) / longer, (v->cy - .5 * v->height_px) / longer);
    const struct {
        const char *tag;
        const double *values;
        int n;
    } fields[3] = { { "Rotation", v->cam_from_world, 9 }, { "Position", v->centre_m, 3 }, { "DistortionCoeficients", d, 6 } };
    if (as_elements)
        fprintf(f, ">\n");
    for (int i = 0; i < 3; i++) {
        fprintf(f, as_elements ? "   <xcr:%s>" : " xcr:%s=\"", fields[i].tag);
        put_numbers(f, fields[i].values, fields[i].n);
        if (as_elements)
            fprintf(f, "</xcr:%s>\n", fields[i].tag);
        else
            fprintf(f, "\"");
    }
    fprintf(f, as_elements ? "  </rdf:Description>\n" : "/>\n");
    fprintf(f, " </rdf:RDF>\n</x:xmpmeta>\n");
}

static inline void put_realitycapture_csv(FILE *f, const struct cameras *c, bool newer)
{
    fprintf(f, newer ? "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2\n"
                     : "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n");
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        const double longer = v->width_px > v->height_px ? v->width_px : v->height_px, degrees = 180 / M_PI;
        double R[9]; // camera (y up, looking along -z) to world
        for (int k = 0; k < 9; k++)
            R[k] = (k % 3 ? -1 : 1) * v->cam_from_world[3 * (k % 3) + k / 3];
        const double row[] = { v->centre_m[0], v->centre_m[1], v->centre_m[2], degrees * atan2(R[1], R[4]),
                               degrees * asin(R[7]), degrees * atan2(-R[6], R[8]), v->fx * 36 / longer,
                               (v->cx - .5 * v->width_px) / longer, (v->cy - .5 * v->height_px) / longer, v->k[0], v->k[1],
                               v->k[2], v->k[3], v->p[1], v->p[0] };
        fprintf(f, "%s.jpg", v->name);
        for (size_t k = 0; k < sizeof(row) / sizeof(row[0]); k++)
            fprintf(f, ",%.17g", row[k]);
        fprintf(f, "\n");
    }
}

// ---- Meshroom -----------------------------------------------------------------------------------------------------------

// version: 10000 a + 100 b + c. distortion: today's name; radialk3pt for a camera of three radial terms. 36 mm sensors.
static inline void put_meshroom(FILE *f, const struct cameras *c, int version, const char *const *distortion)
{
    fprintf(f, "{\n \"version\": [\"%d\", \"%d\", \"%d\"],\n \"featuresFolders\": [\"/a\"],\n \"views\": [\n", version / 10000,
            version / 100 % 100, version % 100);
    for (int i = 0; i < c->n; i++)
        fprintf(f, "  {\"viewId\": \"%d\", \"poseId\": \"%u\", \"intrinsicId\": \"%u\", \"path\": \"/photos/%s.JPG\", \"width\": \"%d\", "
                   "\"height\": \"%d\", \"metadata\": {\"Make\": \"x.y\"}},\n", 100 + i, 4000000000u + (unsigned)i, 3000000000u + (unsigned)i,
                c->view[i].name, c->view[i].width_px, c->view[i].height_px);
    fprintf(f, "  {\"viewId\": \"7\", \"path\": \"/photos/unplaced.JPG\", \"poseId\": \"7\", \"intrinsicId\": \"7\"}\n ],\n \"intrinsics\": [\n");
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        const char *d = distortion[i];
        const bool pt = !strcmp(d, "radialk3pt"), fisheye = v->model == CAMERA_FISHEYE, equidistant = fisheye && strcmp(d, "fisheye");
        // An equidistant camera's radii are in units of half the field of view that the shorter side has at this focal length;
        // radialk3pt divides by the factor at radius 1, which the focal length must make good.
        const double shorter = v->width_px < v->height_px ? v->width_px : v->height_px;
        double unit = 1, at_one = 1;
        for (int k = 0; k < 50; k++) {
            unit = equidistant ? 2 * v->fx * at_one / shorter : 1;
            at_one = pt ? 1 + v->k[0] / pow(unit, 2) + v->k[1] / pow(unit, 4) + v->k[2] / pow(unit, 6) : 1;
        }
        const double fx = v->fx * at_one, fy = v->fy * at_one;
        const double centre[2] = { v->cx - (version >= 10201 ? .5 * v->width_px : 0), v->cy - (version >= 10201 ? .5 * v->height_px : 0) };
        const double mm = 36. / v->width_px;
        const char *old_type = !strcmp(d, "radialk1") ? "radial1" : !strcmp(d, "radialk3") ? "radial3" : !strcmp(d, "none") ? "pinhole" : d;
        fprintf(f, "  {\"intrinsicId\": \"%u\", \"width\": \"%d\", \"height\": \"%d\", \"sensorWidth\": \"36\", \"sensorHeight\": \"24\", ",
                3000000000u + (unsigned)i, v->width_px, v->height_px);
        if (version >= 10208)
            fprintf(f, "\"type\": \"%s\", \"distortionType\": \"%s\", \"undistortionType\": \"none\", ", equidistant ? "equidistant" : "pinhole", d);
        else
            fprintf(f, "\"type\": \"%s\", ", old_type);
        if (version >= 10211)
            fprintf(f, "\"focalLength\": \"%.17g\", \"pixelRatio\": \"%.17g\", ", fy * mm, fy / fx);
        else if (version >= 10205)
            fprintf(f, "\"focalLength\": \"%.17g\", \"pixelRatio\": \"%.17g\", ", fx * mm, fy / fx);
        else if (version >= 10202)
            fprintf(f, "\"focalLength\": \"%.17g\", \"pixelRatio\": \"%.17g\", ", fx * mm, fx / fy);
        else if (version >= 10200)
            fprintf(f, "\"pxFocalLength\": [\"%.17g\", \"%.17g\"], ", fx, fy);
        else
            fprintf(f, "\"pxFocalLength\": \"%.17g\", ", fx);
        fprintf(f, "\"principalPoint\": [\"%.17g\", \"%.17g\"], \"distortionParams\": [", centre[0], centre[1]);
        const int n = !strcmp(d, "none") ? 0 : !strcmp(d, "radialk1") ? 1 : !strncmp(d, "radialk3", 8) ? 3 : !strcmp(d, "brown") ? 5 : 4;
        for (int k = 0; k < n; k++) {
            const double value = n == 5 && k > 2 ? v->p[k - 3] / unit : v->k[k] / pow(unit, 2 * k + 2);
            fprintf(f, "%s\"%.17g\"", k ? ", " : "", value);
        }
        fprintf(f, "], \"locked\": \"0\"}%s\n", i + 1 < c->n ? "," : "");
    }
    fprintf(f, " ],\n \"poses\": [\n");
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        fprintf(f, "  {\"poseId\": \"%u\", \"pose\": {\"transform\": {\"rotation\": [", 4000000000u + (unsigned)i);
        for (int k = 0; k < 9; k++) // down the columns
            fprintf(f, "%s\"%.17g\"", k ? ", " : "", v->cam_from_world[3 * (k % 3) + k / 3]);
        fprintf(f, "], \"center\": [\"%.17g\", \"%.17g\", \"%.17g\"]}, \"locked\": \"0\"}}%s\n", v->centre_m[0], v->centre_m[1], v->centre_m[2],
                i + 1 < c->n ? "," : "");
    }
    fprintf(f, " ]\n}\n");
}

// ---- Bundler ------------------------------------------------------------------------------------------------------------

static inline void put_bundler(FILE *f, const struct cameras *c)
{
    static const double flip[9] = { 1, 0, 0, 0, -1, 0, 0, 0, -1 };
    fprintf(f, "# Bundle file v0.3\n%d 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n", c->n + 1); // the first is not registered
    for (int i = 0; i < c->n; i++) {
        const struct camera *v = &c->view[i];
        double R[9], t[3];
        mat3_mul(R, flip, v->cam_from_world);
        mat3_mul_vec(t, flip, v->t_m);
        fprintf(f, "%.17g %.17g %.17g\n", v->fx, v->k[0], v->k[1]);
        for (int k = 0; k < 3; k++, fprintf(f, "\n"))
            put_numbers(f, R + 3 * k, 3);
        put_numbers(f, t, 3);
        fprintf(f, "\n");
    }
}

static inline void put_bundler_list(FILE *f, const struct cameras *c)
{
    fprintf(f, "lost.jpg\n");
    for (int i = 0; i < c->n; i++)
        fprintf(f, "./photos/%s.jpg 0 %.17g\n", c->view[i].name, c->view[i].fx);
}
