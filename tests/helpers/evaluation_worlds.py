"""Protocols on the street of planes and boxes: windows in milliseconds, without a rendering back end."""

import contextlib
from dataclasses import dataclass

from reconstruct_street import Street, camera

from nurec_sim.evaluate import Protocol
from nurec_sim.evaluate.recorded import recorded_window

BOX = {"car": ((4.0, 1.8, 1.5), [14.0, 1.0])}


def street(frames: int = 7, **more) -> Street:
    return Street(frames=frames, cameras=(camera("front", width=96, height=64),), boxes=BOX, **more)


def street_window(id: str = "street", boxes: bool = False, **more):
    """Frames 0, 3 and 6 are seen, the others asked for."""
    return recorded_window(street(**more), id, ("front",), (0, 3), (1, 2, 4, 5), boxes)


@dataclass(frozen=True)
class StreetProtocol(Protocol):
    """Protocol storm with one street per seed, the faster the larger the seed; ``opened`` counts windows by seed."""

    opened = []

    @property
    def ids(self):
        return tuple(f"street-{seed}" for seed in self.seeds)

    @contextlib.contextmanager
    def window(self, index, progress=None):
        type(self).opened.append(self.seeds[index])
        yield street_window(self.ids[index], self.boxes, speed_mps=4.0 + self.seeds[index])
