"""Kernel that turns blended planes into a camera frame: sky, colour correction, rounding, depth, labels, normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from llvmlite import ir

from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.records import LABEL_BITS, STEP
from nurec_sim.render.cpu.simd import I8, I32, INTS, LANES, Lanes, Vector, spread, vector_kernel
from nurec_sim.types import Label

SKY = int(Label.SKY)
SURFACE_ALPHA = 0.5
VISIBLE_SKY = 1e-4
"""Where less of the sky than this is left, it is not looked up."""

# Planes of a picture, see ``draw.draw_tiles``; the last two come after the normals.
ALPHA, COLOUR = 0, 1


class CameraRays(NamedTuple):
    """A camera's rays by pixel, as the finishing pass reads them; see ``grid.Grid``."""

    ray_z: Float32[np.ndarray, "h w"]
    """Depth per distance: z of the unit rays; [0,0] where distances are depths already."""
    direction: Float32[np.ndarray, "h w 3"]
    """Unit rays in the sensor's frame."""
    valid: UInt8[np.ndarray, "h w"]
    line: Int32[np.ndarray, "h w"]
    world_from_line: Float32[np.ndarray, "l 3 3"]
    """Turns a line's rays into the world; a single one where nothing moves."""


class CameraPixels(NamedTuple):
    """Pixels of a finished camera frame."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    alpha: Float32[np.ndarray, "h w"]
    label: UInt8[np.ndarray, "h w"]
    normal: Float32[np.ndarray, "h w 3"]
    """[0,0,3] where it is not requested."""


@inner
def sky_lookup(sky, x, y, z, behind, lane):
    """Write the bilinear colour of a world direction (``geometry.cubemap_coordinates``), clamped within a face.

    Args:
        sky: [6,s,s,3] cubemap.
        x: direction in the world, of any length.
        y: see x.
        z: see x.
        behind: [3,LANES] output.
        lane: column of ``behind`` to write.
    """
    # The cubemap has OpenGL axes (y up, -z ahead), the world x ahead, y left, z up.
    gx, gy, gz = -y, z, -x
    ax, ay, az = abs(gx), abs(gy), abs(gz)
    if az > ax and az > ay:
        face, major, s, t = (4, az, gx, -gy) if gz > 0 else (5, az, -gx, -gy)
    elif ay > ax and ay >= az:
        face, major, s, t = (2, ay, gx, gz) if gy > 0 else (3, ay, gx, -gz)
    else:
        face, major, s, t = (0, ax, -gz, -gy) if gx > 0 else (1, ax, gz, -gy)
    size = sky.shape[1]
    scale = f4(0.5) / max(major, f4(1e-30))
    u = min(max((s * scale + f4(0.5)) * f4(size) - f4(0.5), f4(0)), f4(size - 1))
    v = min(max((t * scale + f4(0.5)) * f4(size) - f4(0.5), f4(0)), f4(size - 1))
    i, j = np.uint64(u), np.uint64(v)
    i1, j1 = min(i + np.uint64(1), np.uint64(size - 1)), min(j + np.uint64(1), np.uint64(size - 1))
    fu, fv = u - f4(i), v - f4(j)
    for c in range(3):
        top = sky[face, j, i, c] + fu * (sky[face, j, i1, c] - sky[face, j, i, c])
        bottom = sky[face, j1, i, c] + fu * (sky[face, j1, i1, c] - sky[face, j1, i, c])
        behind[c, lane] = top + fv * (bottom - top)


@vector_kernel("ii")
def sky_mask(v: Lanes, alpha: ir.Value, valid: ir.Value) -> ir.Value:
    """The pixels behind which the sky shows."""
    seen = v.load(alpha) < 1 - VISIBLE_SKY
    rays = v.b.load(v.pointer(valid), typ=ir.VectorType(I8, LANES), align=1)
    some = v.b.icmp_unsigned("!=", rays, ir.Constant(rays.type, [0] * LANES))
    return v.b.zext(v.b.bitcast(v.b.and_(seen.value, some), ir.IntType(LANES)), ir.IntType(64))


def _bytes(v: Lanes, x: Vector) -> ir.Value:
    return v.b.trunc(x.integers(), ir.VectorType(I8, LANES))


@vector_kernel("iiiiiiiiii")
def finish_pixels(
    v: Lanes,
    planes: ir.Value,
    plane_bytes: ir.Value,
    last: ir.Value,
    behind: ir.Value,
    valid: ir.Value,
    ray_z: ir.Value,
    isp: ir.Value,
    rgb: ir.Value,
    depth: ir.Value,
    label: ir.Value,
) -> None:
    """Finish LANES pixels.

    Args:
        v: vectors.
        planes: address of the pixels in the first plane.
        plane_bytes: distance of planes.
        last: offset of the plane of distances, which the tagged weights follow.
        behind: address of the sky's [3,LANES] colours.
        valid: address of a byte per pixel, 0 where there is no ray.
        ray_z: address of the rays' z, or 0 where distances are depths already.
        isp: address of the [3,4] colour correction.
        rgb: output, 3 bytes a pixel.
        depth: output, float32.
        label: output, a byte a pixel.
    """
    b = v.b
    at = planes
    rays = b.load(v.pointer(valid), typ=ir.VectorType(I8, LANES), align=1)
    there = b.icmp_unsigned("!=", rays, ir.Constant(rays.type, [0] * LANES))
    alpha = Vector(b, b.select(there, v.load(at).value, v.number(0).value))
    # Pixels without a ray count as transparent here and become black below.
    left = 1 - alpha
    colour = []
    for c in range(3):
        at = b.add(at, plane_bytes)
        colour.append(v.load(at) + left * v.load(behind, STEP * c))
    channels = []
    # The colour correction comes after the sky, because the camera sees both through the same optics.
    for c in range(3):
        row = [v.broadcast(isp, 4 * (4 * c + k)) for k in range(4)]
        # Clipped to 0..1; adding 0.5 before truncation rounds half up, as in ``spec``.
        shown = (row[0] * colour[0] + row[1] * colour[1] + row[2] * colour[2] + row[3]).max(0).min(1)
        shown = Vector(b, b.select(there, (shown * 255 + 0.5).value, v.number(0).value))
        channels.append(_bytes(v, shown))
    # Interleave three bytes a pixel: first two channels side by side, then the third between them.
    red_green = b.shuffle_vector(
        channels[0], channels[1], ir.Constant(ir.VectorType(I32, 2 * LANES), list(range(2 * LANES)))
    )
    blue = b.shuffle_vector(
        channels[2], channels[2], ir.Constant(ir.VectorType(I32, 2 * LANES), list(range(2 * LANES)))
    )
    order = [k // 3 + (k % 3) * LANES for k in range(3 * LANES)]
    # Lane order R0 G0 B0 R1 ..: one store of 3 LANES bytes.
    mixed = b.shuffle_vector(red_green, blue, ir.Constant(ir.VectorType(I32, 3 * LANES), order))
    b.store(mixed, v.pointer(rgb), align=1)

    surface = alpha >= SURFACE_ALPHA
    distance_at = b.add(planes, last)
    # Expected distance of what the ray met: the sum of weights times distances over the sum of weights.
    far = v.load(distance_at) / alpha.max(1e-6)
    table = b.icmp_signed("!=", ray_z, ir.Constant(ray_z.type, 0))
    z = v.load(b.select(table, ray_z, planes))
    one = b.select(spread(b, table, ir.VectorType(ir.IntType(1), LANES)), z.value, v.number(1).value)
    v.store(surface.where((far * Vector(b, one)).max(0), 0), depth)
    tagged = v.load(b.add(distance_at, plane_bytes)).bits()
    seen = b.and_(tagged, ir.Constant(INTS, [LABEL_BITS] * LANES))
    # The low bits of the heaviest weight are the label it came with (``blocks``).
    kept = b.select(surface.value, seen, ir.Constant(INTS, [SKY] * LANES))
    b.store(b.trunc(kept, ir.VectorType(I8, LANES)), v.pointer(label), align=1)


@inner
def _normals(planes, valid, y, width, normal):
    """Unit normals of a row."""
    for x in range(width):
        a, b, c = planes[4, y, x], planes[5, y, x], planes[6, y, x]
        length = np.sqrt(a * a + b * b + c * c)
        known = valid[y, x] != 0 and planes[ALPHA, y, x] >= f4(SURFACE_ALPHA) and length > f4(1e-6)
        scale = f4(1) / length if known else f4(0)
        normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = a * scale, b * scale, c * scale


@kernel
def composite(first, last, planes, rays, sky, isp, pixels):
    """Finish the rows first..last of a camera frame.

    Args:
        first: first row.
        last: one behind the last.
        planes: see ``draw.draw_tiles``; rows are at least LANES longer than the last group of pixels begins.
        rays: see ``CameraRays``.
        sky: cubemap [6,s,s,3].
        isp: [3,4].
        pixels: output, see ``CameraPixels``.
    """
    ray_z, direction, valid, line, world_from_line = rays
    rgb, depth, alpha, label, normal = pixels
    width = valid.shape[1]
    behind = np.zeros((3, LANES), np.float32)
    # The last pixels of a row may be fewer than LANES: they pass through arrays of their own, so nothing is written
    # past the row.
    colours, labels, depths = np.empty(3 * LANES, np.uint8), np.empty(LANES, np.uint8), np.empty(LANES, np.float32)
    rays, heights = np.zeros(LANES, np.uint8), np.zeros(LANES, np.float32)
    plane_bytes, row_bytes = 4 * planes.shape[1] * planes.shape[2], 4 * planes.shape[2]
    distances = (planes.shape[0] - 2) * plane_bytes
    table = ray_z.shape[0] > 0
    moving = world_from_line.shape[0] > 1
    for y in range(first, last):
        for x in range(0, width, LANES):
            at = planes.ctypes.data + y * row_bytes + 4 * x
            whole = x + LANES <= width
            valid_at = valid.ctypes.data + y * width + x
            z_at = ray_z.ctypes.data + 4 * (y * width + x) if table else np.int64(0)
            if not whole:
                for k in range(LANES):
                    inside = x + k < width
                    rays[k] = valid[y, x + k] if inside else np.uint8(0)
                    heights[k] = ray_z[y, x + k] if inside and table else f4(1)
                valid_at = rays.ctypes.data
                z_at = heights.ctypes.data if table else np.int64(0)
            # Most pixels are opaque: the lookup is done only where some of the sky shows.
            shown = sky_mask(at, valid_at)
            behind[:] = f4(0)  # leftovers of other pixels would make a frame depend on the rows done before
            if shown != 0:
                for k in range(min(LANES, width - x)):
                    if (shown >> k) & 1:
                        m = world_from_line[np.uint64(line[y, x + k]) if moving else np.uint64(0)]
                        a, b, c = direction[y, x + k, 0], direction[y, x + k, 1], direction[y, x + k, 2]
                        px = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
                        py = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
                        pz = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
                        sky_lookup(sky, px, py, pz, behind, k)
            if whole:
                finish_pixels(at, plane_bytes, distances, behind.ctypes.data, valid_at, z_at, isp.ctypes.data,
                              rgb.ctypes.data + 3 * (y * width + x), depth.ctypes.data + 4 * (y * width + x),
                              label.ctypes.data + y * width + x)  # fmt: skip
            else:
                finish_pixels(at, plane_bytes, distances, behind.ctypes.data, valid_at, z_at, isp.ctypes.data,
                              colours.ctypes.data, depths.ctypes.data, labels.ctypes.data)  # fmt: skip
                for k in range(width - x):
                    depth[y, x + k], label[y, x + k] = depths[k], labels[k]
                    for channel in range(3):
                        rgb[y, x + k, channel] = colours[3 * k + channel]
        for x in range(width):
            alpha[y, x] = planes[ALPHA, y, x] if valid[y, x] != 0 else f4(0)
        if normal.shape[0] > 0:
            _normals(planes, valid, y, width, normal)
