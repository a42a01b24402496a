// solver/rays.c - a mesh that answers rays, by Embree 3 or 4 (which of them is decided by the
// headers that are installed).
//
// One device per mesh, with one build thread and no affinity: the tree, and so the triangle that
// wins a tie on a shared edge, does not depend on how many cores there are. The robust flag makes
// shared edges watertight: no light leaks between triangles.
#include "solver/rays.h"
#include "solver/take/log.h"
#include "solver/vec3.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <assert.h>
#include <errno.h>
#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { PACKET = 16 };

struct rays {
    RTCDevice device;
    RTCScene scene;
    float offset_m;
    int n_triangles;
    float (*position_m)[3], (*normal)[3]; // by vertex: what rays_start() needs of the mesh
    uint32_t (*triangle)[3];
};

static void log_embree_error(void *arg, enum RTCError code, const char *reason)
{
    (void)arg;
    log_error("rays: Embree error %d: %s", (int)code, reason ? reason : "no reason given");
}

static int errno_of(enum RTCError code)
{
    return code == RTC_ERROR_OUT_OF_MEMORY ? -ENOMEM : -EIO;
}

// Embree's own copy: its buffers must be readable 16 bytes beyond the last vertex, which the mesh
// does not promise.
static int attach(struct rays *r, const struct mesh *mesh)
{
    RTCGeometry geometry = rtcNewGeometry(r->device, RTC_GEOMETRY_TYPE_TRIANGLE);
    if (!geometry)
        return errno_of(rtcGetDeviceError(r->device));
    void *vertices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                             sizeof(mesh->position_m[0]), (size_t)mesh->n_vertices);
    void *triangles = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                              sizeof(mesh->triangle[0]), (size_t)mesh->n_triangles);
    if (vertices && triangles) {
        memcpy(vertices, mesh->position_m, (size_t)mesh->n_vertices * sizeof(mesh->position_m[0]));
        memcpy(triangles, mesh->triangle, (size_t)mesh->n_triangles * sizeof(mesh->triangle[0]));
        rtcCommitGeometry(geometry);
        rtcAttachGeometry(r->scene, geometry);
    }
    rtcReleaseGeometry(geometry); // the scene holds it
    const enum RTCError code = rtcGetDeviceError(r->device);
    return code == RTC_ERROR_NONE ? 0 : errno_of(code);
}

static void *copy_of(const void *from, size_t n_bytes)
{
    void *to = malloc(n_bytes ? n_bytes : 1);
    if (to && n_bytes)
        memcpy(to, from, n_bytes);
    return to;
}

static float offset_m_of(const struct mesh *mesh)
{
    double diagonal_m[3], far_m = 0;
    vec3_sub(diagonal_m, mesh->bounds_m[1], mesh->bounds_m[0]);
    for (int i = 0; i < 3; i++)
        far_m = fmax(far_m, fmax(fabs(mesh->bounds_m[0][i]), fabs(mesh->bounds_m[1][i])));
    return (float)fmax(1e-5 * vec3_norm(diagonal_m), 8 * FLT_EPSILON * far_m);
}

int rays_new(struct rays **out, const struct mesh *mesh)
{
    *out = NULL;
    for (int i = 0; i < mesh->n_triangles; i++)
        for (int k = 0; k < 3; k++)
            assert(mesh->triangle[i][k] < (uint32_t)mesh->n_vertices);
    struct rays *r = calloc(1, sizeof(*r));
    if (!r)
        return -ENOMEM;
    int err = -ENOMEM;
    r->offset_m = offset_m_of(mesh);
    r->n_triangles = mesh->n_triangles;
    const size_t n_vertices = (size_t)mesh->n_vertices, n_triangles = (size_t)mesh->n_triangles;
    r->position_m = copy_of(mesh->position_m, n_vertices * sizeof(r->position_m[0]));
    r->normal = copy_of(mesh->normal, n_vertices * sizeof(r->normal[0]));
    r->triangle = copy_of(mesh->triangle, n_triangles * sizeof(r->triangle[0]));
    if (!r->position_m || !r->normal || !r->triangle)
        goto fail;

    r->device = rtcNewDevice("threads=1");
    if (!r->device) {
        const enum RTCError code = rtcGetDeviceError(NULL);
        log_embree_error(NULL, code, "no device");
        err = errno_of(code);
        goto fail;
    }
    rtcSetDeviceErrorFunction(r->device, log_embree_error, NULL);
    r->scene = rtcNewScene(r->device);
    if (!r->scene) {
        err = errno_of(rtcGetDeviceError(r->device));
        goto fail;
    }
    rtcSetSceneFlags(r->scene, RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(r->scene, RTC_BUILD_QUALITY_MEDIUM);
    err = mesh->n_triangles ? attach(r, mesh) : 0;
    if (err)
        goto fail;
    rtcCommitScene(r->scene);
    const enum RTCError code = rtcGetDeviceError(r->device);
    if (code != RTC_ERROR_NONE) {
        err = errno_of(code);
        goto fail;
    }
    *out = r;
    return 0;
fail:
    rays_free(r);
    return err;
}

void rays_free(struct rays *r)
{
    if (!r)
        return;
    if (r->scene)
        rtcReleaseScene(r->scene);
    if (r->device)
        rtcReleaseDevice(r->device);
    free(r->position_m);
    free(r->normal);
    free(r->triangle);
    free(r);
}

// Embree's own limit of coordinates; Debian's build asserts it.
static const float MOST_COORDINATE = 1.8e18f;

// False for a ray that asks nothing: no direction, an empty interval, a NaN anywhere, or out of all
// bounds.
static bool make_ray(struct RTCRay *ray, const float origin_m[3], const float dir[3], float t_min,
                     float t_max)
{
    for (int i = 0; i < 3; i++)
        if (!(fabsf(origin_m[i]) <= MOST_COORDINATE) || !(fabsf(dir[i]) <= MOST_COORDINATE))
            return false;
    if ((dir[0] == 0 && dir[1] == 0 && dir[2] == 0) || !(t_min < t_max))
        return false;
    *ray = (struct RTCRay){
        .org_x = origin_m[0],
        .org_y = origin_m[1],
        .org_z = origin_m[2],
        .dir_x = dir[0],
        .dir_y = dir[1],
        .dir_z = dir[2],
        .tnear = t_min > 0 ? t_min : 0,
        .tfar = t_max,
        .mask = (unsigned)-1,
    };
    return ray->tnear < ray->tfar;
}

bool rays_blocked(const struct rays *r, const float origin_m[3], const float dir[3], float t_min,
                  float t_max)
{
    struct RTCRay ray;
    if (!make_ray(&ray, origin_m, dir, t_min, t_max))
        return false;
#if RTC_VERSION_MAJOR >= 4
    rtcOccluded1(r->scene, &ray, NULL);
#else
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(r->scene, &context, &ray);
#endif
    return ray.tfar < 0; // Embree's sign for "hit": -infinity
}

void rays_blocked_from(const struct rays *r, const float origin_m[3], int n, const float (*dir)[3], const float *t_max, uint8_t *blocked)
{
    for (int begin = 0; begin < n; begin += PACKET) {
        struct RTCRay16 packet = { 0 };
        _Alignas(64) int asked[PACKET] = { 0 };
        const int n_here = n - begin < PACKET ? n - begin : PACKET;
        for (int i = 0; i < n_here; i++) {
            struct RTCRay ray;
            if (!make_ray(&ray, origin_m, dir[begin + i], 0, t_max[begin + i]))
                continue;
            asked[i] = -1;
            packet.org_x[i] = ray.org_x, packet.org_y[i] = ray.org_y, packet.org_z[i] = ray.org_z;
            packet.dir_x[i] = ray.dir_x, packet.dir_y[i] = ray.dir_y, packet.dir_z[i] = ray.dir_z;
            packet.tnear[i] = ray.tnear, packet.tfar[i] = ray.tfar, packet.mask[i] = ray.mask;
        }
#if RTC_VERSION_MAJOR >= 4
        struct RTCOccludedArguments how;
        rtcInitOccludedArguments(&how);
        how.flags = RTC_RAY_QUERY_FLAG_COHERENT;
        rtcOccluded16(asked, r->scene, &packet, &how);
#else
        struct RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
        rtcOccluded16(asked, r->scene, &context, &packet);
#endif
        for (int i = 0; i < n_here; i++)
            blocked[begin + i] = asked[i] && packet.tfar[i] < 0;
    }
}

bool rays_hit(const struct rays *r, const float origin_m[3], const float dir[3], float t_min,
              float t_max, struct ray_hit *hit)
{
    struct RTCRayHit query;
    if (!make_ray(&query.ray, origin_m, dir, t_min, t_max))
        return false;
    query.hit = (struct RTCHit){ .geomID = RTC_INVALID_GEOMETRY_ID };
    query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
    rtcIntersect1(r->scene, &query, NULL);
#else
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(r->scene, &context, &query);
#endif
    if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID)
        return false;
    *hit = (struct ray_hit){ query.hit.primID, query.ray.tfar, query.hit.u, query.hit.v };
    return true;
}

float rays_offset_m(const struct rays *r)
{
    return r->offset_m;
}

void rays_start(const struct rays *r, uint32_t triangle, const float barycentric[2],
                float start_m[3])
{
    assert(triangle < (uint32_t)r->n_triangles);
    const uint32_t *corner = r->triangle[triangle];
    const double weight[3] = { 1.0 - barycentric[0] - barycentric[1], barycentric[0],
                               barycentric[1] };
    double point[3] = { 0 }, normal[3] = { 0 }, lift[3] = { 0 };
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++) {
            point[i] += weight[k] * r->position_m[corner[k]][i];
            normal[i] += weight[k] * r->normal[corner[k]][i];
        }
    vec3_normalise(normal);
    // How far the point lies below each corner's tangent plane; planes below the point (a hollow)
    // lift nothing.
    for (int k = 0; k < 3; k++) {
        const float *q = r->position_m[corner[k]], *n = r->normal[corner[k]];
        const double below =
            (q[0] - point[0]) * n[0] + (q[1] - point[1]) * n[1] + (q[2] - point[2]) * n[2];
        for (int i = 0; below > 0 && i < 3; i++)
            lift[i] += weight[k] * below * n[i];
    }
    float base[3], towards[3];
    for (int i = 0; i < 3; i++) {
        base[i] = (float)(point[i] + r->offset_m * normal[i]);
        towards[i] = (float)lift[i];
    }
    // Another part of the surface within the lift: the facet itself is then the better start. (Not
    // asked of lifts as small as the offset itself: on fine meshes that saves a ray per point.)
    const bool lifted = vec3_norm(lift) <= r->offset_m || !rays_blocked(r, base, towards, 0, 1);
    for (int i = 0; i < 3; i++)
        start_m[i] = lifted ? base[i] + towards[i] : base[i];
}

bool rays_blocked_brute_force(const struct mesh *mesh, const double origin_m[3],
                              const double dir[3], double t_min, double t_max)
{
    for (int i = 0; i < mesh->n_triangles; i++) {
        double corner[3][3], e1[3], e2[3], s[3], p[3], q[3];
        for (int k = 0; k < 3; k++)
            for (int c = 0; c < 3; c++)
                corner[k][c] = mesh->position_m[mesh->triangle[i][k]][c];
        vec3_sub(e1, corner[1], corner[0]);
        vec3_sub(e2, corner[2], corner[0]);
        vec3_cross(p, dir, e2);
        const double det = vec3_dot(e1, p);
        if (det == 0)
            continue;
        vec3_sub(s, origin_m, corner[0]);
        const double u = vec3_dot(s, p) / det;
        vec3_cross(q, s, e1);
        const double v = vec3_dot(dir, q) / det;
        const double t = vec3_dot(e2, q) / det;
        if (u >= 0 && v >= 0 && u + v <= 1 && t >= t_min && t <= t_max)
            return true;
    }
    return false;
}
