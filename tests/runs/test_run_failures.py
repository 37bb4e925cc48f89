"""`nurec-sim run` where things fail: hostile policies, a server that dies or freezes; real sockets and processes."""

import io
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from metrics_worlds import flat_street
from serving_process import serving

from nurec_sim import cli, runs, sim
from nurec_sim.errors import ScenarioError, ServerError
from nurec_sim.metrics import read_table
from nurec_sim.runs.rollout_file import load_rollout
from nurec_sim.runs.video import write_video
from nurec_sim.scene import write_scene
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.connection import Connection
from nurec_sim.types import Needs, Plan

HOSTILE = """
import itertools, os, sys, threading, time
import numpy as np
from nurec_sim.types import Needs, Plan

class Straight:
    needs = Needs()
    def reset(self, rig, seed):
        self.plans = 0
    def act(self, observation): ...
    def plan(self, observation):
        self.plans += 1
        if self.plans == 2:
            self.act(observation)
        steps = np.arange(1, 51)
        return Plan(observation.t_us + 100_000 * steps, np.column_stack([0.8 * steps, 0 * steps, 0 * steps]))

class Writes(Straight):
    name = "writes"
    def act(self, observation):
        observation.history[0].world_from_rig[0, 3] = 1e6

class Exits(Straight):
    name = "exits"
    def act(self, observation):
        sys.exit(0)

class Interrupts(Straight):
    name = "interrupts"
    def act(self, observation):
        raise KeyboardInterrupt

class Closes(Straight):
    name = "closes"
    def act(self, observation):
        raise GeneratorExit

class Hangs(Straight):
    name = "hangs"
    def act(self, observation):
        threading.Thread(target=time.sleep, args=(1000,)).start()  # Python would wait for it at the end
        time.sleep(1000)

class Spins(Straight):
    name = "spins"
    def act(self, observation):
        for _ in itertools.count(): pass

class Good(Straight):
    name = "good"
"""
BAD = {
    "Writes": "ValueError: assignment destination is read-only",
    "Exits": "SystemExit: 0",
    "Interrupts": "KeyboardInterrupt: ",
    "Closes": "GeneratorExit: ",
    "Hangs": "plan() did not finish within 1 s; --plan-timeout (plan_timeout_s) sets the limit",
    "Spins": "plan() did not finish within 1 s; --plan-timeout (plan_timeout_s) sets the limit",
}
SCENARIO = """
name: brief
duration_s: 2.0
warm_up_s: 0.3
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("failures")
    scene, _ = flat_street()
    write_scene(scene, folder / "street.usdz")
    (folder / "hostile.py").write_text(HOSTILE)
    (folder / "brief.yaml").write_text(SCENARIO)
    return folder


def nurec_sim(*words, cwd, timeout_s=120):
    return subprocess.run(
        [sys.executable, "-m", "nurec_sim.cli", *words], cwd=cwd, capture_output=True, text=True, timeout=timeout_s
    )


def test_hostile_policies_are_failed_rows_and_the_others_are_driven(place):
    """Written, exited, interrupted, hung: six failed rollouts, a good one before and after, and exit status 1."""
    policies = [f"hostile.py:{name}" for name in (*BAD, "Good")]
    words = ("run", "street.usdz", "--scenario", "brief.yaml", "--plan-timeout", "1", "--no-video")
    done = nurec_sim(*words, "--policies", "constant_velocity", *policies, cwd=place)
    assert done.returncode == 1, done.stderr
    table = read_table(place / "runs" / "latest" / "metrics.parquet")
    found = dict(table.select("policy", "error").unique().iter_rows())
    assert found == {name.lower(): text for name, text in BAD.items()} | {"constant_velocity": "", "good": ""}
    said = " ".join(done.stderr.split())
    for name, text in BAD.items():
        assert f"{name.lower()} in street (lift), seed 0 failed: {text.strip()}" in said
    assert "6 of 8 rollouts failed; the report gives the reasons" in said and "Traceback" not in done.stderr
    assert (place / "runs" / "latest" / "report.html").exists()
    cli.main(["run", str(place / "street.usdz"), "--scenario", str(place / "brief.yaml"), "--policies", "log_replay",
              "--out", str(place / "good"), "--no-video"])  # fmt: skip  # ends without a status


@pytest.mark.parametrize(
    ("text", "limit_s"),
    [("import sys; sys.exit(0)", 60.0), ("raise KeyboardInterrupt", 60.0), ("import time; time.sleep(9)", 0.5)],
)
def test_a_file_that_exits_or_hangs_when_it_is_read_is_refused_before_anything_is_driven(tmp_path, text, limit_s):
    (tmp_path / "file.py").write_text(text)
    with pytest.raises(ScenarioError, match=r"policy (file )?'.*file\.py' cannot be (imported|created): "):
        runs.load_policies([str(tmp_path / "file.py"), "constant_velocity"], plan_timeout_s=limit_s)


class Looks:
    """Needs an image for every plan, and does ``act`` at the second one of a seed."""

    name, needs = "looks", Needs(cameras=("front",), image_width_px=32)

    def __init__(self, act=lambda: None, seed=1):
        self.act, self.when = act, seed

    def reset(self, rig, seed):
        self.plans, self.seed = 0, seed

    def plan(self, observation):
        self.plans += 1
        if (self.plans, self.seed) == (2, self.when):
            self.act()
        steps = np.arange(1, 51)
        return Plan(observation.t_us + 100_000 * steps, np.column_stack([0.8 * steps, 0 * steps, 0 * steps]))


@pytest.mark.slow
def test_a_server_killed_in_the_middle_fails_what_is_left_within_seconds(place, tmp_path):
    scene, _ = flat_street()
    scenario, heard = sim.load_scenario(place / "brief.yaml"), []
    with serving("serve", str(place / "street.usdz"), "--port", "0") as (process, address):
        killed_s = []

        def kill():
            killed_s.append(time.monotonic())
            process.kill()

        with RemoteSensors(address, scene.id) as sensors:
            run = runs.execute([scene], scenario, [Looks(kill)], lambda scene_id: sensors.sense, tmp_path,
                               seeds=[0, 1, 2], notice=heard.append)  # fmt: skip
    assert time.monotonic() - killed_s[0] < 60, "two rollouts, some 3 s each, and the report"
    rollouts = [load_rollout(run / "street" / "lift" / "looks" / str(seed) / "rollout.npz") for seed in range(3)]
    assert [rollout.status for rollout in rollouts] == ["ok", "failed", "failed"]
    assert [path.parent.name for path in run.rglob("front.mp4")] == ["0"] and not list(run.rglob("video_error.txt"))
    assert len(heard) == 2 and all(f"failed: ServerError: {address}: UNAVAILABLE" in text for text in heard)
    assert len(rollouts[1].states) == 3 + 1 + 10


@pytest.mark.slow
def test_a_frozen_server_costs_one_time_limit_and_then_the_time_to_connect(place):
    with serving("serve", str(place / "street.usdz"), "--port", "0") as (process, address):
        with RemoteSensors(address, "street", timeout_s=2.0, connect_timeout_s=0.5) as sensors:
            assert sensors.scenes() == ["clipgt-street"]
            process.send_signal(signal.SIGSTOP)
            with pytest.raises(ServerError, match="DEADLINE_EXCEEDED"):
                sensors.scenes()
            before = time.monotonic()
            with pytest.raises(ServerError, match=r"the server cannot be reached within 0\.5 s"):
                sensors.scenes()
            assert time.monotonic() - before < 1.9
            process.send_signal(signal.SIGCONT)
            until = time.monotonic() + 20
            while time.monotonic() < until:
                try:
                    assert sensors.scenes() == ["clipgt-street"]
                    break
                except ServerError:
                    continue
            else:
                pytest.fail("a server that goes on is not found again")


def test_an_address_without_a_server_ends_the_run_before_anything_is_made(place, monkeypatch, capsys):
    monkeypatch.setitem(Connection.__init__.__kwdefaults__, "connect_timeout_s", 0.3)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", str(place / "street.usdz"), "--address", "127.0.0.1:9", "--policies", "log_replay",
                  "--out", str(place / "none")])  # fmt: skip
    assert stop.value.code == 1 and not (place / "none").exists()
    assert capsys.readouterr().err.strip() == "nurec-sim: 127.0.0.1:9: the server cannot be reached within 0.3 s"


def test_a_finished_archive_is_not_refined(place, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", str(place / "street.usdz"), "--refine", "5", "--out", str(place / "none")])
    assert stop.value.code == 1 and not (place / "none").exists()
    assert "--refine optimises reconstructions of clips; clipgt-street is a finished archive" in capsys.readouterr().err


@pytest.mark.slow
def test_a_real_interrupt_ends_a_run_with_130(place):
    """Ctrl-C while a policy hangs."""
    (place / "sleeps.py").write_text(
        HOSTILE
        + textwrap.dedent("""
        class Sleeps(Straight):
            name = "sleeps"
            def act(self, observation):
                print("asleep", flush=True)
                time.sleep(1000)
    """)
    )
    words = ["run", "street.usdz", "--scenario", "brief.yaml", "--policies", "sleeps.py:Sleeps", "--no-video"]
    # Where pytest itself runs in the background, its children ignore Ctrl-C.
    listening = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import runpy; "
    with subprocess.Popen(
        [sys.executable, "-c", listening + "runpy.run_module('nurec_sim.cli', run_name='__main__')", *words],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            asleep = any("asleep" in line for line in iter(process.stdout.readline, ""))
            # Once: a second Ctrl-C would interrupt the ending itself. A policy is given up after 60 s anyway.
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=50)
        finally:
            process.kill()
    assert asleep and process.returncode == 130, said
    assert "interrupted; finished rollouts are kept" in said


def test_a_film_that_cannot_be_finished_is_an_error_not_a_wait():
    pictures = [np.zeros((36, 64, 3), np.uint8)] * 5

    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError):
        write_video(Full(), pictures)
    with pytest.raises(OSError):
        write_video("/nowhere/film.mp4", pictures * 10)  # more than may wait
