"""Policies are found by name, file and entry point; what is no policy is told why."""

import pytest

from nurec_sim import plugins
from nurec_sim.errors import ScenarioError

GOOD = """
from nurec_sim.types import Needs, Plan
class Mine:
    name = "mine"
    needs = Needs()
    def reset(self, rig, seed): pass
    def plan(self, observation): return None
"""


def write(tmp_path, text):
    file = tmp_path / "my_policy.py"
    file.write_text(text, encoding="utf-8")
    return file


def test_shipped_policies_are_available_by_name():
    names = plugins.available_policies()
    assert {"log_replay", "constant_velocity", "route_follower", "camera_road_follower", "lidar_aeb"} <= set(names)
    assert not any(name.startswith("_") for name in names)
    for name in names:
        assert plugins.load_policy(name).name == name
        assert plugins.load_policy(name) is not plugins.load_policy(name)


def test_a_file_gives_its_class(tmp_path):
    file = write(tmp_path, GOOD)
    assert plugins.load_policy(str(file)).name == plugins.load_policy(f"{file}:Mine").name == "mine"
    file = write(tmp_path, GOOD + GOOD.replace("Mine", "Other").replace('"mine"', '"other"'))
    assert plugins.load_policy(f"{file}:Other").name == "other"
    with pytest.raises(ScenarioError, match=r"name one class, as in file.py:Class; have \['Mine', 'Other'\]"):
        plugins.load_policy(str(file))
    with pytest.raises(ScenarioError, match=r"no class 'Nobody' in the file; have \['Mine', 'Other'\]"):
        plugins.load_policy(f"{file}:Nobody")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import nowhere_at_all", "cannot be imported: ModuleNotFoundError"),
        ("raise SystemExit(0)", "cannot be imported: SystemExit: 0"),
        (GOOD.replace("name = ", "def __init__(self): exit()\n    name = "), "cannot be made: SystemExit"),
        (GOOD.replace("needs = Needs()", ""), r"is not a policy: it lacks needs \(nurec_sim.types.Needs\)"),
        (GOOD.replace("def reset(self, rig, seed): pass", ""), "it lacks reset"),
        (GOOD.replace("name = ", "def __init__(self): 1 / 0\n    name = "), "cannot be made: ZeroDivisionError"),
    ],
)
def test_faults_of_a_file_are_told(tmp_path, text, said):
    with pytest.raises(ScenarioError, match=said):
        plugins.load_policy(str(write(tmp_path, text)))


def test_unknown_names_list_what_there_is():
    with pytest.raises(
        ScenarioError, match=r"unknown policy 'log_reply'; have \['camera_road_follower'.*my_policy.py:Class"
    ):
        plugins.load_policy("log_reply")
    with pytest.raises(ScenarioError, match=r"policy file 'nowhere.py' does not exist"):
        plugins.load_policy("nowhere.py:Mine")
    with pytest.raises(ScenarioError, match=r"a class can be named only after a file"):
        plugins.load_policy("log_replay:LogReplay")


def test_installed_packages_offer_policies(monkeypatch, tmp_path):
    class Installed:
        name = "installed"
        needs = plugins.Needs()

        def reset(self, rig, seed): ...

        def plan(self, observation): ...

    class Point:
        name = "installed"

        def load(self):
            return Installed

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point()] if group == "nurec_sim.policies" else [])
    assert "installed" in plugins.available_policies()
    assert isinstance(plugins.load_policy("installed"), Installed)
