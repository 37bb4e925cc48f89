from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_clip

from nurec_sim import cli, geometry, logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import overlay
from nurec_sim.types import Rig


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return tiny_clip.write(tmp_path_factory.mktemp("overlay") / "clip")


@pytest.fixture(scope="module")
def clip(path) -> logs.Clip:
    return logs.open_clip(path)


def test_points_lie_where_each_camera_sees_them(clip):
    t_us = 2_110_000  # the middle of frame 1
    sheet = logs.draw_overlay(clip, t_us)
    tile_height = overlay.CAPTION_PX + 720  # 64 x 48 pixels, 960 wide
    assert sheet.shape == (2 * tile_height, 2 * 960, 3)
    camera = clip.rig.cameras["front"]
    points = clip.sweep("top", 0).xyz_world_m  # measured at 2.1 s: the nearest
    uv, valid, _ = sensors.project_rolling(camera, clip.world_from_camera("front", 1), points)
    seen = valid & sensors.in_image(camera, uv)
    assert seen.sum() > 5
    columns, rows = np.floor(uv[seen] * 15).astype(int).T
    depth = geometry.transform_points(geometry.inverse(clip.world_from_camera("front", 1)[0]), points[seen])[:, 2]
    drawn = sheet[overlay.CAPTION_PX + rows, columns]
    assert (np.abs(drawn.astype(int) - overlay.depth_rgb(depth)).max(axis=1) < 12).mean() > 0.9
    # The picture below is the camera's own.
    image = cv2.resize(clip.image("front", 1), (960, 720), interpolation=cv2.INTER_LINEAR)
    assert (sheet[overlay.CAPTION_PX : tile_height, :960] == image).all(axis=2).mean() > 0.95


def test_near_is_red_and_far_is_blue():
    near, far = overlay.depth_rgb(np.array([2.0, 80.0])).astype(int)
    assert near[0] > near[2] + 80 and far[2] > far[0]


def test_boxes_are_drawn_around_their_objects(clip, monkeypatch):
    monkeypatch.setattr(clip.__class__, "sweep_records", lambda self, name: ())
    sheet = logs.draw_overlay(clip, 2_110_000)[overlay.CAPTION_PX :, :960]
    camera = sensors.scaled_camera(clip.rig.cameras["front"], 960, 720)
    car = clip.tracks[0]
    corners = geometry.transform_points(car.path.at(2_110_000), np.array([[-2.25, s * 0.95, 0.75] for s in (-1, 1)]))
    uv, _, _ = sensors.project_rolling(camera, clip.world_from_camera("front", 1), corners)
    for column, row in np.floor(uv).astype(int):
        assert sheet[row - 2 : row + 3, column - 2 : column + 3].min(axis=2).max() > 200


def test_what_cannot_be_drawn_is_said(clip, path):
    with pytest.raises(ClipError, match=r"clip 'tiny' lasts 0.300 s; there is nothing to draw 9.000 s after its start"):
        logs.draw_overlay(clip, 11_000_000)
    blind = logs.open_clip(path)
    blind.rig = Rig({}, blind.rig.lidars)
    with pytest.raises(ClipError, match="clip 'tiny' has no cameras to draw over"):
        logs.draw_overlay(blind, 2_110_000)


def test_an_image_that_is_missing_is_a_black_tile(tmp_path):
    path = tiny_clip.write(tmp_path / "clip")
    (path / "images/front/0001.png").unlink()
    sheet = logs.draw_overlay(logs.open_clip(path), 2_110_000)
    tile = sheet[: overlay.CAPTION_PX + 720, :960]
    assert not tile[overlay.CAPTION_PX :].any() and tile[: overlay.CAPTION_PX].any()
    assert sheet[:, 960:].any()


def test_the_command_writes_a_picture_or_nothing(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cli.main(["inspect", str(path), "--overlay", "out/sheet.png", "--time-s", "0.11"])
    assert "wrote out/sheet.png" in capsys.readouterr().out
    drawn = cv2.cvtColor(cv2.imread("out/sheet.png"), cv2.COLOR_BGR2RGB)
    assert np.array_equal(drawn, logs.draw_overlay(logs.open_clip(path), 2_110_000))
    for words, said in (
        (["--time-s", "1"], "--time-s is the time of the --overlay image; give both"),
        (["--overlay", "late.png", "--time-s", "1"], "there is nothing to draw 1.000 s after its start"),
        (["--overlay", "x.png", "--time-s", "nan"], "--time-s must be a number of seconds, got nan"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["inspect", str(path), *words])
        assert stop.value.code == 1 and said in capsys.readouterr().err
    (tmp_path / "scene.usdz").write_bytes(b"PK")
    with pytest.raises(SystemExit):
        cli.main(["inspect", "scene.usdz", "--overlay", "x.png"])
    assert "--overlay draws over the images of a clip; scene.usdz is a scene archive" in capsys.readouterr().err
    assert sorted(item.name for item in tmp_path.iterdir()) == ["out", "scene.usdz"]
