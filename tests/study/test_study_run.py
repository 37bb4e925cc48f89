"""A whole study in a small town: the same bytes whatever runs it, and however often it was interrupted."""

import pytest
from serving_calls import wait_until

from nurec_sim.study import LocalProcesses, RayCluster, make_study, read_agreement, run_study
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


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    """Folder of the study, made by two processes without an interruption."""
    return run_study(CONFIG, tmp_path_factory.mktemp("study") / "a", LocalProcesses(2)).parent


def assert_same_files(one, other):
    first, second = files(one), files(other)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.slow
@pytest.mark.needs_gl
def test_a_study_gives_the_same_bytes_with_two_jobs_and_after_an_interruption(at_once, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_study(CONFIG, tmp_path, Interrupted())
    assert not (tmp_path / "report.html").exists()
    (driven,) = tmp_path.glob("rollouts/*/*/values.parquet")
    before = driven.stat().st_mtime_ns
    run_study(CONFIG, tmp_path, LocalProcesses(1))
    assert driven.stat().st_mtime_ns == before, "a finished world is not driven in again"
    assert_same_files(at_once, tmp_path)
    found = read_agreement(at_once)
    assert found["rollouts"] == 9 and found["failed"] == 0 and found["blind_policies_that_differ"] == []
    assert "Does a reconstruction rank policies" in (at_once / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.needs_gl
def test_two_nodes_of_which_one_is_killed_give_the_same_bytes(at_once, tmp_path):
    pytest.importorskip("ray", reason="Ray is not installed")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    killed = []

    def kill(stage, share):
        finished = sorted(path.parent.name for path in tmp_path.glob("rollouts/*/*/*/*/rollout.npz"))
        if finished and not killed:
            killed.append(finished)
            cluster.remove_node(node, allow_graceful=False)

    try:
        node = cluster.add_node(num_cpus=1)
        with RayCluster(cluster.address) as executor:
            assert executor.jobs == 2
            run_study(CONFIG, tmp_path, executor, progress=kill)
            assert killed
            wait_until(lambda: executor.jobs == 1, 60)  # Ray notices after some missed heartbeats
    finally:
        cluster.shutdown()
    assert_same_files(at_once, tmp_path)
