"""The command ``study``: do reconstructions rank policies as the true world does?"""

from __future__ import annotations

import resource
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import tyro

from nurec_sim.cli.console import app, err, out, print_table, progress
from nurec_sim.errors import RunError
from nurec_sim.files.new_files import check_writable


@app.command
def study(
    config: Annotated[str, tyro.conf.Positional],
    *,
    out_path: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    jobs: int | None = None,
    ray: str | None = None,
    report: bool = False,
) -> None:
    """Does a reconstruction rank policies as the true world does? Towns, reconstructions, rollouts and one report.

    Every scene is a procedural town. Its log is recorded and reconstructed; every policy then drives in the town itself
    (`truth`) and in every reconstruction, from the same starts, among the same actors, with the same random numbers.
    The report says how well each reconstruction ranks the policies (tau-b with interval and noise ceiling, flipped
    pairs), and whether the study could tell a bad one.

    Bundled studies: `smoke` (2 scenes, minutes), `evening` (18 scenes, half an hour on two cores), `nightly` (24
    scenes, also `dense`). Copy one from the package's folder `study/tiers` to make your own; docs/study.md explains
    every key.

    An interrupted study goes on where it stopped: give the same command again. The result is the same, byte for byte,
    for any --jobs and on any cluster. Exit status 1 if a rollout failed.

    Examples: `nurec-sim study smoke`; `nurec-sim study mine.yaml --out studies/mine --jobs 8`;
    `nurec-sim study nightly --ray auto` on a Ray cluster (docs/fleet.md); `nurec-sim study smoke --report` rewrites
    the report only.

    Args:
        config: name of a bundled study, or a YAML file.
        out_path: folder of the study; default: studies/NAME.
        jobs: worker processes; default: one per core.
        ray: run on a Ray cluster instead: host:port of its head, `auto` for the one that this machine belongs to, or
            `local`; needs `pip install 'nurec-sim[fleet]'`.
        report: only rewrite tables and report, of a finished study.
    """
    from nurec_sim import study as studies
    from nurec_sim.compute.cores import usable_cores

    chosen = studies.load_study(config)
    folder = out_path or Path("studies") / chosen.name
    if report:
        path = studies.report_again(chosen, folder)
        out.print(f"wrote {path}", soft_wrap=True)
        return
    if ray is not None and jobs is not None:
        raise RunError("give --jobs or --ray, not both: a cluster runs one task per CPU")
    check_writable(folder, folder=True)
    started, before = time.monotonic(), _cpu_s()
    with ExitStack() as stack:
        executor: studies.Executor
        if ray is None:
            executor = studies.LocalProcesses(usable_cores() if jobs is None else jobs)
        else:
            executor = stack.enter_context(studies.RayCluster(ray))
        out.print(
            f"study {chosen.name}: {len(chosen.scenes)} scenes x {len(chosen.all_worlds)} worlds x "
            f"{len(chosen.policies)} policies x {chosen.trials} trials = {chosen.rollouts} rollouts, "
            f"{executor.jobs} job{'' if executor.jobs == 1 else 's'}"
        )
        advance = stack.enter_context(progress("study"))
        path = studies.run_study(chosen, folder, executor, progress=advance, notice=_notice)
    results = studies.read_agreement(folder)
    heading = ("world", "metric", "tau-b", "95 % interval", "pairs: same", "flipped", "resolved in one", "unresolved")
    print_table("agreement with the truth", studies.agreement_rows(results), heading)
    elapsed = time.monotonic() - started
    out.print(f"{elapsed:.0f} s, {_cpu_s() - before:.0f} CPU s. Report: {path.resolve()}", soft_wrap=True)
    if results["failed"]:
        _notice(f"{results['failed']} of {results['rollouts']} rollouts failed; the report gives the reasons")
        raise SystemExit(1)


def _cpu_s() -> float:
    """CPU time of this process and of all its ended workers."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _notice(text: str) -> None:
    err.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
