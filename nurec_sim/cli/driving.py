"""Verbs that drive policies: run, demo, report, policies."""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from nurec_sim.cli.console import (
    OnePath,
    Paths,
    app,
    chosen_device,
    err,
    out,
    part_of,
    print_faults,
    print_table,
    progress,
)
from nurec_sim.cli.scenes import NO_OPTIMISATION, refinement
from nurec_sim.errors import NurecSimError
from nurec_sim.files.new_files import check_writable, write_file

if TYPE_CHECKING:
    from nurec_sim.render.support import Support
    from nurec_sim.runs.sources import Offer
    from nurec_sim.serving.store import SceneStore


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
    true_world: Path | None = None,
    cache: Path | None = None,
    methods: tuple[str, ...] = (),
    hold_out: int = 10,
    clip: Path | None = None,
    video: bool = True,
    plan_timeout: float = 60.0,
    device: str = "auto",
    refine: float | None = None,
    budget: int | None = None,
) -> None:
    """Run policies closed-loop in scenes, compute metrics, and write a report; exit status 1 if a rollout failed.

    With --methods, or with several archives of one log, the reconstructions are compared side by side.

    Starts its own server unless --address is given. The run folder has report.html, metrics.parquet,
    metrics.csv and one folder per rollout; runs/latest points to the newest.

    Args:
        sources: scene archives or clips.
        scenario: name of a bundled scenario, or a YAML file.
        policies: names, files as my_policy.py:Class, or entry points; default: those of the scenario.
        seeds: one rollout per seed, scene and policy; default: those of the scenario.
        out_path: parent folder of run folders.
        resume: resume this run folder; finished rollouts are kept.
        address: host:port of a running server with the same scenes.
        true_world: also drive in the original town of the clip, given by the plan.json of its ground truth folder; the
            report shows it as reconstruction `truth` (docs/world.md).
        cache: where reconstructed clips are kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
        methods: reconstruct each log by all of these methods, such as `lift dense`, and compare them; default: lift.
        hold_out: with --methods, keep every N-th image and the sweeps taken with it out of the reconstructions, to
            measure them by; 0 for none.
        clip: the log of the given archives, to measure them by and to show beside them.
        video: also record the front camera of every rollout.
        plan_timeout: time limit in seconds for creating a policy and for each plan.
        device: render device without --address: auto (a GPU if available), cpu, cuda or cuda:N.
        refine: time budget in seconds for optimising the reconstruction of each clip on its images and sweeps.
        budget: with --refine, the most static Gaussians of a scene: more are merged before the optimisation.
    """
    drive(
        sources, scenario, policies, seeds, out_path, resume, address, cache, video, true_world, plan_timeout, device,
        methods, hold_out if methods else 0, clip, refine, budget,
    )  # fmt: skip


@app.command
def demo(
    *,
    out_path: Annotated[Path, tyro.conf.arg(name="out")] = Path("runs"),
    resume: Path | None = None,
    save_log: Path | None = None,
    cache: Path | None = None,
    device: str = "auto",
    refine: float | None = None,
    budget: int | None = None,
) -> None:
    """Run the whole chain on the bundled demo log: about two minutes on two cores.

    Args:
        save_log: only write the demo log to this .zip file, to try other commands on it.
        out_path: parent folder of run folders.
        resume: resume this run folder; finished rollouts are kept.
        cache: where the reconstructed scene is kept; $NUREC_SIM_CACHE or ~/.cache/nurec_sim if not given.
        device: render device: auto (a GPU if available), cpu, cuda or cuda:N.
        refine: time budget in seconds for optimising the reconstruction on the log's images and sweeps.
        budget: with --refine, the most static Gaussians: more are merged before the optimisation.
    """
    if save_log is not None:
        return _save_demo_log(save_log)
    drive((), "demo", (), (), out_path, resume, None, cache, True, device=device, refine=refine, budget=budget)


def _save_demo_log(path: Path) -> None:
    """Copy the bundled log to a file.

    Raises:
        NurecSimError: the file exists, does not end in .zip, or cannot be written.
    """
    from nurec_sim import sim

    if path.suffix.lower() != ".zip":
        raise NurecSimError(f"--save-log writes a .zip file, got {str(path)!r}")
    if path.exists():
        raise NurecSimError(f"{path} exists; give --save-log another name")
    scenario_path = sim.scenario_file("demo")
    log = scenario_path.parent / str(sim.load_scenario(scenario_path).clip)
    write_file(path, log.read_bytes())
    out.print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)


@app.command
def report(run_folder: OnePath) -> None:
    """Rewrite report.html of a run folder.

    Args:
        run_folder: a folder written by `nurec-sim run`.
    """
    from nurec_sim import runs

    with progress("reporting") as advance:
        path = runs.write_report(run_folder, advance)
    out.print(f"wrote {path}", soft_wrap=True)


@app.command
def policies(check: Annotated[str | None, tyro.conf.Positional] = None) -> None:
    """List the available policies, or check one against the policy contract.

    Args:
        check: a policy's name, or my_policy.py:Class.
    """
    from nurec_sim import plugins

    if check is None:
        rows = [
            (name, str(policy) if isinstance(policy, NurecSimError) else (inspect.getdoc(policy) or "").split("\n")[0])
            for name, policy in plugins.load_all(plugins.POLICIES)
        ]
        print_table("policies", rows, ("name", "what it does"))
        return
    from nurec_sim.sim.conformance import check_policy

    faults = check_policy(plugins.load_policy(check))
    print_faults(faults)
    out.print(f"{check} conforms to the policy contract")


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
    true_world: Path | None = None,
    plan_timeout_s: float = 60.0,
    device: str = "auto",
    methods: Sequence[str] = (),
    hold_out_every: int = 0,
    clip: Path | None = None,
    refine: float | None = None,
    budget: int | None = None,
) -> None:
    """Policies, scenes, server, rollouts and report, for `run` and `demo`.

    Args:
        sources: clips or scenes; default: the scenario's clip.
        scenario_name: a scenario file, or the name of a bundled scenario.
        policy_names: policies to drive; default: the scenario's.
        seeds: seeds of the rollouts; default: the scenario's.
        out_dir: folder in which a run folder is created.
        resume: an existing run folder to complete instead.
        address: host:port of a sensor server; None starts one in this process.
        cache: folder of cached reconstructions.
        video: whether to write videos.
        true_world: ``plan.json`` of the procedural town behind the only scene, to drive in it as well.
        plan_timeout_s: time limit of each call of a policy.
        device: rendering device of the server in this process.
        methods: reconstruction methods of logs; default: ``lift``.
        hold_out_every: every N-th image of a log is kept out of its reconstructions.
        clip: log of the archives.
        refine: seconds for optimising each reconstructed clip.
        budget: the most static Gaussians of what is optimised.
    """
    from nurec_sim import logs, runs, sim
    from nurec_sim.evaluate import measure_fidelity
    from nurec_sim.runs.folder import existing_run_folder
    from nurec_sim.serving.client import RemoteSensors
    from nurec_sim.serving.server import SensorServer
    from nurec_sim.serving.store import SceneStore

    started = time.monotonic()
    scenario_path = sim.scenario_file(scenario_name)
    scenario = sim.load_scenario(scenario_path)
    if not sources and scenario.clip is None:
        raise NurecSimError(f"scenario {scenario.name!r} has no clip; give clips or scenes")
    if budget is not None and refine is None:
        raise NurecSimError(NO_OPTIMISATION.format("with --refine"))
    fit = refinement(refine, device, budget)
    if fit is not None and address is not None:
        raise NurecSimError("--refine cannot be used with --address: the scenes are those of the running server")
    if scenario.added_actors and address is not None:
        raise NurecSimError(f"scenario {scenario.name!r} adds actors, which needs a server of its own: no --address")
    if resume is not None:
        existing_run_folder(resume)  # fails here, before scenes are reconstructed
    loaded = runs.load_policies(policy_names or scenario.policies, plan_timeout_s)
    if address is not None:
        with RemoteSensors(address) as sensors:
            sensors.version()  # fails here if there is no server
    device = "cpu" if address is not None else chosen_device(device)
    store = SceneStore(cache_dir=cache, device=device)
    offers = runs.offer_all(store, sources or [scenario_path.parent / str(scenario.clip)], methods, hold_out_every, fit)
    if fit is not None and (finished := [offer.scene_id for offer in offers if offer.clip is None]):
        raise NurecSimError(f"--refine optimises reconstructions of clips; {', '.join(finished)} is a finished archive")
    if len(offers) > len({offer.scene_id for offer in offers}) and address is not None:
        raise NurecSimError("several reconstructions of one log need a server of their own: leave out --address")
    paths = {offer.scene_id: offer.clip or clip for offer in offers}
    opened = {scene_id: logs.open_clip(path) for scene_id, path in paths.items() if path is not None}
    check_writable(resume or out_dir, folder=True)
    with progress("loading") as advance:
        loaded_scenes = runs.load_all(store, offers, advance)
    scenes = [scene for _, scene in loaded_scenes]
    served = {(scene.id, runs.reconstruction_of(scene)): offer for offer, scene in loaded_scenes}
    with contextlib.ExitStack() as stack:
        if address is None:
            address = stack.enter_context(SensorServer(store, port=0))
        server, senses = address, {}
        for key, offer in served.items():
            senses[key] = stack.enter_context(RemoteSensors(server, offer.served_as)).sense
        logs_by_id = {scene.id: opened[offer.scene_id] for offer, scene in loaded_scenes if offer.scene_id in opened}
        fidelity: dict[tuple[str, str], dict[str, Any]] = {}
        if len(served) > len({scene.id for scene in scenes}) or clip is not None:
            with progress("comparing with the log") as advance:
                for scene in scenes:
                    key = scene.id, runs.reconstruction_of(scene)
                    if scene.id in logs_by_id:
                        part = part_of(advance, len(fidelity), len(scenes), key[1])
                        every = served[key].hold_out_every
                        fidelity[key] = measure_fidelity(logs_by_id[scene.id], scene, senses[key], every, part)
        # After the comparison with the log, which does not have them.
        loaded_scenes, added = runs.add_to_served(store, loaded_scenes, scenario, scenario_path.parent)
        scenes = [scene for _, scene in loaded_scenes]
        if true_world is not None:
            if len({scene.id for scene in scenes}) != 1:
                raise NurecSimError(f"--true-world needs exactly one clip or scene, got {len(scenes)}")
            scene, sense = stack.enter_context(runs.true_world(true_world, scenes[0], added=added.get(scenes[0].id)))
            # First, because the others are compared with it.
            scenes.insert(0, scene)
            senses[scene.id, runs.reconstruction_of(scene)] = sense
        out.print(f"sensors from {server}; {len(scenes)} scene(s), scenario {scenario.name}")
        with progress("driving") as advance:
            folder = runs.execute(
                scenes,
                scenario,
                loaded,
                lambda scene: senses[scene.id, runs.reconstruction_of(scene)],
                out_dir,
                logs=logs_by_id,
                fidelity=fidelity,
                seeds=seeds or scenario.seeds,
                resume=resume,
                video=video,
                progress=advance,
                notice=_notice,
                support_for=lambda scene: _support(store, served.get((scene.id, runs.reconstruction_of(scene)))),
            )
    heading, *rows = runs.headline(folder)
    print_table("means over rollouts", rows, heading)
    out.print(f"{time.monotonic() - started:.0f} s. Report: {(folder / 'report.html').resolve()}", soft_wrap=True)
    rollouts, failed = (sum(int(row[heading.index(name)]) for row in rows) for name in ("rollouts", "failed"))
    if failed:
        _notice(f"{failed} of {rollouts} rollouts failed; the report gives the reasons")
        _leave(1)


def _support(store: SceneStore, offer: Offer | None) -> Support | None:
    """What the cameras of a scene recorded; None for the true world, and for scenes without times of frames."""
    from nurec_sim.render.support import Support, recorded_frames

    if offer is None:
        return None
    renderer = store.get(offer.served_as).renderer
    return Support(renderer) if recorded_frames(renderer.scene) else None


def _notice(text: str) -> None:
    """Prints a line without disturbing the progress display."""
    err.print(text, style="red", markup=False, highlight=False, soft_wrap=True)


def _leave(status: int) -> None:
    """Exits with a status even if threads of timed-out policies are still running."""
    from nurec_sim.sim.policy_thread import still_abandoned

    if still_abandoned():
        # A normal exit would wait for threads started by a policy, or crash on one that writes to the console.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    raise SystemExit(status)
