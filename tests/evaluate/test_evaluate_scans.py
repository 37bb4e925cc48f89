"""Protocol ``lidar``: means over windows, the columns of Table 3, the run folder."""

import contextlib
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from evaluation_worlds import street
from test_evaluate_run import LIFT

from nurec_sim.evaluate import Protocol, Window, contenders, run_protocol
from nurec_sim.evaluate.scans import mean_figures, scan_tables
from nurec_sim.logs.held_out import HeldOut, without_images


def scored(cd, near):
    return {"cd_l1_sum": cd, "intensity_mae": None, "by_range": {"0-10 m": {"median_abs_range_error_m": near}}}


def test_sides_and_windows_are_averaged_and_unknown_values_left_out():
    first = {"sweeps": {"0": scored(0.1, 0.02), "2": scored(0.3, None), "-2": scored(0.5, 0.08)}}
    second = {"sweeps": {"0": scored(0.2, 0.04), "-2": scored(0.7, 0.04)}}
    means = mean_figures([first, second, {}])
    assert list(means) == ["0", "2"]
    assert means["0"]["cd_l1_sum"] == pytest.approx(0.15) and means["0"]["median at 0-10 m"] == pytest.approx(0.03)
    assert means["2"]["cd_l1_sum"] == pytest.approx(0.5) and means["2"]["median at 0-10 m"] == pytest.approx(0.06)
    assert means["0"]["intensity_mae"] is None and means["0"]["count_ratio"] is None


def test_the_table_has_the_columns_of_the_paper_and_how_much_worse_it_is_beside_the_path():
    on_path = {
        "cd_l1_sum": 0.2,
        "precision_m": 0.08,
        "coverage_m": 0.12,
        "intensity_mae": 0.03,
        "count_ratio": 0.985,
        "median at 0-10 m": 0.01,
    }
    row = {"sweeps": {"0": on_path, "2": {"cd_l1_sum": 0.25}}, "seconds": {"reconstruct": 12.34}}
    nothing = {"sweeps": {}, "seconds": {"reconstruct": 0.0}}
    table, beams = scan_tables({"lift": row, "copy": nothing})
    assert table.rows[0] == ("lift", "0.200", "0.080", "0.120", "0.030", "98.5 %", "0.250", "1.25", "12.3")
    assert table.rows[1] == ("copy", *["-"] * 7, "0.0") and len(table.heading) == 9
    assert beams.rows[1][0] == "copy" and set(beams.rows[1][1:]) == {"-"}
    assert len(beams.heading) == len(beams.rows[0]) == len(beams.rows[1])


@dataclass(frozen=True)
class StreetSweeps(Protocol):
    """A street whose sweep 3 is held out, driven once."""

    @contextlib.contextmanager
    def window(self, index, progress=None):
        clip = street()
        yield Window(self.ids[index], without_images(clip, HeldOut({}, frozenset({3}))), (), {}, {0.0: clip})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return run_protocol(StreetSweeps("lidar", (1,)), contenders(("lift", "copy"), lift=LIFT), folder), folder


def test_a_run_scores_what_has_a_scene_and_draws_sweeps_from_above(finished):
    results, folder = finished
    methods = results["summary"]["methods"]
    assert methods["lift"]["sweeps"]["0"]["cd_l1_sum"] < 0.5 and methods["copy"]["sweeps"] == {}
    assert methods["lift"]["sweeps"]["0"]["count_ratio"] == pytest.approx(1, abs=0.2)
    picture = cv2.imread(str(folder / "sheets" / "lidar-1.png"))
    recorded, simulated = picture[20:, :423], picture[20:, 423:846]
    assert picture.shape[1] == 846 and np.abs(recorded.astype(int) - simulated).mean() < 12
    assert "Table 3" in (folder / "report.html").read_text() and (folder / "lidar.csv").exists()
