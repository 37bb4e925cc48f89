"""Weights files that hold only what another file beside them lacks."""

import hashlib
import json

import pytest
import safetensors.torch
import torch

from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints.shared import KEY, save_difference
from nurec_sim.network.checkpoints.state_dicts import load_state_dict, read_metadata

FACTS = {"nurec_sim": json.dumps({"seed": "1"})}


@pytest.fixture
def files(tmp_path):
    """``base`` and ``full``, which share one tensor."""
    same = torch.arange(6.0).reshape(2, 3)
    safetensors.torch.save_file({"a": same, "b": torch.zeros(2), "only": torch.ones(1)}, tmp_path / "base.safetensors")
    safetensors.torch.save_file(
        {"a": same, "b": torch.ones(2), "c": torch.ones(3)}, tmp_path / "full.safetensors", FACTS
    )
    return tmp_path


def test_a_file_with_the_difference_reads_like_the_full_one(files):
    assert save_difference(files / "full.safetensors", files / "base.safetensors", files / "part.safetensors") == 1
    assert set(safetensors.torch.load_file(files / "part.safetensors")) == {"b", "c"}
    full, part = load_state_dict(files / "full.safetensors"), load_state_dict(files / "part.safetensors")
    assert list(full) == list(part) and all(torch.equal(full[name], part[name]) for name in full)
    assert read_metadata(files / "part.safetensors") == {"seed": "1"}


def test_the_same_files_give_the_same_bytes(files):
    digests = set()
    for _ in range(4):
        save_difference(files / "full.safetensors", files / "base.safetensors", files / "part.safetensors")
        digests.add(hashlib.sha256((files / "part.safetensors").read_bytes()).hexdigest())
    assert len(digests) == 1


def test_the_file_beside_it_must_be_the_right_one(files):
    save_difference(files / "full.safetensors", files / "base.safetensors", files / "part.safetensors")
    safetensors.torch.save_file({"a": torch.zeros(2, 3)}, files / "base.safetensors")
    with pytest.raises(WeightsError, match="of SHA-256"):
        load_state_dict(files / "part.safetensors")
    (files / "base.safetensors").unlink()
    with pytest.raises(WeightsError, match="not there"):
        load_state_dict(files / "part.safetensors")


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ("no json", "says wrongly"),
        ("[1]", "says wrongly"),
        (json.dumps({"file": "../base.safetensors", "sha256": "0", "tensors": []}), "not there"),
        (json.dumps({"file": "base.safetensors", "sha256": "0", "tensors": []}), "of SHA-256"),
    ],
)
def test_wrong_facts_are_refused(files, said, text):
    safetensors.torch.save_file({"b": torch.ones(2)}, files / "part.safetensors", {KEY: said})
    with pytest.raises(WeightsError, match=text):
        load_state_dict(files / "part.safetensors")


def test_a_tensor_that_is_not_there_is_named(files):
    digest = hashlib.sha256((files / "base.safetensors").read_bytes()).hexdigest()
    said = json.dumps({"file": "base.safetensors", "sha256": digest, "tensors": ["gone"]})
    safetensors.torch.save_file({"b": torch.ones(2)}, files / "part.safetensors", {KEY: said})
    with pytest.raises(WeightsError, match="'gone'"):
        load_state_dict(files / "part.safetensors")


def test_what_shares_nothing_or_lies_elsewhere_is_refused(files):
    safetensors.torch.save_file({"z": torch.ones(1)}, files / "other.safetensors")
    with pytest.raises(WeightsError, match="shares no tensor"):
        save_difference(files / "full.safetensors", files / "other.safetensors", files / "part.safetensors")
    with pytest.raises(WeightsError, match="beside"):
        save_difference(files / "full.safetensors", files / "base.safetensors", files / "sub" / "part.safetensors")


def test_the_command_writes_the_small_file_and_says_what_is_wrong(files, capsys):
    from nurec_sim.cli import main

    full, base, part = (str(files / f"{name}.safetensors") for name in ("full", "base", "part"))
    main(["weights", "share", full, "--other", base, "--to", part])
    assert "1 tensors shared with base.safetensors" in " ".join(capsys.readouterr().out.split())
    (files / "broken").write_bytes(b"no weights")
    with pytest.raises(SystemExit) as stopped:
        main(["weights", "share", str(files / "broken"), "--other", base, "--to", part])
    assert stopped.value.code == 1 and "cannot be read" in " ".join(capsys.readouterr().err.split())
