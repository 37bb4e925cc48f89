// Rigid transforms in double precision: quaternions of rotations, and poses between two.
#pragma once
#include "vectors.cuh"

struct Pose {
    double rotation[9], translation[3];
};

INLINE Pose load_pose(const double* m) {
    return {{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}, {m[3], m[7], m[11]}};
}

// Unit quaternion of a rotation, w first and not negative (geometry.quat_from_matrix).
INLINE void quat_of(const double* m, double* q) {
    double d[4] = {1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8], 1 - m[0] - m[4] + m[8]};
    double a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1], xy = m[3] + m[1], xz = m[2] + m[6], yz = m[7] + m[5];
    double rows[4][4] = {{d[0], a, b, c}, {a, d[1], xy, xz}, {b, xy, d[2], yz}, {c, xz, yz, d[3]}};
    // The row with the greatest diagonal, chosen without an index that would put the rows into local memory.
    double row[4] = {d[0], a, b, c}, top = d[0];
#pragma unroll
    for (int k = 1; k < 4; ++k) {
        bool better = d[k] > top;
        top = better ? d[k] : top;
#pragma unroll
        for (int j = 0; j < 4; ++j) row[j] = better ? rows[k][j] : row[j];
    }
    double size = 0;
    for (int k = 0; k < 4; ++k) size += row[k] * row[k];
    size = row[0] < 0 ? -sqrt(size) : sqrt(size);
    for (int k = 0; k < 4; ++k) q[k] = row[k] / size;
}

// Between two poses [4][4]: positions linear, rotations along the shorter arc (geometry.interpolate_pose_pair).
INLINE Pose between(const double* from, const double* to, double fraction) {
    Pose a = load_pose(from), b = load_pose(to);
    bool turns = false;
    for (int k = 0; k < 9; ++k) turns = turns || a.rotation[k] != b.rotation[k];
    for (int k = 0; k < 3; ++k) a.translation[k] += fraction * (b.translation[k] - a.translation[k]);
    if (!turns) return a;
    double p[4], q[4], dot = 0, gap = 0, size = 0;
    quat_of(a.rotation, p), quat_of(b.rotation, q);
    for (int k = 0; k < 4; ++k) dot += p[k] * q[k];
    for (int k = 0; k < 4; ++k) q[k] = dot < 0 ? -q[k] : q[k];
    for (int k = 0; k < 4; ++k) gap += (q[k] - p[k]) * (q[k] - p[k]);
    // Angles in half turns: sinpi needs no reduction of large arguments, for which sin keeps a table in local memory.
    double half = sqrt(gap) / 2, angle = 2 * asin(half < 1 ? half : 1.0) / 3.14159265358979323846;
    double first = 1 - fraction, second = fraction;
    if (angle >= 1e-9 / 3.14159265358979323846)
        first = sinpi(first * angle) / sinpi(angle), second = sinpi(second * angle) / sinpi(angle);
    for (int k = 0; k < 4; ++k) q[k] = first * p[k] + second * q[k], size += q[k] * q[k];
    size = 1 / sqrt(size);
    double w = q[0] * size, x = q[1] * size, y = q[2] * size, z = q[3] * size;
    return {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
             1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
             1 - 2 * (x * x + y * y)},
            {a.translation[0], a.translation[1], a.translation[2]}};
}
