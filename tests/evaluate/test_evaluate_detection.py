"""The detector in evaluation: counts and tables by hand, real logs, the protocol, and the shipped weights."""

import dataclasses

import cv2
import numpy as np
import pytest
from evaluation_worlds import street

from nurec_sim import geometry
from nurec_sim.errors import WeightsError
from nurec_sim.evaluate import Protocol, contenders, procedural, run_protocol
from nurec_sim.evaluate.detection.log import score_log_detections
from nurec_sim.evaluate.detection.sheet import MISSED, RIGHT, WRONG, drawn
from nurec_sim.evaluate.detection.sights import Sight
from nurec_sim.evaluate.detection.summary import detection_figures, detection_tables, summarize_detection
from nurec_sim.logs.held_out import HeldOut
from nurec_sim.metrics.detection import added
from nurec_sim.network.checkpoints.state_dicts import read_metadata, save_weights
from nurec_sim.network.detector.codec import Detections
from nurec_sim.network.detector.detector import SHIPPED, Detector, shipped_detector
from nurec_sim.network.detector.model import DetectorNetwork
from nurec_sim.network.detector.objects import KINDS, Labelled
from nurec_sim.types import CameraFrame, CameraModel, Pinhole
from nurec_sim.world import TrueWorld
from nurec_sim.world.sense.stage import Quality

CAMERA = CameraModel("front", 96, 64, Pinhole(100.0, 100.0, 48.0, 32.0), np.eye(4))
PART = "vehicle 0-30 m"


def vehicles(cls, places, *more):
    n = len(places)
    centres = np.array([(x, 1.0, z) for x, z in places]).reshape(-1, 3)
    return cls(np.zeros(n, np.int64), centres, np.full((n, 3), 2.0), np.zeros(n), *more)


def found(*places):
    return vehicles(Detections, places, np.linspace(0.9, 0.5, len(places)))


def there(*places):
    n = len(places)
    return vehicles(Labelled, places, np.full(n, 100.0), np.full(n, 90.0), np.ones(n, bool), 100.0)


def sight(true, objects):
    return Sight(np.zeros((64, 96, 3), np.uint8), CAMERA, objects, lambda rgb, camera: true)


def test_counts_of_a_rendered_image_beside_those_of_the_true_one():
    # Three vehicles; the true image shows two of them, the rendered one of these, moved by 1 m, and one that is not.
    one = sight(found((0, 10), (3, 20)), there((0, 10), (3, 20), (-3, 25)))
    record = one.record(found((1, 10), (9, 9)))
    assert record["true"][PART] == {"found": 2, "right": 2, "there": 3, "seen": 2}
    assert record["rendered"][PART] == {"found": 2, "right": 1, "there": 3, "seen": 1}
    assert record["kept"][PART] == {"found": 2, "again": 1} and record["backed"][PART] == {"found": 2, "again": 1}
    figures = detection_figures([record, record])[PART]
    assert figures["precision"] == 0.5 and figures["recall"] == pytest.approx(1 / 3)
    assert figures["true_precision"] == 1 and figures["delta_precision"] == -0.5
    assert figures["delta_recall"] == pytest.approx(-1 / 3) and figures["kept"] == figures["backed"] == 0.5
    assert figures["there"] == 6 and figures["found"] == 4 and figures["true_found"] == 4
    nothing = detection_figures([record])["person 0-30 m"]
    assert nothing["recall"] is None and nothing["delta_precision"] is None


def windows():
    """Three windows in which the reconstruction loses none, one and both of two vehicles."""
    both = ((0, 10), (3, 20))
    made = []
    for lost in (0, 1, 2):
        one = sight(found(*both), there(*both))
        rows = [
            {"left_m": left, "full": {"psnr_db": 20.0 + lost}, "detection": one.record(found(*both[lost:]))}
            for left in (0.0, 1.0, -1.0)
        ]
        made.append({"targets": rows, "seconds": {"reconstruct": 2.0, "render": 0.1}})
    return made


def test_sides_are_combined_and_windows_give_the_interval():
    summary = summarize_detection(windows())
    assert list(summary) == ["0", "1"] and summary["1"]["views"] == 6 and summary["0"]["psnr_db"] == 21
    assert summary["1"]["figures"][PART]["recall"] == 0.5 and summary["0"]["figures"][PART]["there"] == 6
    # 1 of 27 draws loses nothing, 1 of 27 everything: more often than 1 in 40.
    assert summary["0"]["interval"]["delta_recall"] == [-1.0, 0.0]
    assert summarize_detection(windows()[:2])["0"]["interval"]["delta_recall"] is None
    assert summarize_detection([{"targets": [{"left_m": 0.0}]}]) == {}


def test_tables_of_the_protocol():
    row = {"detection": summarize_detection(windows()), "seconds": {"reconstruct": 2.0}}
    tables = {table.name: table for table in detection_tables({"lift": row})}
    assert list(tables) == ["detection_vehicle_0-30", "detection_vehicle_30-60", "detection_person_0-30",
                            "detection_person_30-60", "detection_intervals"]  # fmt: skip
    near = tables["detection_vehicle_0-30"]
    assert near.rows[0] == ("true images", "0 m", "-", "100.0 %", "-", "100.0 %", "-", "-", "-", "-")
    assert near.rows[2] == ("lift", "0 m", "21.00", "100.0 %", "+0.0", "50.0 %", "-50.0", "50.0 %", "100.0 %", "2.0")
    assert "6 in 3 views at 0 m, 12 in 6 views at 1 m" in near.note
    assert tables["detection_intervals"].rows[0] == ("lift", "0 m", "-", "-100.0 to +0.0")
    assert detection_tables({"lift": {"detection": {}}}) == []


def test_boxes_are_drawn_in_the_colour_of_their_verdict():
    picture = drawn(np.zeros((64, 96, 3), np.uint8), CAMERA, there((0, 10), (-3, 12)), found((0, 10), (3, 12)))
    # Left: a dot on the missed one, at u = 48 - 25; the middle is right, and what is right of it wrong.
    assert picture[40, 23].tolist() == list(MISSED)
    columns = [np.flatnonzero((picture == colour).all(axis=2).any(axis=0)) for colour in (RIGHT, WRONG)]
    assert len(columns[0]) and len(columns[1]) and columns[0].max() < columns[1].min()


def test_a_recorded_log_is_scored_with_its_own_boxes(tmp_path):
    clip = street()

    def see(requests):
        return [CameraFrame(r.sensor, r.start_us, r.end_us, np.zeros((64, 96, 3), np.uint8)) for r in requests]

    def perfect(rgb, camera):
        """Finds the car in recorded images, at its place, and nothing in black ones."""
        if not rgb.any():
            return found()
        return found(place)

    index = 2
    pose = clip.world_from_camera("front", index)[0]
    (track,) = [track for track in clip.tracks if track.label == "automobile"]
    centre = geometry.transform_points(geometry.inverse(pose), track.path.at(clip.ego.start_us)[:3, 3][None])[0]
    place = (centre[0], centre[2])
    result = score_log_detections(clip, ["front"], HeldOut({"front": frozenset({index})}), see, tmp_path, None, perfect)
    figures = result["figures"][PART]
    assert result["images"] == 1 and "never saw a real image" in result["caveat"]
    assert figures["true_recall"] == 1 and figures["true_precision"] == 1 and figures["there"] == 1
    assert figures["recall"] == 0 and figures["precision"] is None and figures["kept"] == 0
    assert cv2.imread(str(tmp_path / "front_0002_detections.png")).shape == (128, 96, 3)
    bare = street(labelled=False)
    assert "no boxes" in score_log_detections(bare, ["front"], HeldOut(), see)["not_known"]


def test_weights_without_thresholds_are_refused(tmp_path):
    save_weights(DetectorNetwork(), tmp_path / "w.safetensors", {"scores": "[0.3]"}, half=True)
    with pytest.raises(WeightsError, match="has 1 thresholds of scores instead of 2"):
        Detector(tmp_path / "w.safetensors")
    save_weights(DetectorNetwork(), tmp_path / "w.safetensors", {}, half=True)
    with pytest.raises(WeightsError, match="has no thresholds"):
        Detector(tmp_path / "w.safetensors")


def test_the_shipped_detector_says_how_it_was_made():
    assert SHIPPED.stat().st_size < 1.5e6 and read_metadata(SHIPPED)["trained_on"].startswith("procedural worlds")
    blank = shipped_detector().detect(np.full((64, 96, 3), 128, np.uint8), CAMERA)
    assert len(blank) <= 2


@pytest.mark.slow
def test_the_shipped_detector_finds_cars_in_a_held_out_town():
    plan = procedural.held_out_plan(101, 4.0)
    counts = []
    with TrueWorld(plan, quality=Quality(2, 1024)) as world:
        source = procedural.EvaluationWorld(world, procedural.evaluation_rig())
        for second in (1.0, 2.0, 3.0):
            target = source.target("t", "camera_front", plan.span_us[0] + round(second * 1e6), sight=True)
            one = target.sight
            counts.append(one.record(one.found)["true"])
            assert one.objects.visible.any()
    near = added(counts)[PART]
    assert near["there"] >= 3 and near["seen"] >= 0.5 * near["there"] and near["right"] >= 0.5 * near["found"]
    assert set(added(counts)) == {f"{kind} {bins}" for kind in KINDS for bins in ("0-30 m", "30-60 m")}


@pytest.mark.slow
def test_the_protocol_asks_the_detector_on_the_path_and_beside_it(tmp_path):
    whole = procedural.town_plan

    def bare(*given, **more):
        return dataclasses.replace(whole(*given, **more), buildings=(), props=())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(procedural, "town_plan", bare)
        protocol = Protocol("detection", (5,), size_px=(240, 160))
        results = run_protocol(protocol, contenders(("copy",)), tmp_path)
    at = results["summary"]["methods"]["copy"]["detection"]
    assert list(at) == ["0", "1", "2"] and at["0"]["views"] == 3 and at["2"]["views"] <= 6
    assert at["0"]["figures"][PART]["there"] > 0
    assert (tmp_path / "detection_vehicle_0-30.csv").read_text().startswith("method,offset,PSNR,P,")
    assert cv2.imread(str(tmp_path / "sheets" / "detection-5.png")).shape[1] > 2 * 240
    assert "A camera detector on true and on rendered images" in (tmp_path / "report.html").read_text()
