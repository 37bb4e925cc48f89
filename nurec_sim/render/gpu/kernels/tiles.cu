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

// Keys of pairs: numbers of tiles, as 16 bits where these do, which halves the passes of the sort. Signed, as torch sorts.
INLINE void write_key(void* keys, int narrow, long long n, int tile) {
    if (narrow) ((short*)keys)[n] = (short)(tile - 32768);
    else ((int*)keys)[n] = tile;
}
INLINE int read_key(const void* keys, int narrow, long long n) {
    return narrow ? ((const short*)keys)[n] + 32768 : ((const int*)keys)[n];
}

// Tiles of each record, the records in `order`, front to back. There are ends[slots - 1] records, of which `room` fit.
extern "C" __global__ void __launch_bounds__(THREADS)
count_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, const long long* order,
            const long long* ends, int slots, int room, int* counts) {
    int place = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32, count = 0;
    if (place >= room) return;
    if (place >= (slots ? ends[slots - 1] : 0)) {
        if (lane == 0) counts[place] = 0;
        return;
    }
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

// Writes the tiles of each record, and the record beside each of them, as far as there is room; `pair_ends` are the
// running sums of the counts.
extern "C" __global__ void __launch_bounds__(THREADS)
fill_tiles(const View* views, const Record* records, const Span* spans, const Cone* cones, const long long* order,
           const long long* ends, int slots, int room, const int* counts, const long long* pair_ends, int pair_room,
           int narrow, void* keys, int* owners) {
    int place = blockIdx.x * WARPS + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (place >= room || place >= (slots ? ends[slots - 1] : 0)) return;
    long long index = order[place], next = pair_ends[place] - counts[place];
    Span span = spans[index];
    const View& view = views[span.view];
    for (int step = lane;; step += 32) {
        int tile = tile_at(view, span, step);
        bool meets = meets_tile(view, records[index], cones, tile);
        unsigned mask = __ballot_sync(FULL_WARP, meets);
        long long at = next + __popc(mask & ((1u << lane) - 1));
        if (meets && at < pair_room) {
            write_key(keys, narrow, at, tile);
            owners[at] = (int)index;
        }
        next += __popc(mask);
        if (!__any_sync(FULL_WARP, tile >= 0)) break;
    }
}

// Behind the pairs, keys that are sorted to the end.
extern "C" __global__ void __launch_bounds__(THREADS)
pad_pairs(const long long* pair_ends, int room, int pair_room, int narrow, int tiles, void* keys) {
    long long n = blockIdx.x * (long long)THREADS + threadIdx.x;
    if (n < pair_room && n >= pair_ends[room - 1]) write_key(keys, narrow, n, tiles);
}

// Lists of tiles from sorted pairs: the record of each, and where each tile's begin; `totals` receives how many records
// and pairs there are, whether or not they fit.
extern "C" __global__ void __launch_bounds__(THREADS)
list_tiles(const void* keys, int narrow, const long long* slots_of, const int* owners, int tiles, const long long* ends,
           int slots, const long long* pair_ends, int room, int pair_room, int* lists, long long* starts,
           long long* totals) {
    long long n = blockIdx.x * (long long)THREADS + threadIdx.x, pairs = pair_ends[room - 1];
    if (n == 0) totals[0] = slots ? ends[slots - 1] : 0, totals[1] = pairs;
    if (pairs > pair_room) pairs = pair_room;
    if (n < pairs) lists[n] = owners[slots_of[n]];
    if (n > tiles) return;
    long long first = 0, last = pairs;
    while (first < last) {
        long long middle = (first + last) / 2;
        if (read_key(keys, narrow, middle) < n) first = middle + 1;
        else last = middle;
    }
    starts[n] = first;
}
