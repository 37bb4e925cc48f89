"""Camera lenses: point to pixel and pixel to ray, one file per kind (docs/write_a_lens.md)."""

from nurec_sim.lenses.base import BaseLens, Lens
from nurec_sim.lenses.conformance import check_lens
from nurec_sim.lenses.fisheye import Fisheye
from nurec_sim.lenses.ftheta import FTheta, FThetaReference
from nurec_sim.lenses.parameters import decode_parameters, encode_parameters
from nurec_sim.lenses.pinhole import Pinhole
from nurec_sim.lenses.registry import lens_class, lens_kinds, register_lens

__all__ = [
    "BaseLens",
    "FTheta",
    "FThetaReference",
    "Fisheye",
    "Lens",
    "Pinhole",
    "check_lens",
    "decode_parameters",
    "encode_parameters",
    "lens_class",
    "lens_kinds",
    "register_lens",
]
