// Hands records out to tiles: a warp per record, its lanes take the tiles of the record's span.
#include "response.cuh"

// The tile that a lane looks at, `step` tiles into a span; -1 behind its end.
INLINE int tile_at(const View& view, const Span& span, int step) {
    int wide = span.x1 - span.x0 + 1;
    if (wide <= 0) wide += view.tile_columns;
    int x = span.x0 + step % wide, y = span.y0 + step / wide;
    if (x >= view.tile_columns) x -= view.tile_columns;
    return y <= span.y1 ? view.first_tile + y * view.tile_columns + x : -1;
}

INLINE bool meets_tile(const View& view, const Record& record, const Cone* cones, int tile) {
    if (tile < 0) return false;
    float3 travel = load3(view.travel);
    return may_meet(record, cones[tile * CONES], travel, view.moving ? length(travel) : 0.0f);
}

extern "C" __global__ void __launch_bounds__(THREADS)
count_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, int n, int* counts) {
    int index = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32, count = 0;
    if (index >= n) return;
    Span span = spans[index];
    const View& view = views[span.view];
    for (int step = lane;; step += 32) {
        int tile = tile_at(view, span, step);
        count += __popc(__ballot_sync(FULL_WARP, meets_tile(view, records[index], cones, tile)));
        if (!__any_sync(FULL_WARP, tile >= 0)) break;
    }
    if (lane == 0) counts[index] = count;
}

// Writes a key (tile, then depth) and the record for each tile that a record may be seen in; `ends` are the running sums
// of the counts.
extern "C" __global__ void __launch_bounds__(THREADS)
fill_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, int n, const int* counts,
           const long long* ends, long long* keys, int* owners) {
    int index = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (index >= n) return;
    Span span = spans[index];
    const View& view = views[span.view];
    long long place = ends[index] - counts[index];
    for (int step = lane;; step += 32) {
        int tile = tile_at(view, span, step);
        bool meets = meets_tile(view, records[index], cones, tile);
        unsigned mask = __ballot_sync(FULL_WARP, meets);
        if (meets) {
            long long at = place + __popc(mask & ((1u << lane) - 1));
            keys[at] = ((long long)tile << 32) | (unsigned)span.depth_bits;
            owners[at] = index;
        }
        place += __popc(mask);
        if (!__any_sync(FULL_WARP, tile >= 0)) break;
    }
}
