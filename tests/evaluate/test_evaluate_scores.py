from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import street_window

from nurec_sim.evaluate.methods import Contender
from nurec_sim.evaluate.scores.depth import depth_score, least_squares_scale
from nurec_sim.evaluate.scores.images import masked_psnr, masked_ssim, psnr, ssim, ssim_map
from nurec_sim.evaluate.scoring import score_view, score_window
from nurec_sim.evaluate.summary import doubling_offset, interval, summarize
from nurec_sim.evaluate.tables import tables
from nurec_sim.evaluate.views import ScoredView, reduced, reduced_mask, scored_size


def test_depth_scores_are_the_formulas():
    true = np.array([[2.0, 4.0, 10.0, 0.0, 90.0]], np.float32)
    depth = np.array([[2.2, 5.0, 10.0, 3.0, 1.0]], np.float32)
    score = depth_score(depth, true)
    assert score.pixels == 3  # no truth, and beyond 80 m
    assert score.abs_rel == pytest.approx((0.1 + 0.25 + 0) / 3)
    assert score.delta1 == pytest.approx(2 / 3)  # 5 / 4 is exactly 1.25, which is not below it
    assert depth_score(depth, true, np.array([[False, False, True, True, True]])).abs_rel == 0
    with pytest.raises(ValueError, match="one shape"):
        depth_score(depth, true.T)


def test_a_pixel_without_depth_counts_as_wrong():
    score = depth_score(np.array([[0.0, 5.0]]), np.array([[4.0, 5.0]]))
    assert (score.abs_rel, score.delta1, score.coverage) == (0.5, 0.5, 0.5)
    nothing = depth_score(np.ones((1, 2)), np.zeros((1, 2)))
    assert nothing.pixels == 0 and np.isnan(nothing.abs_rel)


def test_the_scale_is_that_of_least_squares():
    rng = np.random.default_rng(3)
    true = rng.uniform(1, 70, (20, 30))
    depth = true / 1.7 * rng.uniform(0.9, 1.1, true.shape)
    depth[0] = 0
    best = least_squares_scale(depth, true)
    loss = [np.sum((s * depth[1:] - true[1:]) ** 2) for s in (best - 1e-3, best, best + 1e-3)]
    assert loss[1] < min(loss[0], loss[2])
    assert least_squares_scale(true / 1.7, true) == pytest.approx(1.7)
    assert least_squares_scale(np.zeros((2, 2)), np.ones((2, 2))) == 1


def test_masks_choose_pixels():
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 1, (2, 24, 30, 3))
    whole, left = np.ones((24, 30), bool), np.zeros((24, 30), bool)
    left[:, :9] = True
    assert masked_psnr(a, b, whole) == pytest.approx(psnr(a, b))
    assert masked_ssim(a, b, whole) == pytest.approx(ssim(a, b))
    assert masked_psnr(a, b, left) == pytest.approx(psnr(a[:, :9], b[:, :9]))
    assert masked_ssim(a, b, left) == pytest.approx(ssim_map(a, b)[:, :6].mean())
    assert np.isnan(masked_psnr(a, b, ~whole)) and np.isnan(masked_ssim(a, b, ~whole))
    with pytest.raises(ValueError, match="size of the images"):
        masked_psnr(a, b, left.T)


def test_views_are_compared_at_the_size_of_the_protocol():
    assert scored_size(1920, 1280) == (240, 160) and scored_size(480, 320) == (240, 160)
    width, height = scored_size(1242, 375)
    assert width * height == pytest.approx(240 * 160, rel=0.01) and width / height == pytest.approx(
        1242 / 375, rel=0.01
    )
    assert scored_size(96, 64) == (96, 64)  # never larger than the image itself
    rgb = np.zeros((320, 480, 3), np.uint8)
    rgb[::2] = 200  # reduced by area, rows that alternate become their mean
    depth = np.tile(np.arange(320, dtype=np.float32)[:, None], (1, 480))
    view = reduced(rgb, depth)
    assert view.rgb.shape == (160, 240, 3) and np.allclose(view.rgb, 100 / 255, atol=1e-6)
    assert np.array_equal(view.depth_m[:, 0], np.arange(1, 320, 2))
    mask = np.zeros((320, 480), bool)
    mask[6, 7] = True
    assert np.argwhere(reduced_mask(mask)).tolist() == [[3, 3]]


def test_the_truth_scores_best_and_a_wrong_scale_is_seen():
    target = street_window(boxes=True).targets[0]
    right = score_view(target.true, target)
    assert right["full"]["psnr_db"] == 100 and right["full"]["ssim"] == pytest.approx(1)
    assert right["full"]["abs_rel"] == 0 and right["full"]["depth_coverage"] == 1
    assert right["dynamic"]["psnr_db"] == 100 and right["dynamic"]["delta1"] == 1
    far = score_view(ScoredView(target.true.rgb, target.true.depth_m * 2), target)["full"]
    assert far["depth_scale"] == pytest.approx(0.5) and far["abs_rel"] == pytest.approx(0, abs=1e-6)
    assert far["abs_rel_metric"] == pytest.approx(1) and far["delta1_metric"] == 0
    flat = score_view(ScoredView(target.true.rgb, None), target)
    assert flat["full"]["abs_rel"] is None and flat["dynamic"]["delta1_metric"] is None


def test_what_cannot_move_is_scored_apart():
    target = street_window(boxes=True).targets[0]
    error = np.where(target.movable[..., None], 0.1, 0.01).astype(np.float32)  # 20 dB where things can move, else 40
    flat = ScoredView(np.full_like(target.true.rgb, 0.5), None)
    found = score_view(ScoredView(flat.rgb + error, None), replace(target, true=flat))
    assert found["dynamic"]["psnr_db"] == pytest.approx(20, abs=1e-3)
    assert found["static"]["psnr_db"] == pytest.approx(40, abs=1e-3)
    nothing = replace(target, movable=np.zeros_like(target.movable))
    whole = score_view(target.true, nothing)
    assert whole["dynamic"] is None and whole["static"]["psnr_db"] == 100
    assert score_view(target.true, replace(target, movable=None))["static"] is None


def test_copying_shows_the_nearest_seen_frame():
    window = street_window()
    scored = score_window(Contender("copy", "copy"), window)
    assert scored.record["gaussians"] is None
    shown = [scored.views[target.name].rgb for target in window.targets]
    seen = [reduced(window.clip.image("front", index), None).rgb for index in (0, 1)]
    for rgb, index in zip(shown, (0, 1, 1, 1), strict=True):
        assert np.array_equal(rgb, seen[index])
    assert [row["beyond"] for row in scored.record["targets"]] == [False, False, True, True]
    with_boxes = score_window(Contender("copy", "copy"), street_window(boxes=True)).record["targets"]
    assert all(row["dynamic"]["psnr_db"] < 100 for row in with_boxes)


def row(psnr_db, abs_rel=0.1, left_m=0.0, beyond=False, dynamic=None):
    full = {"psnr_db": psnr_db, "ssim": 0.5, "abs_rel": abs_rel, "delta1": 0.9, "abs_rel_metric": abs_rel,
            "delta1_metric": 0.9, "depth_scale": 1.0, "depth_coverage": 1.0}  # fmt: skip
    moving = None if dynamic is None else {**full, "psnr_db": dynamic}
    standing = None if dynamic is None else {**full, "psnr_db": psnr_db + 1}
    return {"name": "x", "left_m": left_m, "beyond": beyond, "full": full, "dynamic": moving, "static": standing}


def record(*rows, gaussians=100):
    return {"gaussians": gaussians, "seconds": {"reconstruct": 1.0, "render": 0.1}, "unknown": [], "targets": rows}


def test_figures_are_means_over_views_on_the_path():
    windows = [
        {"id": "a", "methods": {"dense": record(row(20), row(30, dynamic=15.0), row(1, left_m=2.0))}},
        {"id": "b", "methods": {"dense": record(row(22, beyond=True))}},
        {"id": "c", "methods": {"dense": {"error": "no"}}},
    ]
    dense = summarize(windows, ["dense"])["methods"]["dense"]
    assert dense["full"]["psnr_db"] == 24 and dense["dynamic"]["psnr_db"] == 15 and dense["static"]["psnr_db"] == 31
    assert dense["between"]["psnr_db"] == 25 and dense["beyond"]["psnr_db"] == 22
    assert (dense["views"], dense["dynamic_views"], dense["windows"], dense["failed"]) == (3, 1, 2, 1)
    assert dense["curve"]["2"]["psnr_db"] == 1


def test_differences_are_paired_by_window():
    windows = [
        {"id": str(n), "methods": {"dense": record(row(20 + n)), "lift": record(row(19), gaussians=400)}}
        for n in range(4)
    ] + [{"id": "x", "methods": {"dense": {"error": "no"}, "lift": record(row(90))}}]  # fmt: skip
    (pair,) = summarize(windows, ["dense", "lift"])["differences"]
    assert (pair["method"], pair["against"], pair["share_of_gaussians"]) == ("dense", "lift", 0.25)
    assert pair["full"]["psnr_db"] == 2.5 and pair["full"]["better_in"] == 4 and pair["full"]["windows"] == 4
    low, high = pair["full"]["interval_db"]
    assert 1 <= low < 2.5 < high <= 4
    assert pair["dynamic"]["psnr_db"] is None and pair["dynamic"]["interval_db"] is None
    assert interval([1.0, 2.0]) is None and interval([1.0, 2.0, 4.0]) == interval([1.0, 2.0, 4.0])


def test_the_doubling_offset_lies_on_the_line_between_its_neighbours():
    assert doubling_offset({0.0: 0.1, 0.5: 0.15, 1.0: 0.25, 2.0: 0.3}) == pytest.approx(0.75)
    assert doubling_offset({0.0: 0.1, 1.0: 0.2}) == 1.0
    assert doubling_offset({0.0: 0.1, 1.0: 0.19}) is None
    assert doubling_offset({0.0: None, 1.0: 0.3}) is None
    assert doubling_offset({1.0: 0.1}) is None


def test_what_an_input_image_shows_is_scored_apart():
    """An error of 0.1 in the half that is shown, of 0.5 in the other."""
    target = street_window(boxes=False).targets[0]
    left = np.arange(target.true.rgb.shape[1]) < target.true.rgb.shape[1] // 2
    shown = np.broadcast_to(left, target.true.rgb.shape[:2])
    grey = ScoredView(np.full_like(target.true.rgb, 0.4), target.true.depth_m)
    wrong = ScoredView(grey.rgb + np.where(shown, 0.1, 0.5)[..., None], target.true.depth_m)
    figures = score_view(wrong, replace(target, true=grey, shown=shown))["shown"]
    assert figures["psnr_db"] == pytest.approx(20, abs=1e-3) and figures["share"] == pytest.approx(0.5, abs=0.02)
    assert "shown" not in score_view(wrong, target)
    rows = [{**row(25), "shown": {"psnr_db": 30.0, "abs_rel": 0.1, "share": 1.0}},
            {**row(15, left_m=1.0), "shown": {"psnr_db": 20.0, "abs_rel": 0.2, "share": 0.25}},
            {**row(10, left_m=-1.0), "shown": None}]  # fmt: skip
    windows = [{"id": "a", "methods": {"dense": record(*rows)}}]
    results = {"protocol": {"name": "shift"}, "windows": windows, "summary": summarize(windows, ["dense"])}
    made = {table.name: table for table in tables(results)}
    assert made["shift_shown_psnr_db"].rows == (("dense", "30.00", "20.00"),)
    assert made["shift_shown_abs_rel"].rows == (("dense", "0.100", "0.200"),)
    assert "0 m: 100 %, 1 m: 25 % of all" in made["shift_shown_psnr_db"].note


@pytest.mark.parametrize("name", ["storm", "clip", "shift"])
def test_tables_say_what_is_not_known(name):
    rows = (row(20, 0.1), row(18, 0.15, left_m=1.0))
    blind = [{**each, "full": {**each["full"], "abs_rel": None}} for each in rows]
    windows = [{"id": "a", "methods": {"dense": record(*rows), "copy": record(*blind, gaussians=None)}}]
    results = {"protocol": {"name": name, "boxes": False}, "windows": windows,
               "summary": summarize(windows, ["dense", "copy"])}  # fmt: skip
    made = {table.name: table for table in tables(results)}
    assert "shift_shown_psnr_db" not in made
    if name == "shift":
        assert made["shift_doubling"].rows == (
            ("dense", "not reached up to 1 m", "-"),
            ("copy", "depth unknown", "-"),
        )
        assert made["shift_psnr_db"].rows[0] == ("dense", "20.00", "18.00")
    else:
        assert made["paper"].rows[0][:3] == ("dense", "20.00", "0.500")
        assert made["paper"].rows[1][3] == "-"
        assert ("static" in made) == (name == "storm")
        assert "without boxes" in made["paper"].note
    assert made["cost"].rows[1][1] == "-"
    for table in made.values():
        assert {len(cells) for cells in table.rows} == {len(table.heading)}
        assert table.markdown().startswith(f"## {table.title}\n")
        assert table.csv().count("\n") == len(table.rows) + 1


def test_intervals_leave_out_a_fortieth_on_each_side():
    """Means of three draws from 0, 0, 3: all three draws are the 3 in 1 of 27, more often than 1 in 40, less than in
    20. So a 95 % interval ends at 3, a 90 % one would at 2."""
    assert interval([0.0, 0.0, 3.0]) == [0.0, 3.0]


def test_depth_of_what_moves_is_scaled_by_its_whole_frame():
    target = street_window(boxes=True).targets[0]
    figures = score_view(ScoredView(target.true.rgb, target.true.depth_m * 2), target)["dynamic"]
    assert figures["abs_rel"] == pytest.approx(0, abs=1e-6) and figures["delta1"] == 1
    assert figures["abs_rel_metric"] == pytest.approx(1) and figures["delta1_metric"] == 0
