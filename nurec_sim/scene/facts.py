"""JSON encoding of a scene without its large arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.scene import codec
from nurec_sim.types import GaussianScene, Rig, RoadMap, Track, Trajectory

_DECODERS: dict[str, codec.Decoder] = {
    "id": codec.text,
    "span_us": codec.array(np.int64, 2),
    "rig": codec.record(Rig),
    "ego": codec.record(Trajectory),
    "tracks": codec.sequence(codec.record(Track)),
    "road_map": codec.optional(codec.record(RoadMap)),
    "camera_times_us": codec.mapping(codec.array(np.int64, -1, 2)),
    "provenance": codec.mapping(lambda value: value),
}


def scene_facts(scene: GaussianScene) -> dict[str, Any]:
    """The facts as plain JSON, in a canonical form: equal facts give equal text (4 and 4.0 are equal).

    Raises:
        ArchiveError: a value has the wrong type and could not be read back.
    """
    raw = {name: codec.to_json(getattr(scene, name)) for name in _DECODERS}
    return {name: codec.to_json(value) for name, value in _decode(raw, f"scene {scene.id!r}").items()}


def facts_from_json(raw: Any, where: str) -> dict[str, Any]:
    """Keyword arguments of GaussianScene from the object that ``scene_facts`` made.

    Raises:
        ArchiveError: a field is missing, unknown or of the wrong type.
    """
    if not isinstance(raw, dict) or set(raw) != set(_DECODERS):
        given = sorted(raw) if isinstance(raw, dict) else type(raw).__name__
        raise ArchiveError(f"{where}: needs the fields {sorted(_DECODERS)}, got {given}")
    facts = _decode(raw, where)
    start_us, end_us = facts["span_us"].tolist()
    return facts | {"span_us": (start_us, end_us)}


def _decode(raw: dict[str, Any], where: str) -> dict[str, Any]:
    return {name: codec.from_json(decode, raw[name], f"{where}: {name}") for name, decode in _DECODERS.items()}
