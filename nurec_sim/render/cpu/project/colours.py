"""Vector code for view-dependent colours: real spherical harmonics up to degree 3 (``scene.harmonics.sh_basis``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir

from nurec_sim.render.cpu.pack import BLOCK, COLOUR, MEAN
from nurec_sim.render.cpu.records import EYE_HIGH, EYE_LOW, FEATURES, STEP, dot
from nurec_sim.render.cpu.simd import Lanes, Vector, vector_kernel


def _basis(x: Vector, y: Vector, z: Vector, k: int) -> list[Vector]:
    xx, yy, zz = x * x, y * y, z * z
    basis = [y * -0.4886025119029199, z * 0.4886025119029199, x * -0.4886025119029199]
    if k > 3:
        basis += [
            x * y * 1.0925484305920792,
            y * z * -1.0925484305920792,
            (zz * 2 - xx - yy) * 0.31539156525252005,
            x * z * -1.0925484305920792,
            (xx - yy) * 0.5462742152960396,
        ]
    if k > 8:
        basis += [
            y * (xx * 3 - yy) * -0.5900435899266435,
            x * y * z * 2.890611442640554,
            y * (zz * 4 - xx - yy) * -0.4570457994644658,
            z * (zz * 2 - xx * 3 - yy * 3) * 0.3731763325901154,
            x * (zz * 4 - xx - yy) * -0.4570457994644658,
            z * (xx - yy) * 1.445305721320277,
            x * (xx - yy * 3) * -0.5900435899266435,
        ]
    # Constants, signs and order are those of 3D Gaussian splatting (Kerbl et al. 2023).
    return basis


def _harmonics(k: int) -> Callable[..., Any]:
    @vector_kernel("iiii")
    def features(v: Lanes, block: ir.Value, rest: ir.Value, view: ir.Value, scratch: ir.Value) -> None:
        """Take the colours seen from the eye as features, not below 0.

        Args:
            v: vectors.
            block: address of the group's first Gaussian in its block.
            rest: address of the group's first coefficient in ``sh_rest`` [k3,256].
            view: address of ``records.view_parameters``.
            scratch: address of the group's [SCRATCH,LANES]; its FEATURES are written.
        """
        # The eye as a sum of two float32 values, as in ``records.place``: world coordinates are large, offsets are not.
        offset = [
            (v.load(block, 4 * BLOCK * (MEAN + c)) - v.broadcast(view, 4 * (EYE_HIGH + c)))
            - v.broadcast(view, 4 * (EYE_LOW + c))
            for c in range(3)
        ]
        inverse = 1 / dot(offset, offset).sqrt().max(1e-12)
        x, y, z = (component * inverse for component in offset)
        basis = _basis(x, y, z, k)
        for c in range(3):
            colour = v.load(block, 4 * BLOCK * (COLOUR + c))
            for j, function in enumerate(basis):
                colour = colour + function * v.load(rest, 4 * BLOCK * (3 * j + c))
            v.store(colour.max(0), scratch, STEP * (FEATURES + c))

    return features


harmonics_1, harmonics_2, harmonics_3 = _harmonics(3), _harmonics(8), _harmonics(15)
