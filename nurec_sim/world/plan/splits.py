"""Assets of training towns, and assets held out for test towns.

Towns of split ``test`` differ from those of split ``train``: independent random streams, held-out ground texture
families, facades and vehicles, and, every other time, a held-out sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
STREAM_OF_SPLIT: dict[Split, int] = {"train": 0x7121, "test": 0x7E57}
"""First key of every random stream: equal seeds of the two splits are independent."""


@dataclass(frozen=True)
class Choices:
    """Names shared by both splits, and names held out for test."""

    shared: tuple[str, ...]
    held_out: tuple[str, ...]

    @property
    def all(self) -> tuple[str, ...]:
        """Every name."""
        return self.shared + self.held_out


TEMPLATES = Choices(
    ("straight", "curve", "s_curve", "t_junction", "x_junction", "narrowing", "slip_road"),
    ("roundabout", "double_junction"),
)
FACADES = Choices(("brick", "plaster", "panel", "glass"), ("stone", "timber"))
ASPHALTS = Choices(("dark", "grey", "cobbled"), ("patched",))
PAVINGS = Choices(("slabs", "concrete"), ("bricks",))
FOLIAGES = Choices(("broadleaf", "conifer", "birch"), ("autumn",))
VEHICLES = Choices(("hatch", "sedan", "wagon", "suv", "van", "truck", "bus", "sports"), ("pickup", "minivan"))
SKIES = Choices(("clear", "overcast", "dusk", "foggy", "wet"), ("hazy", "sunset"))
