// How a ray meets a Gaussian, exactly (3DGUT).
//
// With R the rotation and S the standard deviations of a Gaussian in the reference frame, A = S^-1 R^T, m its centre,
// b = A m, n = |b| and e1, e2 perpendicular to b, a ray d from the eye has (X, Y, W) = rows d and
//
//     Q1 = X^2 + Y^2,  Q2 = FLAT Q1 + W^2,  q / 16 = Q1 / Q2,  t = W / Q2,  FLAT = 16 / n^2
//
// where q is its squared distance in standard deviations: X and Y vanish at the centre, so nothing large cancels. A ray
// from elsewhere, o, with (Xo, Yo, Wo) = rows o and w = 1 - Wo, has
//
//     Q1 = (X w + W Xo)^2 + (Y w + W Yo)^2 + FLAT (X Yo - Y Xo)^2,  t = (W w - FLAT (X Xo + Y Yo)) / Q2.
//
// alpha = exp(-8 (Q1 / Q2 + FADE)) with FADE = -log(opacity) / 8.
#pragma once
#include "view.cuh"

#define LIMIT (LOG_255 / 8)

struct Hit {
    float alpha, t;
    float x, y, w, q1, q2, forward;  // forward = t Q2
};

// `drift` holds rows . travel. Returns whether the ray meets the Gaussian, at least 1/255 opaque.
INLINE bool meet(const Record& r, float3 drift, bool moving, const Ray& ray, float near_m, Hit* hit) {
    hit->x = dot(xyz(r.x), ray.direction);
    hit->y = dot(xyz(r.y), ray.direction);
    hit->w = dot(xyz(r.w), ray.direction);
    float across = hit->x * hit->x + hit->y * hit->y;
    hit->q1 = across;
    hit->q2 = r.x.w * across + hit->w * hit->w;
    hit->forward = hit->w;
    if (moving) {
        float3 o = ray.instant * drift;
        float keep = 1 - o.z;
        float a = hit->x * keep + hit->w * o.x, b = hit->y * keep + hit->w * o.y, c = hit->x * o.y - hit->y * o.x;
        hit->q1 = a * a + b * b + r.x.w * c * c;
        hit->forward = hit->w * keep - r.x.w * (hit->x * o.x + hit->y * o.y);
    }
    float inverse = __fdividef(1.0f, hit->q2), exponent = hit->q1 * inverse + r.y.w;
    hit->t = hit->forward * inverse;
    hit->alpha = __expf(-8.0f * exponent);
    bool close = __float_as_uint(r.w.w) & CLOSE_BIT;
    return hit->forward > 0 && exponent < LIMIT && !(close && hit->t < near_m);
}

// Whether any ray of a cone can meet the Gaussian: never false where one does. Over the cone (X, Y) and W change by at
// most bound.x and bound.y times its spread, and a hit needs |(X, Y)| < RIM W. From a moving eye the hit lies at o + t d
// with t near the distance D of the centre, so that the eye sees it along d + o / D but for what `bound` leaves open.
INLINE bool may_meet(const Record& r, const Cone& cone, float3 travel, float travel_m) {
    float3 axis = xyz(cone.axis);
    float spread = cone.axis.w;
    if (spread < 0) return false;
    if (travel_m > 0) {
        axis = axis + (cone.time.x * r.bound.z) * travel;
        spread += travel_m * (fabsf(cone.time.x) * (r.bound.w - r.bound.z) + cone.time.y * r.bound.w);
    }
    float x = dot(xyz(r.x), axis), y = dot(xyz(r.y), axis), w = dot(xyz(r.w), axis) + r.bound.y * spread;
    return w > 0 && sqrtf(x * x + y * y) <= 1.0001f * (r.features.w * w + r.bound.x * spread);
}
