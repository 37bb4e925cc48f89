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

// Tiles of each record, the records in `order`, front to back.
extern "C" __global__ void __launch_bounds__(THREADS)
count_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, const long long* order,
            int n, int* counts) {
    int place = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32, count = 0;
    if (place >= n) return;
    long long index = order[place];
    Span span = spans[index];
    const View& view = views[span.view];
    for (int step = lane;; step += 32) {
        int tile = tile_at(view, span, step);
        count += __popc(__ballot_sync(FULL_WARP, meets_tile(view, records[index], cones, tile)));
        if (!__any_sync(FULL_WARP, tile >= 0)) break;
    }
    if (lane == 0) counts[place] = count;
}

// Writes the tiles of each record, and the record beside each of them; `ends` are the running sums of the counts.
extern "C" __global__ void __launch_bounds__(THREADS)
fill_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, const long long* order,
           int n, const int* counts, const long long* ends, int* tiles, int* owners) {
    int place = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (place >= n) return;
    long long index = order[place], next = ends[place] - counts[place];
    Span span = spans[index];
    const View& view = views[span.view];
    for (int step = lane;; step += 32) {
        int tile = tile_at(view, span, step);
        bool meets = meets_tile(view, records[index], cones, tile);
        unsigned mask = __ballot_sync(FULL_WARP, meets);
        if (meets) {
            long long at = next + __popc(mask & ((1u << lane) - 1));
            tiles[at] = tile;
            owners[at] = (int)index;
        }
        next += __popc(mask);
        if (!__any_sync(FULL_WARP, tile >= 0)) break;
    }
}
