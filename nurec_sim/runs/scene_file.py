"""Scene records of a run: facts for the report (``scene.json``) and the road grid (``road.npz``)."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError, ReconstructError, RunError
from nurec_sim.files.new_files import new_file, write_file
from nurec_sim.metrics.offroad_grid import OffroadGrid, scene_offroad_grid
from nurec_sim.runs.folder import ROAD, SCENE
from nurec_sim.scene import codec, scene_hash
from nurec_sim.types import GaussianScene, Label, RoadMap, Track

MOST_LISTED = 50


@dataclass(frozen=True)
class SceneRecord:
    """Scene data for metrics and report.

    ``unknown`` lists missing information of log or reconstruction; ``road_error`` is the reason for a missing grid.
    ``sha256`` is the hash of the whole scene. ``fidelity`` is the result of ``evaluate.measure_fidelity``, empty if not
    measured. ``place`` is the position among the reconstructions of a run: others are compared with the first.
    """

    id: str
    reconstruction: str
    sha256: str
    counts: Mapping[str, int]
    provenance: Mapping[str, object]
    unknown: tuple[str, ...]
    actors_known: bool
    road_map: RoadMap | None = None
    grid: OffroadGrid | None = field(default=None, compare=False)
    road_error: str = ""
    fidelity: Mapping[str, Any] = field(default_factory=dict)
    place: int = 0


def reconstruction_of(scene: GaussianScene) -> str:
    """Name of a reconstruction in a run: its own, or the method that created it."""
    return str(scene.provenance.get("reconstruction", scene.provenance.get("method", "unknown")))


def record_scene(scene: GaussianScene, fidelity: Mapping[str, Any] | None = None, place: int = 0) -> SceneRecord:
    """Hashes a scene, counts its contents and builds its road grid.

    Args:
        scene: the scene.
        fidelity: see ``SceneRecord``.
        place: see ``SceneRecord``.
    """
    listed = scene.provenance.get("unknown", ())
    unknown = tuple(str(text) for text in listed) if isinstance(listed, (list, tuple)) else (str(listed),)
    no_boxes = any(word in text.lower() for text in unknown for word in ("box", "actor", "track"))
    actors = [track for track in scene.tracks if track.actor]
    movers, found = [t for t in scene.tracks if not t.actor], [t for t in actors if not t.labelled]
    actors_known = bool(actors) or ("unknown" in scene.provenance and not no_boxes)
    if not actors_known and not no_boxes:
        unknown += ("the scene has no actor boxes: collisions cannot be measured",)
    if (scene.road_map is None or not scene.road_map.drivable) and not any("map" in text.lower() for text in unknown):
        unknown += ("the scene has no road map: off-road is measured on the road-class Gaussians only",)
    if movers:
        unknown += (
            f"{len(movers)} unlabelled movers without a box in the log are rendered but are not actors: "
            f"metrics and privileged policies ignore them: {_listed(movers, scene)}",
        )
    if found:
        unknown += (
            f"{len(found)} actors were detected by motion and are unlabelled; metrics against "
            f"them may be wrong: {_listed(found, scene)}",
        )
    labels = np.bincount(scene.static.label, minlength=len(Label))
    counts = {"static": len(scene.static), "dynamic": len(scene.dynamic), "tracks": len(actors)}
    counts |= {"unlabelled movers": len(movers)} if movers else {}
    counts |= {f"static {label.name.lower()}": int(labels[label]) for label in Label if labels[label]}
    grid, road_error = None, ""
    try:
        grid = scene_offroad_grid(scene)
    except ReconstructError as error:
        road_error = str(error)
        unknown += (road_error,)
    provenance = json.loads(codec.dump(dict(scene.provenance), "provenance"))
    return SceneRecord(
        scene.id, reconstruction_of(scene), scene_hash(scene), counts, provenance, unknown, actors_known,
        scene.road_map, grid, road_error, dict(fidelity or {}), place,
    )  # fmt: skip


def _listed(tracks: Sequence[Track], scene: GaussianScene) -> str:
    """Id, label and time span of each track."""
    said = [
        f"{track.id} (like {track.label}, {(track.path.start_us - scene.span_us[0]) / 1e6:.1f} to "
        f"{(track.path.end_us - scene.span_us[0]) / 1e6:.1f} s)"
        for track in tracks[:MOST_LISTED]
    ]
    return ", ".join(said) + (f" and {len(tracks) - MOST_LISTED} more" if len(tracks) > MOST_LISTED else "")


def save_scene_record(record: SceneRecord, folder: Path) -> None:
    """Writes ``scene.json`` and, if there is a grid, ``road.npz``."""
    folder.mkdir(parents=True, exist_ok=True)
    road = folder / ROAD
    if record.grid is None:
        road.unlink(missing_ok=True)
    else:
        grid = record.grid
        place = np.array([*grid.origin_m, grid.cell_m, grid.bandwidth_m, grid.overruled_frac], np.float64)
        with new_file(road) as file:
            np.savez_compressed(file, state=grid.state, place=place)
    facts = {name: value for name, value in vars(record).items() if name != "grid"}
    write_file(folder / SCENE, codec.dump(facts, "the scene record", indent=1).decode())


def load_scene_record(folder: Path) -> SceneRecord:
    """Reads the files of ``save_scene_record``.

    Raises:
        RunError: a file is missing or broken.
    """
    path = folder / SCENE
    try:
        facts = codec.load(path.read_bytes(), str(path))
        facts["unknown"] = tuple(facts["unknown"])
        if facts["road_map"] is not None:
            facts["road_map"] = codec.from_json(codec.record(RoadMap), facts["road_map"], "road_map")
        grid = _load_grid(folder / ROAD) if (folder / ROAD).exists() else None
        return SceneRecord(**facts, grid=grid)
    except FileNotFoundError:
        raise RunError(f"{path} does not exist: the run folder is incomplete; run again with --resume") from None
    except (OSError, TypeError, ValueError, KeyError, zipfile.BadZipFile, ArchiveError) as error:
        raise RunError(f"{path} is not a readable scene record: {type(error).__name__}: {error}") from error


def _load_grid(path: Path) -> OffroadGrid:
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        state, place = file["state"], file["place"]
    if state.ndim != 2 or min(state.shape) < 2 or place.shape != (5,) or place[2] <= 0:
        raise ValueError(f"{path.name}: a grid needs cells [rows, columns] and 5 numbers, got {state.shape}")
    x, y, cell, bandwidth, overruled = (float(value) for value in place)
    return OffroadGrid.from_state((x, y), cell, state, bandwidth, overruled)
