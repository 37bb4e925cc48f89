"""Meshes of street furniture, each as parts (mesh, class, material); origin on the ground, x with the traffic.

Signs and lights face -x, against the traffic; arms and seats face +y, towards the road.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from nurec_sim.world.assets.meshes import MeshBuilder
from nurec_sim.world.assets.textures_signs import SIGN_SHAPES, outline
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.plan.town import SIGNS, Prop

Part = tuple[MeshBuilder, SurfaceClass, str]
_POLE, _FURNITURE, _SIGN = SurfaceClass.POLE, SurfaceClass.FURNITURE, SurfaceClass.SIGN


def fixture_parts(prop: Prop) -> Iterator[Part]:
    """The parts of a prop other than a plant.

    Raises:
        ValueError: no such kind of prop.
    """
    if prop.kind not in _MAKERS:
        raise ValueError(f"no fixture of kind {prop.kind!r}; have {sorted(_MAKERS)}")
    return _MAKERS[prop.kind](prop)


def _lamp(prop: Prop) -> Iterator[Part]:
    pole, head = MeshBuilder(), MeshBuilder()
    high = 6.2 + 0.6 * (prop.variant % 3)
    pole.cylinder([0, 0, -0.3], [0, 0, 1.1], 0.11, 0.095, sides=8)
    pole.cylinder([0, 0, 1.0], [0, 0, high], 0.075, 0.05, sides=8)
    reach = 1.3 + 0.3 * (prop.variant % 2)
    pole.cylinder([0, 0, high - 0.1], [0, reach * 0.5, high + 0.22], 0.04, 0.036, sides=6)
    pole.cylinder([0, reach * 0.5, high + 0.22], [0, reach, high + 0.3], 0.036, 0.034, sides=6)
    pole.box([0, reach + 0.28, high + 0.33], [0.13, 0.34, 0.045])
    head.box([0, reach + 0.3, high + 0.275], [0.10, 0.26, 0.012])
    yield pole, _POLE, "metal"
    yield head, _POLE, "lamp"


def _sign(prop: Prop) -> Iterator[Part]:
    pole, face, back = MeshBuilder(), MeshBuilder(), MeshBuilder()
    picture = SIGNS[prop.variant % len(SIGNS)]
    size, middle = 0.72, 2.45
    pole.cylinder([0, 0, -0.3], [0, 0, middle + 0.3], 0.034, sides=8)
    flat = outline(SIGN_SHAPES[picture])
    # The viewer looks along +x, so the right of the image is -y.
    points = np.stack([np.full(len(flat), -0.05), -flat[:, 0] * size, flat[:, 1] * size + middle], axis=1)
    fan = [[0, i, i + 1] for i in range(1, len(flat) - 1)]
    face.add(points, fan, flat + 0.5)
    # Reversed winding: the back is seen from behind.
    back.add(points + [0.012, 0, 0], [triangle[::-1] for triangle in fan], flat + 0.5)
    yield pole, _POLE, "metal"
    yield face, _SIGN, f"sign_{picture}"
    yield back, _POLE, "metal"


def _traffic_light(prop: Prop) -> Iterator[Part]:
    pole, box = MeshBuilder(), MeshBuilder()
    pole.cylinder([0, 0, -0.3], [0, 0, 3.3], 0.06, sides=8)
    box.box([-0.16, 0, 2.85], [0.12, 0.15, 0.44])
    box.box([-0.27, 0, 2.85], [0.006, 0.24, 0.56])
    lit = prop.variant % 2  # 0 red above, 1 green below
    for place, (name, z) in enumerate((("light_red", 3.12), ("light_amber", 2.85), ("light_green", 2.58))):
        on = (place == 0 and lit == 0) or (place == 2 and lit == 1)
        lens = MeshBuilder()
        lens.cylinder([-0.275, 0, z], [-0.295, 0, z], 0.105, sides=14)
        box.cylinder([-0.275, 0, z + 0.012], [-0.36, 0, z + 0.012], 0.118, sides=10, capped=False)
        yield lens, _POLE, name if on else "light_off"
    yield pole, _POLE, "metal"
    yield box, _POLE, "dark"


def _bin(prop: Prop) -> Iterator[Part]:
    body, lid = MeshBuilder(), MeshBuilder()
    body.cylinder([0, 0, -0.1], [0, 0, 0.85], 0.22, 0.26, sides=12)
    lid.cylinder([0, 0, 0.85], [0, 0, 1.0], 0.27, 0.16, sides=12)
    yield body, _FURNITURE, f"plastic{prop.variant % 3}"
    yield lid, _FURNITURE, "dark"


def _bench(prop: Prop) -> Iterator[Part]:
    wood, legs = MeshBuilder(), MeshBuilder()
    for y in (-0.12, 0.02, 0.16):
        wood.box([0, y, 0.46], [0.85, 0.055, 0.02], 1.5)
    for z in (0.66, 0.82):
        wood.box([0, -0.27, z], [0.85, 0.02, 0.06], 1.5)
    for x in (-0.7, 0.7):
        legs.box([x, 0, 0.2], [0.03, 0.2, 0.24])
        legs.box([x, -0.25, 0.62], [0.03, 0.02, 0.25])
    yield wood, _FURNITURE, "wood"
    yield legs, _FURNITURE, "dark"


def _bus_stop(prop: Prop) -> Iterator[Part]:
    frame, glass, board = MeshBuilder(), MeshBuilder(), MeshBuilder()
    for x in (-1.7, 0.0, 1.7):
        frame.cylinder([x, -0.6, -0.2], [x, -0.6, 2.35], 0.04, sides=6)
    for x in (-1.7, 1.7):
        frame.cylinder([x, 0.55, -0.2], [x, 0.55, 2.35], 0.04, sides=6)
    frame.box([0, 0, 2.4], [1.95, 0.85, 0.05])
    frame.box([0, -0.35, 0.48], [1.2, 0.17, 0.025])
    glass.box([0, -0.62, 1.3], [1.66, 0.012, 0.85])
    board.block([1.69, -0.5, 0.6], [1.75, 0.5, 2.0])
    yield frame, _FURNITURE, "metal"
    yield glass, _FURNITURE, "pane"
    yield board, _FURNITURE, f"billboard{prop.variant % 2}"


def _fence(prop: Prop) -> Iterator[Part]:
    mesh, half = MeshBuilder(), prop.length_m / 2
    if prop.variant % 2:  # iron bars
        for z in (0.15, 0.95):
            mesh.box([0, 0, z], [0.02, half, 0.02])
        for y in np.arange(-half, half + 1e-6, 0.22):
            mesh.box([0, y, 0.5], [0.011, 0.011, 0.6])
        yield mesh, SurfaceClass.FENCE, "dark"
    else:  # planks
        for y in np.arange(-half + 0.08, half, 0.2):
            mesh.box([0, y, 0.5], [0.014, 0.085, 0.62], 1.5)
        for z in (0.3, 0.85):
            mesh.box([0.03, 0, z], [0.02, half, 0.05], 1.5)
        yield mesh, SurfaceClass.FENCE, "wood"


def _cone(prop: Prop) -> Iterator[Part]:
    body, stripe = MeshBuilder(), MeshBuilder()
    body.box([0, 0, 0.02], [0.19, 0.19, 0.02])
    body.cylinder([0, 0, 0.03], [0, 0, 0.72], 0.14, 0.03, sides=12)
    stripe.cylinder([0, 0, 0.38], [0, 0, 0.54], 0.091, 0.066, sides=12, capped=False)
    yield body, _FURNITURE, "orange"
    yield stripe, _FURNITURE, "white_plastic"


def _billboard(prop: Prop) -> Iterator[Part]:
    frame, board = MeshBuilder(), MeshBuilder()
    for y in (-1.2, 1.2):
        frame.cylinder([0.05, y, -0.6], [0.05, y, 2.2], 0.06, sides=8)
    frame.box([0.06, 0, 3.2], [0.05, 1.95, 1.05])
    for x, side in ((-0.005, 1.85), (0.115, -1.85)):  # one picture for each direction
        board.quad([x, side, 2.25], [x, -side, 2.25], [x, -side, 4.15], [x, side, 4.15])
    yield frame, _FURNITURE, "metal"
    yield board, _FURNITURE, f"billboard{prop.variant % 2}"


def _bollard(prop: Prop) -> Iterator[Part]:
    body, band = MeshBuilder(), MeshBuilder()
    body.cylinder([0, 0, -0.1], [0, 0, 0.85], 0.07, sides=10)
    body.cylinder([0, 0, 0.85], [0, 0, 0.9], 0.07, 0.03, sides=10)
    band.cylinder([0, 0, 0.66], [0, 0, 0.76], 0.073, sides=10, capped=False)
    yield body, _FURNITURE, "dark"
    yield band, _FURNITURE, "white_plastic"


def _hydrant(prop: Prop) -> Iterator[Part]:
    mesh = MeshBuilder()
    mesh.cylinder([0, 0, -0.1], [0, 0, 0.62], 0.10, sides=10)
    mesh.cylinder([0, 0, 0.62], [0, 0, 0.76], 0.12, 0.04, sides=10)
    mesh.cylinder([0, -0.18, 0.45], [0, 0.18, 0.45], 0.05, sides=8)
    yield mesh, _FURNITURE, "plastic0"


_MAKERS: dict[str, Callable[[Prop], Iterator[Part]]] = {
    "lamp": _lamp, "sign": _sign, "traffic_light": _traffic_light, "bin": _bin, "bench": _bench, "bus_stop": _bus_stop,
    "fence": _fence, "cone": _cone, "billboard": _billboard, "bollard": _bollard, "hydrant": _hydrant,
}  # fmt: skip
