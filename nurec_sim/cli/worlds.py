"""The command ``world``: generates procedural towns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from nurec_sim.cli.console import app, out, print_table, progress
from nurec_sim.errors import ClipError, NurecSimError
from nurec_sim.files.new_files import check_writable

if TYPE_CHECKING:
    from nurec_sim.types import Rig
    from nurec_sim.world import TownPlan

Template = Literal[
    "straight", "curve", "s_curve", "t_junction", "x_junction", "narrowing", "slip_road", "roundabout",
    "double_junction",
]  # fmt: skip
DEFAULT_SEED, DEFAULT_SECONDS = 7, 12.0


@app.command
def world(
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")],
    seed: int | None = None,
    split: Literal["train", "test"] | None = None,
    template: Template | None = None,
    seconds: float | None = None,
    plan_path: Annotated[Path | None, tyro.conf.arg(name="plan")] = None,
    truth: Path | None = None,
    traffic: Literal["usual", "dense"] | None = None,
    turn: Literal["left", "right", "straight"] | None = None,
    hz: float = 10.0,
    jpeg_quality: int = 80,
    width: int | None = None,
    height: int | None = None,
    cameras: Literal[1, 3, 5] | None = None,
    lens: Literal["pinhole", "distorted", "fisheye", "ftheta"] | None = None,
    pixels: int | None = None,
    lidar: str | None = None,
    rig_seed: int | None = None,
    imperfect: bool = False,
    overwrite: bool = False,
) -> None:
    """Generate a procedural town and record a drive through it as a driving log.

    --truth writes exact depth, labels, normals, motion and the plan to a separate folder, which no reader of the log
    can access. The rig has three pinhole cameras of 448 x 256 pixels and one LiDAR; with --width and --height they have
    other images, with --cameras, --lens, --pixels, --lidar or --rig-seed it is a random one.

    Examples: `nurec-sim world --seed 7 --out town.zip`;
    `nurec-sim world --split test --template roundabout --cameras 5 --lens fisheye --truth truth --out town.zip`.

    Args:
        out_path: the clip to write: a folder, or a .zip.
        seed: seed of the town and the log; default: 7.
        split: default: train; towns of split test have templates, materials and vehicles that training never uses.
        template: road layout; default: by the seed. roundabout and double_junction are in split test only.
        seconds: length of the drive, 1 to 30; default: 12.
        plan_path: use this plan.json (of a ground truth folder) instead of a new town.
        truth: also write the ground truth into this folder, which must not exist (docs/world.md).
        traffic: usual, or dense: more vehicles, parked cars and pedestrians in the same town; default: usual.
        turn: which way the ego goes at the first junction; default: by the seed.
        hz: frame sets per second: up to 10 with a LiDAR, up to 25 without.
        jpeg_quality: of the images, 1 to 100.
        width: image width of the usual cameras in pixels; default: 448.
        height: image height of the usual cameras in pixels; default: 256.
        cameras: random rig with this many cameras: front, + front left and right, + rear left and right.
        lens: random rig with this lens type.
        pixels: random rig with about this many pixels per image (width times height).
        lidar: random rig with this LiDAR: 64x900, PANDAR128, AT128, HDL-64, HDL-32, VLP-32C, VLP-16, or none.
        rig_seed: seed of the random rig; default: the town's seed.
        imperfect: add per-camera colour response, vignette and noise, and drop weak LiDAR returns.
        overwrite: replace an existing clip.
    """
    from nurec_sim.world import random_readout_us, random_responses, write_town_clip

    plan = _plan(seed, split, template, seconds, traffic, turn, plan_path)
    car_seed = plan.seed if rig_seed is None else rig_seed
    rig = _rig(car_seed, cameras, lens, pixels, lidar, width, height, chosen=rig_seed is not None)
    if not 0.1 <= hz <= 25.0:
        raise NurecSimError(f"--hz must be within 0.1..25, got {hz:g}")
    if not 1 <= jpeg_quality <= 100:
        raise NurecSimError(f"--jpeg-quality must be within 1..100, got {jpeg_quality}")
    options = {"traffic": traffic, "turn": turn, "hz": None if hz == 10.0 else f"{hz:g}",
               "jpeg-quality": None if jpeg_quality == 80 else jpeg_quality, "width": width, "height": height,
               "cameras": cameras, "lens": lens, "pixels": pixels, "lidar": lidar, "rig-seed": rig_seed}  # fmt: skip
    check_writable(out_path, folder=out_path.suffix != ".zip")
    with progress("rendering the town") as advance:
        path = write_town_clip(
            plan,
            out_path,
            rig=rig,
            period_us=round(1e6 / hz),
            readout_us=random_readout_us(car_seed),
            responses=random_responses(rig, car_seed) if imperfect else None,
            jpeg_quality=jpeg_quality,
            truth=truth,
            command=_command(plan, plan_path, options) + (" --imperfect" if imperfect else ""),
            progress=advance,
            overwrite=overwrite,
        )
    moving = sum(actor.moves for actor in plan.actors)
    print_table(f"town {plan.split} {plan.seed}", [
        ("template", plan.template), ("sky", plan.weather.preset), ("seconds", f"{_seconds(plan):g}"),
        ("actors", f"{moving} moving, {len(plan.actors) - moving} standing"),
    ])  # fmt: skip
    out.print(f"wrote {path}" + ("" if truth is None else f" and its ground truth {truth}"), soft_wrap=True)


def _plan(
    seed: int | None, split: str | None, template: str | None, seconds: float | None,
    traffic: Literal["usual", "dense"] | None, turn: Literal["left", "right", "straight"] | None, file: Path | None,
) -> TownPlan:  # fmt: skip
    from nurec_sim.world import TownPlan, town_plan

    if file is None:
        try:
            return town_plan(
                DEFAULT_SEED if seed is None else seed,
                "test" if split == "test" else "train",
                template,
                DEFAULT_SECONDS if seconds is None else seconds,
                traffic or "usual",
                turn,
            )
        except ValueError as error:
            raise NurecSimError(str(error)) from None
    given = {"--seed": seed, "--split": split, "--template": template, "--seconds": seconds,
             "--traffic": traffic, "--turn": turn}  # fmt: skip
    both = [name for name, value in given.items() if value is not None]
    if both:
        raise NurecSimError(f"--plan defines the town; remove {', '.join(both)}")
    try:
        return TownPlan.from_json(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise NurecSimError(f"cannot read the plan {file}: {error}") from None
    except ClipError as error:
        raise NurecSimError(f"{file}: {error}") from None


def _rig(
    seed: int, cameras: int | None, lens: str | None, pixels: int | None, lidar: str | None, width: int | None,
    height: int | None, *, chosen: bool,
) -> Rig:  # fmt: skip
    """The usual rig, or a random one if any of its options is given."""
    from nurec_sim.world import random_rig, street_rig

    usual = {name: size for name, size in (("width_px", width), ("height_px", height)) if size is not None}
    if not chosen and (cameras, lens, pixels, lidar) == (None, None, None, None):
        try:
            return street_rig(**usual)
        except ValueError as error:
            raise NurecSimError(str(error)) from None
    if usual:
        raise NurecSimError("--width and --height are for the usual rig; give --pixels for a random one")
    given = {"pixels": pixels, "lidar": lidar}
    options: dict = {name: value for name, value in given.items() if value is not None}
    if lidar == "none":
        options["lidar"] = None
    try:
        return random_rig(seed, cameras, lens=lens, **options)
    except ValueError as error:
        raise NurecSimError(str(error)) from None


def _seconds(plan: TownPlan) -> float:
    return (plan.span_us[1] - plan.span_us[0]) / 1e6


def _command(plan: TownPlan, plan_path: Path | None, options: Mapping[str, object]) -> str:
    """The command that reproduces the log, without output paths: the same log has the same bytes."""
    town = f"--seed {plan.seed} --split {plan.split} --template {plan.template} --seconds {_seconds(plan):g}"
    words = ["nurec-sim world", town if plan_path is None else f"--plan {plan_path.name}"]
    return " ".join([*words, *(f"--{name} {value}" for name, value in options.items() if value is not None)])
