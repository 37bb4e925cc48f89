// Colour by view direction and of the sky.
#pragma once
#include "vectors.cuh"

#define SH_STRIDE 256

// What spherical harmonics of degree 1 and up (layers.sh_basis) add to one channel along a unit direction. `rest` points
// to coefficient 0 of the channel; coefficients lie 3 * SH_STRIDE apart; there are k of them.
INLINE float sh_channel(const float* rest, int k, float3 d) {
    const int step = 3 * SH_STRIDE;
    float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    float v = 0.4886025119f * (z * rest[step] - y * rest[0] - x * rest[2 * step]);
    if (k > 3) {
        v += 1.0925484306f * (x * y * rest[3 * step] - y * z * rest[4 * step] - x * z * rest[6 * step]);
        v += 0.3153915653f * (2 * zz - xx - yy) * rest[5 * step] + 0.5462742153f * (xx - yy) * rest[7 * step];
    }
    if (k > 8) {
        v -= 0.5900435899f * (y * (3 * xx - yy) * rest[8 * step] + x * (xx - 3 * yy) * rest[14 * step]);
        v += 2.8906114426f * x * y * z * rest[9 * step] + 1.4453057213f * z * (xx - yy) * rest[13 * step];
        v -= 0.4570457995f * (4 * zz - xx - yy) * (y * rest[10 * step] + x * rest[12 * step]);
        v += 0.3731763326f * z * (2 * zz - 3 * xx - 3 * yy) * rest[11 * step];
    }
    return v;
}

// Bilinear colour of a world direction in a cubemap [6, size, size, 3] (geometry.cubemap_coordinates), clamped within a
// face.
INLINE float3 sky_colour(const float* sky, int size, float3 d) {
    float x = -d.y, y = d.z, z = -d.x, ax = fabsf(x), ay = fabsf(y), az = fabsf(z), major, s, t;
    int face;
    if (az > ax && az > ay) {
        face = z > 0 ? 4 : 5, major = az, s = z > 0 ? x : -x, t = -y;
    } else if (ay > ax && ay >= az) {
        face = y > 0 ? 2 : 3, major = ay, s = x, t = y > 0 ? z : -z;
    } else {
        face = x > 0 ? 0 : 1, major = ax, s = x > 0 ? -z : z, t = -y;
    }
    float scale = 0.5f / fmaxf(major, 1e-30f);
    float u = fminf(fmaxf((s * scale + 0.5f) * size - 0.5f, 0.0f), size - 1.0f);
    float v = fminf(fmaxf((t * scale + 0.5f) * size - 0.5f, 0.0f), size - 1.0f);
    int i = (int)u, j = (int)v, right = i + 1 < size ? 3 : 0, below = j + 1 < size ? 3 * size : 0;
    float fu = u - i, fv = v - j;
    const float* texel = sky + 3 * ((face * size + j) * size + i);
    float3 upper = (1 - fu) * load3(texel) + fu * load3(texel + right);
    float3 lower = (1 - fu) * load3(texel + below) + fu * load3(texel + below + right);
    return (1 - fv) * upper + fv * lower;
}
