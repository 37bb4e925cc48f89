"""Every real driving pack goes through the whole chain, and its report says what could not be known."""

from pathlib import Path

import pytest

from nurec_sim import logs, runs, sim
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
POLICIES = ("log_replay", "constant_velocity", "route_follower", "camera_road_follower", "lidar_aeb")
PACKS = ("kitti_raw_0009", "kitti_raw_0002", "ddad_6cam", "ddad_3cam_static", "nuscenes_6cam_1frame")
FEW_VIEWS = LiftSettings(views=ViewSettings(max_views=8, width_px=320))


@pytest.mark.parametrize("pack", PACKS)
def test_a_real_log_opens_reconstructs_serves_and_rolls_out(pack: str, realdata: Path, tmp_path: Path) -> None:
    clip = logs.open_clip(realdata / pack)
    scene = reconstruct(clip, "lift", settings=FEW_VIEWS)
    assert any("no map" in text for text in scene.provenance["unknown"])
    scenario = sim.make_scenario({"name": "short", "duration_s": 1.5, "warm_up_s": 0.1})
    with SensorServer(SceneStore([scene]), port=0) as address, RemoteSensors(address, scene.id) as sensors:
        folder = runs.execute([scene], scenario, POLICIES, lambda _: sensors.sense, tmp_path, stamp="one", video=False)
    assert not list(folder.rglob("error.txt")), [path.read_text() for path in folder.rglob("error.txt")]
    assert len(list(folder.rglob("rollout.npz"))) == len(POLICIES)
    report = (folder / "report.html").read_text(encoding="utf-8")
    assert "no map" in report
    if not clip.tracks:
        assert "no boxes" in report
