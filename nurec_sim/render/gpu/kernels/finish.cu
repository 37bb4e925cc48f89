// Blended planes to frames: sky, colour correction, rounding, depth and labels; or the returns of a LiDAR.
#include "colours.cuh"
#include "view.cuh"

INLINE float3 toned(const float* isp, float3 c) {
    return make_float3(dot(load3(isp), c) + isp[3], dot(load3(isp + 4), c) + isp[7], dot(load3(isp + 8), c) + isp[11]);
}
INLINE unsigned char rounded(float v) { return (unsigned char)floorf(fminf(fmaxf(v, 0.0f), 1.0f) * 255 + 0.5f); }

// One thread per ray (x) and view (y); views of LiDARs are left alone. Outputs that nobody asked for are null.
extern "C" __global__ void __launch_bounds__(THREADS)
finish_images(const View* views, long long rays, const float* planes, unsigned char* rgb, float* depth, float* opaque,
              unsigned char* label, float* normal) {
    const View& view = views[blockIdx.y];
    int cell = blockIdx.x * THREADS + threadIdx.x;
    if (view.kind == LIDAR || cell >= view.columns * view.rows) return;
    long long n = view.first_ray + cell;
    const float* plane = planes + n;
    float alpha = plane[ALPHA * rays];
    bool surface = alpha >= SURFACE_ALPHA;
    if (opaque) opaque[n] = alpha;
    if (label) label[n] = surface ? (unsigned char)plane[CLASS * rays] : SKY;
    if (depth) depth[n] = surface ? fmaxf(plane[DISTANCE * rays] / alpha * view.rays[cell].z, 0.0f) : 0.0f;
    if (normal) {
        float3 facing = make_float3(plane[FACING * rays], plane[(FACING + 1) * rays], plane[(FACING + 2) * rays]);
        float size = length(facing);
        facing = (surface && size > 1e-6f ? 1 / size : 0.0f) * facing;
        normal[3 * n] = facing.x, normal[3 * n + 1] = facing.y, normal[3 * n + 2] = facing.z;
    }
    if (!rgb) return;

    Ray ray = ray_of(view, cell);
    float3 colour = make_float3(0, 0, 0);
    bool lit = dot(ray.direction, ray.direction) > 0;
    if (lit) {
        float3 behind = sky_colour(view.sky, view.sky_size, apply_transposed(view.turn, ray.direction));
        colour = make_float3(plane[0], plane[rays], plane[2 * rays]) + (1 - alpha) * behind;
        colour = toned(view.isp, colour);
    }
    rgb[3 * n] = rounded(colour.x), rgb[3 * n + 1] = rounded(colour.y), rgb[3 * n + 2] = rounded(colour.z);
}

// Writes x, y, z (in the sensor at the end of the sweep), range, intensity and whether it returns (spec.sweep_frame),
// per beam. A negative distance threshold stands for none.
extern "C" __global__ void __launch_bounds__(THREADS)
finish_beams(const View* views, long long rays, const float* planes, float opacity_threshold, float drop_threshold,
             float distance_threshold, float* returns) {
    const View& view = views[blockIdx.y];
    int cell = blockIdx.x * THREADS + threadIdx.x;
    if (view.kind != LIDAR || cell >= view.columns * view.rows) return;
    const float* plane = planes + view.first_ray + cell;
    float alpha = plane[ALPHA * rays], half = plane[HALF * rays];
    float mean = plane[DISTANCE * rays] / fmaxf(alpha, 1 / 255.0f), range = half > 0 ? half : mean;
    bool back = alpha > opacity_threshold && range >= view.range_m[0] && range <= view.range_m[1];
    back = back && plane[2 * rays] <= drop_threshold * alpha;
    back = back && (distance_threshold < 0 || fabsf(range - mean) <= distance_threshold);
    Ray ray = ray_of(view, cell);
    back = back && dot(ray.direction, ray.direction) > 0;  // blocked beams have no direction
    float3 point = ray.instant * load3(view.travel) + range * ray.direction;
    point = toned(view.end_from_reference, point);
    float* out = returns + 6 * ((long long)view.first_ray + view.beam[cell]);
    out[0] = point.x, out[1] = point.y, out[2] = point.z;
    out[3] = range;
    out[4] = plane[0] / fmaxf(plane[rays], 1e-12f);
    out[5] = back ? 1.0f : 0.0f;
}
