// Blends the records of each tile front to back; one thread per ray, one warp per 8 x 4 rays.
//
// A block reads its tile's list in batches. Each warp tests a whole batch against the cone of its own rays, 32 records
// at a time, and then looks at those only that one of its rays may meet.
#include "batch.cuh"

extern "C" __global__ void __launch_bounds__(THREADS)
blend(const View* views, const int* tile_view, const Cone* cones, const Record* records, const int* lists,
      const long long* starts, long long rays, float* planes) {
    __shared__ Loaded batch[THREADS];
    int tile = blockIdx.x, warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const View& view = views[tile_view[tile]];
    float least = least_transmittance(view);
    int cell = cell_of(view, tile);
    Ray ray = ray_of(view, cell);
    Cone cone = cones[tile * CONES + 1 + warp];
    float3 travel = load3(view.travel);
    float travel_m = view.moving ? length(travel) : 0.0f, near_m = view.near_m;
    bool moving = view.moving;

    float transmittance = dot(ray.direction, ray.direction) > 0 ? 1.0f : 0.0f;
    float3 features = make_float3(0, 0, 0), facing = features;
    float distance = 0, alpha = 0, half = 0, largest = 0;
    int label = SKY;
    for (long long first = starts[tile], last = starts[tile + 1]; first < last; first += THREADS) {
        // Also keeps the batch until every warp is done with it.
        if (!__syncthreads_or(transmittance > least)) break;
        int size = last - first < THREADS ? (int)(last - first) : THREADS;
        if ((int)threadIdx.x < size) batch[threadIdx.x] = loaded(records[lists[first + threadIdx.x]], travel);
        __syncthreads();
        for (int group = 0; group < size; group += 32) {
            if (!__any_sync(FULL_WARP, transmittance > least)) break;
            bool chosen = group + lane < size && may_meet(batch[group + lane].record, cone, travel, travel_m);
            for (unsigned left = __ballot_sync(FULL_WARP, chosen); left; left &= left - 1) {
                const Loaded& entry = batch[group + __ffs(left) - 1];
                Hit hit;
                if (!(meet(entry.record, xyz(entry.drift), moving, ray, near_m, &hit) &&
                      transmittance > least)) {
                    continue;
                }
                float weight = hit.alpha * transmittance;
                features = features + weight * xyz(entry.record.features);
                facing = facing + weight * xyz(entry.record.facing);
                distance += weight * hit.t;
                alpha += weight;
                if (weight > largest) {
                    largest = weight;
                    label = __float_as_int(entry.record.w.w) & LABEL_BITS;
                }
                bool above = transmittance > 0.5f;
                transmittance -= weight;
                if (above && transmittance <= 0.5f) half = hit.t;
            }
        }
    }
    if (cell < 0) return;
    float* out = planes + view.first_ray + cell;
    float values[PLANES] = {features.x, features.y, features.z, distance, alpha,
                            half,       facing.x,   facing.y,   facing.z, (float)label};
#pragma unroll
    for (int k = 0; k < PLANES; ++k) out[k * rays] = values[k];
}
