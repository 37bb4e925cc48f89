"""Where things lie in a run folder, and how they get there in one step.

::

    runs/latest -> 2026-01-31_18-00-00/
      report.html  metrics.parquet  metrics.csv
      <scene>/<reconstruction>/scene.json  road.npz
      <scene>/<reconstruction>/<policy>/<seed>/scenario.yaml  rollout.npz  versions.json  front.mp4  [error.txt]

A rollout's folder is filled under another name and renamed, so a folder that is there is complete.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from nurec_sim.errors import RunError, WriteError
from nurec_sim.new_files import writing

ROLLOUT, SCENARIO, VERSIONS, VIDEO, ERROR = "rollout.npz", "scenario.yaml", "versions.json", "front.mp4", "error.txt"
VIDEO_ERROR = "video_error.txt"
SCENE, ROAD, REPORT = "scene.json", "road.npz", "report.html"


def new_run_folder(out_dir: Path, stamp: str) -> Path:
    """Make ``out_dir/<stamp>`` (numbered if it is taken) and let ``out_dir/latest`` point to it."""
    out_dir = Path(out_dir)
    with writing(out_dir):
        out_dir.mkdir(parents=True, exist_ok=True)
        for number in range(1, 1000):
            folder = out_dir / (stamp if number == 1 else f"{stamp}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                point_latest(folder)
                return folder
    raise RunError(f"{out_dir} already has 999 runs named {stamp}")


def point_latest(folder: Path) -> None:
    """Let ``latest`` beside a run folder point to it; left alone where it is a real file or folder."""
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return
    part = folder.parent / f".latest.{os.getpid()}"
    with contextlib.suppress(FileNotFoundError):
        part.unlink()
    with contextlib.suppress(OSError):  # a file system without links goes without
        part.symlink_to(folder.name, target_is_directory=True)
        os.replace(part, link)


def existing_run_folder(path: Path) -> Path:
    """A run folder to read or to go on with; links are followed.

    Raises:
        RunError: there is no such folder.
    """
    path = Path(path)
    if not path.is_dir():
        raise RunError(f"run folder {path} does not exist; give a folder that `nurec-sim run` made")
    return path.resolve()


def scene_folder(run: Path, scene_id: str, reconstruction: str) -> Path:
    """Folder of a scene under one reconstruction."""
    return run / folder_name(scene_id) / folder_name(reconstruction)


def rollout_folder(run: Path, scene_id: str, reconstruction: str, policy: str, seed: int) -> Path:
    """Folder of one rollout."""
    return scene_folder(run, scene_id, reconstruction) / folder_name(policy) / str(seed)


def folder_name(text: str) -> str:
    """A name that every file system takes: other characters than letters, digits and ``._-`` become ``_``."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", text).strip(".")
    return name or "_"


def rollout_folders(run: Path) -> list[Path]:
    """Every complete rollout of a run, sorted."""
    return sorted(path.parent for path in run.glob(f"*/*/*/*/{ROLLOUT}") if not path.parent.name.startswith("."))


def scene_folders(run: Path) -> list[Path]:
    """Every scene of a run, sorted."""
    return sorted(path.parent for path in run.glob(f"*/*/{SCENE}"))


@contextlib.contextmanager
def written_at_once(target: Path) -> Iterator[Path]:
    """Fill a hidden folder that becomes ``target`` at the end; whatever goes wrong leaves ``target`` as it was."""
    part, old = (target.with_name(f".{target.name}.{kind}.{os.getpid()}") for kind in ("part", "old"))
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            yield part
            if target.exists():
                shutil.rmtree(old, ignore_errors=True)
                os.rename(target, old)
            try:
                os.rename(part, target)
            except OSError:
                if old.exists():
                    os.rename(old, target)
                raise
        except WriteError as error:  # of a file in the folder, which nobody knows by its hidden name
            raise WriteError(error.errno, error.strerror, error.filename.replace(str(part), str(target))) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
