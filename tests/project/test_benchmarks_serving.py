"""The load script in short: it starts a server, compares answers, and writes its figures."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
PROGRAM = Path(__file__).parents[2] / "benchmarks" / "serving.py"


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read from /proc")
def test_a_few_clients_get_what_one_gets(tmp_path):
    command = [sys.executable, str(PROGRAM), "--clients", "4", "--seconds", "1.5"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "reached wrong answers: 0" in run.stdout and "reached errors: 0" in run.stdout
    figures = json.loads((tmp_path / "build" / "bench_serving.json").read_text())
    assert figures["many"]["answers"] > 4 and figures["many"]["clients"] == 4
    assert figures["distinct_answers"] > figures["requests_in_mix"] // 2
    assert figures["reached"]["health p99"] > 0


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the memory of a process is read from /proc")
def test_a_small_client_beside_a_greedy_one(tmp_path):
    program = PROGRAM.with_name("fairness.py")
    command = [sys.executable, str(program), "--rounds", "1", "--scale", "0.15", "--floods", "actors-400000"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "p99 of the small client" in run.stdout and "p99 of health" in run.stdout
    (row,) = json.loads((tmp_path / "build" / "bench_fairness.json").read_text())["rows"]
    assert row["alone"]["images"] > 2 and row["flooded"]["images"] > 2 and row["peak_mb"] > 50
    assert all(how.startswith("RESOURCE_EXHAUSTED") for how in row["ended"])
