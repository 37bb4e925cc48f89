"""A seeded sample of mutated requests and archives; ``python benchmarks/fuzz.py`` runs the whole."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz_archives import fuzz_archives
from fuzz_requests import OPTIONS, fuzz_handlers, fuzz_socket, requests
from repetition import slow_after

SMALL = dataclasses.replace(OPTIONS, max_pixels=1 << 14)


@pytest.mark.slow
def test_the_script_runs_all_three_parts():
    script = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
    command = [sys.executable, str(script), "--requests", "40", "--archives", "5"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for part in ("38 requests in", "2 requests over a socket in", "5 archives in"):
        assert part in done.stdout


def test_requests_depend_on_the_seed_only():
    assert list(requests(50, 3)) == list(requests(50, 3)) != list(requests(50, 4))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("count", slow_after(1, [600, 2000]))
def test_mutated_requests_get_a_status_of_the_map(count):
    tally = fuzz_handlers(count, options=SMALL)
    assert tally.faults == []
    assert sum(tally.codes.values()) == count
    assert all(tally.codes[name] > 5 for name in ("OK", "INVALID_ARGUMENT", "NOT_FOUND", "OUT_OF_RANGE")), tally.codes
    assert tally.codes["RESOURCE_EXHAUSTED"] > 5


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_mutated_requests_over_a_socket_get_a_status_of_the_map():
    tally = fuzz_socket(100)
    assert tally.faults == [] and sum(tally.codes.values()) == 100


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_mutated_archives_are_read_or_refused(tmp_path):
    tally = fuzz_archives(60, tmp_path)
    assert tally.faults == [] and tally.codes["ArchiveError"] > 30
