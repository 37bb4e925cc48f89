// Cones around the rays of each tile and of each of its warps.
#include "view.cuh"

// One block per tile; writes its view, and CONES: that of the tile, then those of its warps.
extern "C" __global__ void __launch_bounds__(THREADS)
gather_cones(const View* views, int view_count, int* tile_view, Cone* cones) {
    __shared__ float4 sums[WARPS];
    __shared__ float4 limits[WARPS];
    int tile = blockIdx.x, warp = threadIdx.x / 32;
    int number = 0;
    while (number + 1 < view_count && views[number + 1].first_tile <= tile) ++number;
    const View& view = views[number];
    if (threadIdx.x == 0) tile_view[tile] = number;
    Ray ray = ray_of(view, cell_of(view, tile));
    bool is_ray = dot(ray.direction, ray.direction) > 0;

    float count = warp_sum(is_ray ? 1.0f : 0.0f);
    float3 sum = warp_sum(ray.direction);
    float latest = warp_max(is_ray ? ray.instant : -1e9f), earliest = -warp_max(is_ray ? -ray.instant : -1e9f);
    float3 axis = (1 / fmaxf(count, 1.0f)) * sum;
    float spread = warp_max(is_ray ? length(ray.direction - axis) : -1.0f);
    if (threadIdx.x % 32 == 0) {
        sums[warp] = with(sum, count);
        // A little wider, for what rounding may do.
        Cone cone = {with(axis, count > 0 ? 1.001f * spread + 2e-6f : -1.0f),
                     make_float4(0.5f * (latest + earliest), 0.5f * (latest - earliest) + 1e-6f, 0, 0)};
        cones[tile * CONES + 1 + warp] = cone;
    }
    __syncthreads();

    float4 total = make_float4(0, 0, 0, 0);
    for (int k = 0; k < WARPS; ++k) {
        total = with(xyz(total) + xyz(sums[k]), total.w + sums[k].w);
    }
    axis = (1 / fmaxf(total.w, 1.0f)) * xyz(total);
    spread = warp_max(is_ray ? length(ray.direction - axis) : -1.0f);
    if (threadIdx.x % 32 == 0) limits[warp] = make_float4(spread, latest, earliest, 0);
    __syncthreads();

    if (threadIdx.x == 0) {
        for (int k = 1; k < WARPS; ++k) {
            spread = fmaxf(spread, limits[k].x);
            latest = fmaxf(latest, limits[k].y);
            earliest = fminf(earliest, limits[k].z);
        }
        Cone cone = {with(axis, total.w > 0 ? 1.001f * spread + 2e-6f : -1.0f),
                     make_float4(0.5f * (latest + earliest), 0.5f * (latest - earliest) + 1e-6f, 0, 0)};
        cones[tile * CONES] = cone;
    }
}
