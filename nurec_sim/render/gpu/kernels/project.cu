// Gaussians to records: what can be seen, where, and what a ray needs to weigh it.
//
// One block of threads per block of Gaussians (x) and view (y). First their visible Gaussians are counted, then, with
// the running sums of those counts, records are written in the order of the Gaussians: nothing depends on which block
// runs first.
#include "bounds.cuh"
#include "colours.cuh"

struct Gaussian {
    float3 centre;   // in the reference frame
    float3 axes[3];  // unit
    float3 scale;
    float log_opacity, k2, reach, distance, nearest;
};

INLINE float distance_of(const View& view, const Sphere& s) {
    return length(make_float3((float)(s.x - view.eye[0]), (float)(s.y - view.eye[1]), (float)(s.z - view.eye[2])));
}

// Whether a block is drawn rather than those that it stands for (render/lod.py).
INLINE bool fine_enough(const View& view, const Sphere& s) {
    return s.error_m <= 0 || s.error_m <= fmaxf(distance_of(view, s) - s.radius, NEAREST_M) * view.detail;
}

// Where a block's Gaussians lie in memory; null if the view has no such block, or cannot see anything of its sphere.
INLINE const float* block_fields(const View& view, int block, int static_blocks, const float* static_fields,
                                 const float* moving_fields, const Sphere* spheres) {
    if (block >= static_blocks) {
        block -= static_blocks;
        return block < view.blocks ? moving_fields + (size_t)(view.first_block + block) * FIELDS * BLOCK : nullptr;
    }
    const Sphere& sphere = spheres[block];
    if (!fine_enough(view, sphere)) return nullptr;
    for (int above = sphere.parent; above >= 0; above = spheres[above].parent) {
        if (fine_enough(view, spheres[above])) return nullptr;
    }
    float travel = length(load3(view.travel)), swing = length(load3(view.swing));
    float3 offset = make_float3((float)(sphere.x - view.eye[0]), (float)(sphere.y - view.eye[1]),
                                (float)(sphere.z - view.eye[2]));
    float distance = length(offset), radius = sphere.radius + travel;
    if (view.field_cos > -1 && distance > radius) {
        // The cone of the view's rays against that of the sphere.
        float angle = acosf(fminf(fmaxf(dot(load3(view.turn + 6), offset) / distance, -1.0f), 1.0f));
        if (angle > acosf(view.field_cos) + swing + 0.02f + asinf(radius / distance)) return nullptr;
    }
    return static_fields + (size_t)block * FIELDS * BLOCK;
}

// The Gaussian in the view's reference frame, and the tiles that may see it.
INLINE bool look(const View& view, const float* fields, Gaussian* g, Span* span) {
    const float* f = fields + threadIdx.x;
    g->log_opacity = f[LOG_OPACITY * BLOCK];
    g->k2 = 2 * (g->log_opacity + LOG_255);
    if (!(g->k2 > 0)) return false;
    float3 offset = make_float3((float)(f[MEAN * BLOCK] - view.eye[0]), (float)(f[(MEAN + 1) * BLOCK] - view.eye[1]),
                                (float)(f[(MEAN + 2) * BLOCK] - view.eye[2]));
    g->centre = apply(view.turn, offset);
    g->distance = length(g->centre);
    float depth = view.by_range ? g->distance : g->centre.z;
    if (!(depth >= view.near_m)) return false;
    float3 world[3], scaled[3];
    rotation_columns(f[QUAT * BLOCK], f[(QUAT + 1) * BLOCK], f[(QUAT + 2) * BLOCK], f[(QUAT + 3) * BLOCK], world);
    g->scale = make_float3(f[SCALE * BLOCK], f[(SCALE + 1) * BLOCK], f[(SCALE + 2) * BLOCK]);
    for (int k = 0; k < 3; ++k) g->axes[k] = apply(view.turn, world[k]);
    scaled[0] = g->scale.x * g->axes[0];
    scaled[1] = g->scale.y * g->axes[1];
    scaled[2] = g->scale.z * g->axes[2];
    g->reach = sqrtf(g->k2) * fmaxf(g->scale.x, fmaxf(g->scale.y, g->scale.z));
    g->nearest = g->distance - g->reach - length(load3(view.travel));
    span->depth_bits = __float_as_int(depth);
    return span_of(view, box_of(view, g->centre, scaled, g->k2, g->nearest), span);
}

INLINE Record record_of(const Gaussian& g) {
    // Rows of A = S^-1 R^T.
    float3 row[3] = {(1 / g.scale.x) * g.axes[0], (1 / g.scale.y) * g.axes[1], (1 / g.scale.z) * g.axes[2]};
    float3 ball = make_float3(dot(row[0], g.centre), dot(row[1], g.centre), dot(row[2], g.centre)), e1, e2;
    float n2 = fmaxf(dot(ball, ball), 1e-30f), inverse = rsqrtf(n2);
    float3 unit = inverse * ball;
    perpendicular(unit, &e1, &e2);
    float3 x = 0.25f * (e1.x * row[0] + (e1.y * row[1] + e1.z * row[2]));
    float3 y = 0.25f * (e2.x * row[0] + (e2.y * row[1] + e2.z * row[2]));
    float3 w = inverse * (unit.x * row[0] + (unit.y * row[1] + unit.z * row[2]));
    float xx = dot(x, x), yy = dot(y, y), xy = dot(x, y), half = 0.5f * (xx - yy);
    // At the rim, Q1 / Q2 = k2 / 16: Q1 = k2 / 16 / (1 - k2 / n^2) W^2.
    float room = 1 - g.k2 / n2;
    Record r;
    r.x = with(x, 16 / n2);
    r.y = with(y, g.log_opacity * -0.125f);
    r.w = with(w, 0);
    r.features.w = room > 1e-4f ? 0.25f * sqrtf(g.k2 / room) : 1e15f;
    r.bound = make_float4(sqrtf(0.5f * (xx + yy) + sqrtf(half * half + xy * xy)), length(w), 1 / g.distance,
                          1 / fmaxf(g.nearest, 1e-6f));
    return r;
}

extern "C" __global__ void __launch_bounds__(THREADS)
count_visible(const View* views, int static_blocks, const float* static_fields, const float* moving_fields,
              const Sphere* spheres, int* counts) {
    const View& view = views[blockIdx.y];
    const float* fields =
        block_fields(view, blockIdx.x, static_blocks, static_fields, moving_fields, spheres);
    int count = 0;
    if (fields) {
        Gaussian g;
        Span span;
        count = __syncthreads_count(look(view, fields, &g, &span));
    }
    if (threadIdx.x == 0) counts[blockIdx.y * gridDim.x + blockIdx.x] = count;
}

// `ends` are the running sums of the counts. Records that there is no `room` for are left out. `depths` receives what they
// are sorted by, `record_of_row` (or null) each Gaussian's record in each view.
extern "C" __global__ void __launch_bounds__(THREADS)
project(const View* views, int static_blocks, const float* static_fields, const float* moving_fields,
        const Sphere* spheres, const float* static_sh, int sh_count, const long long* ends, const int* counts, int room,
        Record* records, Span* spans, int* depths, int* record_of_row) {
    __shared__ int warp_counts[WARPS];
    int slot = blockIdx.y * gridDim.x + blockIdx.x, count = counts[slot];
    if (count == 0) return;
    const View& view = views[blockIdx.y];
    const float* fields =
        block_fields(view, blockIdx.x, static_blocks, static_fields, moving_fields, spheres);
    Gaussian g;
    Span span;
    bool seen = look(view, fields, &g, &span);
    unsigned mask = __ballot_sync(FULL_WARP, seen);
    int warp = threadIdx.x / 32, rank = __popc(mask & ((1u << threadIdx.x % 32) - 1));
    if (threadIdx.x % 32 == 0) warp_counts[warp] = __popc(mask);
    __syncthreads();
    if (!seen) return;
    for (int k = 0; k < warp; ++k) rank += warp_counts[k];
    long long n = ends[slot] - count + rank;
    if (n >= room) return;

    const float* f = fields + threadIdx.x;
    Record r = record_of(g);
    bool close = g.nearest < view.near_m;
    r.w.w = __int_as_float(((int)f[LABEL * BLOCK] & LABEL_BITS) | (close ? CLOSE_BIT : 0));
    float3 normal = make_float3(f[NORMAL * BLOCK], f[(NORMAL + 1) * BLOCK], f[(NORMAL + 2) * BLOCK]);
    float slanted = dot(apply(view.turn, normal), g.centre);
    float3 features = make_float3(f[COLOUR * BLOCK], f[(COLOUR + 1) * BLOCK], f[(COLOUR + 2) * BLOCK]);
    if (view.intensity) {
        // By incidence; see Gaussians.falloff.
        float met = fabsf(slanted) / fmaxf(g.distance, 1e-12f);
        float kept = 1 - f[FALLOFF * BLOCK] * fmaxf(1 - met, 0.0f);
        features = make_float3(kept * f[INTENSITY * BLOCK], f[(INTENSITY + 1) * BLOCK], f[(INTENSITY + 2) * BLOCK]);
    } else if (sh_count > 0 && (int)blockIdx.x < static_blocks) {
        float3 away = (1 / fmaxf(g.distance, 1e-12f)) * apply_transposed(view.turn, g.centre);
        const float* rest = static_sh + (size_t)blockIdx.x * 3 * sh_count * BLOCK + threadIdx.x;
        features = make_float3(fmaxf(features.x + sh_channel(rest, sh_count, away), 0.0f),
                               fmaxf(features.y + sh_channel(rest + BLOCK, sh_count, away), 0.0f),
                               fmaxf(features.z + sh_channel(rest + 2 * BLOCK, sh_count, away), 0.0f));
    }
    r.features = with(features, r.features.w);
    float sign = slanted > 0 ? -1.0f : 1.0f;
    int row = blockIdx.x * BLOCK + threadIdx.x;
    r.facing = with(sign * normal, __int_as_float(row));
    span.view = blockIdx.y;
    records[n] = r;
    spans[n] = span;
    depths[n] = span.depth_bits;
    if (record_of_row) record_of_row[(size_t)blockIdx.y * gridDim.x * BLOCK + row] = (int)n;
}

// Behind the records, keys that are sorted to the end.
extern "C" __global__ void __launch_bounds__(THREADS)
pad_depths(const long long* ends, int slots, int room, int* depths) {
    long long n = blockIdx.x * (long long)THREADS + threadIdx.x;
    if (n < room && n >= (slots ? ends[slots - 1] : 0)) depths[n] = 0x7fffffff;
}
