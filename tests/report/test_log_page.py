"""The page about a log."""

import contextlib
import dataclasses
import re

import numpy as np
import pytest
import tiny_clip

from nurec_sim import cli, geometry, logs
from nurec_sim.logs.moved import later
from nurec_sim.logs.selection import with_tracks
from nurec_sim.reconstruct import movers
from nurec_sim.report.log_map import drive_map, timeline
from nurec_sim.report.log_page import log_page
from nurec_sim.types import Track, Trajectory


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tiny_clip.write(tmp_path_factory.mktemp("page") / "clip")


@pytest.fixture(scope="module")
def clip(path):
    return logs.open_clip(path)


def test_the_page_stands_alone_and_tells_everything(clip):
    measures = [
        logs.Measure("ground below the rear axle, LiDAR 'top'", "z = +1.50 m", ("the ground is 1.5 m <too> high",)),
        logs.Measure("LiDAR in camera 'front'", "cannot tell: no sweep about the time of an image"),
        logs.Measure("boxes that hold LiDAR points", "90% of 20 in sight"),
    ]
    page = log_page(clip, ["camera 'wide' frame 1: cut off"], measures)
    assert not re.search(r'(src|href)="(?!data:)', page)  # nothing is loaded from elsewhere
    assert '<span class="tag bad">2 faults</span>' in page
    rows = re.findall(r"<tr><td>(.*?)</tr>", page)[:3]
    assert (
        "the ground is 1.5 m &lt;too&gt; high" in rows[0] and "Correct the height or the tilt of the LiDAR" in rows[0]
    )
    assert "undecided" in rows[1] and "Check the direction of the camera" in rows[1]
    assert "fits" in rows[2] and rows[2].endswith('<td class="todo"></td>')
    assert "camera &#x27;wide&#x27; frame 1: cut off" in page
    # 3 cameras with 3 frames each: one time is enough.
    assert page.count("<figure>") == 3 and page.count("data:image/jpeg") == 3
    assert "no faults" in log_page(clip, [], [])
    # Where nothing is to be done, there is no column for it.
    fits = log_page(clip, [], measures[2:])
    assert "What to do" in page and "What to do" not in fits
    assert re.findall(r"<tr><td>(.*?)</tr>", fits)[0].endswith('<td class="find">90% of 20 in sight</td>')


def test_the_timeline_has_every_frame_and_names_gaps(clip):
    drawn, gaps = timeline(clip)
    boxes = 3  # distinct times of poses of tracks
    assert drawn.count("<rect") == len(clip.ego.t_us) + 3 * 3 + 3 + boxes and not gaps
    late = later(clip, 0)
    records = [dataclasses.replace(late.image_records("front")[0], start_us=t, end_us=t)
               for t in tiny_clip.START_US + np.array([0, 50_000, 100_000, 150_000, 290_000])]  # fmt: skip
    late._images["front"] = tuple(records)
    assert timeline(late)[1] == ["front: nothing from 0.15 to 0.29 s"]


def test_the_map_shows_path_objects_road_and_coverage(clip):
    drawn = drive_map(clip)
    assert drawn.count("<polygon") == 2 + 2 + 1  # outer edge and hole of the road, two objects, the car
    assert drawn.count("<polyline") == 1 + 1 + 1  # lane, the moving object's path, the car's
    assert drawn.count("<image") == 1


def test_coverage_says_what_cameras_see(clip):
    from nurec_sim.report.log_map import REACH_M, SEEN_RGB, UNSEEN_RGB, _coverage

    low = clip.ego.position_m[:, :2].min(axis=0) - REACH_M
    image = _coverage(clip, low, low + 2 * REACH_M)
    painted = image.reshape(-1, 3)[(image.reshape(-1, 3) < 255).any(axis=1)].astype(float)
    # Points lie all around the car at 12 to 14 m; cameras look ahead and a little to the left.
    towards = [
        np.linalg.norm(np.cross(255 - painted, 255.0 - colour), axis=1) < 2000 for colour in (SEEN_RGB, UNSEEN_RGB)
    ]
    assert len(painted) > 100 and towards[0].any() and towards[1].any()
    rows, columns = np.nonzero((image < 255).any(axis=2))
    x, y = low[0] + 0.5 * (columns + 0.5), low[1] + 2 * REACH_M - 0.5 * (rows + 0.5)
    blue = image[rows, columns, 2] > image[rows, columns, 0]
    assert y[blue].max() > 2 - y[blue].min()  # the left camera looks to the left
    assert x[blue].min() > clip.ego.position_m[0, 0] and (x[~blue] < 0).any() and np.abs(y).max() < 20


def test_the_command_writes_it(path, tmp_path, capsys):
    out = tmp_path / "page.html"
    try:
        cli.main(["inspect", str(path), "--html", str(out)])
    except SystemExit:  # faults are part of the page
        pass
    assert out.read_text().startswith("<!doctype html>") and f"wrote {out}" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["inspect", "street.usdz", "--html", str(out)])
    assert "--html shows a clip; street.usdz is a scene archive" in capsys.readouterr().err


def test_a_log_without_boxes_is_shown_with_what_moves_in_it(tmp_path, capsys, monkeypatch):
    bare = tiny_clip.write(tmp_path / "bare")
    (bare / "tracks.json").unlink()
    poses = np.stack([geometry.pose_from_xyyaw(x, 4.0, 0.0) for x in (5.0, 6.0)])
    path = Trajectory(tiny_clip.START_US + np.array([0, 200_000]), poses)
    found = Track("found-1", "automobile", (4.2, 1.7, 1.5), path, labelled=False)
    monkeypatch.setattr(movers, "find_actors", lambda log, progress: (found,))
    out = tmp_path / "page.html"
    with contextlib.suppress(SystemExit):
        cli.main(["inspect", str(bare), "--html", str(out)])
    table = capsys.readouterr().out.partition("no boxes; found by motion")[2]
    words = next(line for line in table.splitlines() if "found-1" in line).replace("│", " ").split()
    assert words == "found-1 automobile 4.2 x 1.7 x 1.5 0.0 to 0.2 5.0".split()
    page = out.read_text()
    assert "found by motion, unlabelled" in page and "0 in 0 tracks" in page
    log = logs.open_clip(bare)
    shown = with_tracks(log, (found,))
    assert drive_map(shown).count("<polygon") == drive_map(log).count("<polygon") + 1
    assert timeline(shown) == timeline(log)  # the log recorded no boxes
