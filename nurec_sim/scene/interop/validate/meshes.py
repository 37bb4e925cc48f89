"""Meshes for AlpaSim's physics: ``mesh_ground.ply`` and ``mesh.ply``, ASCII or binary, of triangles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.ply_table import BYTE_ORDERS, TYPES
from nurec_sim.scene.interop.validate.contents import Contents
from nurec_sim.scene.interop.validate.finding import Report

PROBES = 40
GROUND_WITHIN_M = 2.0
_MAX_HEADER_BYTES = 65536


def check_ground(report: Report, contents: Contents, world_from_rig: Float64[np.ndarray, "t 4 4"] | None) -> None:
    """Adds findings on the meshes; the ground is probed below the path, if any."""
    with report.rule("mesh-ground"):
        vertices, triangles = read_triangles(contents.read("mesh_ground.ply"), "mesh_ground.ply")
        if world_from_rig is not None:
            places = world_from_rig[np.unique(np.linspace(0, len(world_from_rig) - 1, PROBES).astype(int)), :3, 3]
            found = _has_ground(vertices, triangles, places)
            if not found.all():
                message = (
                    f"mesh_ground.ply: no ground within {GROUND_WITHIN_M:g} m of the rig at {int((~found).sum())} of "
                )
                first = ", ".join(f"{value:.1f}" for value in places[np.argmin(found)])
                report.add("mesh-under-path", f"{message}{len(found)} places of the path, the first at {first}")
    with report.rule("mesh"):
        read_triangles(contents.read("mesh.ply"), "mesh.ply")


def _has_ground(
    vertices: Float64[np.ndarray, "v 3"], triangles: Int64[np.ndarray, "f 3"], places: Float64[np.ndarray, "p 3"]
) -> Bool[np.ndarray, " p"]:
    """Whether a triangle is within ``GROUND_WITHIN_M`` above or below each point."""
    corners = vertices[triangles]
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    found = np.zeros(len(places), bool)
    for index, place in enumerate(places):
        near = ((low <= place[:2] + 1e-6) & (high >= place[:2] - 1e-6)).all(axis=1)
        a, b, c = np.moveaxis(corners[near], 1, 0)
        ab, ac, ap = (b - a)[:, :2], (c - a)[:, :2], place[:2] - a[:, :2]
        # Barycentric coordinates in the xy plane; vertical triangles have no area there.
        area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
        flat = np.abs(area) < 1e-12
        area = np.where(flat, 1.0, area)
        v = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
        w = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
        inside = ~flat & (v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6)
        height = a[:, 2] + v * (b - a)[:, 2] + w * (c - a)[:, 2]
        found[index] = (inside & (np.abs(height - place[2]) <= GROUND_WITHIN_M)).any()
    return found


def read_triangles(data: bytes, name: str) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
    """Vertices and triangles of a PLY mesh; other properties are skipped.

    Raises:
        ArchiveError: no PLY, cut short, without triangles, with other polygons, or with corners that are not there.
    """
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise ArchiveError(f"{name} is no PLY file")
    try:
        kind, elements = _header(data[:end].decode("ascii", "replace"))
        body = data[line_end + 1 :]
        read = _ascii if kind == "ascii" else _binary
        vertices, faces = read(body, elements, BYTE_ORDERS[kind])
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError) as error:
        raise ArchiveError(f"{name} is damaged or of an unknown layout ({error})") from None
    if len(faces) == 0 or len(vertices) < 3:
        raise ArchiveError(f"{name} has {len(faces)} triangles and {len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        raise ArchiveError(f"{name} has vertices that are not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ArchiveError(f"{name}: a triangle names a vertex that is not there")
    return vertices, faces


Elements = dict[str, tuple[int, list[list[str]]]]


def _header(text: str) -> tuple[str, Elements]:
    """(format, {element: (count, its property lines)}), elements in order."""
    kind, current = "", ""
    elements: Elements = {}
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            kind = words[1]
        elif words[:1] == ["element"]:
            current = words[1]
            elements[current] = (int(words[2]), [])
            if elements[current][0] < 0:
                raise ValueError(f"{words[2]} of {current}")
        elif words[:1] == ["property"]:
            elements[current][1].append(words[1:])
    if kind not in BYTE_ORDERS:
        raise ValueError(f"format {kind!r}")
    if list(elements)[:2] != ["vertex", "face"]:
        raise ValueError(f"elements {list(elements)}; vertex, then face is read")
    return kind, elements


def _columns(properties: list[list[str]], order: str) -> np.dtype:
    """A row of an element; a list is taken to have three entries."""
    fields: list[tuple] = []
    for words in properties:
        if words[0] == "list":
            fields.append((f"count of {words[3]}", order + TYPES[words[1]]))
            fields.append((words[3], order + TYPES[words[2]], 3))
        else:
            fields.append((words[1], order + TYPES[words[0]]))
    return np.dtype(fields)


def _binary(body: bytes, elements: Elements, order: str) -> tuple[np.ndarray, np.ndarray]:
    (vertex_count, vertex_properties), (face_count, face_properties) = elements["vertex"], elements["face"]
    vertex_row, face_row = _columns(vertex_properties, order), _columns(face_properties, order)
    rows = np.frombuffer(body, vertex_row, vertex_count)
    faces = np.frombuffer(body, face_row, face_count, offset=vertex_count * vertex_row.itemsize)
    name = _corner_list(face_properties)
    if not (faces[f"count of {name}"] == 3).all():
        raise ValueError("a face is no triangle")
    return np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"]), faces[name].astype(np.int64)


def _ascii(body: bytes, elements: Elements, order: str) -> tuple[np.ndarray, np.ndarray]:
    (vertex_count, vertex_properties), (face_count, face_properties) = elements["vertex"], elements["face"]
    lines = body.splitlines()
    if len(lines) < vertex_count + face_count:
        raise ValueError("cut short")
    names = [words[-1] for words in vertex_properties]
    columns = [names.index(axis) for axis in "xyz"]
    vertices = [[float(words[c]) for c in columns] for words in map(bytes.split, lines[:vertex_count])]
    faces = [[int(word) for word in line.split()[:4]] for line in lines[vertex_count : vertex_count + face_count]]
    _corner_list(face_properties[:1])
    if any(len(face) != 4 or face[0] != 3 for face in faces):
        raise ValueError("a face is no triangle")
    return np.array(vertices).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 4)[:, 1:]


def _corner_list(properties: list[list[str]]) -> str:
    """The name of the list of corners."""
    for words in properties:
        if words[0] == "list" and words[3] in ("vertex_indices", "vertex_index"):
            return words[3]
    raise ValueError("faces have no list vertex_indices")
