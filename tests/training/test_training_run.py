import csv
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
from training_samples import GroundSamples, mean_difference, small_config

from nurec_sim import network
from nurec_sim.errors import TrainingError, WeightsError
from nurec_sim.network.checkpoints.state_dicts import load_weights, read_metadata
from nurec_sim.training.checkpoint import CHECKPOINT, read_position
from nurec_sim.training.config import Stage, read_config
from nurec_sim.training.trainer import CURVES, WEIGHTS, Trainer, learning_rate

pytestmark = pytest.mark.slow


def trainer(folder, config=None):
    return Trainer(config or small_config(), folder, GroundSamples(), mean_difference, threads=1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a run of all three stages."""
    folder = tmp_path_factory.mktemp("training") / "whole"
    trainer(folder).run()
    return folder


@pytest.fixture(scope="module")
def first_step(tmp_path_factory):
    """The folder of a run that ended after one step; tests copy what they change."""
    folder = tmp_path_factory.mktemp("training") / "first"
    trainer(folder).run(until=1)
    return folder


def assert_same_state(folder, other):
    """Networks, moving averages and moments of two runs, bit for bit."""
    state = [safetensors.torch.load_file(each / CHECKPOINT) for each in (folder, other)]
    assert state[0].keys() == state[1].keys()
    assert all(torch.equal(state[0][name], state[1][name]) for name in state[0])


def test_a_run_goes_on_bit_for_bit_within_a_stage(first_step, tmp_path):
    shutil.copytree(first_step, tmp_path / "cut")
    for name in ("cut", "straight"):
        trainer(tmp_path / name).run(until=2)
    assert_same_state(tmp_path / "cut", tmp_path / "straight")


def test_after_the_first_step_the_average_holds_a_tenth_of_the_random_weights(first_step):
    """The decay at step n is the smaller of the recipe's and (1 + n) / (10 + n)."""
    name = "encoder.vit.blocks.0.attn.qkv.weight"
    saved = safetensors.torch.load_file(first_step / CHECKPOINT)
    random = network.build("tiny", seed=0).state_dict()[name]
    assert not torch.equal(saved[f"model/{name}"], random)
    torch.testing.assert_close(saved[f"average/{name}"], 0.9 * saved[f"model/{name}"] + 0.1 * random)


def test_a_stage_begins_with_moments_of_its_own(whole):
    assert not [name for name in safetensors.torch.load_file(whole / CHECKPOINT) if name.startswith(("count", "exp_"))]


@pytest.mark.slow
def test_a_run_that_was_cut_off_ends_with_the_same_bytes(whole, tmp_path):
    for until in (2, 4, 7, None):
        trainer(tmp_path / "cut").run(until=until)
    assert_same_state(whole, tmp_path / "cut")
    folders = (whole, tmp_path / "cut")
    metadata = [read_metadata(folder / WEIGHTS) for folder in folders]
    assert metadata[0].pop("seconds") and metadata[1].pop("seconds") and metadata[0] == metadata[1]
    # The header has the seconds, with as many digits as they have, and is padded to whole 8 bytes.
    sizes = [(folder / WEIGHTS).stat().st_size for folder in folders]
    assert abs(sizes[0] - sizes[1]) <= 8


def test_a_run_leaves_curves_weights_and_its_recipe(whole):
    with (whole / CURVES).open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == list(range(1, 9))
    assert [row["stage"] for row in rows] == ["context"] * 3 + ["motion"] * 2 + ["gaussians"] * 3
    assert all(float(row["loss"]) > 0 for row in rows) and float(rows[-1]["psnr"]) > 5
    assert json.loads((whole / "recipe.json").read_text())["profile"] == "tiny"
    assert (whole / "samples" / "000008.png").is_file()
    model = network.build("tiny", seed=None)
    load_weights(model, whole / WEIGHTS, "tiny")
    assert (whole / WEIGHTS).stat().st_size < 16 * 2**20
    facts = read_metadata(whole / WEIGHTS)
    assert facts["steps"] == "8" and facts["data"] == "ground" and json.loads(facts["recipe"])["seed"] == 0


@pytest.mark.slow
def test_training_lowers_the_loss(tmp_path):
    stage = {"name": "context", "steps": 30, "trains": ["encoder", "context"], "learning_rate": 2e-3, "warm_up": 3}
    trainer(tmp_path, small_config(stages=[stage])).run()
    with (tmp_path / CURVES).open() as file:
        depth = [float(row["depth"]) for row in csv.DictReader(file)]
    assert sum(depth[-5:]) < 0.75 * sum(depth[:5])


def test_another_recipe_does_not_go_on_in_a_run_folder(first_step):
    with pytest.raises(TrainingError, match="another recipe"):
        trainer(first_step, small_config(seed=1))


def test_a_damaged_checkpoint_is_refused(first_step, tmp_path):
    (tmp_path / CHECKPOINT).write_bytes((first_step / CHECKPOINT).read_bytes()[:1000])
    with pytest.raises(TrainingError, match="damaged"):
        read_position(tmp_path)


def test_training_begins_with_given_weights_and_says_what_does_not_fit(first_step, tmp_path):
    config = small_config(profile="tiny-selective", start=first_step / WEIGHTS)
    begun = trainer(tmp_path / "selective", config)
    given = safetensors.torch.load_file(first_step / WEIGHTS)["encoder.vit.blocks.0.attn.qkv.weight"]
    assert torch.equal(begun.model.encoder.vit.blocks[0].attn.qkv.weight.half(), given)
    with pytest.raises(WeightsError, match="no weights at"):
        trainer(tmp_path / "none", small_config(start=tmp_path / "missing.safetensors"))


def test_the_learning_rate_rises_and_falls():
    stage = Stage(name="a", steps=100, trains=("encoder",), learning_rate=1.0, warm_up=10, final_rate=0.1)
    rates = [learning_rate(stage, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == pytest.approx(1.0) and rates.index(max(rates)) in (9, 10)
    assert rates[-1] == pytest.approx(0.1, abs=0.01) and rates[10:] == sorted(rates[10:], reverse=True)


def test_recipes_are_checked_key_by_key(tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text("profile: tiny\nstages:\n  - {name: a, steps: 1, trains: [encoder], learning_rat: 1}\n")
    with pytest.raises(TrainingError, match=r"stages\.0\.learning_rat: Extra inputs"):
        read_config(path)
    path.write_text("profile: huge\nstages: [{name: a, steps: 1, trains: [encoder]}]\n")
    with pytest.raises(TrainingError, match="no network profile 'huge'; have"):
        read_config(path)
    path.write_text("- 1\n")
    with pytest.raises(TrainingError, match="must hold keys and values"):
        read_config(path)
    with pytest.raises(TrainingError, match="cannot be read"):
        read_config(tmp_path / "none.yaml")
    path.write_text("start: w.safetensors\nstages: [{name: a, steps: 1, trains: [encoder]}]\n")
    assert read_config(path).start == tmp_path / "w.safetensors"


RANK_PROGRAM = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import torch
torch.set_num_threads(1)
from training_samples import GroundSamples, mean_difference, small_config
from nurec_sim.training.processes import Processes
from nurec_sim.training.trainer import Trainer
processes = Processes.from_torchrun()
run = Trainer(small_config(), Path({folder!r}), GroundSamples(), mean_difference, processes, threads=1)
run.run(until=6)
total = sum(float(p.double().sum()) for p in run.model.parameters())
print(f"rank {{processes.rank}} of {{processes.count}}: {{total:.12f}}")
processes.leave()
"""


@pytest.mark.slow
def test_two_processes_keep_the_same_weights_and_one_of_them_writes(tmp_path):
    program = RANK_PROGRAM.format(tests=str(Path(__file__).parents[1] / "helpers"), folder=str(tmp_path / "run"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    common = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", program], env=os.environ | common | {"RANK": str(rank)}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )
        for rank in range(2)
    ]  # fmt: skip
    said = [process.communicate(timeout=300) for process in ranks]
    assert [process.returncode for process in ranks] == [0, 0], said
    totals = [out.split(": ")[1].strip() for out, _ in said]
    assert totals[0] == totals[1]
    assert read_position(tmp_path / "run").step == 6
