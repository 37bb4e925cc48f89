"""Run folders: atomic writes, resuming, failures that cost no more than they must."""

import contextlib
import io
import json
import zipfile

import numpy as np
import pytest
from metrics_worlds import flat_street, full_rollout
from repetition import slow_after
from striped_images import striped

from nurec_sim import runs, sim
from nurec_sim.errors import RequestError, RunError, ScenarioError
from nurec_sim.metrics import read_table
from nurec_sim.runs import folder as layout
from nurec_sim.runs.rollout_file import load_rollout, save_rollout
from nurec_sim.types import Needs, Plan


class Crash:
    """Plans once, then raises."""

    name = "crash"
    needs = Needs()

    def reset(self, rig, seed):
        self.left = 1

    def plan(self, observation):
        if self.left == 0:
            raise RuntimeError("out of ideas </script>")
        self.left -= 1
        t = np.arange(1, 51) * 100_000
        return Plan(observation.t_us + t, np.column_stack([t * 8e-6, 0 * t, 0 * t]))


SCENARIO = sim.make_scenario({"name": "short", "duration_s": 2.0, "warm_up_s": 0.3, "seeds": [0, 1]})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    scene, _ = flat_street()
    out = tmp_path_factory.mktemp("runs")
    heard = []
    run = runs.execute(
        [scene], SCENARIO, ["log_replay", "constant_velocity", Crash()], lambda scene_id: striped, out,
        stamp="2026-01-31", progress=lambda stage, share: heard.append((stage, share)),
    )  # fmt: skip
    return scene, run, heard


def test_a_run_folder_holds_everything(finished):
    scene, run, heard = finished
    assert run.name == "2026-01-31" and (run.parent / "latest").resolve() == run.resolve()
    for policy in ("log_replay", "constant_velocity", "crash"):
        for seed in ("0", "1"):
            names = {path.name for path in (run / "street" / "lift" / policy / seed).iterdir()}
            wanted = {"scenario.yaml", "rollout.npz", "versions.json"}
            assert names == wanted | {"error.txt" if policy == "crash" else "front.mp4"}
    place = run / "street" / "lift" / "constant_velocity" / "1"
    resolved = sim.load_scenario(place / "scenario.yaml")
    assert resolved.seeds == (1,) and resolved.policies == ("constant_velocity",) and resolved.duration_s == 2.0
    assert json.loads((place / "versions.json").read_text())["packages"]["numpy"] == np.__version__
    assert "out of ideas" in (run / "street" / "lift" / "crash" / "0" / "error.txt").read_text()
    assert not list(run.rglob(".*")), "nothing half-written is left"
    shares = [share for _, share in heard]
    assert shares == sorted(shares) and shares[-1] == 1.0
    table = read_table(run / "metrics.parquet")
    assert table.filter(table["policy"] == "crash")["status"].unique().to_list() == ["failed"]
    heading, *rows = runs.headline(run)
    assert heading[:4] == ("policy", "reconstruction", "rollouts", "failed")
    by_policy = {row[0]: row for row in rows}
    assert by_policy["crash"][2:5] == ("2", "2", "unknown") and by_policy["log_replay"][4:6] == ("0.00", "0.00")


def test_resume_keeps_what_is_finished_and_drives_the_rest(finished):
    scene, run, _ = finished
    place = run / "street" / "lift"
    before = {path: path.stat().st_mtime_ns for path in place.rglob("rollout.npz")}
    report = (run / "report.html").read_bytes()
    table = (run / "metrics.parquet").read_bytes()
    (place / "log_replay" / "0" / "rollout.npz").unlink()
    driven = []

    def sense(requests):
        driven.append(len(requests))
        return striped(requests)

    runs.execute([scene], SCENARIO, ["log_replay", "constant_velocity"], lambda scene_id: sense, run.parent, resume=run)
    changed = {path for path in before if path.stat().st_mtime_ns != before[path]}
    assert changed == {place / "log_replay" / "0" / "rollout.npz"} and driven
    assert (run / "metrics.parquet").read_bytes() == table, "the same rollout again, byte for byte"
    assert (run / "report.html").read_bytes() == report
    other = sim.make_scenario({**SCENARIO.model_dump(), "duration_s": 1.5})
    runs.execute(
        [scene], other, ["log_replay"], lambda scene_id: striped, run.parent, resume=run, seeds=[0], video=False
    )
    assert len(load_rollout(place / "log_replay" / "0" / "rollout.npz").states) == 16
    assert len(load_rollout(place / "log_replay" / "1" / "rollout.npz").states) == 21
    assert layout.rollout_folders(run)


@pytest.mark.parametrize("spoil", slow_after(1, ["bit", "cut", "empty", "other file"]))
def test_a_damaged_rollout_is_driven_again_with_a_line_that_says_so(tmp_path, spoil):
    scene, _ = flat_street()

    def go(**more):
        return runs.execute([scene], SCENARIO, ["log_replay", "constant_velocity"], lambda scene_id: striped, tmp_path,
                            seeds=[0], video=False, **more)  # fmt: skip

    run = go(stamp="a")
    path = run / "street" / "lift" / "log_replay" / "0" / "rollout.npz"
    whole, report = path.read_bytes(), (run / "report.html").read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0x10
    path.write_bytes(
        {"cut": whole[: len(whole) // 2], "bit": bytes(flipped), "empty": b"", "other file": b"not a zip" * 99}[spoil]
    )
    heard = []
    go(resume=run, notice=heard.append)
    assert path.read_bytes() == whole and (run / "report.html").read_bytes() == report
    assert len(heard) == 1
    assert heard[0].startswith(
        f"log_replay in street (lift), seed 0 is repeated: {path} is not a readable rollout file"
    )


def test_no_damage_of_a_rollout_file_gets_past_the_reader(tmp_path):
    """Every byte of the file may be wrong; the reader either says so or gives a rollout."""
    path = save_rollout(full_rollout(), tmp_path / "r.npz")
    whole, random = path.read_bytes(), np.random.default_rng(5)
    for number in range(300):
        spoilt = bytearray(whole[: random.integers(len(whole))] if number % 3 == 0 else whole)
        for place in random.integers(0, max(len(spoilt), 1), 3):
            if place < len(spoilt):
                spoilt[place] ^= int(random.integers(1, 256))
        path.write_bytes(spoilt)
        with contextlib.suppress(RunError):
            load_rollout(path)


def test_parts_of_killed_writers_are_removed_by_the_next_run_and_live_ones_are_not(tmp_path):
    scene, _ = flat_street()

    def go(**more):
        return runs.execute(
            [scene], SCENARIO, ["log_replay"], lambda i: striped, tmp_path, seeds=[0], video=False, **more
        )

    run = go(stamp="a")
    place = run / "street" / "lift"
    (place / "log_replay" / "0" / "rollout.npz").unlink()
    left = [run / ".report.html.x7_.part", place / ".road.npz.ab.part", place / "log_replay" / ".0.part.4711",
            place / "log_replay" / ".0.old.4711"]  # fmt: skip
    mine = [tmp_path / ".other.part", run / ".notes"]

    def leave():
        for path in left[:2] + mine:
            path.write_text("half")
        for path in left[2:]:
            path.mkdir()
            (path / "rollout.npz").write_text("half")

    with layout.owned(run.resolve()):
        leave()
        go(stamp="b")  # beside a run that is alive: its parts stay
        assert all(path.exists() for path in left)
        with pytest.raises(RunError, match="another run is writing to .*/a; wait until it ends"):
            go(resume=run)
    go(resume=run)
    assert not any(path.exists() for path in left) and all(path.exists() for path in mine)
    leave()
    go(stamp="c")  # a new run tidies up after the latest one
    assert not any(path.exists() for path in left) and all(path.exists() for path in mine)


def test_failed_rollouts_are_told_and_get_no_video(tmp_path):
    scene, _ = flat_street()
    rendered, heard = [], []

    def sense(requests):
        rendered.append(len(requests))
        return striped(requests)

    run = runs.execute([scene], SCENARIO, [Crash()], lambda i: sense, tmp_path, notice=heard.append)
    assert heard == [
        f"crash in street (lift), seed {seed} failed: RuntimeError: out of ideas </script>" for seed in (0, 1)
    ]
    assert not rendered and not list(run.rglob("*.mp4")) and not list(run.rglob("video_error.txt"))


def test_policies_are_loaded_once_and_used_by_several_runs(tmp_path):
    scene, _ = flat_street()
    loaded = runs.load_policies(["constant_velocity"], plan_timeout_s=5.0)
    for stamp in ("a", "b"):
        run = runs.execute([scene], SCENARIO, loaded, lambda i: striped, tmp_path, stamp=stamp, video=False, seeds=[0])
        assert "failed" not in (run / "metrics.csv").read_text()
    with pytest.raises(ScenarioError, match="above 0 s, got 0"):
        runs.load_policies(["constant_velocity"], plan_timeout_s=0)


def test_an_interrupted_rollout_leaves_nothing(tmp_path):
    scene, _ = flat_street()

    def interrupted(requests):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runs.execute([scene], SCENARIO, ["log_replay"], lambda scene_id: interrupted, tmp_path, stamp="a")
    left = {path.name for path in (tmp_path / "a").rglob("*") if path.is_file()}
    assert left == {"scene.json", "road.npz"}
    with pytest.raises(RunError, match="has no rollout"):
        runs.write_report(tmp_path / "a")


def test_a_renderer_that_fails_costs_the_video_not_the_rollout(tmp_path):
    scene, _ = flat_street()

    def broken(requests):
        raise RequestError("the renderer is out")

    run = runs.execute([scene], SCENARIO, ["log_replay"], lambda i: broken, tmp_path, stamp="a", seeds=[0])
    place = run / "street" / "lift" / "log_replay" / "0"
    assert (place / "video_error.txt").read_text() == "the renderer is out\n" and not (place / "front.mp4").exists()
    assert "no video: the renderer is out" in (run / "report.html").read_text()


def test_two_runs_at_the_same_time_get_their_own_folders(tmp_path):
    first, second = layout.new_run_folder(tmp_path, "x"), layout.new_run_folder(tmp_path, "x")
    assert (first.name, second.name) == ("x", "x-2") and (tmp_path / "latest").resolve() == second


def test_bad_orders_are_refused(tmp_path):
    scene, _ = flat_street()

    def drive(scenes, policies, **more):
        runs.execute(scenes, SCENARIO, policies, lambda i: striped, tmp_path, **more)

    with pytest.raises(ScenarioError, match="no policy to run"):
        drive([scene], [])
    with pytest.raises(ScenarioError, match="no scene to run"):
        drive([], ["log_replay"])
    with pytest.raises(ScenarioError, match="policy names must be unique; repeated: .'crash'"):
        drive([scene], [Crash(), Crash()])
    with pytest.raises(ScenarioError, match="reconstruction names of their own; repeated: .'street/lift'"):
        drive([scene, scene], ["log_replay"])
    with pytest.raises(RunError, match="does not exist; give a folder written by"):
        drive([scene], ["log_replay"], resume=tmp_path / "no")


def test_names_that_no_file_system_takes():
    assert layout.folder_name("a/b:c d") == "a_b_c_d" and layout.folder_name("..") == "_"
    buffer = io.BytesIO()
    np.savez(buffer, x=np.zeros(1))
    assert zipfile.ZipFile(buffer).infolist()[0].date_time[0] == 1980, "numpy writes no clock into rollouts"
