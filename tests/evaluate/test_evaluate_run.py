import json
import re
from pathlib import Path

import cv2
import pytest
from evaluation_worlds import StreetProtocol

from nurec_sim.errors import ReconstructError, RunError, WeightsError
from nurec_sim.evaluate import contenders, run_protocol
from nurec_sim.evaluate.methods import CHOICES, build, describe, without_weights
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, PointSettings, ViewSettings

pytestmark = pytest.mark.slow

LIFT = LiftSettings(sky_px=32, views=ViewSettings(levels=16), points=PointSettings(min_voxel_m=0.24))
NETWORK = FeedForwardSettings(random_weights=3, sky_px=16)


@pytest.fixture(autouse=True)
def _forget():
    StreetProtocol.opened.clear()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    told = []
    methods = contenders(("dense", "lift", "copy"), NETWORK, lift=LIFT)
    results = run_protocol(StreetProtocol("storm", (1, 2)), methods, folder, lambda *what: told.append(what))
    return results, folder, told


def without_seconds(results):
    text = json.dumps(results)
    return re.sub(r'"(reconstruct|render)": [\d.]+', "", text)


def test_a_run_folder_holds_everything(finished):
    results, folder, told = finished
    assert json.loads((folder / "results.json").read_text()) == json.loads(json.dumps(results, allow_nan=False))
    assert sorted(p.name for p in (folder / "windows").iterdir()) == [f"street-{n}.json" for n in (1, 2)]
    assert "| lift |" in (folder / "tables.md").read_text()
    assert (folder / "paper.csv").read_text().startswith("method,PSNR,SSIM")
    sheet = cv2.imread(str(folder / "sheets" / "street-2.png"))
    assert sheet.shape[1] == 4 * 96 + 3 * 3 and sheet.std() > 30
    assert [fraction for _, fraction in told] == sorted(fraction for _, fraction in told)
    assert 0 <= told[0][1] < 0.2 and told[-1][1] <= 1


def test_methods_that_see_the_street_beat_random_weights(finished):
    methods = finished[0]["summary"]["methods"]
    assert methods["lift"]["full"]["psnr_db"] > methods["copy"]["full"]["psnr_db"]
    assert methods["lift"]["full"]["abs_rel"] < 0.3 and methods["copy"]["full"]["abs_rel"] is None
    assert methods["dense"]["full"]["psnr_db"] < methods["lift"]["full"]["psnr_db"]
    assert methods["dense"]["gaussians"] > 1000 and methods["dense"]["windows"] == 2
    assert finished[0]["methods"]["dense"]["settings"]["random_weights"] == 3


def test_the_report_opens_without_a_network(finished):
    page = (finished[1] / "report.html").read_text()
    assert '<td class="">lift</td>' in page and "random weights of seed 3" in page
    assert page.count("data:image/jpeg;base64,") == 2
    assert not re.search(r'(src|href)="https?:', page) and "NaN" not in page


def test_finished_windows_are_not_done_again(tmp_path):
    copy = contenders(("copy",))
    results = run_protocol(StreetProtocol("storm", (1, 2)), copy, tmp_path)
    (tmp_path / "windows" / "street-2.json").unlink()
    StreetProtocol.opened.clear()
    again = run_protocol(StreetProtocol("storm", (1, 2)), copy, tmp_path)
    assert StreetProtocol.opened == [2]
    assert without_seconds(again) == without_seconds(results)


def test_another_setting_is_refused(tmp_path):
    copy = contenders(("copy",))
    run_protocol(StreetProtocol("storm", (1,)), copy, tmp_path)
    with pytest.raises(RunError, match=r"other settings: ids was \[\"street-1\"\], now \[\"street-1\", \"street-2"):
        run_protocol(StreetProtocol("storm", (1, 2)), copy, tmp_path)
    with pytest.raises(RunError, match="methods.lift was null"):
        run_protocol(StreetProtocol("storm", (1,)), contenders(("copy", "lift"), lift=LIFT), tmp_path)
    (tmp_path / "windows" / "street-1.json").write_text('{"id": ')
    with pytest.raises(RunError, match=r"cannot read .*street-1.json.*delete it and run again"):
        run_protocol(StreetProtocol("storm", (1,)), copy, tmp_path)
    (tmp_path / "windows" / "street-1.json").write_text('{"methods": {}}')
    with pytest.raises(RunError, match="does not have the results of these methods"):
        run_protocol(StreetProtocol("storm", (1,)), copy, tmp_path)


def test_an_interrupted_run_keeps_what_is_finished(tmp_path):
    def stop(stage, fraction):
        if "street-2" in stage:
            raise KeyboardInterrupt

    protocol, methods = StreetProtocol("storm", (1, 2)), contenders(("copy",))
    with pytest.raises(KeyboardInterrupt):
        run_protocol(protocol, methods, tmp_path, stop)
    assert [p.name for p in (tmp_path / "windows").iterdir()] == ["street-1.json"]
    run_protocol(protocol, methods, tmp_path)
    assert StreetProtocol.opened == [1, 2, 2]
    assert not [p for p in tmp_path.rglob(".*")]


def test_a_method_that_fails_is_a_row_with_its_error():
    blind = FeedForwardSettings(random_weights=0, frames=1, max_chunks=1)
    results = run_protocol(StreetProtocol("storm", (1,)), contenders(("dense", "copy"), blind))
    dense = results["summary"]["methods"]["dense"]
    assert "max_chunks is 1" in results["windows"][0]["methods"]["dense"]["error"]
    assert dense["failed"] == 1 and dense["full"]["psnr_db"] is None
    assert results["summary"]["methods"]["copy"]["full"]["psnr_db"] > 5


def test_without_boxes_methods_that_read_sweeps_find_what_moves(monkeypatch):
    given = {}

    def spy(clip, method, *, actors, settings, **rest):
        given[method, getattr(settings, "lidar_depth", None)] = actors
        raise ReconstructError("enough")

    monkeypatch.setattr("nurec_sim.reconstruct.reconstruct", spy)
    methods = contenders(("dense", "selective", "dense-lidar", "lidar", "lift", "optimized"), NETWORK)
    with StreetProtocol("storm", (1,)).window(0) as window:
        for method in methods:
            with pytest.raises(ReconstructError, match="enough"):
                build(method, window)
    assert given == {
        ("dense", "off"): "recorded",
        ("selective", "off"): "recorded",
        ("dense", "local"): "auto",
        ("lidar", None): "auto",
        ("lift", None): "auto",
        ("optimized", None): "auto",
    }
    assert [describe(method)["actors"] for method in methods] == list(given.values())


def test_choosing_methods():
    assert [each.name for each in contenders(tuple(CHOICES))] == list(CHOICES)
    both = contenders(("dense-concatenated", "selective"), FeedForwardSettings(profile="tiny", random_weights=1))
    assert both[0].settings.merge == "concatenate" and both[0].settings.profile == "tiny"
    fitted, plain = contenders(("dense-lidar", "dense"), FeedForwardSettings(random_weights=1))
    assert (fitted.settings.lidar_depth, plain.settings.lidar_depth) == ("local", "off")
    assert both[1].settings.profile is None and both[1].settings.random_weights == 1
    assert describe(both[1])["settings"]["profile"] == "tiny-selective"
    given = FeedForwardSettings(profile="pq-front", checkpoint=Path("a.pt"))
    dense, selective = contenders(("dense", "selective"), given)
    assert (dense.settings.profile, dense.settings.checkpoint) == (None, None)
    assert (selective.settings.profile, selective.settings.checkpoint) == ("pq-front", Path("a.pt"))
    (own,) = contenders(("selective",), FeedForwardSettings(checkpoint=Path("a.pt")), Path("b.pt"))
    assert own.settings.checkpoint == Path("b.pt") and without_weights(own) is None
    with pytest.raises(ReconstructError, match=r"methods must be named, each once, as \['dense'"):
        contenders(("dense", "dense"))
    with pytest.raises(ReconstructError, match="no network profile 'big'"):
        contenders(("dense",), FeedForwardSettings(profile="big"))


def test_missing_weights_are_said_before_anything_is_drawn(tmp_path):
    missing = FeedForwardSettings(checkpoint=tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match="no weights at"):
        run_protocol(StreetProtocol("storm", (1,)), contenders(("dense",), missing), tmp_path / "run")
    assert not StreetProtocol.opened and not (tmp_path / "run").exists()
