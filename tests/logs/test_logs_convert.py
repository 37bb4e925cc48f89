"""Logs of any format, or parts of them, written as clip folders."""

from pathlib import Path

import numpy as np
import pytest
import tiny_clip

from nurec_sim import cli, logs
from nurec_sim.errors import ClipError


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> logs.Clip:
    return logs.open_clip(tiny_clip.write(tmp_path_factory.mktemp("tiny") / "tiny.zip"))


def test_a_log_is_written_as_it_is(tiny, tmp_path):
    again = logs.open_clip(logs.convert_clip(tiny, tmp_path / "again.zip"))
    assert (again.id, again.facts["converted_from"]) == (tiny.id, "nurec-sim-clip")
    assert logs.check_clip(again) == [] and again.span_us == tiny.span_us
    assert np.allclose(again.ego.world_from_body, tiny.ego.world_from_body) and len(again.tracks) == len(tiny.tracks)
    for name in tiny.rig.cameras:
        assert again.camera_times_us(name).tolist() == tiny.camera_times_us(name).tolist()
        assert np.allclose(again.world_from_camera(name, 1), tiny.world_from_camera(name, 1))
        assert again.encoded_image(name, 1) == tiny.encoded_image(name, 1)  # bytes of the file, not compressed again
        assert isinstance(again.encoded_image(name, 1), bytes)
    ours, theirs = again.sweep("top", 2), tiny.sweep("top", 2)
    assert np.allclose(ours.xyz_m, theirs.xyz_m, atol=6e-4) and (ours.point_t_us == theirs.point_t_us).all()


def test_a_source_of_pixels_is_written_too(tiny, tmp_path):
    class Pixels:
        def __init__(self, source):
            self.image, self.sweep, self.ego_mask = source.image, source.sweep, source.ego_mask

    records = {name: tiny.image_records(name) for name in tiny.rig.cameras}
    sweeps = {name: tiny.sweep_records(name) for name in tiny.rig.lidars}
    clip = logs.Clip("pixels", tiny.rig, tiny.ego, records, sweeps, Pixels(tiny.source))
    again = logs.open_clip(logs.convert_clip(clip, tmp_path / "again"))
    difference = again.image("front", 1).astype(float) - clip.image("front", 1)
    assert np.abs(difference).mean() < 2


def test_a_part_has_what_was_recorded_then(tiny, tmp_path):
    """Frames start 0, 0.1 and 0.2 s after the start of the log, sweeps end 0.1 s later."""
    path = logs.convert_clip(tiny, tmp_path / "part", id="part", start_s=0.05, seconds=0.1, cameras=["left"])
    part = logs.open_clip(path)
    assert part.id == "part" and list(part.rig.cameras) == ["left"] and list(part.rig.lidars) == ["top"]
    start_us = tiny.span_us[0]
    images, sweeps = tiny.camera_times_us("left"), [record.t_us for record in tiny.sweep_records("top")]
    kept = [row.tolist() for row in images if start_us + 50_000 <= row[0] < start_us + 150_000]
    assert part.camera_times_us("left").tolist() == kept and len(kept) == 1
    kept = [t_us for t_us in sweeps if start_us + 50_000 <= t_us < start_us + 150_000]
    assert [record.t_us for record in part.sweep_records("top")] == kept and len(kept) == 1
    # Poses reach as far as what was recorded, and are those of the log.
    times = np.array([part.ego.start_us, part.ego.end_us])
    assert part.span_us[0] == part.ego.start_us == part.sweep_records("top")[0].start_us
    assert np.allclose(part.ego.at(times), tiny.ego.at(times)) and part.ego.end_us < tiny.ego.end_us
    assert all(
        part.ego.start_us <= track.path.start_us and track.path.end_us <= part.ego.end_us for track in part.tracks
    )


@pytest.mark.parametrize(
    "options, text",
    [
        ({"start_s": 9}, "a part of this log starts at 0 to 0.300 s and is longer than 0 s; asked for all from 9 s on"),
        ({"seconds": 0}, "asked for 0 s from 0 s on"),
        ({"start_s": float("nan")}, "asked for all from nan s on"),
        ({"cameras": ["rear"]}, "has no camera 'rear'; have .'front', 'left', 'wide'"),
        ({"start_s": 0.25, "seconds": 0.02}, "nothing was recorded from 0.25 s to 0.27 s"),
    ],
)
def test_wrong_parts_are_refused_and_leave_nothing(tiny, tmp_path, options, text):
    with pytest.raises(ClipError, match=text):
        logs.convert_clip(tiny, tmp_path / "part", **options)
    assert list(tmp_path.iterdir()) == []


def test_the_commands(tiny, tmp_path, capsys):
    whole, part = tmp_path / "whole.zip", tmp_path / "part"
    cli.main(["import-log", str(tiny.path), "--out", str(whole)])
    assert logs.open_clip(whole).id == tiny.id
    cli.main(["trim", str(whole), "--seconds", "0.15", "--cameras", "front", "--out", str(part)])
    assert list(logs.open_clip(part).rig.cameras) == ["front"]
    for words, text in (
        (["trim", str(whole), "--out", str(part)], "exists; give another --out, or --overwrite"),
        (["import-log", str(whole), "--out", str(whole), "--overwrite"], "is the log itself; give another --out"),
        (["trim", str(Path("nowhere")), "--out", str(tmp_path / "b")], "no clip at 'nowhere'"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(words)
        assert stop.value.code == 1 and text in capsys.readouterr().err
