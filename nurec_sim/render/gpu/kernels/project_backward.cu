// Gradients of records carried back to the Gaussians: mean, rotation, scale, opacity and features.
//
// With X = e1^T A / 4, Y = e2^T A / 4, W = b^T A / n^2 and b = A m (response.cuh), e1 and e2 turn with b: the rest of
// their freedom, a turn about b, changes no response. So de1 = -(e1 . db) b / n^2, and likewise e2.
#include "view.cuh"

#define SUMS 16
#define GRADIENTS 14

// One thread per packed Gaussian. Sums over the views first_view..last_view - 1 and over each record's tiles, in order.
// Writes gradients [GRADIENTS][rows]: mean (world), quaternion, scale, log opacity, features.
extern "C" __global__ void __launch_bounds__(THREADS)
project_backward(const View* views, int first_view, int last_view, const float* fields, const int* record_of_row,
                 const long long* place_of_record, const int* counts, const long long* ends, const float* sums,
                 float* gradients) {
    int row = blockIdx.x * BLOCK + threadIdx.x, rows = gridDim.x * BLOCK;
    const float* f = fields + (size_t)blockIdx.x * FIELDS * BLOCK + threadIdx.x;
    float quat[4], out[GRADIENTS] = {};
    float3 scale = make_float3(f[SCALE * BLOCK], f[(SCALE + 1) * BLOCK], f[(SCALE + 2) * BLOCK]), world[3], turn[3];
    for (int k = 0; k < 4; ++k) quat[k] = f[(QUAT + k) * BLOCK];
    rotation_columns(quat[0], quat[1], quat[2], quat[3], world);
    for (int k = 0; k < 3; ++k) turn[k] = make_float3(0, 0, 0);  // gradient of the columns of the rotation

    for (int v = first_view; v < last_view; ++v) {
        int record = record_of_row[(size_t)v * rows + row];
        if (record < 0) continue;
        const View& view = views[v];
        float g[SUMS] = {};
        long long place = place_of_record[record], last = ends[place];
        for (long long k = last - counts[place]; k < last; ++k) {
            for (int c = 0; c < SUMS; ++c) g[c] += sums[k * SUMS + c];
        }
        float3 offset =
            make_float3((float)(f[MEAN * BLOCK] - view.eye[0]), (float)(f[(MEAN + 1) * BLOCK] - view.eye[1]),
                        (float)(f[(MEAN + 2) * BLOCK] - view.eye[2]));
        float3 m = apply(view.turn, offset), axes[3];
        for (int k = 0; k < 3; ++k) axes[k] = apply(view.turn, world[k]);
        float3 row_a[3] = {(1 / scale.x) * axes[0], (1 / scale.y) * axes[1], (1 / scale.z) * axes[2]};
        float3 b = make_float3(dot(row_a[0], m), dot(row_a[1], m), dot(row_a[2], m)), e1, e2;
        float inverse2 = 1 / fmaxf(dot(b, b), 1e-30f);
        perpendicular(sqrtf(inverse2) * b, &e1, &e2);
        float3 w = inverse2 * (b.x * row_a[0] + (b.y * row_a[1] + b.z * row_a[2]));
        float3 gx = 0.25f * load3(g), gy = 0.25f * load3(g + 3), gw = inverse2 * load3(g + 6);
        float3 along = make_float3(dot(row_a[0], gw), dot(row_a[1], gw), dot(row_a[2], gw));
        float radial = 2 * dot(w, gw) + 32 * inverse2 * inverse2 * g[9];
        float3 gb = along - (dot(w, gx) * e1 + (dot(w, gy) * e2 + radial * b));

        float3 ga[3] = {e1.x * gx + (e2.x * gy + (b.x * gw + gb.x * m)),
                        e1.y * gx + (e2.y * gy + (b.y * gw + gb.y * m)),
                        e1.z * gx + (e2.z * gy + (b.z * gw + gb.z * m))};
        float3 gm = apply_transposed(view.turn, gb.x * row_a[0] + (gb.y * row_a[1] + gb.z * row_a[2]));
        out[0] += gm.x, out[1] += gm.y, out[2] += gm.z;
        out[7] -= dot(ga[0], row_a[0]) / scale.x;
        out[8] -= dot(ga[1], row_a[1]) / scale.y;
        out[9] -= dot(ga[2], row_a[2]) / scale.z;
        turn[0] = turn[0] + (1 / scale.x) * apply_transposed(view.turn, ga[0]);
        turn[1] = turn[1] + (1 / scale.y) * apply_transposed(view.turn, ga[1]);
        turn[2] = turn[2] + (1 / scale.z) * apply_transposed(view.turn, ga[2]);
        out[10] -= g[10] * 0.125f;
        for (int c = 0; c < 3; ++c) out[11 + c] += g[11 + c];
    }
    // Columns of the rotation of a unit quaternion, differentiated.
    float qw = 2 * quat[0], qx = 2 * quat[1], qy = 2 * quat[2], qz = 2 * quat[3];
    out[3] = qz * (turn[0].y - turn[1].x) + qy * (turn[2].x - turn[0].z) + qx * (turn[1].z - turn[2].y);
    out[4] = qy * (turn[0].y + turn[1].x) + qz * (turn[0].z + turn[2].x) + qw * (turn[1].z - turn[2].y) -
             2 * qx * (turn[1].y + turn[2].z);
    out[5] = qx * (turn[0].y + turn[1].x) + qz * (turn[1].z + turn[2].y) + qw * (turn[2].x - turn[0].z) -
             2 * qy * (turn[0].x + turn[2].z);
    out[6] = qx * (turn[0].z + turn[2].x) + qy * (turn[1].z + turn[2].y) + qw * (turn[0].y - turn[1].x) -
             2 * qz * (turn[0].x + turn[1].y);
    for (int c = 0; c < GRADIENTS; ++c) gradients[(size_t)c * rows + row] = out[c];
}
