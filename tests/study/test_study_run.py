"""A whole study in a small town: the same bytes whatever runs it, and however often it was interrupted."""

import pytest

from nurec_sim.study import LocalProcesses, make_study, read_agreement, run_study
from nurec_sim.study.tasks import drive

CONFIG = make_study(
    {
        "name": "tiny",
        "families": [{"name": "curve", "template": "curve", "seeds": [3], "scenario": "study_drive"}],
        "worlds": ["truth", "lift"],
        "controls": {"of": "lift", "how": ["faint"]},
        "policies": ["constant_velocity", "blind_route_noisy", "fusion"],
        "recording": {"seconds": 2.0, "hz": 2.0, "width_px": 96, "height_px": 64, "lidar_rows": 16,
                      "lidar_columns": 180},
    }
)  # fmt: skip


class Interrupted:
    """Runs tasks in this process, and stops after the first world that was driven in."""

    def run(self, work, tasks, tick):
        for task in tasks:
            yield task, work(task)
            if work is drive:
                raise KeyboardInterrupt


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.needs_gl
def test_a_study_gives_the_same_bytes_with_two_jobs_and_after_an_interruption(tmp_path):
    at_once = run_study(CONFIG, tmp_path / "a", LocalProcesses(2))
    with pytest.raises(KeyboardInterrupt):
        run_study(CONFIG, tmp_path / "b", Interrupted())
    assert not (tmp_path / "b" / "report.html").exists()
    (driven,) = (tmp_path / "b").glob("rollouts/*/*/values.parquet")
    before = driven.stat().st_mtime_ns
    run_study(CONFIG, tmp_path / "b", LocalProcesses(1))
    assert driven.stat().st_mtime_ns == before, "a finished world is not driven in again"
    first, second = files(tmp_path / "a"), files(tmp_path / "b")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    found = read_agreement(tmp_path / "a")
    assert found["rollouts"] == 9 and found["failed"] == 0 and found["blind_policies_that_differ"] == []
    assert "Does a reconstruction rank policies" in at_once.read_text()
