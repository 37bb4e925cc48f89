// Where on a sensor's grid a Gaussian can be seen; conservative, in cells (centres at +0.5). Tiles inside of these boxes
// are tested again, ray cone by ray cone (response.cuh), so a wide box costs time and nothing else.
#pragma once
#include "view.cuh"

struct Box {
    float u0, u1, v0, v1;
};
#define EVERYWHERE Box{-1e9f, 1e9f, -1e9f, 1e9f}
#define NOWHERE Box{1e9f, -1e9f, 1e9f, -1e9f}

// Tangent of the angular radius from which a Gaussian is taken to cover the whole grid of a lens or a LiDAR.
#define WIDE 1.5f

INLINE Box around(Box a, Box b) {
    return Box{fminf(a.u0, b.u0), fmaxf(a.u1, b.u1), fminf(a.v0, b.v0), fmaxf(a.v1, b.v1)};
}

// Parameters of a view (render/cpu/project/charts.py).
enum Pinhole { FX, FY, CX, CY };
enum Lens { TEXELS, MIDDLE, MISFIT };
enum Lidar { PER_RADIAN, AZIMUTH, PERIOD, LEAST_AHEAD, MOST_AHEAD };

// A direction's pixel, from the table [size, size, 2] by stereographic direction.
INLINE float2 lens_place(const View& view, float3 p) {
    int size = view.table_size;
    float far = length(p), scale = view.params[TEXELS] / fmaxf(far + p.z, 1e-6f * far);
    float s = fminf(fmaxf(p.x * scale + view.params[MIDDLE], 0.0f), size - 1.001f);
    float t = fminf(fmaxf(p.y * scale + view.params[MIDDLE], 0.0f), size - 1.001f);
    int i = (int)s, j = (int)t;
    float fs = s - i, ft = t - j;
    const float* low = view.table + 2 * (j * size + i);
    const float* high = low + 2 * size;
    float u0 = low[0] + fs * (low[2] - low[0]), u1 = high[0] + fs * (high[2] - high[0]);
    float v0 = low[1] + fs * (low[3] - low[1]), v1 = high[1] + fs * (high[3] - high[1]);
    return make_float2(u0 + ft * (u1 - u0), v0 + ft * (v1 - v0));
}

// A direction's row, from the table [size] by sine of elevation; and its column, of which whole turns mean nothing.
INLINE float lidar_row(const View& view, float3 p) {
    float sine = p.z / fmaxf(length(p), 1e-20f);
    float s = fminf(fmaxf((sine + 1) * 0.5f * (view.table_size - 1), 0.0f), view.table_size - 1.01f);
    int i = (int)s;
    return view.table[i] + (s - i) * (view.table[i + 1] - view.table[i]);
}
INLINE float lidar_column(const View& view, float3 p) {
    return view.params[PER_RADIAN] * (atan2f(p.y, p.x) - view.params[AZIMUTH]) + 0.5f;
}

// Box around the image of the ellipsoid of squared radius k2, exact for an ideal pinhole: tangents of its dual conic
// k2 Sigma - m m^T. `axes` are its principal axes, as long as its standard deviations.
INLINE Box pinhole_box(const View& view, float3 m, const float3 axes[3], float k2) {
    float sxx = 0, syy = 0, szz = 0, sxz = 0, syz = 0;
    for (int k = 0; k < 3; ++k) {
        sxx += axes[k].x * axes[k].x;
        syy += axes[k].y * axes[k].y;
        szz += axes[k].z * axes[k].z;
        sxz += axes[k].x * axes[k].z;
        syz += axes[k].y * axes[k].z;
    }
    float fx = view.params[FX], fy = view.params[FY], cx = view.params[CX], cy = view.params[CY];
    if (k2 * szz > 0.999f * m.z * m.z) {
        // It reaches the camera plane: everywhere, unless it lies behind a side of the image.
        for (int side = 0; side < 4; ++side) {
            bool upright = side < 2, high = side % 2;
            float edge = upright ? ((high ? view.columns : 0) - cx) / fx : ((high ? view.rows : 0) - cy) / fy;
            float height = upright ? m.x - edge * m.z : m.y - edge * m.z;
            float reach = (upright ? sxx - 2 * edge * sxz : syy - 2 * edge * syz) + edge * edge * szz;
            if (high) height = -height;
            if (height < 0 && height * height > k2 * reach) return NOWHERE;
        }
        return EVERYWHERE;
    }
    // With x = u z the discriminant is free of the cancelling m m^T products.
    float u = m.x / m.z, v = m.y / m.z, scale = k2 / (m.z * m.z);
    float c = scale * szz - 1, bx = scale * (sxz - u * szz), by = scale * (syz - v * szz);
    float rx = sqrtf(fmaxf(bx * bx - scale * (sxx - 2 * u * sxz + u * u * szz) * c, 0.0f));
    float ry = sqrtf(fmaxf(by * by - scale * (syy - 2 * v * syz + v * v * szz) * c, 0.0f));
    const float pad = 2e-3f;  // c < 0: dividing swaps the two roots
    return Box{fx * (u + (bx + rx) / c) + cx - pad, fx * (u + (bx - rx) / c) + cx + pad,
               fy * (v + (by + ry) / c) + cy - pad, fy * (v + (by - ry) / c) + cy + pad};
}

// Box around points of the ellipsoid's outline, sent through the grid's table, with a margin for what lies between. In
// the frame where the ellipsoid is a ball its outline is a circle about a point on the way to its centre.
INLINE Box outline_box(const View& view, float3 m, const float3 axes[3], float k2) {
    float3 ball = make_float3(dot(axes[0], m) / dot(axes[0], axes[0]), dot(axes[1], m) / dot(axes[1], axes[1]),
                              dot(axes[2], m) / dot(axes[2], axes[2]));
    float n2 = dot(ball, ball);
    if (!(n2 > 1.01f * k2)) return EVERYWHERE;  // the sensor is inside
    float3 e1, e2;
    perpendicular(rsqrtf(n2) * ball, &e1, &e2);
    float keep = 1 - k2 / n2, radius = sqrtf(k2 * keep);
    float3 a = radius * (e1.x * axes[0] + (e1.y * axes[1] + e1.z * axes[2]));
    float3 b = radius * (e2.x * axes[0] + (e2.y * axes[1] + e2.z * axes[2]));
    float3 centre = keep * m;
    float angle = sqrtf(dot(a, a) + dot(b, b)) / fmaxf(length(centre), 1e-20f);
    if (!(angle <= WIDE)) return EVERYWHERE;
    bool lidar = view.kind == LIDAR;
    float2 middle = lidar ? make_float2(lidar_column(view, m), lidar_row(view, m)) : lens_place(view, m);
    Box box = {middle.x, middle.x, middle.y, middle.y};
    const int points = 16;
    float su = 0, suu = 0, sv = 0, svv = 0;
    for (int k = 0; k < points; ++k) {
        float sine, cosine;
        sincospif(k * (2.0f / points), &sine, &cosine);
        float3 p = centre + (cosine * a + sine * b);
        float2 at;
        if (lidar) {
            // Azimuth from the centre's, so that nothing wraps.
            float turn = atan2f(m.x * p.y - m.y * p.x, m.x * p.x + m.y * p.y);
            at = make_float2(middle.x + view.params[PER_RADIAN] * turn, lidar_row(view, p));
        } else {
            at = lens_place(view, p);
        }
        box = around(box, Box{at.x, at.x, at.y, at.y});
        float du = at.x - middle.x, dv = at.y - middle.y;
        su += du, suu += du * du, sv += dv, svv += dv * dv;
    }
    // The affine image of a circle reaches sqrt(2) standard deviations of evenly spaced points; the rest is the bend.
    float mu = su / points, mv = sv / points;
    float pad = lidar ? 0.15f : 0.3f + view.params[MISFIT], bend = 1.02f + 0.2f * angle;
    float hu = bend * sqrtf(2 * fmaxf(suu / points - mu * mu, 0.0f)) + pad;
    float hv = bend * sqrtf(2 * fmaxf(svv / points - mv * mv, 0.0f)) + pad;
    box = around(Box{box.u0 - pad, box.u1 + pad, box.v0 - pad, box.v1 + pad},
                 Box{middle.x + mu - hu, middle.x + mu + hu, middle.y + mv - hv, middle.y + mv + hv});
    float flat = sqrtf(m.x * m.x + m.y * m.y) / fmaxf(length(m), 1e-20f);
    if (lidar && flat < 2 * angle) box.u0 = -1e9f, box.u1 = 1e9f;  // near the pole: any azimuth
    return box;
}

// The box from where the sensor is at an instant.
INLINE Box box_at(const View& view, float instant, float3 m, const float3 axes[3], float k2) {
    float3 back = (-instant) * load3(view.swing), seen[3];
    m = turned(m - instant * load3(view.travel), back);
    for (int k = 0; k < 3; ++k) seen[k] = turned(axes[k], back);
    return view.kind == PINHOLE ? pinhole_box(view, m, seen, k2) : outline_box(view, m, seen, k2);
}

// The box during an exposure: around those of its start, middle and end, and an eighth more for the bend between them.
INLINE Box box_of(const View& view, float3 m, const float3 axes[3], float k2, float nearest) {
    Box box;
    if (!view.moving) {
        box = view.kind == PINHOLE ? pinhole_box(view, m, axes, k2) : outline_box(view, m, axes, k2);
    } else {
        if (nearest < length(load3(view.travel))) return EVERYWHERE;
        Box middle = box_at(view, 0, m, axes, k2);
        box = middle;
        for (int end = -1; end <= 1; end += 2) {
            Box other = box_at(view, 0.5f * end, m, axes, k2);
            if (view.kind == LIDAR) {
                float period = view.params[PERIOD];
                float turn = period * floorf((middle.u0 + middle.u1 - other.u0 - other.u1) / (2 * period) + 0.5f);
                other.u0 += turn, other.u1 += turn;
            }
            box = around(box, other);
        }
        if (box.u0 > box.u1 || middle.u0 > middle.u1) return box.u0 > box.u1 ? NOWHERE : EVERYWHERE;
        box.u0 -= 0.5f + 0.125f * (middle.u0 - box.u0), box.u1 += 0.5f + 0.125f * (box.u1 - middle.u1);
        box.v0 -= 0.5f + 0.125f * (middle.v0 - box.v0), box.v1 += 0.5f + 0.125f * (box.v1 - middle.v1);
    }
    // A LiDAR's beams look somewhat aside of their column.
    if (view.kind == LIDAR) box.u0 -= view.params[MOST_AHEAD], box.u1 -= view.params[LEAST_AHEAD];
    return box;
}

// Tiles that hold a ray inside of a box. Returns false where the box lies beside the grid or between all rays.
INLINE bool span_of(const View& view, Box box, Span* span) {
    float wide = view.columns, high = view.rows;
    if (!(box.v1 > 0 && box.v0 < high && box.u0 <= box.u1)) return false;
    int y0 = (int)ceilf(fmaxf(box.v0, 0.0f) - 0.5f), y1 = (int)floorf(fminf(box.v1, high) - 0.5f);
    if (y0 > y1) return false;
    span->y0 = y0 / TILE, span->y1 = y1 / TILE;
    if (view.kind == LIDAR) {
        float period = view.params[PERIOD], turn = floorf(box.u0 / period) * period;
        if (!(box.u1 - box.u0 < period - 1)) {
            span->x0 = 0, span->x1 = view.tile_columns - 1;
            return true;
        }
        // What leaves one end of a turn enters at the other.
        int x0 = (int)ceilf(box.u0 - turn - 0.5f), x1 = (int)floorf(fminf(box.u1 - turn, wide) - 0.5f);
        int again = (int)floorf(fminf(box.u1 - turn - period, wide) - 0.5f);
        span->x0 = x0 <= x1 ? x0 / TILE : 0;
        span->x1 = again >= 0 ? again / TILE : x1 / TILE;
        if (x0 <= x1 && again >= 0 && span->x0 <= span->x1) span->x0 = 0, span->x1 = view.tile_columns - 1;
        return x0 <= x1 || again >= 0;
    }
    if (!(box.u1 > 0 && box.u0 < wide)) return false;
    int x0 = (int)ceilf(fmaxf(box.u0, 0.0f) - 0.5f), x1 = (int)floorf(fminf(box.u1, wide) - 0.5f);
    span->x0 = x0 / TILE, span->x1 = x1 / TILE;
    return x0 <= x1;
}
