"""End-to-end driving by the front camera and a tele view: a small network, trained by imitation (``_end_to_end``)."""

from __future__ import annotations

from nurec_sim.policies._end_to_end import EndToEnd
from nurec_sim.types import Needs


class EndToEndTwo(EndToEnd):
    """A network sees 2 images."""

    name = "e2e_2cam"
    needs = Needs(cameras=("front", "tele"), image_width_px=160)
