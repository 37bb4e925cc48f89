"""End-to-end driving by the front camera: a small network, trained by imitation (``_end_to_end``)."""

from __future__ import annotations

from nurec_sim.policies._end_to_end import EndToEnd
from nurec_sim.types import Needs


class EndToEndOne(EndToEnd):
    """A network sees 1 image."""

    name = "e2e_1cam"
    needs = Needs(cameras=("front",), image_width_px=160)
