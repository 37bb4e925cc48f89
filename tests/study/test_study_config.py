"""Study files: what is read, and what a wrong one is told."""

import pytest
import yaml

from nurec_sim.errors import RunError, ScenarioError
from nurec_sim.plugins import available_policies
from nurec_sim.study import load_study, make_study, shipped_studies

LEAST = {"name": "mine", "families": [{"name": "bend", "seeds": [3, 8]}], "policies": ["blind_route", "lidar_aeb"]}


def test_bundled_studies_load_and_name_known_policies():
    assert {"smoke", "evening", "nightly"} <= set(shipped_studies())
    for name in shipped_studies():
        study = load_study(name)
        assert study.name == name and set(study.policies) <= set(available_policies())


def test_nightly_is_24_scenes_10_policies_3_worlds_2_trials():
    study = load_study("nightly")
    assert (len(study.scenes), len(study.policies), len(study.worlds), study.trials) == (24, 10, 3, 2)


def test_a_study_counts_its_rollouts_and_names_its_scenes(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(LEAST | {"trials": 3, "controls": {"of": "lift", "how": ["faint"]}}))
    study = load_study(file)
    assert study.all_worlds == ("truth", "lift", "lift-faint")
    assert [scene_id for scene_id, _, _ in study.scenes] == ["bend-3", "bend-8"]
    assert study.rollouts == 2 * 3 * 2 * 3


def test_scenario_files_are_found_beside_the_study_file(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies" / "slow.yaml").write_text("name: slow\nduration_s: 4.0\n")
    file = tmp_path / "studies" / "mine.yaml"
    family = {"name": "bend", "seeds": [3], "scenario": "slow.yaml"}
    file.write_text(yaml.safe_dump(LEAST | {"families": [family]}))
    monkeypatch.chdir(tmp_path)
    assert load_study(file).families[0].scenario == str(tmp_path / "studies" / "slow.yaml")
    monkeypatch.chdir(tmp_path / "studies")
    assert load_study("mine.yaml").families[0].scenario == "slow.yaml"
    file.write_text(yaml.safe_dump(LEAST | {"families": [family | {"scenario": "fast.yaml"}]}))
    with pytest.raises(ScenarioError, match="family 'bend': scenario file 'fast.yaml' does not exist"):
        load_study(file)


def test_no_two_towns_share_seeds_and_more_trials_keep_the_first():
    one, three = (make_study(LEAST | {"trials": trials}) for trials in (1, 3))
    assert three.seeds(3) == (3000, 3001, 3002) and one.seeds(3) == (3000,)
    assert not set(three.seeds(3)) & set(three.seeds(8))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"trails": 2}, "unknown key 'trails'"),
        ({"policies": ["blind_route"]}, "key 'policies': Tuple should have at least 2 items"),
        ({"worlds": ["lift", "truth"]}, "worlds must be different, the first one 'truth', got ['lift', 'truth']"),
        ({"controls": {"how": ["blurred"]}}, "controls must be different ones of ['empty_road', 'faint', 'no_sky',"),
        ({"controls": {"of": "dense", "how": ["faint"]}}, "controls are of 'dense', which is none of ['lift']"),
        ({"families": [{"name": "a", "seeds": [1, 1]}]}, "key 'families.0.seeds': seeds must differ"),
        ({"families": [LEAST["families"][0]] * 2}, "families need names of their own, got ['bend', 'bend']"),
        ({"recording": {"seconds": 100}}, "key 'recording.seconds': should be less than or equal to 30, got 100"),
        ({"name": "a/b"}, "key 'name': String should match pattern"),
    ],
)
def test_a_wrong_key_is_named(change, said):
    with pytest.raises(RunError) as error:
        make_study(LEAST | change, "study file 'x.yaml'")
    assert str(error.value).startswith("study file 'x.yaml': ") and said in str(error.value)


def test_a_folder_does_not_hide_a_bundled_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "smoke").mkdir()
    assert load_study("smoke").name == "smoke"


def test_files_that_are_no_study(tmp_path):
    with pytest.raises(RunError, match="no study named 'smok'; have \\['evening', 'nightly', 'smoke'\\]"):
        load_study("smok")
    with pytest.raises(RunError, match="cannot be read"):
        load_study(tmp_path / "none.yaml")
    file = tmp_path / "list.yaml"
    file.write_text("- a\n")
    with pytest.raises(RunError, match="must hold keys and values, got list"):
        load_study(file)
    with pytest.raises(ScenarioError, match="family 'a': no scenario named 'shrt'"):
        make_study(LEAST | {"families": [{"name": "a", "seeds": [1], "scenario": "shrt"}]})
