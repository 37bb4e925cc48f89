"""The interface of reconstruction methods."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from nurec_sim.types.logs import Clip
from nurec_sim.types.scenes import GaussianScene

Progress = Callable[[str, float], None]
"""Called with the current stage and the approximate fraction of all work done; may raise to abort the work."""

ActorsName = Literal["auto", "recorded", "found", "none"]
"""Which objects of a log are its actors: those with boxes, those found by their motion, none; ``auto`` takes the boxes
if there are any."""


class Method(Protocol):
    """Turns a driving log into a Gaussian scene (docs/write_a_method.md)."""

    name: str
    """As in ``reconstruct --method NAME`` and in the provenance of its scenes."""
    settings: type[Any]
    """A frozen dataclass, documented field by field, every field with a default."""

    def files(self, settings: Any) -> Sequence[Path]:
        """Files that the result depends on besides the log (weights); cached scenes are valid until they change."""
        ...

    def reconstruct(
        self,
        clip: Clip,
        settings: Any,
        *,
        cameras: Sequence[str] | None,
        hold_out_sweeps: Collection[int],
        progress: Progress,
    ) -> GaussianScene:
        """Reconstructs the scene of a log.

        Args:
            clip: the driving log.
            settings: an instance of the class ``settings``.
            cameras: ids of the cameras whose images may be read, all of the rig; None leaves the choice to the method.
            hold_out_sweeps: indices of the sweeps, of every LiDAR, that must not be read.
            progress: see ``Progress``.

        Raises:
            ReconstructError: the log lacks what the method needs.
        """
        ...
