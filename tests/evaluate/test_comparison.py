"""Scenes of one log side by side: the report, and the verb as a user types it."""

import dataclasses
import json

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import cli, logs, scene
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate import compare_scenes, figure_rows, render_comparison, side_by_side
from nurec_sim.logs import hold_out
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))


@pytest.fixture(scope="module")
def comparison():
    """A scene, and the same with every colour darker."""
    clip = Street(frames=4, cameras=(camera("left", 0.25),))
    good = reconstruct(clip, "lift", settings=SMALL)
    dark = dataclasses.replace(good, static=dataclasses.replace(good.static, rgb=good.static.rgb * np.float32(0.5)))
    scenes = {"good": lambda: good, "dark & <wrong>": lambda: dark}
    return clip, good, dark, compare_scenes(clip, scenes, hold_out(clip, ["left"], sweeps_every=2))


def test_the_same_figures_for_every_scene_and_the_better_one_is_better(comparison):
    rows = {(group, name): each for group, name, each in side_by_side(comparison[3].figures)}
    good, dark = rows["Images: frames it was made from", "PSNR (dB)"]
    assert good.value > dark.value + 1 and good.text == f"{good.value:.2f}"
    good, dark = rows["LiDAR: sweeps held out", "median error, all ranges (m)"]
    assert good.value == dark.value  # colours change no range
    assert all(None not in each for each in rows.values())
    groups = [row.group for row in figure_rows(comparison[3].figures["good"])]
    assert groups == sorted(groups, key=groups.index) and "False obstacles" in groups


def test_the_report_shows_differences_in_the_right_colour_and_escapes_names(comparison):
    page = render_comparison(comparison[3])
    row = page[page.index("<td>PSNR (dB)</td>") :]
    assert 'class="n bad">-' in row[: row.index("</tr>")]
    row = page[page.index("<td>FLIP</td>") :]
    assert 'class="n bad">+' in row[: row.index("</tr>")]
    assert "dark &amp; &lt;wrong&gt;" in page and "<wrong>" not in page
    assert page.count("data:image/jpeg") == len(comparison[3].worst) == 4
    # Not "http" alone: the base64 of a picture may spell it.
    assert "data:video/mp4" in page and "http:" not in page and "https:" not in page


def test_worst_frames_show_the_truth_every_scene_and_the_differences(comparison):
    clip, _, _, found = comparison
    _, picture = found.worst[0]
    height = 2 * (480 * 96 // 192 // 2)
    assert picture.shape == (2 * height + 20, 3 * 480, 3)
    differences = picture[20 + height :, 480:].astype(int)
    assert differences[:, 480:].mean() > differences[:, :480].mean() + 5


def test_one_scene_is_no_comparison():
    with pytest.raises(ReconstructError, match=r"a comparison needs two scenes or more, got \['a'\]"):
        compare_scenes(Street(frames=2), {"a": lambda: None})


@pytest.mark.slow
def test_the_verb_writes_a_report_and_names_what_is_wrong(comparison, tmp_path, monkeypatch, capsys):
    clip, good, dark, _ = comparison
    monkeypatch.chdir(tmp_path)
    write_street(clip, tmp_path / "log")
    scene.write_scene(good, tmp_path / "a.usdz")
    scene.write_scene(dark, tmp_path / "b.usdz")
    cli.main(["compare", "a.usdz", "b.usdz", "--clip", "log", "--out", "r.html", "--json", "r.json"])
    told = capsys.readouterr().out
    assert "PSNR (dB)" in told and "wrote r.html" in told
    assert set(json.loads((tmp_path / "r.json").read_text())) == {"a", "b"}
    assert "data:video/mp4" in (tmp_path / "r.html").read_text()
    with pytest.raises(SystemExit) as stop:
        cli.main(["compare", "a.usdz", "--clip", "log"])
    assert stop.value.code == 1 and "a comparison needs two scenes or more, got ['a.usdz']" in capsys.readouterr().err


def write_street(clip, path):
    frames = [logs.CameraEntry("left", *map(int, times), clip.image("left", k), clip.world_from_camera("left", k))
              for k, times in enumerate(clip.camera_times_us("left"))]  # fmt: skip
    frames += [logs.LidarEntry("top", clip.sweep("top", k)) for k in range(len(clip.sweep_times_us("top")))]
    logs.write_clip(path, id=clip.id, rig=clip.rig, ego=clip.ego, frames=frames, tracks=clip.tracks)
