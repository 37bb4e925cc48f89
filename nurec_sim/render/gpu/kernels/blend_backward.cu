// Gradients of blending, in one pass front to back.
//
// With g the loss' gradient of a hit's own contribution and G = sum of w g over the whole ray, which the forward pass
// left, dL/dalpha = T g - (G - gathered so far) / (1 - alpha). Each warp sums over its rays, the block over its warps in
// order, and every (tile, record) pair has a row of its own in `sums`: no atomics, the same bytes every time.
#include "batch.cuh"

#define SUMS 16
#define PART 32

// Places of the sums of a pair: gradients of the three rows, of FLAT and FADE, and of the features.
enum Sum { GX = 0, GY = 3, GW = 6, GFLAT = 9, GFADE = 10, GFEATURES = 11 };

// Gradients of one hit with respect to its record, given those of alpha and t.
INLINE void hit_gradients(const Record& r, float3 drift, const Ray& ray, float3 travel, const Hit& hit, float g_alpha,
                          float g_t, float (&g)[SUMS]) {
    float flat = r.x.w, inverse = 1 / hit.q2;
    float g_exponent = -8 * hit.alpha * g_alpha;
    float g_q1 = g_exponent * inverse, g_forward = g_t * inverse;
    float g_q2 = -(g_exponent * hit.q1 + g_t * hit.forward) * inverse * inverse;
    float3 o = ray.instant * drift, from = ray.instant * travel;
    float keep = 1 - o.z;
    float a = hit.x * keep + hit.w * o.x, b = hit.y * keep + hit.w * o.y, c = hit.x * o.y - hit.y * o.x;
    float ga = 2 * a * g_q1, gb = 2 * b * g_q1, gc = 2 * flat * c * g_q1, g_lean = -flat * g_forward;
    float gx = ga * keep + gc * o.y + 2 * flat * hit.x * g_q2 + o.x * g_lean;
    float gy = gb * keep - gc * o.x + 2 * flat * hit.y * g_q2 + o.y * g_lean;
    float gw = ga * o.x + gb * o.y + 2 * hit.w * g_q2 + keep * g_forward;
    float gox = ga * hit.w - gc * hit.y + hit.x * g_lean, goy = gb * hit.w + gc * hit.x + hit.y * g_lean;
    float goz = -(ga * hit.x + gb * hit.y + hit.w * g_forward);
    float3 row_x = gx * ray.direction + gox * from;
    float3 row_y = gy * ray.direction + goy * from;
    float3 row_w = gw * ray.direction + goz * from;
    g[GX] = row_x.x, g[GX + 1] = row_x.y, g[GX + 2] = row_x.z;
    g[GY] = row_y.x, g[GY + 1] = row_y.y, g[GY + 2] = row_y.z;
    g[GW] = row_w.x, g[GW + 1] = row_w.y, g[GW + 2] = row_w.z;
    g[GFLAT] = c * c * g_q1 + (hit.x * hit.x + hit.y * hit.y) * g_q2 - (hit.x * o.x + hit.y * o.y) * g_forward;
    g[GFADE] = g_exponent;
}

// `grads` holds the gradients of the first six planes (features, distance, alpha, half) and `slots` the row of `sums`
// of each entry of `lists`, which comes full of zeros.
extern "C" __global__ void __launch_bounds__(THREADS)
blend_backward(const View* views, const int* tile_view, const Cone* cones, const Record* records, const int* lists,
               const long long* starts, const long long* slots, long long rays, const float* planes,
               const float* grads, float* sums) {
    __shared__ Loaded batch[PART];
    __shared__ float partial[WARPS][PART][SUMS];
    int tile = blockIdx.x, warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const View& view = views[tile_view[tile]];
    float least = least_transmittance(view);
    int cell = cell_of(view, tile);
    Ray ray = ray_of(view, cell);
    Cone cone = cones[tile * CONES + 1 + warp];
    float3 travel = load3(view.travel);
    float travel_m = view.moving ? length(travel) : 0.0f;
    bool is_ray = dot(ray.direction, ray.direction) > 0;

    float3 g_features = make_float3(0, 0, 0);
    float g_distance = 0, g_alpha = 0, g_half = 0, total = 0, gathered = 0, transmittance = is_ray ? 1.0f : 0.0f;
    if (is_ray) {
        long long n = view.first_ray + cell;
        const float *g = grads + n, *plane = planes + n;
        g_features = make_float3(g[0], g[rays], g[2 * rays]);
        g_distance = g[DISTANCE * rays], g_alpha = g[ALPHA * rays], g_half = g[HALF * rays];
        total = dot(g_features, make_float3(plane[0], plane[rays], plane[2 * rays])) +
                g_distance * plane[DISTANCE * rays] + g_alpha * plane[ALPHA * rays];
    }
    for (long long first = starts[tile], last = starts[tile + 1]; first < last; first += PART) {
        if (!__syncthreads_or(transmittance > least)) break;
        int size = last - first < PART ? (int)(last - first) : PART;
        for (int k = threadIdx.x; k < WARPS * PART * SUMS; k += THREADS) (&partial[0][0][0])[k] = 0;
        if ((int)threadIdx.x < size) batch[threadIdx.x] = loaded(records[lists[first + threadIdx.x]], travel);
        __syncthreads();
        bool chosen = lane < size && may_meet(batch[lane].record, cone, travel, travel_m);
        for (unsigned left = __ballot_sync(FULL_WARP, chosen); left; left &= left - 1) {
            int entry = __ffs(left) - 1;
            const Record& record = batch[entry].record;
            float3 drift = xyz(batch[entry].drift);
            Hit hit;
            bool met = transmittance > least &&
                       meet(record, drift, view.moving, ray, view.near_m, &hit);
            if (!__any_sync(FULL_WARP, met)) continue;
            float g[SUMS] = {};
            if (met) {
                float weight = hit.alpha * transmittance, after = transmittance - weight;
                float own = dot(g_features, xyz(record.features)) + g_distance * hit.t + g_alpha;
                gathered += weight * own;
                float g_opaque = transmittance * own - (total - gathered) / (1 - hit.alpha);
                float g_t = weight * g_distance + (transmittance > 0.5f && after <= 0.5f ? g_half : 0.0f);
                hit_gradients(record, drift, ray, travel, hit, g_opaque, g_t, g);
                g[GFEATURES] = weight * g_features.x;
                g[GFEATURES + 1] = weight * g_features.y;
                g[GFEATURES + 2] = weight * g_features.z;
                transmittance = after;
            }
            float sum = warp_sums(g);
            if (lane % 2 == 0) partial[warp][entry][lane / 2] = sum;
        }
        __syncthreads();
        for (int k = threadIdx.x; k < size * SUMS; k += THREADS) {
            float sum = 0;
            for (int w = 0; w < WARPS; ++w) sum += partial[w][k / SUMS][k % SUMS];
            sums[slots[first + k / SUMS] * SUMS + k % SUMS] = sum;
        }
    }
}
