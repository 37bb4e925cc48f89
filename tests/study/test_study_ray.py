"""Files of a task travel: what it reads to a node, what it has changed back."""

import sys

import pytest

from nurec_sim import __version__
from nurec_sim.errors import RunError
from nurec_sim.study import RayCluster, make_study
from nurec_sim.study.ray_cluster import _changes, _keep, _run_on_node
from nurec_sim.study.tasks import Task

CONFIG = make_study(
    {"name": "street", "families": [{"name": "street", "seeds": [0]}], "policies": ["constant_velocity", "fusion"],
     "worlds": ["truth", "lift"], "controls": {"of": "lift", "how": ["faint"]}}
)  # fmt: skip


def task_of(folder, world):
    return Task(folder, CONFIG, *CONFIG.scenes[0], world=world)


def test_what_is_new_changed_or_gone_is_sent_once_and_what_is_half_written_never(tmp_path):
    here, there, sent = tmp_path / "here", tmp_path / "there", {}
    (here / "a" / ".seven.part.12").mkdir(parents=True)
    (here / "a" / ".seven.part.12" / "rollout.npz").write_bytes(b"half")
    (here / "a" / ".x.part").write_bytes(b"half")
    (here / "a" / "x").write_bytes(b"1")
    assert _changes(here, sent) == {"a/x": b"1"}
    assert _changes(here, sent) == {}
    (here / "a" / "x").write_bytes(b"22")
    (here / "y").write_bytes(b"3")
    changed = _changes(here, sent)
    assert changed == {"a/x": b"22", "y": b"3"}
    _keep(changed, there)
    (here / "y").unlink()
    gone = _changes(here, sent)
    assert gone == {"y": None}
    _keep(gone, there)
    assert [path.relative_to(there).as_posix() for path in there.rglob("*") if path.is_file()] == ["a/x"]


def copied(task):
    """A task that reads its log and writes what it holds."""
    text = (task.scene_folder / "log.zip").read_text()
    (task.folder / "written").write_text(text.upper())
    return ["done"]


def test_a_task_runs_in_a_folder_of_its_own_with_its_files(tmp_path):
    task = task_of(tmp_path, "lift")
    replies = list(_run_on_node(__version__, copied, task, ["scenes/street-0/log.zip"], b"log"))
    assert replies == [{"written": b"LOG"}, ["done"]] and not list(tmp_path.iterdir())


def test_another_version_on_a_node_is_refused(tmp_path):
    with pytest.raises(RunError, match="install the same version on every node"):
        next(_run_on_node("0.0.1", copied, task_of(tmp_path, ""), []))


def test_without_ray_or_a_cluster_there_is_one_line(monkeypatch):
    pytest.importorskip("ray", reason="Ray is not installed")
    with pytest.raises(RunError, match="cannot stream results"):
        RayCluster("ray://head:10001")
    for address in ("127.0.0.1:9", "127.0.0.1:head"):
        with pytest.raises(RunError, match=f"no Ray cluster can be reached at {address}"):
            RayCluster(address)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RunError, match=r"pip install 'nurec-sim\[fleet\]'"):
        RayCluster("auto")


def test_a_task_names_the_files_that_it_reads(tmp_path):
    def names(world):
        task = task_of(tmp_path, world)
        return [path.relative_to(tmp_path).as_posix() for path in task.inputs()]

    for name in ("log.zip", "plan.json", "lift.usdz", "dense.usdz"):
        path = tmp_path / "scenes" / "street-0" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    finished = task_of(tmp_path, "lift-faint").world_folder / "constant_velocity" / "0" / "rollout.npz"
    finished.parent.mkdir(parents=True)
    finished.touch()
    log = ["scenes/street-0/log.zip", "scenes/street-0/plan.json"]
    assert names("") == []
    assert names("truth") == log
    assert names("lift") == [*log, "scenes/street-0/lift.usdz"]
    resumed = finished.relative_to(tmp_path).as_posix()
    assert names("lift-faint") == [*log, "scenes/street-0/lift.usdz", resumed]
