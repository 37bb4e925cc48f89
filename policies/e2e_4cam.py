"""End-to-end driving by front, tele and side cameras: a small network, trained by imitation (``_end_to_end``)."""

from __future__ import annotations

from nurec_sim.policies._end_to_end import EndToEnd
from nurec_sim.types import Needs


class EndToEndFour(EndToEnd):
    """A network sees 4 images."""

    name = "e2e_4cam"
    needs = Needs(cameras=("front", "tele", "left", "right"), image_width_px=160)
