"""Drivers and runtimes whose messages come from other code than ours, each in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import worlds
from driving_calls import Looking, driver

from nurec_sim import plugins
from nurec_sim.errors import ScenarioError
from nurec_sim.sim import make_scenario, run_rollout

SCRIPT = str(Path(__file__).parents[1] / "helpers" / "generated_driving.py")


def test_generated_code_leads_a_session_on_our_driver(tmp_path):
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed")
    with driver(Looking) as stub:
        command = [sys.executable, SCRIPT, str(tmp_path), "client", stub.address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        said = json.loads(done.stdout)
        seen = stub.made[1].seen
    assert said["version"].endswith("looking") and len(seen) == len(said["answers"]) == 3
    camera = seen[0].cameras["front"].camera
    assert (camera.id, camera.width_px, camera.height_px) == ("camera_front_wide_120fov", 160, 100)
    assert camera.ideal_pinhole is not None
    np.testing.assert_allclose(camera.rig_from_camera[:3, 2], [1, 0, 0], atol=1e-6)  # it looks ahead
    assert seen[2].ego.speed_mps == 5.0 and len(seen[2].history) == 3
    for step, answer in enumerate(np.array(said["answers"])):
        assert answer[:, 0].tolist() == [2_000_000 + 500_000 * step + 100_000 * i for i in range(51)]
        # The car heads along y of the local frame; the policy goes 0.5 m ahead a step, 4 m to the left.
        np.testing.assert_allclose(answer[1:, 1], 96.0, atol=1e-4)
        np.testing.assert_allclose(answer[1:, 2], 2.5 * step + 0.5 * np.arange(1, 51), atol=1e-4)
        np.testing.assert_allclose(answer[:, 3:], 2**-0.5, atol=1e-6)


def test_a_driver_of_generated_code_drives_in_our_loop(tmp_path):
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed")
    command = [sys.executable, SCRIPT, str(tmp_path), "driver"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            with pytest.raises(ScenarioError, match="takes no LiDAR sweeps; only drivers of nurec_sim do"):
                plugins.load_policy(f"grpc://{address}?lidars=any")
            policy = plugins.load_policy(f"grpc://{address}?width=200")
            assert policy.name == f"driver@{address}" and policy.needs.cameras == ("front",)
            world = worlds.curve()
            scenario = make_scenario({"name": "short", "duration_s": 2.0, "controller": "perfect"})
            found = run_rollout(scenario, policy, world.sense, world)
            policy.close()
            assert found.status == "ok", found.error
            process.stdin.close()
            heard = [json.loads(line) for line in process.stdout]
        finally:
            process.kill()
    assert [entry[:2] for entry in heard] == [[["front_wide"], ["front_wide", [120, 200, 3]]]] * 3
    assert all(way_points > 10 for _, _, way_points in heard)
    for _, plan in found.plans:
        assert len(plan.t_us) == 50  # the pose of now is left out
        np.testing.assert_allclose(plan.pose[:, 0], 0.4 * np.arange(1, 51), atol=1e-4)
        np.testing.assert_allclose(plan.pose[:, 1:], 0.0, atol=1e-4)
    assert abs(found.states[-1].speed_mps - 4.0) < 0.01
