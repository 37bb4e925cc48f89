"""Policies are found by name, file and entry point; what is no policy is told why."""

import pytest

from nurec_sim import plugins
from nurec_sim.errors import ClipError, ReconstructError, ScenarioError

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
    with pytest.raises(ScenarioError, match=r"unknown policy 'log_reply'; have \['blind_route'.*my_policy.py:Class"):
        plugins.load_policy("log_reply")
    with pytest.raises(ScenarioError, match=r"policy file 'nowhere.py' does not exist"):
        plugins.load_policy("nowhere.py:Mine")
    with pytest.raises(ScenarioError, match=r"'log_replay:LogReplay' cannot be imported: ModuleNotFoundError"):
        plugins.load_policy("log_replay:LogReplay")
    with pytest.raises(
        ReconstructError, match=r"unknown reconstruction method 'lyft'; have .*'lift'.*my_method.py:Class"
    ):
        plugins.load(plugins.METHODS, "lyft")


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


KINDS = [plugins.POLICIES, plugins.LOG_READERS, plugins.METHODS]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.noun)
def test_shipped_plugins_of_every_kind_are_found_and_are_what_they_must_be(kind):
    names = plugins.available(kind)
    assert names and [name for name, _ in plugins.load_all(kind)] == names
    for name in names:
        assert plugins.lacking(kind, plugins.load(kind, name)) == []


def test_an_importable_class_is_loaded_by_module_and_name():
    assert plugins.load_policy("nurec_sim.policies.log_replay:LogReplay").name == "log_replay"
    assert plugins.load(plugins.METHODS, "nurec_sim.reconstruct.methods.lift:Lift").name == "lift"
    with pytest.raises(ClipError, match=r"log reader 'json:JSONDecoder' is not a log reader: it lacks can_open, open"):
        plugins.load(plugins.LOG_READERS, "json:JSONDecoder")


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.noun)
def test_a_broken_plugin_is_reported_by_name_and_the_others_work(kind, monkeypatch):
    class Broken:
        name = "broken"

        def load(self):
            raise ImportError("no module named sdk")

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Broken()] if group == kind.group else [])
    found = dict(plugins.load_all(kind))
    assert isinstance(found.pop("broken"), kind.error) and found
    assert not any(isinstance(each, Exception) for each in found.values())
    with pytest.raises(kind.error, match=f"{kind.noun} 'broken' is installed but cannot be imported: ImportError"):
        plugins.load(kind, "broken")
