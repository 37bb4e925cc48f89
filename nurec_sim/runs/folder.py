"""Layout of a run folder, with atomic writes.

::

    runs/latest -> 2026-01-31_18-00-00/
      report.html  metrics.parquet  metrics.csv
      <scene>/recorded.mp4  recorded_lidar.mp4
      <scene>/<reconstruction>/scene.json  road.npz
      <scene>/<reconstruction>/<policy>/<seed>/scenario.yaml  rollout.npz  versions.json  front.mp4
      ... lidar.mp4  [support.json]  [error.txt]  [video_error.txt]

A rollout's folder is written under a temporary name and renamed, so existing folders are complete. While writing, a run
holds an advisory lock (``flock``) on its folder, which the system releases when the process ends. So hidden parts in an
unlocked folder are leftovers of killed processes; the next run removes them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from nurec_sim.errors import RunError, WriteError
from nurec_sim.files.new_files import swap, writing

ROLLOUT, SCENARIO, VERSIONS, VIDEO, ERROR = "rollout.npz", "scenario.yaml", "versions.json", "front.mp4", "error.txt"
LIDAR, RECORDED, RECORDED_LIDAR = "lidar.mp4", "recorded.mp4", "recorded_lidar.mp4"
VIDEO_ERROR, SUPPORT = "video_error.txt", "support.json"
_LEFTOVER = re.compile(r"\..+\.(part|part\.\d+|old\.\d+)")
"""Temporary names of ``files.new_files.new_file`` and ``written_at_once``."""
SCENE, ROAD, REPORT = "scene.json", "road.npz", "report.html"


def new_run_folder(out_dir: Path, stamp: str) -> Path:
    """Creates ``out_dir/<stamp>`` (numbered if it exists) and links ``out_dir/latest`` to it."""
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
    """Links ``latest`` next to a run folder to it, unless ``latest`` is a real file or folder."""
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return
    part = folder.parent / ".latest.part"
    with contextlib.suppress(FileNotFoundError):
        part.unlink()
    with contextlib.suppress(OSError):  # file system without links
        part.symlink_to(folder.name, target_is_directory=True)
        os.replace(part, link)


def existing_run_folder(path: Path) -> Path:
    """An existing run folder to read or resume; follows links.

    Raises:
        RunError: there is no such folder.
    """
    path = Path(path)
    if not path.is_dir():
        raise RunError(f"run folder {path} does not exist; give a folder written by `nurec-sim run`")
    return path.resolve()


@contextlib.contextmanager
def owned(run: Path) -> Iterator[None]:
    """Locks a run folder for the block, after removing leftovers of killed processes.

    Raises:
        RunError: another process holds the lock.
    """
    # The kernel releases a flock when its process ends, however it ends: there are no stale lock files.
    handle = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(
                f"another run is writing to {run}; wait until it ends, or start a new run without --resume"
            ) from None
        except OSError:  # file system without locks: leftovers cannot be identified
            pass
        else:
            _remove_leftovers(run)
        yield
    finally:
        os.close(handle)


def tidy(run: Path) -> None:
    """Removes leftovers of killed processes in a run folder, unless it is locked."""
    if run.is_dir():
        with contextlib.suppress(RunError, OSError), owned(run):
            pass


def _remove_leftovers(run: Path) -> None:
    for place in ("", "*/*/", "*/*/*/"):
        for path in [path for path in run.glob(f"{place}.*") if _LEFTOVER.fullmatch(path.name)]:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def scene_folder(run: Path, scene_id: str, reconstruction: str) -> Path:
    """Folder of a scene under one reconstruction."""
    return run / folder_name(scene_id) / folder_name(reconstruction)


def rollout_folder(run: Path, scene_id: str, reconstruction: str, policy: str, seed: int) -> Path:
    """Folder of one rollout.

    Args:
        run: the run folder.
        scene_id: id of the scene.
        reconstruction: name of the reconstruction.
        policy: name of the policy.
        seed: seed of the rollout.
    """
    return scene_folder(run, scene_id, reconstruction) / folder_name(policy) / str(seed)


def folder_name(text: str) -> str:
    """A portable file name: characters other than letters, digits and ``._-`` become ``_``."""
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
    """Yields a hidden folder that is renamed to ``target`` on success; on failure ``target`` is unchanged."""
    # On the same file system, so that both renames are atomic. An existing target is moved aside first, since a
    # non-empty folder cannot be replaced, and is restored if the second rename fails.
    part, old = (target.with_name(f".{target.name}.{kind}.{os.getpid()}") for kind in ("part", "old"))
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            yield part
            shutil.rmtree(old, ignore_errors=True)
            swap(part, target, old)
        except WriteError as error:  # report the final name instead of the hidden one
            raise WriteError(error.errno, error.strerror, error.filename.replace(str(part), str(target))) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
