"""The state of a NuRec reconstruction: named arrays and a few facts, from ``volume.nurec`` or ``checkpoint.ckpt``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

GAUSSIANS = "gaussians_nodes."
_READ = re.compile(
    r"gaussians_nodes\.[^.]+\.(positions|rotations|scales|densities|features_albedo|features_specular"
    r"|n_active_features|gaussian_cuboid_ids)"
    r"|background\.textures"
    r"|post_processings\.\d+\.ppisp\.(exposure_params|vignetting_params|crf_params)"
)


@dataclass(frozen=True)
class NurecState:
    """Arrays of a reconstruction by name, the names spelt alike for both files (``plain_name``).

    Attributes:
        arrays: those that ``read_entries`` finds, as stored.
        track_ids: ``obj_track_ids``: for each layer the tracks that ``gaussian_cuboid_ids`` counts.
        config: settings of the layers and of the background, empty where the file has none.
        others: names of the arrays and values that are not read.
        version: version string of the program that wrote the file.
    """

    arrays: Mapping[str, np.ndarray]
    track_ids: Mapping[str, Sequence[str]] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    others: Sequence[str] = ()
    version: str = ""


def plain_name(name: str) -> str:
    """A name without the prefix of its file type: ``.`` in volumes, ``model.`` in checkpoints."""
    return name.removeprefix("model.").removeprefix(".")


def read_entries(
    entries: Iterable[tuple[Any, Any]],
) -> tuple[dict[str, tuple[str, Any]], list[str], dict[str, tuple[str, ...]]]:
    """Sorts the entries of a state.

    Returns:
        The key and the value of each array to read by plain name, the plain names of those that are not read, and the
        tracks by layer (``NurecState.track_ids``).
    """
    found: dict[str, tuple[str, Any]] = {}
    others: list[str] = []
    track_ids: dict[str, tuple[str, ...]] = {}
    for key, value in entries:
        if not isinstance(key, str):
            continue
        name = plain_name(key)
        if name == "_extra_state":
            track_ids = _track_ids(value)
        elif _READ.fullmatch(name):
            found[name] = key, value
        else:
            others.append(name)
    return found, others, track_ids


def _track_ids(extra_state: object) -> dict[str, tuple[str, ...]]:
    """``obj_track_ids`` of the extra state by layer; layers whose ids are no list of texts are left out."""
    ids = extra_state.get("obj_track_ids") if isinstance(extra_state, Mapping) else None
    if not isinstance(ids, Mapping):
        return {}
    return {
        layer: tuple(names)
        for layer, names in ids.items()
        if isinstance(layer, str) and isinstance(names, (list, tuple)) and all(isinstance(n, str) for n in names)
    }
