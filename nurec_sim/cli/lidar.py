"""The verb about one LiDAR sweep of a scene: lidar."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from nurec_sim.cli.console import OnePath, app, chosen_device, out, print_table
from nurec_sim.cli.scenes import loaded
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable


@app.command
def lidar(
    source: OnePath,
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("sweep.png"),
    model: str | None = None,
    columns: int | None = None,
    lidar: str | None = None,
    time_s: float = 0.0,
    left_m: float = 0.0,
    ahead_m: float = 0.0,
    yaw_deg: float = 0.0,
    standing: bool = False,
    noise_m: Annotated[float, tyro.conf.arg(name="noise")] = 0.0,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """Render one LiDAR sweep of a scene, at a recorded pose or beside it, with any device.

    The suffix of --out says what is written. .png: the sweep from above and as an image of ranges. .npz: xyz_m,
    range_m, intensity, beam and t_us per return, the beam table and the poses. .ply: x, y, z, intensity, range, row,
    column and after_start_us, for point-cloud viewers. Points are in the sensor's frame at the end of the sweep. Moving
    actors are where they were recorded; each column of beams is fired from its own pose.

    Example: nurec-sim lidar scene.usdz --left-m 3.5 --model PANDAR128 --noise 0.02 --out sweep.ply

    Args:
        source: a scene archive or a driving log.
        out_path: the file to write: .png, .npz or .ply.
        model: a device in place of the rig's LiDAR: PANDAR128, AT128, HDL-64, HDL-32, VLP-32C or VLP-16.
        columns: firings per turn of that device; default: its own number.
        lidar: id of the rig's LiDAR, or of the one whose place the device takes; default: the first.
        time_s: when the sweep starts, in seconds after the first recorded pose.
        left_m: lateral offset of the car in metres, left positive.
        ahead_m: offset of the car along its heading in metres.
        yaw_deg: yaw offset of the car in degrees, left positive.
        standing: take the whole sweep from its first pose.
        noise_m: standard deviation of the range noise in metres.
        seed: of the noise; the same seed gives the same file.
        device: render device: auto (a GPU if available), cpu, cuda or cuda:N.
    """
    from nurec_sim.render.images.sweep import SUFFIXES, SweepPlace, choose_lidar, write_sweep

    if out_path.suffix.lower() not in SUFFIXES:
        raise NurecSimError(f"--out must end in {', '.join(SUFFIXES)}, got {str(out_path)!r}")
    if not (np.isfinite(noise_m) and noise_m >= 0):
        raise NurecSimError(f"--noise is a standard deviation in metres, at least 0; got {noise_m:g}")
    if seed < 0:
        raise NurecSimError(f"--seed must be at least 0, got {seed}")
    if not np.isfinite([left_m, ahead_m, yaw_deg]).all():
        raise NurecSimError("--left-m, --ahead-m and --yaw-deg must be finite")
    check_writable(out_path)
    renderer = loaded(source, chosen_device(device)).renderer
    chosen = choose_lidar(renderer.scene, lidar, model, columns)
    place = SweepPlace(time_s, left_m, ahead_m, yaw_deg, standing)
    frame = write_sweep(renderer, out_path, chosen, place, noise_m, seed)
    rows, firings = len(chosen.elevation_rad), len(chosen.azimuth_rad)
    print_table(
        f"sweep of {chosen.id}",
        [
            ("beams", f"{rows} x {firings}"),
            ("returns", f"{len(frame.beam):,} ({len(frame.beam) / (rows * firings):.1%})"),
            ("median range", f"{np.median(frame.range_m):.2f} m" if len(frame.beam) else "no returns"),
        ],
    )
    out.print(f"wrote {out_path}", soft_wrap=True)
