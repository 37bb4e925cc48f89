"""Gaussians from columns of third-party files: validated, activated, invalid ones dropped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim.errors import ArchiveError
from nurec_sim.geometry import quat_normalize
from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.types import Gaussians, Label

_NAMES = {
    "mean_m": "positions",
    "quat_wxyz": "rotations",
    "scale_m": "scales",
    "opacity": "opacities",
    "dc": "colours",
    "rest": "view-dependent colours",
}


@dataclass(frozen=True)
class Columns:
    """Gaussians in common conventions: scales and opacities after activation, colours as 3DGS harmonics."""

    mean_m: np.ndarray  # [n,3]
    quat_wxyz: np.ndarray  # [n,4], of any length
    scale_m: np.ndarray  # [n,3]
    opacity: np.ndarray  # [n]
    dc: np.ndarray  # [n,3]
    rest: np.ndarray | None = None  # [n,k,3]

    def check(self, where: str) -> None:
        """Checks the shapes of all columns.

        Raises:
            ArchiveError: with the column, the given and the required shape.
        """
        n = len(self.mean_m)
        wanted = {"mean_m": (n, 3), "quat_wxyz": (n, 4), "scale_m": (n, 3), "opacity": (n,), "dc": (n, 3)}
        wanted |= {} if self.rest is None else {"rest": (n, *self.rest.shape[1:2], 3)}
        for name, shape in wanted.items():
            given = getattr(self, name).shape
            if given != shape:
                raise ArchiveError(f"{where}: {_NAMES[name]} must be {shape}, got {given}")
        if self.rest is not None and self.rest.shape[1] not in (3, 8, 15):
            raise ArchiveError(f"{where}: {self.rest.shape[1]} harmonics; degrees 1 to 3 have 3, 8 and 15")

    def gaussians(
        self,
        label: Label | UInt8[np.ndarray, " n"] = Label.OTHER,
        normal: Float32[np.ndarray, "n 3"] | None = None,
    ) -> tuple[Gaussians, int]:
        """The valid Gaussians in single precision, and the number of dropped ones.

        Args:
            label: class of all, or of each.
            normal: unit vectors or zero; zero for all if None.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            single = {name: np.asarray(value).astype(np.float32, copy=False) for name, value in self._parts().items()}
            length = np.linalg.norm(single["quat_wxyz"].astype(np.float64), axis=1)
            sound = np.isfinite(single["opacity"]) & (length > 1e-12) & (single["scale_m"] > 0).all(axis=1)
        for values in single.values():
            sound &= np.isfinite(values).reshape(len(values), int(np.prod(values.shape[1:]))).all(axis=1)
        kept = {name: values[sound] for name, values in single.items()}
        n = int(sound.sum())
        rest = kept.get("rest")
        rgb = 0.5 + SH_C0 * kept["dc"].astype(np.float64)
        view_dependent = rest is not None and bool(rest.any())
        gaussians = Gaussians(
            mean_m=kept["mean_m"],
            quat_wxyz=quat_normalize(kept["quat_wxyz"]).astype(np.float32),
            scale_m=kept["scale_m"],
            opacity=np.clip(kept["opacity"], 0, 1),
            # Renderers clamp the sum of all terms; without view-dependent ones that is the base colour.
            rgb=(rgb if view_dependent else np.maximum(rgb, 0)).astype(np.float32),
            normal=np.zeros((n, 3), np.float32) if normal is None else normal[sound],
            label=np.broadcast_to(np.asarray(label, np.uint8), sound.shape)[sound],
            intensity=np.full(n, np.nan, np.float32),
            sh_rest=np.ascontiguousarray(rest) if view_dependent else None,
        )
        return gaussians, len(sound) - n

    def rows(self, rows: np.ndarray) -> Columns:
        """Some of the Gaussians."""
        parts: dict[str, Any] = {name: values[rows] for name, values in self._parts().items()}
        return Columns(**parts)

    def _parts(self) -> Mapping[str, np.ndarray]:
        names = ("mean_m", "quat_wxyz", "scale_m", "opacity", "dc", "rest")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


def sigmoid(logit: np.ndarray) -> Float64[np.ndarray, "*n"]:
    """1 / (1 + exp(-logit)) of logits of either sign, infinite ones too; NaN stays."""
    values = np.asarray(logit, np.float64)
    # exp of a negative argument only, which cannot overflow.
    small = np.exp(-np.abs(values))
    return np.where(values < 0, small, 1.0) / (1 + small)
