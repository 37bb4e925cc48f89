"""The ablations: what each takes away from a recipe, what they share when trained, and how their table is made."""

import json
import sys
from pathlib import Path
from typing import get_args

import pytest
from training_samples import GroundSamples, small_config

from nurec_sim.cli import training
from nurec_sim.errors import TrainingError
from nurec_sim.network.checkpoints.state_dicts import load_state_dict
from nurec_sim.network.profiles import PROFILES
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.training.ablations import ABLATIONS, DEPTH_LOSSES, SKY_MLP_PROFILES, ablated, scaled
from nurec_sim.training.config import LossWeights
from nurec_sim.training.data.samples import TownSamples

CONFIG = small_config()


@pytest.fixture(scope="module")
def script():
    folder = str(Path(__file__).parents[2] / "benchmarks")
    sys.path.insert(0, folder)
    try:
        import ablations

        yield ablations
    finally:
        sys.path.remove(folder)


# --- recipes


def test_the_rows_are_those_of_the_papers_table():
    assert list(ABLATIONS) == ["full", "single_stage", "sky_mlp", "no_perceptual", "no_depth_loss", "concatenation"]
    full = ABLATIONS["full"].paper
    assert (full.psnr_db, full.ssim, full.abs_rel, full.delta1) == (29.93, 0.793, 0.069, 0.950)
    # The last one is of the LiDAR branch, whose rows are in Table 3.
    assert get_args(training.AblationName) == (*ABLATIONS, "no_scale_floor")
    assert all(row.paper.psnr_db < full.psnr_db and row.paper.ssim < full.ssim for row in list(ABLATIONS.values())[1:])


def test_each_takes_away_one_thing():
    assert ablated(CONFIG, "full") == ablated(CONFIG, "concatenation") == CONFIG
    assert {name: row.merge for name, row in ABLATIONS.items() if row.merge != "ownership"} == {
        "concatenation": "concatenate"
    }
    sky = ablated(CONFIG, "sky_mlp")
    assert sky.profile == "tiny-sky-mlp" and sky.model_copy(update={"profile": "tiny"}) == CONFIG
    silent = ablated(CONFIG, "no_perceptual").stages
    assert silent[:2] == CONFIG.stages[:2]  # nothing is rendered there
    assert silent[2].losses == CONFIG.stages[2].losses.model_copy(update={"perceptual": 0.0})
    for stage, before in zip(ablated(CONFIG, "no_depth_loss").stages, CONFIG.stages, strict=True):
        gone = {"depth", "edges", "rendered_depth"} if stage.targets else {"depth", "edges"}
        assert set(DEPTH_LOSSES) >= gone
        for loss in LossWeights.model_fields:
            assert getattr(stage.losses, loss) == (0.0 if loss in gone else getattr(before.losses, loss))
        assert stage.model_copy(update={"losses": before.losses}) == before


def test_profiles_with_a_sky_mlp_differ_in_nothing_else():
    for name, twin in SKY_MLP_PROFILES.items():
        ours, theirs = PROFILES[name], PROFILES[twin]
        differing = {field for field in vars(ours) if getattr(ours, field) != getattr(theirs, field)}
        assert differing == {"name", "sky"} and theirs.sky.kind == "mlp"
        assert theirs.sky.cubemap_px == ours.sky.cubemap_px


def test_one_stage_trains_everything_at_once_for_as_many_steps():
    stages = [stage.model_dump() for stage in CONFIG.stages]
    stages[0]["losses"]["depth"] = 0.7
    stages[2]["losses"]["depth"] = 0.1  # no longer applies first
    stages[1]["losses"]["motion"] = 0.4
    stages[2]["losses"]["perceptual"] = 0.9
    stages[2]["pixels"] = 20_000
    joint = ablated(small_config(stages=stages), "single_stage").stages
    assert len(joint) == 1 and joint[0].steps == CONFIG.steps and joint[0].targets == 1
    assert set(joint[0].trains) == {"encoder", "context", "motion", "sky", "gaussians", "isp"}
    assert (joint[0].losses.depth, joint[0].losses.motion, joint[0].losses.perceptual) == (0.7, 0.4, 0.9)
    assert joint[0].pixels == 20_000 and joint[0].warm_up == CONFIG.stages[0].warm_up


def test_what_cannot_be_taken_away_is_said():
    with pytest.raises(TrainingError, match=r"no ablation 'no_sky'; have \['full', 'single_stage'"):
        ablated(CONFIG, "no_sky")
    joint = ablated(CONFIG, "single_stage")
    with pytest.raises(TrainingError, match="the recipe already trains without what 'single_stage' takes away"):
        ablated(joint, "single_stage")
    with pytest.raises(TrainingError, match="profile 'pa-full' has no twin with a sky MLP; have .*tiny-sky-mlp"):
        ablated(small_config(profile="pa-full"), "sky_mlp")


def test_a_budget_is_shared_out_as_in_the_recipe():
    long = CONFIG.model_copy(
        update={
            "stages": tuple(
                stage.model_copy(update={"steps": steps, "warm_up": 10, "pixels": 40_000})
                for stage, steps in zip(CONFIG.stages, (600, 300, 100), strict=True)
            )
        }
    )
    short = scaled(long, 100, 16_000)
    assert [stage.steps for stage in short.stages] == [60, 30, 10]
    assert [stage.warm_up for stage in short.stages] == [1, 1, 1] and short.stages[0].pixels == 16_000
    assert [stage.steps for stage in scaled(long, 3, 784).stages] == [1, 1, 1]
    assert [stage.warm_up for stage in scaled(long, 3, 784).stages] == [0, 0, 0]
    assert sum(stage.steps for stage in scaled(long, 7, 784).stages) == 7
    assert scaled(long, 100, 99_000).stages[0].pixels == 40_000
    with pytest.raises(TrainingError, match="3 stages need at least as many steps, got 2"):
        scaled(long, 2, 784)


# --- training


def test_variants_share_what_they_have_in_common(script, tmp_path):
    runs = {name: script.stage_runs(ablated(CONFIG, name), tmp_path) for name in ABLATIONS if name != "single_stage"}
    folders = {name: [folder for folder, _ in each] for name, each in runs.items()}
    assert folders["full"] == folders["concatenation"] and len(set(folders["full"])) == 3
    assert folders["no_perceptual"][:2] == folders["full"][:2] and folders["no_perceptual"][2] != folders["full"][2]
    assert not set(folders["sky_mlp"]) & set(folders["full"])
    assert not set(folders["no_depth_loss"]) & set(folders["full"])
    for folder, recipe in runs["full"][1:]:
        assert recipe.start.parent in folders["full"] and recipe.start.parent != folder
    again = script.stage_runs(CONFIG.model_copy(update={"seed": 1}), tmp_path)
    assert not {folder for folder, _ in again} & set(folders["full"])


@pytest.mark.slow
def test_finished_runs_are_not_trained_again(script, tmp_path):
    stages = [stage.model_dump() | {"steps": 1, "warm_up": 0} for stage in (CONFIG.stages[0], CONFIG.stages[2])]
    config, options = small_config(stages=stages), script.Options(out=tmp_path, threads=1)
    said = []
    train = lambda name: script.train(ablated(config, name), options, GroundSamples(), lambda *a: said.append(a[0]))  # noqa: E731
    full = train("full")
    assert [line.split()[0] for line in said] == ["waiting", "context", "waiting", "gaussians"]
    written = full.stat().st_mtime_ns
    assert train("concatenation") == full == train("full")
    assert len(said) == 4 and full.stat().st_mtime_ns == written
    other = train("no_perceptual")
    # They share the first stage.
    assert other != full and [line.split()[0] for line in said[4:]] == ["waiting", "gaussians"]
    full_state, other_state = load_state_dict(full), load_state_dict(other)
    assert any((full_state[name] != other_state[name]).any() for name in full_state)
    contender = script.contender("concatenation", full, options)
    assert contender.settings == FeedForwardSettings(
        "tiny", full, frames=4, image_pixels=options.pixels, max_chunks=100, merge="concatenate"
    )


def test_clips_that_nobody_draws_are_not_waited_for(script, tmp_path):
    options = script.Options(out=tmp_path, training_clips=2)
    with (
        TownSamples(script.budget(options), tmp_path / "clips", generators=0) as samples,
        pytest.raises(TrainingError, match="holds 0 clips, and 2 are needed; give --generators 1 or more"),
    ):
        script.train(CONFIG.model_copy(update={"data": script.budget(options).data}), options, samples, lambda *a: None)
    assert not (tmp_path / "runs").exists()


def test_the_benchmarks_own_recipe_can_be_trained_without_each_thing(script):
    config = script.budget(script.Options())
    assert config.data.refresh is False and [stage.name for stage in config.stages] == [
        "context",
        "motion",
        "gaussians",
    ]
    changed = [ablated(config, name) for name in ABLATIONS if name not in ("full", "concatenation")]
    assert len({each.digest() for each in (config, *changed)}) == 5
    assert {each.steps for each in changed} == {config.steps}
    assert script.budget(script.Options(steps=30)).steps == 30


# --- table


def window(**psnr):
    """One world: per variant the PSNR of its views; the other figures follow from it."""
    return {
        "methods": {
            name: {
                "targets": [
                    {"full": {"psnr_db": db, "ssim": db / 40, "abs_rel": 2 / db, "delta1": None}} for db in values
                ]
            }
            for name, values in psnr.items()
        }
    }


def test_rows_compare_with_the_full_training_world_by_world(script):
    worlds = [
        window(full=[20, 22], sky_mlp=[18, 20]),
        window(full=[30], sky_mlp=[28.5]),
        window(full=[10], sky_mlp=[9]),
    ]
    worlds.append({"methods": {"full": worlds[0]["methods"]["full"], "sky_mlp": {"error": "no Gaussians"}}})
    full, sky = script.rows_of(worlds, ["full", "sky_mlp"])
    assert full["differences"] == {} and full["psnr_db"] == pytest.approx((21 + 30 + 10 + 21) / 4)
    difference = sky["differences"]["psnr_db"]
    assert difference["ours"] == pytest.approx(-1.5)  # of the three worlds that both have
    assert difference["paper"] == -3.2 and -2 <= difference["interval"][0] <= -1.5 <= difference["interval"][1] <= -1
    assert sky["differences"]["delta1"]["ours"] is None
    table = script.table_of([full, sky])
    text = table.markdown()
    assert "| sky MLP instead of cubemap | 18.83 | -1.50 (-3.20) ✓ |" in text and "- (+0.000)" in text
    assert json.loads(json.dumps([full, sky])) == [full, sky]


@pytest.mark.parametrize(
    ("ours", "interval", "paper", "said"),
    [
        (-0.4, [-0.6, -0.2], -2.28, "-0.40 (-2.28) ✓"),
        (0.4, None, -2.28, "+0.40 (-2.28) ✗"),
        (-0.4, [-0.9, 0.1], -2.28, "-0.40 (-2.28) ?"),
        (0.001, None, -2.28, "+0.00 (-2.28) ?"),
        (0.4, None, 0.0, "+0.40 (+0.00) ?"),
    ],
)
def test_signs_are_told_only_where_they_are_clear(script, ours, interval, paper, said):
    assert script.verdict({"ours": ours, "interval": interval, "paper": paper}, 2) == said
