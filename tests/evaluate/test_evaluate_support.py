"""Support against real errors: counts and correlations by hand, and a street scored beside the path."""

import dataclasses

import numpy as np
import pytest
from evaluation_worlds import street_window

from nurec_sim.evaluate import contenders
from nurec_sim.evaluate.page import calibration_figure
from nurec_sim.evaluate.scoring import score_window
from nurec_sim.evaluate.support import (
    right_pixels,
    summarize_support,
    support_record,
    support_tables,
)
from nurec_sim.evaluate.views import ScoredView
from nurec_sim.reconstruct import LiftSettings, PointSettings, ViewSettings


def view(grey, depth_m):
    grey = np.asarray(grey, np.float32)
    return ScoredView(np.repeat(grey[..., None], 3, axis=-1), np.asarray(depth_m, np.float32))


def test_a_pixel_is_right_in_colour_and_depth():
    true = view([[0.5] * 8], [[10, 10, 10, 10, 0, 0, 10, 2000]])
    shown = view([[0.59, 0.61, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]], [[10, 10, 9.3, 9.0, 0, 50, 0, 0]])
    # A tenth of 0.1 / m, and 0.001 / m: 9.3 m is 0.0075 / m off, 9 m is 0.0111 / m off; 2 km is as good as the sky.
    assert right_pixels(shown, true).tolist() == [[True, False, True, False, True, False, False, True]]


def test_one_wrong_channel_is_a_wrong_colour():
    true, shown = view([[0.5]], [[10]]), view([[0.5]], [[10]])
    shown.rgb[0, 0, 2] = 0.7
    assert not right_pixels(shown, true).any()


def record(support, right):
    """Of a row of pixels; wrong ones have another colour."""
    true = view([np.zeros(len(right))], [np.full(len(right), 5.0)])
    return support_record(np.float32([support]), view([1.0 - np.array(right)], [np.full(len(right), 5.0)]), true)


def test_pixels_are_counted_by_support():
    found = record([0.0, 0.05, 0.95, 1.0], [0, 1, 1, 1])
    assert found["mean"] == pytest.approx(0.5) and found["wrong"] == pytest.approx(0.25)
    assert found["pixels"] == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found["right"] == [1, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found["sums"] == pytest.approx([0.05, 0, 0, 0, 0, 0, 0, 0, 0, 1.95])


def row(left_m, support, right, psnr_db, abs_rel=None):
    full = {"psnr_db": psnr_db, "abs_rel_metric": abs_rel}
    return {"left_m": left_m, "full": full, "support": record(support, right)}


@pytest.fixture
def rows():
    return [
        row(0.0, [1.0, 1.0], [1, 1], 30.0, 0.1),
        row(1.0, [0.8, 0.8], [1, 0], 20.0, 0.2),
        row(-1.0, [0.4, 0.4], [1, 0], 25.0, 0.3),
        row(2.0, [0.0, 0.0], [0, 0], 10.0, 0.4),
        {"left_m": 3.0, "full": {"psnr_db": 5.0}},
    ]


def test_the_summary_has_calibration_offsets_and_ranks(rows):
    found = summarize_support(rows)
    assert found["views"] == 4
    assert [(round(each["support"], 3), each["right"], each["pixels"]) for each in found["calibration"]] == [
        (0.0, 0.0, 0.25), (0.4, 0.5, 0.25), (0.8, 0.5, 0.25), (1.0, 1.0, 0.25)
    ]  # fmt: skip
    assert found["curve"]["1"] == pytest.approx({"predicted": 0.4, "real": 0.5})
    assert list(found["curve"]) == ["0", "1", "2"]
    # Predicted errors rank 1 2 3 4; wrong pixels 1, 2.5, 2.5, 4: 4.5 / sqrt(5 * 4.5). -PSNR ranks 1 3 2 4: 0.8.
    assert found["rank"]["wrong"] == pytest.approx(4.5 / np.sqrt(5 * 4.5))
    assert found["rank"]["psnr_db"] == pytest.approx(0.8) and found["rank"]["abs_rel_metric"] == pytest.approx(1.0)


def test_nothing_is_said_without_support(rows):
    assert summarize_support(rows[-1:]) == {} and support_tables({"copy": {"support": {}}}) == []
    assert calibration_figure({"copy": {"support": {}}}) is None


def test_the_tables_show_every_method_that_has_support(rows):
    methods = {"lift": {"support": summarize_support(rows)}, "copy": {"support": {}}}
    curve, rank, calibration = support_tables(methods)
    assert curve.rows == (
        ("lift", "predicted", "0.0 %", "40.0 %", "100.0 %"),
        ("lift", "real", "0.0 %", "50.0 %", "100.0 %"),
    )
    assert rank.rows == (("lift", "0.95", "0.80", "1.00", "4"),)
    assert calibration.rows[0][:3] == ("lift", "0.0 %", "-") and calibration.rows[0][-1] == "100.0 %"
    drawn = calibration_figure(methods)["data"]
    assert [trace["name"] for trace in drawn] == ["calibrated", "lift"] and drawn[1]["y"] == [0.0, 50.0, 50.0, 100.0]


def test_views_beside_the_path_have_less_support():
    """Views of a street with a parked car, 0 and 3 m to the left: some of what is seen there was hidden."""
    window = street_window(boxes=True)
    left = [
        dataclasses.replace(target, left_m=left_m) for target, left_m in zip(window.targets, (0, 3, 0, 3), strict=True)
    ]
    beside = []
    for target in left:
        pose = target.request.world_from_sensor @ np.eye(4)
        pose[:, :3, 3] -= target.left_m * pose[:, :3, 0]  # the camera's x axis points to the right
        beside.append(dataclasses.replace(target, request=dataclasses.replace(target.request, world_from_sensor=pose)))
    settings = LiftSettings(sky_px=32, views=ViewSettings(levels=16), points=PointSettings(min_voxel_m=0.24))
    (method,) = contenders(("lift",), lift=settings)
    scored = score_window(method, dataclasses.replace(window, targets=tuple(beside)), device="cpu").record["targets"]
    on_path, off_path = (np.mean([t["support"]["mean"] for t in scored if t["left_m"] == side]) for side in (0, 3))
    assert on_path > 0.7 and off_path < on_path - 0.05
