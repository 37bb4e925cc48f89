"""The command line: one function per verb; heavy modules are imported by the verb that needs them."""

from __future__ import annotations

import contextlib
import inspect as inspect_module
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from nurec_sim.errors import NurecSimError

if TYPE_CHECKING:
    from nurec_sim.types import GaussianScene

app = tyro.extras.SubcommandApp()
out = Console(width=None if sys.stdout.isatty() else 120)
err = Console(stderr=True)

Paths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH...")]
OnePath = Annotated[Path, tyro.conf.Positional]
Report = Callable[[str, float], None]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; errors of ours become one line and exit status 1, Ctrl-C becomes 130."""
    try:
        app.cli(
            prog="nurec-sim",
            description="An open closed-loop sensor simulator for driving. A log becomes a Gaussian world, a gRPC "
            "server renders it, policies drive through it, a report says which is better. Start with: nurec-sim demo",
            args=None if arguments is None else list(arguments),
        )
    except NurecSimError as error:
        err.print(f"nurec-sim: {error}", style="red", markup=False, highlight=False)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        err.print("interrupted; finished rollouts are kept: add --resume runs/latest to go on", markup=False)
        raise SystemExit(130) from None


@app.command
def inspect(clip: OnePath) -> None:
    """Show what a driving log holds, and check it.

    Prints a table of sensors, rates, spans and boxes, then every fault as one line. Exit status 1 if there are faults.

    Args:
        clip: a clip folder, or a .zip of one (docs/clip_format.md).
    """
    from nurec_sim import logs
    from nurec_sim.logs.describe import SENSOR_COLUMNS

    log = logs.open_clip(clip)
    summary = logs.describe_clip(log)
    print_table(f"clip {log.id}", summary.facts)
    print_table("sensors", summary.sensors, SENSOR_COLUMNS)
    with err.status("reading every image and sweep"):
        faults = logs.check_clip(log)
    for fault in faults:
        out.print(f"fault: {fault}", style="red", markup=False, highlight=False, soft_wrap=True)
    if faults:
        raise SystemExit(1)
    out.print("no faults")


@app.command
def world(
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")],
    seed: int = 7,
    seconds: float = 12.0,
    truth: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Draw a small MuJoCo street and write it as a driving log.

    Args:
        out_path: the clip to write: a folder, or a .zip.
        seed: same seed, same street, same log.
        seconds: length of the log, 1 to 20.
        truth: also write exact depth and labels into this folder, apart from the log.
        overwrite: replace a clip that is there.
    """
    from nurec_sim.world import street_plan, write_street_clip

    command = f"nurec-sim world --seed {seed} --seconds {seconds:g} --out {out_path.name}"
    with progress("drawing the street") as advance:
        path = write_street_clip(
            street_plan(seed, seconds), out_path, truth=truth, command=command, progress=advance, overwrite=overwrite
        )
    out.print(f"wrote {path}", soft_wrap=True)


@app.command
def reconstruct(
    clip: OnePath,
    *,
    out_path: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    method: Literal["lift"] = "lift",
    cameras: tuple[str, ...] = (),
    overwrite: bool = False,
) -> None:
    """Turn a driving log into a Gaussian scene archive (.usdz).

    Args:
        clip: a clip folder, or a .zip of one.
        out_path: the archive to write; CLIP's name with .usdz in the current folder if not given.
        method: how to reconstruct; lift colours LiDAR points, no learning.
        cameras: use only these cameras; all if not given.
        overwrite: replace an archive that is there.
    """
    from nurec_sim import logs, scene
    from nurec_sim.reconstruct import reconstruct as run_method

    log = logs.open_clip(clip)
    target = out_path or Path(f"{log.id}.usdz")
    if target.exists() and not overwrite:
        raise NurecSimError(f"{target} exists; give another --out, or --overwrite")
    with progress("reconstructing") as advance:
        world_scene = run_method(log, method, cameras=cameras or None, progress=advance)
    scene.write_scene(world_scene, target, overwrite=overwrite)
    print_table(f"scene {world_scene.id}", scene.summary(world_scene))
    for text in world_scene.provenance.get("unknown", ()):
        out.print(f"not known: {text}", markup=False)
    out.print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)


@app.command
def render(
    source: OnePath,
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("frame.png"),
    camera: str | None = None,
    frame: int = 0,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
    layer: Literal["rgb", "depth", "alpha", "label"] = "rgb",
    width: int | None = None,
) -> None:
    """Render one camera image of a scene to a PNG, from where it was recorded or beside it.

    Args:
        source: a scene archive or a clip.
        out_path: the PNG to write.
        camera: camera id; the first if not given.
        frame: which recorded frame's time and pose to take.
        left_m: move the car to the left by so many metres.
        yaw_deg: turn the car to the left by so many degrees.
        layer: what to draw.
        width: image width in pixels; the camera's own if not given.
    """
    from nurec_sim.render.still import render_still

    scene_ = load_scene(source)
    render_still(scene_, out_path, camera, frame, left_m=left_m, yaw_deg=yaw_deg, layer=layer, width_px=width)
    out.print(f"wrote {out_path}", soft_wrap=True)


@app.command
def serve(
    sources: Paths,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    threads: int | None = None,
    cache: Path | None = None,
) -> None:
    """Serve scenes over gRPC, for AlpaSim, CARLA and NuRec clients. Ctrl-C stops.

    Prints `Serving on <host>:<port>` when ready. Clips are reconstructed on first use and kept in the cache.

    Args:
        sources: scene archives, clips, or folders of them.
        host: address to listen on; only this machine unless said otherwise.
        port: 0 takes a free one.
        threads: render threads; the number of cores if not given.
        cache: where reconstructed clips are kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
    """
    from nurec_sim.scene_store import SceneStore
    from nurec_sim.server import serve as run_server

    store = SceneStore(sources, cache_dir=cache, threads=threads, on_progress=err.print)
    try:
        run_server(store, host=host, port=port)
    except OSError as error:
        raise NurecSimError(str(error)) from None


@app.command
def run(
    sources: Paths,
    *,
    scenario: str = "short",
    policies: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("runs"),
    resume: Path | None = None,
    address: str | None = None,
    cache: Path | None = None,
    video: bool = True,
) -> None:
    """Drive policies closed-loop through scenes, measure, and write a report.

    Starts a server of its own unless --address names one. The run folder holds report.html, metrics.parquet,
    metrics.csv and one folder per rollout; runs/latest points to the newest.

    Args:
        sources: scene archives or clips.
        scenario: a shipped scenario's name, or a YAML file.
        policies: names, files as my_policy.py:Class, or entry points; the scenario's own if not given.
        seeds: one rollout each per scene and policy; the scenario's own if not given.
        out_path: folder that collects run folders.
        resume: go on with this run folder; finished rollouts are kept.
        address: host:port of a running server that serves the same scenes.
        cache: where reconstructed clips are kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
        video: also record the front camera of every rollout.
    """
    drive(sources, scenario, policies, seeds, out_path, resume, address, cache, video)


@app.command
def demo(
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("runs"),
    resume: Path | None = None,
    cache: Path | None = None,
) -> None:
    """Run the whole chain on the log that ships with the package: about five minutes on two cores.

    Args:
        out_path: folder that collects run folders.
        resume: go on with this run folder; finished rollouts are kept.
        cache: where the reconstructed scene is kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
    """
    drive((), "demo", (), (), out_path, resume, None, cache, True)


@app.command
def evaluate(
    clip: OnePath,
    *,
    method: Literal["lift"] = "lift",
    input_cameras: tuple[str, ...] = (),
    target_cameras: tuple[str, ...] = (),
    hold_out_sweeps: int = 0,
    local: bool = False,
    images: Path | None = None,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure a reconstruction against what the log recorded: images of other cameras, LiDAR sweeps left out.

    Args:
        clip: a clip folder, or a .zip of one.
        method: how to reconstruct.
        input_cameras: cameras that the reconstruction may see; all if not given.
        target_cameras: cameras to compare with; the input cameras if not given.
        hold_out_sweeps: leave out every so-manieth sweep and simulate it; 0 leaves out none.
        local: render in this process instead of through gRPC.
        images: also write rendered and recorded images side by side into this folder.
        json_path: write all figures here.
    """
    from nurec_sim import logs
    from nurec_sim.evaluate import evaluate as run_evaluation

    log = logs.open_clip(clip)
    with progress("evaluating") as advance:
        figures = run_evaluation(
            log,
            method,
            input_cameras=input_cameras or None,
            target_cameras=target_cameras or None,
            hold_out_every=hold_out_sweeps,
            via_grpc=not local,
            images_dir=images,
            progress=advance,
        )
    if json_path is not None:
        json_path.write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    print_table(f"{method} on {log.id}", flatten(figures))


@app.command
def report(run_folder: OnePath) -> None:
    """Write report.html of a run folder anew.

    Args:
        run_folder: a folder made by `nurec-sim run`.
    """
    from nurec_sim import runs

    out.print(f"wrote {runs.write_report(run_folder)}", soft_wrap=True)


@app.command
def policies(check: Annotated[str | None, tyro.conf.Positional] = None) -> None:
    """List the policies that can be driven, or check that one keeps the contract.

    Args:
        check: a policy's name, or my_policy.py:Class.
    """
    from nurec_sim import plugins

    if check is None:
        found = [(name, plugins.load_policy(name)) for name in plugins.available_policies()]
        rows = [(name, (inspect_module.getdoc(policy) or "").split("\n")[0]) for name, policy in found]
        print_table("policies", rows, ("name", "what it does"))
        return
    from nurec_sim.sim.conformance import check_policy

    faults = check_policy(plugins.load_policy(check))
    for fault in faults:
        out.print(f"fault: {fault}", style="red", markup=False, highlight=False, soft_wrap=True)
    if faults:
        raise SystemExit(1)
    out.print(f"{check} keeps the contract")


def drive(
    sources: Sequence[Path],
    scenario_name: str,
    policy_names: Sequence[str],
    seeds: Sequence[int],
    out_dir: Path,
    resume: Path | None,
    address: str | None,
    cache: Path | None,
    video: bool,
) -> None:
    """Scenes, server, rollouts, report: what `run` and `demo` share."""
    from nurec_sim import runs, sim
    from nurec_sim.client import RemoteSensors
    from nurec_sim.scene_store import SceneStore
    from nurec_sim.server import SensorServer

    started = time.monotonic()
    scenario_path = find_scenario(scenario_name)
    scenario = sim.load_scenario(scenario_path)
    if not sources and scenario.clip is None:
        raise NurecSimError(f"scenario {scenario.name!r} names no clip; give clips or scenes to drive through")
    store = SceneStore(sources or [scenario_path.parent / str(scenario.clip)], cache_dir=cache)
    for fault in store.faults.values():
        raise NurecSimError(fault)
    with progress("reconstructing") as advance:
        scenes = [store.get(scene_id, progress=advance).scene for scene_id in store.ids]
    with contextlib.ExitStack() as stack:
        if address is None:
            address = stack.enter_context(SensorServer(store, port=0))
        out.print(f"sensors from {address}; {len(scenes)} scene(s), scenario {scenario.name}")
        with progress("driving") as advance:
            folder = runs.execute(
                scenes,
                scenario,
                policy_names or scenario.policies,
                lambda scene_id: stack.enter_context(RemoteSensors(address, scene_id)).sense,
                out_dir,
                seeds=seeds or scenario.seeds,
                resume=resume,
                video=video,
                progress=advance,
            )
    heading, *rows = runs.headline(folder)
    print_table("means over rollouts", rows, heading)
    out.print(f"{time.monotonic() - started:.0f} s. Report: {(folder / 'report.html').resolve()}", soft_wrap=True)


def find_scenario(name: str) -> Path:
    """The file of a shipped scenario, or ``name`` itself if it is a YAML file."""
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    folder = Path(str(resources.files("nurec_sim.scenarios")))
    shipped = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in shipped:
        raise NurecSimError(f"no shipped scenario {name!r}; have {shipped}, or give a .yaml file")
    return folder / f"{name}.yaml"


def load_scene(source: Path) -> GaussianScene:
    """A scene from an archive, or from a clip that is reconstructed now."""
    from nurec_sim.scene_store import SceneStore

    store = SceneStore([source])
    for fault in store.faults.values():
        raise NurecSimError(fault)
    with progress("loading") as advance:
        return store.get(store.ids[0], progress=advance).scene


@contextlib.contextmanager
def progress(title: str) -> Iterator[Report]:
    """A progress bar on stderr, fed with (what is being done, fraction 0..1)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(title, total=1.0)

        def advance(stage: str, fraction: float) -> None:
            bar.update(task, description=f"{title}: {stage}" if stage else title, completed=fraction)

        yield advance


def print_table(title: str, rows: Sequence[Sequence[object]], heading: Sequence[str] = ()) -> None:
    """Rows as a table, with or without a heading."""
    table = Table(title=title, title_justify="left", show_header=bool(heading))
    for name in heading or [""] * max((len(row) for row in rows), default=0):
        table.add_column(name, no_wrap=name == "policy")
    for row in rows:
        table.add_row(*(escape(str(cell)) for cell in row))
    out.print(table)


def flatten(figures: dict, prefix: str = "") -> list[tuple[str, str]]:
    """Nested figures as dotted rows; lists stay in the JSON file."""
    rows: list[tuple[str, str]] = []
    for key, value in figures.items():
        if isinstance(value, dict):
            rows += flatten(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            rows.append((prefix + key, f"{value:.4g}" if isinstance(value, float) else str(value)))
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
