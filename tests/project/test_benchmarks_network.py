"""The network's benchmark measures, counts and keeps its rows."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nurec_sim import network

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def modules():
    """The benchmark's own modules, which are scripts beside each other."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import network as script
        import network_cases

        yield {"script": script, "cases": network_cases}
    finally:
        sys.path.remove(str(BENCHMARKS))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(BENCHMARKS / "network.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
def test_the_quick_run_writes_a_row_of_every_kind(tmp_path):
    output = tmp_path / "bench.json"
    done = run("--quick", "--repeats", "1", "--threads", "1", "--precisions", "float32", "--output", str(output))
    assert done.returncode == 0, done.stderr
    rows = json.loads(output.read_text())
    assert [row["kind"] for row in rows] == ["pass", "slots", "slots", "clip"], done.stdout
    once, bare, road, clip = rows
    assert once["parameters"] == sum(p.numel() for p in network.build("tiny").parameters())
    assert (once["images"], once["width"], once["height"], once["gaussians"]) == (3, 392, 238, 3 * 392 * 238)
    assert once["tflop"] > 0.01 and once["gflop_per_s"] == pytest.approx(1e3 * once["tflop"] / once["s_median"])
    assert 0.2 < once["peak_gb"] < 4 and once["threads"] == 1 and once["cpu_s_median"] > 0
    # 2 images of 18 x 24 strided clusters; one row of 49 cells shows road where a 20th of the image does.
    assert (bare["tokens"], bare["tokens_release"]) == (2 * 432, 2 * (432 + 60))
    assert (road["tokens"], road["tokens_release"]) == (2 * (432 + 49), 2 * (432 + 60))
    assert bare["tflop"] < road["tflop"] < road["tflop_release"]
    assert clip["chunks"] == 1 and clip["gaussians"] > 0
    assert clip["s_median"] == pytest.approx(sum(clip["stages"].values())) and "network" in clip["stages"]
    for row in rows:
        assert row["name"] in done.stdout
    assert done.stdout.count("reached") + done.stdout.count("MISSED") == 2


def test_attention_is_counted(modules):
    script = modules["script"]
    q, k, v = torch.rand(2, 3, 40, 8), torch.rand(2, 3, 70, 8), torch.rand(2, 3, 70, 8)
    with torch.inference_mode():
        _, operations = script.counted(lambda: torch.nn.functional.scaled_dot_product_attention(q, k, v))
        _, linear = script.counted(lambda: torch.nn.functional.linear(torch.rand(5, 7), torch.rand(11, 7)))
    assert operations == 2 * 2 * (2 * 3 * 40 * 70 * 8)
    assert linear == 2 * 5 * 7 * 11


def test_limits_are_told_in_words(modules):
    row = {
        "name": "pa-front float32",
        "kind": "pass",
        "s_median": 26.0,
        "peak_gb": 2.1,
        "limit_s": 25.0,
        "limit_gb": 4.0,
    }
    slots = {"name": "s", "kind": "slots", "tokens": 5, "tokens_release": 9, "ratio": 0.7, "limit_s": None,
             "limit_gb": None}  # fmt: skip
    full = {**slots, "tokens": 9}
    time_line, memory_line, slot_line = modules["script"].verdicts([row, slots, full])
    assert time_line.startswith("MISSED  pa-front float32: 26 s")
    assert memory_line.startswith("reached peak memory of pa-front float32: 2.1 GB")
    assert slot_line.startswith("reached s, CPU time over the release's rule: 0.7")


def test_inputs_are_the_same_every_time_and_their_rays_are_those_of_their_poses(modules):
    case = modules["cases"].Case("tiny", 3, 2)
    first, second = (modules["cases"].inputs_of(case, 1) for _ in range(2))
    assert torch.equal(first.rgb, second.rgb) and first.rgb.shape == (1, 6, 238, 392, 3)
    assert first.camera_idxs.tolist() == [[0, 0, 1, 1, 2, 2]]
    middle = torch.nn.functional.normalize(first.rays[0, :, 118:120, 195:197, 3:].mean((1, 2)), dim=-1)
    assert torch.allclose(middle, first.c2w[0, :, :3, 2], atol=1e-6)
    assert torch.allclose(first.rays[0, :, 0, 0, :3] * 0.15, first.c2w[0, :, :3, 3])


@pytest.mark.slow
def test_without_a_gpu_the_reason_is_printed(tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU, so its cases would run")
    output = tmp_path / "bench.json"
    done = run("--device", "cuda", "--output", str(output))
    assert done.returncode == 0 and "nothing measured on cuda: " in done.stdout
    assert not output.exists()
