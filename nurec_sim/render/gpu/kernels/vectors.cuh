// Small vector arithmetic, and sums over the lanes of a warp.
#pragma once

#define FULL_WARP 0xffffffffu
#define INLINE static __device__ __forceinline__

INLINE float3 operator+(float3 a, float3 b) { return make_float3(a.x + b.x, a.y + b.y, a.z + b.z); }
INLINE float3 operator-(float3 a, float3 b) { return make_float3(a.x - b.x, a.y - b.y, a.z - b.z); }
INLINE float3 operator*(float s, float3 a) { return make_float3(s * a.x, s * a.y, s * a.z); }
INLINE float dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE float length(float3 a) { return sqrtf(dot(a, a)); }
INLINE float3 cross(float3 a, float3 b) {
    return make_float3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
INLINE float3 xyz(float4 a) { return make_float3(a.x, a.y, a.z); }
INLINE float3 load3(const float* p) { return make_float3(p[0], p[1], p[2]); }
INLINE float4 with(float3 a, float w) { return make_float4(a.x, a.y, a.z, w); }

// A row-major 3x3 matrix times a vector, and its transpose times a vector.
INLINE float3 apply(const float* m, float3 a) {
    return make_float3(dot(load3(m), a), dot(load3(m + 3), a), dot(load3(m + 6), a));
}
INLINE float3 apply_transposed(const float* m, float3 a) {
    return a.x * load3(m) + (a.y * load3(m + 3) + a.z * load3(m + 6));
}

// The vector turned by a rotation vector (Rodrigues), stable down to no rotation.
INLINE float3 turned(float3 a, float3 rotation) {
    float half = 0.5f * length(rotation), sine, cosine;
    sincospif(half * 0.3183098862f, &sine, &cosine);  // unlike sinf, needs no local memory for huge angles
    float s = half > 1e-4f ? sine / half : 1.0f;
    float3 across = cross(rotation, a);
    return a + ((s * cosine) * across + (0.5f * s * s) * cross(rotation, across));
}

// Columns of the rotation matrix of a unit quaternion (w, x, y, z).
INLINE void rotation_columns(float w, float x, float y, float z, float3 column[3]) {
    column[0] = make_float3(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y));
    column[1] = make_float3(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x));
    column[2] = make_float3(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
}

// Two unit vectors perpendicular to a unit vector and to each other (Duff et al. 2017).
INLINE void perpendicular(float3 u, float3* e1, float3* e2) {
    float sign = u.z >= 0 ? 1.0f : -1.0f;
    float a = -1.0f / (sign + u.z), b = u.x * u.y * a;
    *e1 = make_float3(1 + sign * u.x * u.x * a, sign * b, -sign * u.x);
    *e2 = make_float3(b, sign + u.y * u.y * a, -u.y);
}

INLINE float warp_sum(float v) {
    for (int bit = 16; bit > 0; bit /= 2) v += __shfl_xor_sync(FULL_WARP, v, bit);
    return v;
}
INLINE float warp_max(float v) {
    for (int bit = 16; bit > 0; bit /= 2) v = fmaxf(v, __shfl_xor_sync(FULL_WARP, v, bit));
    return v;
}
INLINE float3 warp_sum(float3 v) { return make_float3(warp_sum(v.x), warp_sum(v.y), warp_sum(v.z)); }

// Lanes trade halves of their values: each keeps the sums of the half that bit `2 * HALF` of its number names.
template <int HALF>
INLINE void fold(float (&v)[16]) {
    bool upper = threadIdx.x & (2 * HALF);
#pragma unroll
    for (int k = 0; k < HALF; ++k) {
        float give = upper ? v[k] : v[k + HALF], keep = upper ? v[k + HALF] : v[k];
        v[k] = keep + __shfl_xor_sync(FULL_WARP, give, 2 * HALF);
    }
}

// Sums of 16 values over a warp in 16 shuffles instead of 80: lanes 2k and 2k+1 return the sum of value k.
INLINE float warp_sums(float (&v)[16]) {
    fold<8>(v), fold<4>(v), fold<2>(v), fold<1>(v);
    return v[0] + __shfl_xor_sync(FULL_WARP, v[0], 1);
}
