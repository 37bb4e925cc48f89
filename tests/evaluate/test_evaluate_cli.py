import json
from typing import get_args

import pytest
from evaluation_worlds import StreetProtocol

from nurec_sim import cli, evaluate
from nurec_sim.cli import evaluation
from nurec_sim.errors import NurecSimError


def run_cli(*words):
    cli.main(["evaluate", *map(str, words)])


@pytest.fixture
def streets(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate, "Protocol", StreetProtocol, raising=False)
    StreetProtocol.opened.clear()
    return tmp_path


def test_the_choices_are_those_of_the_package():
    assert get_args(evaluation.ProtocolName) == evaluate.PROTOCOLS == tuple(evaluation.USUAL_METHODS)
    assert {name for names in evaluation.USUAL_METHODS.values() for name in names} <= set(evaluate.CHOICES)
    assert set(evaluation.USUAL_WORLDS) == set(evaluate.PROTOCOLS)


def test_one_command_prints_the_tables_and_keeps_them(streets, capsys):
    run_cli("--protocol", "storm", "--worlds", 2, "--seed", 4, "--methods", "copy")
    text = capsys.readouterr().out
    for words in ("columns of the paper's Table 1", "dyn PSNR", "Metric depth", "without boxes", "report.html"):
        assert words in " ".join(text.split())
    folder = streets / "evaluations" / "latest"
    results = json.loads((folder / "results.json").read_text())
    assert results["protocol"]["seeds"] == [4, 5] and list(results["methods"]) == ["copy"]
    run_cli("--protocol", "storm", "--worlds", 2, "--seed", 4, "--methods", "copy", "--resume", folder)
    assert StreetProtocol.opened == [4, 5]
    assert len([p for p in (streets / "evaluations").iterdir() if not p.is_symlink()]) == 1


@pytest.mark.slow
def test_random_weights_are_named_as_such(streets, capsys):
    run_cli("--protocol", "storm", "--worlds", 1, "--methods", "selective", "--random-weights", 2, "--sky-px", 16)
    page = (streets / "evaluations" / "latest" / "report.html").read_text()
    assert "random weights of seed 2: its results are meaningless" in page
    assert "selective" in capsys.readouterr().out


def test_usual_methods_without_weights_are_left_out_and_named(streets, monkeypatch, capsys):
    monkeypatch.setattr("nurec_sim.network.checkpoints.download._SHIPPED", streets)
    monkeypatch.delenv("INSTANT_NUREC_FULL_PT", raising=False)
    monkeypatch.setitem(evaluation.USUAL_METHODS, "storm", ("dense", "copy"))
    run_cli("--protocol", "storm", "--worlds", 1)
    said = capsys.readouterr()
    assert "dense is skipped: weights of 'tiny' are not part of this version" in " ".join(said.err.split())
    assert "copy" in said.out and "dense" not in said.out
    with pytest.raises(SystemExit):
        run_cli("--protocol", "storm", "--worlds", 1, "--methods", "dense")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((), "nothing to evaluate: give a clip, or --protocol storm, clip, shift, lidar or detection"),
        (("log", "--worlds", "3"), "--worlds cannot be used without --protocol"),
        (("--protocol", "storm", "--method", "lift", "--local"), "--local cannot be used with --protocol"),
        (("--protocol", "storm", "--set", "sky_px=8"), "--set cannot be used with --protocol"),
        (("log", "--set", "views.width=8"), "--set: there is no setting 'views.width'; have ['budget'"),
        (("log", "--protocol", "storm"), "with --protocol, logs are given by --clips log"),
        (("--protocol", "storm", "--clips", "log", "--seed", "2"), "--worlds and --seed select procedural worlds"),
        (("--protocol", "storm", "--clips", "log", "--methods", "copy"), "no clip at"),
        (("--protocol", "shift", "--worlds", "0"), "give seeds or clips"),
        (("--protocol", "storm", "--checkpoint", "none.pt", "--methods", "dense"), "no weights at 'none.pt'"),
        (("--protocol", "storm", "--worlds", "1", "--methods", "copy", "--resume", "gone"), "gone does not exist"),
    ],
)
def test_mistakes_are_one_clear_line(words, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        run_cli(*words)
    assert stop.value.code == 1
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_settings_are_those_of_the_method_and_the_device_that_of_the_renderer(tmp_path, monkeypatch, capsys):
    """`lift` has no device of its own: --device is no mistake, and chooses what renders."""
    wanted = []

    def stop_here(log, method, **given):
        wanted.append((method, given["settings"], given["device"]))
        raise NurecSimError("enough")

    monkeypatch.setattr(evaluate, "evaluate", stop_here)
    world = tmp_path / "town.zip"
    cli.main(
        ["world", "--seed", "1", "--seconds", "1", "--hz", "2", "--width", "64", "--height", "64", "--out", str(world)]
    )
    with pytest.raises(SystemExit):
        run_cli(world, "--device", "cpu", "--set", "views.width_px=99", "--set", "sky_px=8")
    ((method, settings, device),) = wanted
    assert (method, settings.views.width_px, settings.sky_px, device) == ("lift", 99, 8, "cpu")
    assert "enough" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run_cli(world, "--scene", "made.usdz", "--set", "sky_px=8")
    assert "--set: for a new reconstruction, and --scene is a finished one" in capsys.readouterr().err
