"""The benchmark script measures, compares and keeps its rows."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
KEYS = {"name", "width", "height", "gaussians", "threads", "ms_median", "ms_p99", "psnr_vs_spec_db"}
TINY = ["--scenes", "driving", "--gaussians", "3000", "--parity-rays", "60", "--no-extras", "--threads", "2"]


@pytest.fixture(scope="module")
def modules():
    """The benchmarks' own modules, which are scripts beside each other."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import cases
        import parity
        import peers
        import scenes

        yield {"cases": cases, "parity": parity, "peers": peers, "scenes": scenes}
    finally:
        sys.path.remove(str(BENCHMARKS))


def command(output: Path, *more: str) -> list[str]:
    return [sys.executable, str(BENCHMARKS / "render.py"), *TINY, "--output", str(output), *more]


@pytest.mark.slow
def test_the_script_writes_a_row_per_sensor_that_agrees_with_the_reference(tmp_path):
    output = tmp_path / "bench.json"
    options = ["--sensors", "pinhole-640", "lidar-64", "--repeats", "3", "--paths", "turn"]
    done = subprocess.run(command(output, *options), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads(output.read_text())
    assert [row["name"] for row in rows] == ["driving pinhole-640 turn", "driving lidar-64 turn"]
    for row in rows:
        assert row.keys() >= KEYS
        assert row["gaussians"] == 3000 and row["frames"] == 3 and row["threads"] == 2
        assert 0 < row["ms_median"] <= row["ms_p99"] and row["cpu_ms_median"] > 0
        assert row["psnr_vs_spec_db"] >= 60
        assert f"{row['ms_median']:.1f}" in done.stdout
    assert (rows[0]["width"], rows[0]["height"]) == (640, 360)
    assert rows[0]["depth_psnr_db"] >= 60 and rows[0]["alpha_psnr_db"] >= 60
    assert rows[1]["lidar_range_error_m_median"] <= 1e-3 and rows[1]["return_agreement"] >= 0.98


@pytest.mark.slow
def test_an_interrupted_run_keeps_what_it_has_measured(tmp_path):
    output = tmp_path / "bench.json"
    running = subprocess.Popen(
        command(output, "--sensors", "pinhole-640", "--repeats", "100000", "--paths", "drive"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout is not None
    for line in running.stdout:
        if line.startswith("warmed up"):
            break
    time.sleep(1)  # frames are timed from here on; they would take hours
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert running.returncode == 130, errors
    assert "interrupted" in errors
    (row,) = json.loads(output.read_text())
    assert 1 <= row["frames"] < 100000 and row["psnr_vs_spec_db"] is None


def test_scenes_are_the_same_every_time_and_as_large_as_asked(modules):
    scenes = modules["scenes"]
    for make in (scenes.driving, scenes.poles, scenes.haze, scenes.open_sky, scenes.large, scenes.view_dependent):
        first, second = make(2000).scene, make(2000).scene
        assert len(first.static) + len(first.dynamic) == 2000
        np.testing.assert_array_equal(first.static.mean_m, second.static.mean_m)
        np.testing.assert_array_equal(first.static.rgb, second.static.rgb)
        assert np.isfinite(first.static.scale_m).all() and (first.static.scale_m > 0).all()


def test_every_frame_of_a_path_has_another_pose(modules):
    built = modules["scenes"].driving(2000)
    for path in built.paths:
        ticks = modules["cases"].tick_requests(built, modules["cases"].SENSORS["pinhole-640"], path, 9)
        poses = np.stack([asked.world_from_sensor[0] for (asked,) in ticks])
        assert len(np.unique(poses.reshape(9, -1).round(6), axis=0)) == 9


def test_the_reference_may_be_spared_gaussians_that_no_ray_passes(modules):
    from nurec_sim.render import spec

    cases, parity = modules["cases"], modules["parity"]
    built = modules["scenes"].driving(3000)
    ((asked,),) = cases.tick_requests(built, cases.SENSORS["rolling-960"], "drive", 1)
    chosen = parity.spread_rays(960, 540, 40, seed=0)
    spared = parity.reached_scene(built.scene, asked, chosen)
    assert 0 < len(spared.static) < len(built.scene.static)
    full, part = (spec.render_camera(scene, asked, pixels=chosen) for scene in (built.scene, spared))
    np.testing.assert_array_equal(full.rgb, part.rgb)
    np.testing.assert_allclose(full.depth_m, part.depth_m, rtol=1e-6)


def test_the_torch_peer_draws_the_same_image(modules):
    cases, parity, peers = modules["cases"], modules["parity"], modules["peers"]
    built = modules["scenes"].driving(1500)
    ((asked,),) = cases.tick_requests(built, cases.resized(cases.SENSORS["pinhole-640"], 96, 54), "drive", 1)
    figures = parity.against_spec(built.scene, [asked], [peers.torch_frame(built.scene, asked)], 400)
    assert figures["psnr_vs_spec_db"] >= 60 and figures["depth_psnr_db"] >= 60 and figures["alpha_psnr_db"] >= 60


def test_a_peer_that_cannot_run_is_named_with_its_reason(modules):
    import torch

    if torch.cuda.is_available():
        pytest.skip("gsplat may run where there is a GPU")
    built = modules["scenes"].driving(1500)
    ((asked,),) = modules["cases"].tick_requests(built, modules["cases"].SENSORS["pinhole-640"], "drive", 1)
    assert "Error" in (modules["peers"].why_gsplat_cannot_run(built.scene, asked) or "")
