"""Scenario files: what is read, and what a wrong one is told."""

import pytest

from nurec_sim.errors import ScenarioError
from nurec_sim.plugins import available_policies
from nurec_sim.sim import Scenario, load_scenario, make_scenario, shipped_scenarios


def write(tmp_path, text):
    file = tmp_path / "mine.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_shipped_scenarios_load_and_name_known_policies():
    assert {"demo", "short"} <= set(shipped_scenarios())
    for name in shipped_scenarios():
        scenario = load_scenario(name)
        assert scenario.name == name and set(scenario.policies) <= set(available_policies())
    assert load_scenario("demo").policies == tuple(
        ["log_replay", "constant_velocity", "route_follower", "camera_road_follower", "lidar_aeb", "e2e_1cam"]
    )


def test_a_file_of_one_key_has_all_defaults(tmp_path):
    scenario = load_scenario(write(tmp_path, "name: tiny\n"))
    assert scenario == Scenario(name="tiny")
    assert (scenario.duration_s, scenario.replan_s, scenario.controller, scenario.seeds) == (
        20.0,
        0.5,
        "pursuit_pi",
        (0,),
    )


def test_a_scenario_survives_writing_and_reading():
    scenario = make_scenario({"name": "a", "actors": {"7": {"shift_m": [1.0, 0.5], "delay_s": 0.2}}, "seeds": [3, 4]})
    assert make_scenario(scenario.model_dump(mode="json")) == scenario


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: a\nduraton_s: 3\n", "unknown key 'duraton_s'; allowed: actors, added_actors, clip, controller"),
        ("name: a\nsensors: {fps: 3}\n", "unknown key 'sensors.fps'; allowed: image_width_px, interval_s"),
        ("name: a\nactors: {'7': {jump: 1}}\n", "unknown key 'actors.7.jump'; allowed: brake, delay_s, hide, shift_m"),
        (
            "name: a\nactors: {lead: {brake: {at: 1}}}\n",
            "unknown key 'actors.lead.brake.at'; allowed: at_s, decel_mps2",
        ),
        ("duration_s: 3\n", "key 'name' is missing"),
        ("name: a\nduration_s: 30\n", "key 'duration_s': should be less than or equal to 20, got 30"),
        ("name: a\nduration_s: 1.234\n", "key 'duration_s': must be a multiple of 0.1 s, got 1.234"),
        ("name: a\nreplan_s: .nan\n", "key 'replan_s'"),
        ("name: a\ncontroller: mpc\n", "key 'controller': should be 'pursuit_pi' or 'perfect', got 'mpc'"),
        ("name: a\nseeds: [1, 1]\n", "seeds must differ"),
        ("name: a\nseeds: []\n", "key 'seeds'"),
        ("name: a b\n", "key 'name'"),
        ("- a\n", "must hold keys and values, got list"),
        ("a: [\n", "is not YAML"),
    ],
)
def test_faults_are_named_with_file_and_key(tmp_path, text, said):
    file = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(file)
    assert said in str(caught.value) and str(file) in str(caught.value)


def test_missing_files_and_names():
    with pytest.raises(ScenarioError, match=r"scenario file 'nowhere.yaml' does not exist"):
        load_scenario("nowhere.yaml")
    with pytest.raises(
        ScenarioError, match=r"no scenario named 'nowhere'; have \['cut_in', 'demo', 'hard_brake', 'pedestrian'"
    ):
        load_scenario("nowhere")
