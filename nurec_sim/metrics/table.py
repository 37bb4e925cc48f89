"""The long table of all rollouts: AlpaSim's columns, then ours (docs/metrics.md).

One row per rollout, metric and time. Ids are uuid5 of the named object, so the same run gives the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim.files.new_files import write_file
from nurec_sim.types import Rollout, Series

if TYPE_CHECKING:
    import polars as pl

ALPASIM_COLUMNS = (
    "name", "timestamps_us", "values", "valid", "time_aggregation", "clipgt_id", "rollout_id", "run_uuid", "run_name",
)  # fmt: skip
OWN_COLUMNS = ("world", "reconstruction", "policy", "trial", "seed", "unit", "status", "error")
NAMESPACE = uuid.UUID("6f3b8f5e-52d1-5f0e-9a2e-5b0f7c1d2a44")


def rollout_id(rollout: Rollout) -> str:
    """UUID of scenario, scene, reconstruction, policy and seed."""
    parts = (rollout.scenario, rollout.scene_id, rollout.reconstruction, rollout.policy, str(rollout.seed))
    return str(uuid.uuid5(NAMESPACE, "\0".join(parts)))


def metric_table(
    scored: Sequence[tuple[Rollout, Sequence[Series]]], run_name: str, worlds: Mapping[str, str] | None = None
) -> pl.DataFrame:
    """Rollouts and their series as one table, sorted by scene, reconstruction, policy, seed, metric and time.

    Args:
        scored: rollouts with the result of ``score_rollout``.
        run_name: name of the run, for all rows.
        worlds: reconstruction -> rendered world; default "reconstruction".

    Raises:
        ValueError: two rollouts have the same scenario, scene, reconstruction, policy and seed.
    """
    import polars as pl

    ids = [rollout_id(rollout) for rollout, _ in scored]
    if len(set(ids)) != len(ids):
        twice = next(rollout for (rollout, _), id_ in zip(scored, ids, strict=True) if ids.count(id_) > 1)
        raise ValueError(
            f"two rollouts of policy '{twice.policy}', seed {twice.seed}, in scene '{twice.scene_id}', "
            f"scenario '{twice.scenario}': each may occur only once in a run"
        )
    order = sorted(range(len(ids)), key=lambda i: (*_place(scored[i][0]), ids[i]))
    # The run's id depends on its content in sorted order, not on the time or the order of the rollouts.
    run_uuid = str(uuid.uuid5(NAMESPACE, _digest((ids[i], scored[i][1]) for i in order)))
    trials = _trials([scored[i][0] for i in order])
    frames = []
    for index, trial in zip(order, trials, strict=True):
        rollout, series = scored[index]
        constants = {
            "clipgt_id": rollout.scene_id,
            "rollout_id": ids[index],
            "run_uuid": run_uuid,
            "run_name": run_name,
            "world": (worlds or {}).get(rollout.reconstruction, "reconstruction"),
            "reconstruction": rollout.reconstruction,
            "policy": rollout.policy,
            "trial": trial,
            "seed": rollout.seed,
            "status": rollout.status,
            "error": rollout.error,
        }
        for one in series:
            count = len(one.t_us)
            columns = {
                "name": [one.name] * count,
                "timestamps_us": np.asarray(one.t_us, np.int64),
                "values": np.asarray(one.values, np.float64),
                "valid": np.asarray(one.valid, bool),
                "time_aggregation": [one.reduce.value] * count,
                "unit": [one.unit] * count,
                **{name: [value] * count for name, value in constants.items()},
            }
            frames.append(pl.DataFrame(columns, schema=_schema()))
    return pl.concat(frames) if frames else pl.DataFrame(schema=_schema())


def write_table(table: pl.DataFrame, folder: Path) -> tuple[Path, Path]:
    """Writes ``metrics.parquet`` and ``metrics.csv`` atomically; returns both paths."""
    parquet, text = Path(folder) / "metrics.parquet", Path(folder) / "metrics.csv"
    for path, write in ((parquet, table.write_parquet), (text, table.write_csv)):
        content = io.BytesIO()  # polars would turn a disk error into mere text
        write(content)
        write_file(path, content.getvalue())
    return parquet, text


def read_table(path: Path) -> pl.DataFrame:
    """Read ``metrics.parquet``.

    Raises:
        ValueError: a column is missing.
    """
    import polars as pl

    table = pl.read_parquet(path)
    missing = [name for name in (*ALPASIM_COLUMNS, *OWN_COLUMNS) if name not in table.columns]
    if missing:
        raise ValueError(f"{path} is not a metric table: missing columns {missing}")
    return table


def _schema() -> pl.Schema:
    import polars as pl

    special: dict[str, type[pl.DataType]] = {
        "timestamps_us": pl.Int64, "values": pl.Float64, "valid": pl.Boolean, "trial": pl.Int64, "seed": pl.Int64,
    }  # fmt: skip
    return pl.Schema({name: special.get(name, pl.String) for name in (*ALPASIM_COLUMNS, *OWN_COLUMNS)})


def _place(rollout: Rollout) -> tuple[str, str, str, str, int]:
    return rollout.scene_id, rollout.scenario, rollout.reconstruction, rollout.policy, rollout.seed


def _trials(rollouts: Sequence[Rollout]) -> list[int]:
    """Index of each rollout's seed among those of the same scene, scenario, reconstruction and policy."""
    seeds: dict[tuple, list[int]] = {}
    for rollout in rollouts:
        seeds.setdefault(_place(rollout)[:4], []).append(rollout.seed)
    return [sorted(seeds[_place(rollout)[:4]]).index(rollout.seed) for rollout in rollouts]


def _digest(parts: Iterable[tuple[str, Sequence[Series]]]) -> str:
    digest = hashlib.sha256()
    for id_, series in parts:
        digest.update(id_.encode())
        for one in series:
            digest.update(one.name.encode())
            digest.update(np.ascontiguousarray(one.t_us, np.int64).tobytes())
            # NaN has many bit patterns; invalid values are hashed as 0.
            digest.update(np.where(one.valid, one.values, 0.0).astype(np.float64).tobytes())
            digest.update(np.asarray(one.valid, bool).tobytes())
    return digest.hexdigest()
