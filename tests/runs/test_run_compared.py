"""Reconstructions of one log, driven and judged side by side."""

import dataclasses
import json
import re

import av
import numpy as np
import pytest
import tiny_clip
from doc_examples import example
from metrics_worlds import flat_street

from nurec_sim import cli, logs, runs, sim
from nurec_sim.errors import RunError
from nurec_sim.metrics import read_table
from nurec_sim.runs.common_truth import with_common_truth
from nurec_sim.runs.rollout_file import load_rollout
from nurec_sim.runs.scene_file import load_scene_record
from nurec_sim.scene import write_scene
from nurec_sim.serving.store import SceneStore
from nurec_sim.types import CameraFrame, LidarFrame, Needs, Plan

SCENARIO = sim.make_scenario({"name": "short", "duration_s": 1.5, "warm_up_s": 0.3})
BLIND = ["log_replay", "constant_velocity", "route_follower"]


def in_shade(shade):
    """A renderer of one brightness, without LiDAR returns."""

    def sense(requests):
        frames = []
        for request in requests:
            if hasattr(request.sensor, "width_px"):
                size = request.sensor.height_px, request.sensor.width_px
                image = np.full((*size, 3), shade, np.uint8)
                frames.append(CameraFrame(request.sensor, request.start_us, request.end_us, image))
            else:
                none = np.zeros(0, np.float32)
                frames.append(LidarFrame(request.sensor, request.start_us, request.end_us, none.reshape(0, 3), none,
                                         none, np.zeros(0, np.int32)))  # fmt: skip
        return frames

    return sense


class Follows:
    """Drives straight ahead in the dark, and to the left in the light."""

    name, needs = "follows", Needs(cameras=("front",), image_width_px=32)

    def reset(self, rig, seed): ...

    def plan(self, observation):
        bright = observation.cameras["front"].rgb.mean() > 127
        t = np.arange(1, 51) * 0.1
        heading = 0.5 * bright * np.minimum(t, 1)
        return Plan(observation.t_us + (1e6 * t).astype(np.int64), np.column_stack([8 * t, 4 * bright * t, heading]))


@pytest.fixture(scope="module")
def pair():
    """The same street twice: the second has half of the Gaussians, a shorter span and a mover that it found itself."""
    scene, _ = flat_street()
    mover = dataclasses.replace(scene.tracks[0], id="found", labelled=False)
    first, last = scene.span_us
    other = dataclasses.replace(
        scene, static=scene.static[::2], tracks=(*scene.tracks, mover), span_us=(first, last - 200_000),
        provenance={**scene.provenance, "method": "dense"},
    )  # fmt: skip
    return with_common_truth([scene, other])


@pytest.fixture(scope="module")
def finished(pair, tmp_path_factory):
    shades = {"lift": 20, "dense": 230}
    return runs.execute(
        pair, SCENARIO, [*BLIND, Follows()], lambda scene: in_shade(shades[runs.reconstruction_of(scene)]),
        tmp_path_factory.mktemp("compared"), stamp="a",
    )  # fmt: skip


def test_policies_that_see_nothing_rendered_drive_the_same_bit_for_bit(finished):
    for policy in (*BLIND, "follows"):
        one, two = (load_rollout(finished / f"street/{name}/{policy}/0/rollout.npz") for name in ("lift", "dense"))
        same = np.array_equal(one.world_from_rig, two.world_from_rig)
        assert same == (policy != "follows"), policy
        assert list(one.actors) == list(two.actors) == ["parked"], "what a reconstruction found is no actor"
        assert np.array_equal(one.t_us, two.t_us)
        if policy in BLIND:
            for (_, plan), (_, other) in zip(one.plans, two.plans, strict=True):
                assert np.array_equal(plan.pose, other.pose)


def test_the_report_opens_with_what_differs(finished):
    text = (finished / "report.html").read_text()
    page = re.sub(r"<[^>]+>", " ", re.sub(r"<(script|style).*?</\1>", "", text, flags=re.S))
    page = re.sub(r"\s+", " ", page)
    order = ["What differs between", "Difference from lift", "Do they rank", "How true are they", "Rollouts The most",
             "What was extrapolated", "Headline"]  # fmt: skip
    places = [page.index(name) for name in order]
    assert places == sorted(places)
    assert "3 rollouts drove exactly the same (constant_velocity, log_replay, route_follower)" in page
    assert "the road-class Gaussians of lift, because the log has no map" in page
    assert re.search(r"follows · street · seed 0 up to \d\.\d m apart", page), "the most different one comes first"
    assert re.search(r"\d\.\d s : farthest apart, \d\.\d m", page)
    assert page.index("follows · street") < page.index("constant_velocity · street")
    assert "Not measured: give the log as well" in page
    stored = json.loads(re.search(r'id="figures">(.*?)</script>', text, re.S).group(1))["figures"]
    bars, labels = stored["bars-offroad"]["data"][::2], stored["bars-offroad"]["data"][1::2]
    assert [trace["name"] for trace in bars] == ["lift", "dense"]
    for bar, label in zip(bars, labels, strict=True):  # a value is written at the end of its interval
        ends = [at + (half or 0) for at, half in zip(bar["x"], bar["error_x"]["array"], strict=True)]
        assert label["x"] == pytest.approx(ends, abs=0.002) and label["offsetgroup"] == bar["offsetgroup"]
    lines = {trace["name"] for trace in stored["plan0"]["data"]}
    assert {"driven in lift", "driven in dense", "recorded path"} <= lines and len(stored["plan0"]["now"]) == 2
    assert {trace["name"] for trace in stored["time0"]["data"]} == {"recorded", "lift", "dense"}
    assert load_scene_record(finished / "street/dense").place == 1
    assert set(read_table(finished / "metrics.parquet")["reconstruction"]) == {"lift", "dense"}
    before = (finished / "report.html").read_bytes()
    assert runs.write_report(finished).read_bytes() == before


def test_scenes_of_other_logs_are_refused(pair):
    one, two = pair
    far = dataclasses.replace(two.ego, world_from_body=two.ego.world_from_body + 1e-1 * np.eye(4)[3, 3])
    with pytest.raises(RunError, match="are not of the same log: their recorded drives are up to 0.17 m apart"):
        with_common_truth([one, dataclasses.replace(two, ego=far)])
    with pytest.raises(RunError, match=r"only one of them has the actors \['parked'\]"):
        with_common_truth([one, dataclasses.replace(two, tracks=())])


def test_several_archives_of_one_log_are_one_run(pair, tmp_path, capsys):
    """Two made by the same method are told apart by their files; more than one needs a server of its own."""
    for name in ("small", "large"):
        write_scene(pair[0], tmp_path / f"{name}.usdz")
    archives = [str(tmp_path / f"{name}.usdz") for name in ("small", "large")]
    (tmp_path / "brief.yaml").write_text("{name: brief, duration_s: 1.0, warm_up_s: 0.3}")
    words = ["run", *archives, "--scenario", str(tmp_path / "brief.yaml"), "--policies", "constant_velocity"]
    cli.main([*words, "--no-video", "--out", str(tmp_path / "runs")])
    run = tmp_path / "runs" / "latest"
    assert sorted(path.name for path in (run / "street").iterdir()) == ["lift_large", "lift_small"]
    assert "No rollout ends differently" in (run / "report.html").read_text()
    assert not list(run.rglob("*.mp4"))
    store = SceneStore([pair[0]], device="cpu")
    with pytest.raises(RunError, match="each method may be given once"):
        runs.offer_all(store, archives, ["lift", "lift"])


def test_a_log_by_two_methods_is_measured_by_what_was_held_out(tmp_path):
    """Two methods from the documents' example; image 2 of 3 and its sweep are kept out of both."""
    log = tiny_clip.write(tmp_path / "tiny.zip")
    for name, share in (("dots", 10), ("sparse", 20)):
        text = (
            example("write_a_method.md")
            .replace('"dots"', f'"{name}"')
            .replace("every: int = 10", f"every: int = {share}")
        )
        (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / "brief.yaml").write_text("{name: brief, duration_s: 0.2, warm_up_s: 0.1, replan_s: 0.1}")
    cli.main(["run", str(log), "--methods", str(tmp_path / "dots.py"), str(tmp_path / "sparse.py"), "--hold-out", "3",
              "--scenario", str(tmp_path / "brief.yaml"), "--policies", "log_replay", "--out", str(tmp_path / "runs"),
              "--cache", str(tmp_path / "cache")])  # fmt: skip
    run = tmp_path / "runs" / "latest"
    held = logs.hold_out(logs.open_clip(log), ["front", "left", "wide"], images_every=3)
    records = [load_scene_record(run / "tiny" / name) for name in ("dots", "sparse")]
    for record in records:
        assert record.fidelity["held_out"] and record.fidelity["images"] == 3 and 3 < record.fidelity["psnr_db"] < 40
        assert record.fidelity["sweeps"] == len(held.sweeps)
    assert records[0].counts["static"] > records[1].counts["static"] > 0
    for name in ("recorded.mp4", "recorded_lidar.mp4", "dots/log_replay/0/front.mp4", "sparse/log_replay/0/lidar.mp4"):
        with av.open(str(run / "tiny" / name)) as video:
            assert sum(1 for _ in video.decode(video=0)) == len(load_rollout(
                run / "tiny/dots/log_replay/0/rollout.npz").states), name  # fmt: skip
    text = (run / "report.html").read_text()
    assert "Images and sweeps that the reconstruction did not see." in text and "the map of the log" in text
