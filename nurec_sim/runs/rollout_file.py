"""Lossless ``.npz`` files of rollouts; plain arrays and JSON, no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import RunError
from nurec_sim.files.new_files import new_file
from nurec_sim.scene import codec
from nurec_sim.types import EgoState, Event, Plan, Rig, Rollout, Trajectory

FORMAT = 1
_TEXTS = ("scenario", "scene_id", "reconstruction", "policy", "status", "error")
_STATE_NUMBERS = ("speed_mps", "accel_mps2", "yaw_rate_radps", "steering_rad")
_ARRAYS: dict[str, tuple[type, tuple[int, ...]]] = {
    "state_t_us": (np.int64, (-1,)),
    "state_numbers": (np.float64, (-1, len(_STATE_NUMBERS))),
    "world_from_rig": (np.float64, (-1, 4, 4)),
    "actor_poses": (np.float64, (-1, -1, 4, 4)),
    "actor_sizes_m": (np.float64, (-1, 3)),
    "recorded_t_us": (np.int64, (-1,)),
    "recorded_poses": (np.float64, (-1, 4, 4)),
    "plan_made_us": (np.int64, (-1,)),
    "plan_ends": (np.int64, (-1,)),
    "plan_t_us": (np.int64, (-1,)),
    "plan_poses": (np.float64, (-1, 3)),
    "plan_stops": (np.bool_, (-1,)),
}


def save_rollout(rollout: Rollout, path: Path | str) -> Path:
    """Writes a rollout atomically; the same rollout gives the same bytes."""
    plans = [plan for _, plan in rollout.plans]
    count, ids = len(rollout.states), list(rollout.actors)
    header = {
        "format": FORMAT,
        **{name: getattr(rollout, name) for name in _TEXTS},
        "seed": int(rollout.seed),
        "first_closed_loop_us": int(rollout.first_closed_loop_us),
        "rig": rollout.rig,
        "actors": [[id_, rollout.actor_labels.get(id_, "")] for id_ in ids],
        "events": [[int(event.t_us), event.kind, event.text] for event in rollout.events],
    }
    numbers = [[getattr(state, name) for name in _STATE_NUMBERS] for state in rollout.states]
    arrays = {
        "header": np.frombuffer(codec.dump(header, "the rollout"), np.uint8),
        "state_t_us": rollout.t_us,
        "state_numbers": np.array(numbers, np.float64).reshape(count, len(_STATE_NUMBERS)),
        "world_from_rig": rollout.world_from_rig,
        "actor_poses": np.array([rollout.actors[id_] for id_ in ids], np.float64).reshape(len(ids), count, 4, 4),
        "actor_sizes_m": np.array([rollout.actor_sizes_m[id_] for id_ in ids], np.float64).reshape(len(ids), 3),
        "recorded_t_us": rollout.recorded.t_us,
        "recorded_poses": rollout.recorded.world_from_body,
        "plan_made_us": np.array([made for made, _ in rollout.plans], np.int64),
        "plan_ends": np.cumsum([len(plan.t_us) for plan in plans], dtype=np.int64),
        "plan_t_us": np.concatenate([np.zeros(0, np.int64), *(plan.t_us for plan in plans)]).astype(np.int64),
        "plan_poses": np.concatenate([np.zeros((0, 3)), *(plan.pose for plan in plans)]).astype(np.float64),
        "plan_stops": np.array([plan.stop_session for plan in plans], np.bool_),
    }
    path = Path(path)
    with new_file(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return path


def load_rollout(path: Path | str) -> Rollout:
    """Read a rollout.

    Raises:
        RunError: the file is missing, not a rollout, or inconsistent.
    """
    path = Path(path)
    try:
        # numpy does not close a damaged file that it opened itself
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            missing = [name for name in ("header", *_ARRAYS) if name not in file.files]
            if missing:
                raise RunError(f"{path} is not a rollout file: missing {missing}")
            header_bytes = bytes(file["header"].astype(np.uint8).tobytes())
            arrays = {name: _checked(path, name, file[name]) for name in _ARRAYS}
        header = json.loads(header_bytes.decode("utf-8"))
        return _assemble(header, arrays)
    except FileNotFoundError:
        raise RunError(f"rollout file {path} does not exist") from None
    except RunError:
        raise
    except codec.ArchiveError as error:
        raise RunError(f"{path} is not a readable rollout file: {error}") from error
    except Exception as error:  # zipfile, zlib, numpy and json raise various exceptions for damaged files
        raise RunError(f"{path} is not a readable rollout file: {type(error).__name__}: {error}") from error


def _checked(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    kind, shape = _ARRAYS[name]
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    if array.dtype != kind or not fits:
        raise RunError(f"{path}: {name} must be {kind.__name__} {list(shape)}, got {array.dtype} {list(array.shape)}")
    return array


def _assemble(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Rollout:
    if header.get("format") != FORMAT:
        raise ValueError(f"format {header.get('format')!r}; this version reads {FORMAT}")
    count, ids = len(arrays["state_t_us"]), [id_ for id_, _ in header["actors"]]
    for name, length in (
        ("state_numbers", count), ("world_from_rig", count), ("actor_sizes_m", len(ids)), ("actor_poses", len(ids)),
        ("plan_ends", len(arrays["plan_made_us"])), ("plan_stops", len(arrays["plan_made_us"])),
        ("plan_poses", len(arrays["plan_t_us"])),
    ):  # fmt: skip
        if len(arrays[name]) != length:
            raise ValueError(f"{name} has {len(arrays[name])} entries; {length} are needed")
    if len(ids) and arrays["actor_poses"].shape[1] != count:
        raise ValueError(f"actor_poses has {arrays['actor_poses'].shape[1]} times; there are {count} states")
    states = tuple(
        EgoState(int(t), pose, *(float(number) for number in numbers))
        for t, pose, numbers in zip(
            arrays["state_t_us"], arrays["world_from_rig"], arrays["state_numbers"], strict=True
        )
    )
    starts = np.concatenate([[0], arrays["plan_ends"]])[:-1].astype(np.int64)
    plans = tuple(
        (int(made), Plan(arrays["plan_t_us"][a:b], arrays["plan_poses"][a:b], bool(stop)))
        for made, a, b, stop in zip(
            arrays["plan_made_us"], starts, arrays["plan_ends"], arrays["plan_stops"], strict=True
        )
    )
    return Rollout(
        **{name: codec.text(header[name]) for name in _TEXTS},
        seed=codec.integer(header["seed"]),
        rig=codec.from_json(codec.record(Rig), header["rig"], "rig"),
        states=states,
        actors=dict(zip(ids, arrays["actor_poses"], strict=True)),
        actor_sizes_m={id_: tuple(size) for id_, size in zip(ids, arrays["actor_sizes_m"].tolist(), strict=True)},
        actor_labels={id_: label for id_, label in header["actors"]},
        recorded=Trajectory(arrays["recorded_t_us"], arrays["recorded_poses"]),
        plans=plans,
        events=tuple(Event(codec.integer(t), codec.text(kind), codec.text(text)) for t, kind, text in header["events"]),
        first_closed_loop_us=codec.integer(header["first_closed_loop_us"]),
    )
