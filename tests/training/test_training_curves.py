"""Curves of a run: files as they are left by a run that goes on, that was cut off, and that went on again."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurec_sim.errors import TrainingError
from nurec_sim.training.curves import curves_image, curves_page, read_curves, smoothed, write_curves

HEAD = "step,stage,seconds,rate,loss,abs_rel,psnr,skipped\n"


def run_folder(folder: Path, rows: int = 60) -> Path:
    """Two stages; the second one renders."""
    rng = np.random.default_rng(0)
    lines = [HEAD]
    for k in range(rows):
        step, second = 20 * (k + 1), k >= rows // 2
        loss = (0.5 if second else 4.0) * np.exp(-0.1 * (k % (rows // 2))) + 0.05 + 0.02 * rng.random()
        psnr = f"{15 + 0.2 * k + rng.random():.5g}" if second else ""
        stage = "gaussians" if second else "context"
        lines.append(f"{step},{stage},{1.5 * step:.1f},5e-4,{loss:.6g},{0.4 / (k + 1) + 0.05:.6g},{psnr},0\n")
    folder.mkdir(exist_ok=True)
    (folder / "curves.csv").write_text("".join(lines))
    return folder


def test_curves_are_read_by_stage(tmp_path):
    curves = read_curves(run_folder(tmp_path / "run") / "curves.csv")
    assert curves.stages == ("context", "gaussians")
    assert list(curves.values) == ["rate", "loss", "abs_rel", "psnr", "skipped"]
    assert np.array_equal(curves.step, 20 * np.arange(1, 61)) and curves.seconds[-1] == 1800
    step, psnr = curves.of_stage("psnr", "gaussians")
    assert len(step) == 30 and step[0] == 620 and np.isfinite(psnr).all()
    assert len(curves.of_stage("psnr", "context")[0]) == 0


def test_what_a_run_leaves_behind_is_read(tmp_path):
    path = tmp_path / "curves.csv"
    path.write_text(HEAD + "20,a,1,5e-4,2.5,,,0\n40,a,2,5e-4,2.0,,,0\n60,a,3,5e")
    assert list(read_curves(path).step) == [20, 40]  # the last line is being written
    path.write_text(HEAD + "20,a,1,,2.5,,,\n40,a,2,,2.0,,,\n60,a,3,,1.5,,,\n40,a,9,,1.9,,,\n")
    again = read_curves(path)  # it went on from step 20
    assert list(again.step) == [20, 40] and list(again.values["loss"]) == [2.5, 1.9]
    assert list(again.values) == ["loss"]  # columns without any value are left out
    path.write_text(HEAD + "20,a,1,,nan,inf,3,\n")
    assert list(read_curves(path).values) == ["psnr"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must have the columns step, stage, seconds; it has none"),
        ("step,loss\n1,2\n", r"it has \['step', 'loss'\]"),
        (HEAD + "20,a,1,5e-4\n", "line 2: a row needs a value or nothing for every column"),
        (HEAD + "20,a,1,,,,,,,7\n", "line 2: a row needs"),
        (HEAD + "20,a,1,,much,,,\n", "line 2: could not convert string to float: 'much'"),
        (HEAD + ",a,1,,,,,\n", "line 2: a row needs"),
    ],
)
def test_other_files_are_refused(tmp_path, text, said):
    (tmp_path / "curves.csv").write_text(text)
    with pytest.raises(TrainingError, match=said):
        read_curves(tmp_path / "curves.csv")


def test_nothing_to_draw_is_said(tmp_path):
    with pytest.raises(TrainingError, match="no curves at .*: No such file"):
        write_curves(tmp_path)
    (tmp_path / "curves.csv").write_text(HEAD)
    with pytest.raises(TrainingError, match="holds no values yet"):
        write_curves(tmp_path)


def test_page_and_picture(tmp_path):
    folder = run_folder(tmp_path / "<run>")
    page, picture = write_curves(folder)
    text = page.read_text()
    assert "&lt;run&gt;" in text and "<run>" not in text and "http-equiv" not in text
    stored = json.loads(re.search(r'id="figures">(.*?)</script>', text, re.S).group(1))
    panels = stored["panels"]
    assert [panel["id"] for panel in panels] == ["rate", "loss", "abs_rel", "psnr", "skipped"]
    loss = panels[1]
    assert len(loss["data"]) == 4 and loss["layout"]["yaxis"]["type"] == "log"  # two stages, measured and smoothed
    assert "type" not in panels[3]["layout"]["yaxis"]
    assert curves_page(read_curves(folder / "curves.csv"), "<run>") == text
    image = cv2.imread(str(picture))
    assert image.shape == (446, 1360, 3)
    blue, red = (np.abs(image[..., ::-1].astype(int) - rgb).sum(-1) < 40 for rgb in ((0, 114, 178), (213, 94, 0)))
    loss_panel = np.s_[26:236, 340:680]
    assert blue[loss_panel].sum() > 100 and red[loss_panel].sum() > 100
    rows = np.argwhere(blue[loss_panel])[:, 0]
    assert rows.max() - rows.min() > 60  # the first stage's loss falls through much of the panel
    assert sorted(path.name for path in folder.iterdir()) == ["curves.csv", "curves.html", "curves.png"]


def test_one_point_and_constant_curves_can_be_drawn(tmp_path):
    (tmp_path / "curves.csv").write_text(HEAD + "1,only,1,5e-4,2,,,0\n")
    image = curves_image(read_curves(tmp_path / "curves.csv"))
    assert image.shape == (236, 3 * 340, 3) and image.min() < 255


def test_smoothing_is_even_handed_and_keeps_constants():
    assert np.allclose(smoothed(np.full(9, 3.0)), 3)
    peak = smoothed(np.array([0, 0, 0, 1.0, 0, 0, 0]))
    assert np.allclose(peak, peak[::-1]) and peak.argmax() == 3 and 0 < peak[0] < peak[2] < peak[3] < 0.5
    assert smoothed(np.array([2.0])) == 2
