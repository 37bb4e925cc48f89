// What the kernels work on: sensors of a batch, packed Gaussians, records and cones of rays.
#pragma once
#include "vectors.cuh"

// A tile is 16 x 16 cells of a sensor's grid of rays; each of the 8 warps of its block takes 8 x 4 of them.
#define TILE 16
#define THREADS 256
#define WARPS 8
#define CONES (WARPS + 1)
#define BLOCK 256
#define PLANES 10

#define PINHOLE 0
#define LENS 1
#define LIDAR 2

#define LOG_255 5.541263545158426f
#define MIN_TRANSMITTANCE 1e-4f
#define LIDAR_MIN_TRANSMITTANCE 1e-2f
#define SURFACE_ALPHA 0.5f
#define SKY 3
#define NEAREST_M 0.5f          // blocks nearer than this count as this far away (render/lod.py)

// Fields of a block of packed Gaussians, [FIELDS][BLOCK] (render/cpu/pack.py).
enum Field {
    MEAN = 0, QUAT = 3, SCALE = 7, LOG_OPACITY = 10, COLOUR = 11, LABEL = 14, INTENSITY = 15, NORMAL = 18, FALLOFF = 21,
    FIELDS = 22
};

// Places of the planes that blending leaves, each one value per ray.
enum Plane { FEATURES = 0, DISTANCE = 3, ALPHA = 4, HALF = 5, FACING = 6, CLASS = 9 };

// One sensor of a batch; filled in by gpu/views.py. Its reference frame has the sensor's axes at the reference instant
// and its origin in the eye. An instant runs from 0 there; 1 is a whole exposure later.
struct View {
    double eye[3];              // origin of the reference frame in the world
    double reference;           // share of the exposure after which the reference instant comes
    long long instant_us;       // the reference instant
    const float4* rays;         // [rows * columns] unit direction in the sensor (zero: no ray), and its instant
    const float* table;         // from direction to place on the grid (bounds.cuh)
    const float* sky;           // [6, sky_size, sky_size, 3]
    const int* beam;            // [rows * columns] LiDAR: the beam of each cell
    float turn[9];              // reference_from_world
    float travel[3];            // metres moved during an exposure, in the reference frame
    float swing[3];             // rotation vector of an exposure
    float params[5];            // of the table; see there
    float isp[12];              // colour correction [3,4]
    float end_from_reference[12];
    float range_m[2];           // LiDAR: of what it returns
    float detail;               // metres per metre of distance that a merged Gaussian may paint wrong; 0 for none
    float near_m;
    float field_cos;            // cosine of the largest angle between a ray and the z axis; -1 for LiDARs
    int kind, columns, rows, tile_columns, tile_rows, first_tile, first_ray, table_size, sky_size;
    int by_range, intensity, moving;
    int first_block, blocks;    // of the moving layer
};
static_assert(sizeof(View) == VIEW_BYTES, "gpu/views.py and view.cuh disagree");

// What a ray needs to weigh a Gaussian exactly; see response.cuh.
struct Record {
    float4 x, y, w;             // rows e1^T A / 4, e2^T A / 4, b^T A / n^2; then FLAT, FADE, TAG
    float4 features;            // three features, RIM
    float4 bound;               // largest change of (X, Y) and of W with the direction, 1 / distance, 1 / nearest
    float4 facing;              // normal turned to the eye, in the world; source (int: packed row, or -1)
};
#define LABEL_BITS 0xff
#define CLOSE_BIT 0x80000000    // in TAG: a hit may be nearer than the near plane

// Where a record may be seen: tiles x0..x1 (wrapping round where x0 > x1) by y0..y1.
struct Span {
    int x0, x1, y0, y1;
    int view, depth_bits, unused0, unused1;
};

// Rays of a tile or of a warp: all lie within `spread` of `axis`, all instants within `span` of `middle`.
struct Cone {
    float4 axis;                // xyz; spread, negative where there are no rays
    float4 time;                // middle, span
};

// Where a block of static Gaussians lies, how wrong it is (render/lod.py; 0: not merged), and the block that stands for it
// and its neighbours one level above; -1 for none.
struct Sphere {
    float x, y, z, radius, error_m;
    int parent;
};

struct Ray {
    float3 direction;           // in the reference frame, unit length; zero where the cell has no ray
    float instant;
};

// The transmittance at which a ray ends.
INLINE float least_transmittance(const View& view) {
    return view.kind == LIDAR ? LIDAR_MIN_TRANSMITTANCE : MIN_TRANSMITTANCE;
}

// The cell that a thread of a tile's block looks at; -1 outside of the grid.
INLINE int cell_of(const View& view, int tile) {
    int warp = threadIdx.x / 32, lane = threadIdx.x % 32, local = tile - view.first_tile;
    int column = local % view.tile_columns * TILE + warp % 2 * 8 + lane % 8;
    int row = local / view.tile_columns * TILE + warp / 2 * 4 + lane / 8;
    return column < view.columns && row < view.rows ? row * view.columns + column : -1;
}

INLINE Ray ray_of(const View& view, int cell) {
    Ray ray = {make_float3(0, 0, 0), 0};
    if (cell < 0) return ray;
    float4 entry = view.rays[cell];
    ray.direction = xyz(entry);
    ray.instant = entry.w;
    if (view.moving) ray.direction = turned(ray.direction, entry.w * load3(view.swing));
    return ray;
}
