"""The commands ``import-log`` and ``trim``: a log of any format as a clip folder of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from nurec_sim.cli.console import OnePath, app, out, print_table, progress
from nurec_sim.cli.inputs import PosesName, with_poses
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable

OutPath = Annotated[Path, tyro.conf.arg(name="out")]


@app.command(name="import-log")
def import_log(log: OnePath, *, out_path: OutPath, poses: PosesName = "recorded", overwrite: bool = False) -> None:
    """Write a driving log of any format as a clip folder of ours (docs/log_formats.md).

    Other commands open these formats directly; a clip folder is for editing and moving a log.

    Args:
        log: the log, such as the folder of a KITTI drive.
        out_path: the folder to create, or a .zip file.
        poses: those of the log, or refined by its LiDAR.
        overwrite: replace an existing clip.
    """
    _convert(log, out_path, None, 0.0, None, (), overwrite, poses)


@app.command
def trim(
    log: OnePath,
    *,
    out_path: OutPath,
    start_s: float = 0.0,
    seconds: float | None = None,
    cameras: tuple[str, ...] = (),
    overwrite: bool = False,
) -> None:
    """Write a part of a driving log of any format as a clip folder of ours.

    Args:
        log: the log.
        out_path: the folder to create, or a .zip file; its name becomes the clip's.
        start_s: start of the part, in seconds after the start of the log.
        seconds: length of the part; default: to the end.
        cameras: cameras to keep; default: all. LiDARs are kept.
        overwrite: replace an existing clip.
    """
    _convert(log, out_path, out_path.stem, start_s, seconds, cameras, overwrite)


def _convert(
    path: Path,
    out_path: Path,
    id: str | None,
    start_s: float,
    seconds: float | None,
    cameras: tuple[str, ...],
    overwrite: bool,
    poses: PosesName = "recorded",
) -> None:
    from nurec_sim import logs

    if out_path.exists() and not overwrite:
        raise NurecSimError(f"{out_path} exists; give another --out, or --overwrite")
    if out_path.resolve() == path.resolve():
        raise NurecSimError(f"--out {out_path} is the log itself; give another --out")
    check_writable(out_path, folder=out_path.suffix != ".zip")
    log = with_poses(logs.open_clip(path), poses)
    with progress(f"writing {out_path.name}") as advance:
        logs.convert_clip(
            log,
            out_path,
            id=id,
            start_s=start_s,
            seconds=seconds,
            cameras=cameras or None,
            overwrite=overwrite,
            progress=advance,
        )
    print_table(f"clip {out_path.stem}", logs.describe_clip(logs.open_clip(out_path)).facts)
    out.print(f"wrote {out_path}", soft_wrap=True)
