"""The report: complete, honest about what is missing, self-contained, and safe against odd texts."""

import dataclasses
import json
import re

import numpy as np
import pytest
from metrics_worlds import (
    curve_points,
    curve_yaw,
    failed_rollout,
    rollout,
    s_curve_gaussians,
    s_curve_map,
    s_curve_path,
    standing,
)

from nurec_sim import geometry
from nurec_sim.metrics import build_offroad_grid, find_contacts, metric_table, rollout_values, score_rollout, summarize
from nurec_sim.metrics.series import METRICS
from nurec_sim.report import ReportRollout, ReportScene, RunReport, Video, render_report
from nurec_sim.report.cells import fact_list
from nurec_sim.report.plan import PlanAxes, plan_view
from nurec_sim.types import Trajectory

EGO = s_curve_path()


def on_curve(left_m: np.ndarray, speed: float = 1.0) -> np.ndarray:
    x = 12 + speed * np.arange(len(left_m))
    xy = curve_points(x, left_m)
    return np.stack([geometry.pose_from_xyyaw(*p, a) for p, a in zip(xy, curve_yaw(x), strict=True)])


def curve_actors(count: int) -> dict[str, np.ndarray]:
    parked = standing(count, *curve_points(np.array([75.0]), np.array([-2.4]))[0], curve_yaw(75.0))
    oncoming = on_curve(np.full(count, 1.9), speed=-0.6)
    oncoming[:, :2, 3] = curve_points(95 - 0.7 * np.arange(count), np.full(count, 1.9))
    oncoming[:, 2, 3] = 0.75
    return {"parked": parked, "oncoming": oncoming}


def street_report(tmp_path=None, profile="strict") -> RunReport:
    """Three policies on the S-curve: one drives well, one leaves the road, one never starts."""
    grid = build_offroad_grid(s_curve_gaussians(), EGO, rollout(on_curve(np.zeros(2))).rig.body)
    runs = [
        rollout(on_curve(np.full(80, -1.2)), curve_actors(80), EGO.world_from_body, 5, policy="route_follower"),
        rollout(on_curve(np.linspace(0, 9, 80)), curve_actors(80), EGO.world_from_body, 5, policy="drifter"),
        failed_rollout(policy="<b>broken</b>"),
    ]
    scored = [(run, score_rollout(run, grid, s_curve_map(), profile)) for run in runs]
    values = rollout_values(metric_table(scored, "2026-01-31"), profile)
    scene = ReportScene(
        "street", "lift", "ab" * 32, {"static": 98_765, "tracks": 2}, {"method": "lift", "seconds": 12.5},
        ("no boxes of pedestrians",), s_curve_map(), grid,
    )  # fmt: skip
    entries = tuple(
        ReportRollout(run, {one.name: one for one in series}, tuple(find_contacts(run)), scenario="name: drive")
        for run, series in scored
    )
    versions = ({"python": "3.11", "packages": {"numpy": "2.0"}},)
    return RunReport("2026-01-31", profile, (scene,), entries, values, summarize(values), versions)


@pytest.fixture(scope="module")
def report() -> RunReport:
    return street_report()


@pytest.fixture(scope="module")
def text(report) -> str:
    return render_report(report)


def figures(text: str) -> dict:
    return json.loads(re.search(r'id="figures">(.*?)</script>', text, re.S).group(1))


def words(text: str) -> str:
    """The page without scripts, styles and tags."""
    return re.sub(r"<[^>]+>", " ", re.sub(r"<(script|style).*?</\1>", "", text, flags=re.S))


def test_it_opens_without_network_and_holds_plotly_once(text):
    assert text.startswith("<!doctype html>")
    assert not re.findall(r"<(?:script|link|img|video)[^>]+(?:src|href)=[\"']?https?:", text)
    assert text.count("plotly.js v") == 1


def test_the_same_run_gives_the_same_report(report, text):
    assert render_report(report) == text


def test_headline_counts_validity_and_never_zero_for_unknown(text):
    page = words(text)
    assert re.search(r"drifter\s+1\s+0 %\s+1 of 1\s+100 %\s+1 of 1\s+50 %", page), "C, O, (C+O)/2"
    broken = re.search(r"&lt;b&gt;broken&lt;/b&gt;\s+1\s+1 failed(.*?)drifter", page, re.S).group(1)
    assert broken.count("unknown") == 9 and "0 %" not in broken
    assert "No intervals: a single scene" in page


def test_failures_unknowns_and_classes_are_told(text):
    page = words(text)
    assert "PlanError: plan has NaN poses" in page and "1 failed" in page
    unknown = page[page.index("Unknowns") : page.index("Failures")]
    assert "no boxes of pedestrians" in unknown and "every rollout failed" in unknown
    assert "without reacting to the ego" in unknown
    assert "front or lateral" in page, "the rule of fault is named"
    assert [trace["name"] for trace in figures(text)["figures"]["collisions"]["data"]] == ["front", "lateral", "rear"]
    for name in METRICS:
        assert name in page


def test_texts_of_others_cannot_break_the_page(report):
    odd = "</script><script>alert(1)</script> & 'x'"
    entry = report.rollouts[1]
    event = dataclasses.replace(report.rollouts[2].rollout.events[0], text=odd)
    run = dataclasses.replace(entry.rollout, events=(event,), status="failed", error=odd)
    scene = dataclasses.replace(report.scenes[0], unknown=(odd,))
    entries = (*report.rollouts[:1], dataclasses.replace(entry, rollout=run), *report.rollouts[2:])
    text = render_report(dataclasses.replace(report, rollouts=entries, scenes=(scene,)))
    assert "<script>alert" not in text
    assert any("&lt;/script&gt;" in json.dumps(trace) for trace in figures(text)["figures"]["plan0"]["data"])


def test_plans_show_road_boxes_path_and_events(text):
    stored = figures(text)
    drifter = stored["figures"]["plan2"]  # after a failure and a collision: the worst come first
    names = {trace["name"] for trace in drifter["data"]}
    assert {"road", "not road", "unknown", "recorded path", "driven path", "static actors", "off-road"} <= names
    assert {"moving actors, each second", "ego at the first event", "true road edge"} <= names
    (image,) = drifter["layout"]["images"]
    assert stored["images"][image["image_key"]]["source"].startswith("data:image/png;base64,")
    assert "plan0" not in stored["figures"], "nothing to draw for a rollout without states"
    shades = [shape["fillcolor"] for shape in stored["figures"]["time2"]["layout"]["shapes"] if shape["type"] == "rect"]
    assert shades[0] == "rgba(220,38,38,0.15)"


def test_the_drive_goes_to_the_right_whatever_its_heading(report):
    north = geometry.pose_from_xyyaw(100.0, -50.0, 2.0)
    turned = PlanAxes(Trajectory(EGO.t_us, north @ EGO.world_from_body))
    ends = turned.points((north @ EGO.world_from_body)[[0, -1], :2, 3])
    assert ends[0] == pytest.approx([0, 0]) and ends[1][1] == pytest.approx(0, abs=1e-9) and ends[1][0] > 90
    grid = report.scenes[0].grid
    image = PlanAxes(EGO).grid_image(grid)
    assert image["x"] == pytest.approx(PlanAxes(EGO).low[0] - 25) and image["sizex"] > 100
    figure = plan_view(report.rollouts[:1], PlanAxes(EGO), None, None)
    assert "images" not in figure["layout"]


def test_grid_image_lies_where_the_path_is(report):
    import base64

    import cv2

    view = PlanAxes(EGO)
    image = view.grid_image(report.scenes[0].grid)
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(image["source"].split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    place = view.points(EGO.position_m)
    column = ((place[:, 0] - image["x"]) / image["sizex"] * pixels.shape[1]).astype(int)
    row = ((image["y"] - place[:, 1]) / image["sizey"] * pixels.shape[0]).astype(int)
    assert (pixels[row, column][:, ::-1] == (203, 213, 225)).all(), "the driven path lies on road"


def test_videos_are_embedded_or_linked(report, tmp_path, monkeypatch):
    video = tmp_path / "front.mp4"
    video.write_bytes(b"not really a video")
    entry = dataclasses.replace(report.rollouts[0], videos=(Video(video, "street/lift/a/0/front.mp4"),))
    with_video = dataclasses.replace(report, rollouts=(entry, *report.rollouts[1:]))
    assert 'src="data:video/mp4;base64,bm90IHJlYWxseSBhIHZpZGVv"' in render_report(with_video)
    monkeypatch.setattr("nurec_sim.report.page.MAX_EMBEDDED_BYTES", 10)
    assert 'src="street/lift/a/0/front.mp4"' in render_report(with_video)


def test_many_scenes_get_intervals(report):
    entries, scored = [], []
    for scene, left in (("s1", 0.0), ("s2", 6.0)):
        run = dataclasses.replace(
            rollout(on_curve(np.linspace(0, left, 60)), None, EGO.world_from_body), scene_id=scene
        )
        series = score_rollout(run, report.scenes[0].grid)
        scored.append((run, series))
        entries.append(ReportRollout(run, {one.name: one for one in series}))
    values = rollout_values(metric_table(scored, "r"))
    page = words(render_report(RunReport("r", "alpasim", (), tuple(entries), values, summarize(values))))
    assert "[0 %, 100 %]" in page and "bootstrap interval over scenes" in page and "collisions unknown" in page
    assert "truncated when the ego is 4 m off the recorded path" in page


def test_settings_within_settings_are_folded_and_escaped():
    shown = fact_list({"method": "lift", "settings": {"views": {"levels": 72}, "<sky>": 512}})
    views = "<details><summary>levels</summary><dl><dt>levels</dt><dd>72</dd></dl></details>"
    assert shown == (
        "<dl><dt>method</dt><dd>lift</dd><dt>settings</dt><dd><details><summary>views, &lt;sky&gt;</summary>"
        f"<dl><dt>views</dt><dd>{views}</dd><dt>&lt;sky&gt;</dt><dd>512</dd></dl></details></dd></dl>"
    )
