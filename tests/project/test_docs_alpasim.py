"""docs/alpasim.md: its files agree with each other, with the demo log and with the commands beside them."""

import re
import shlex
from importlib.resources import files
from pathlib import Path

import pytest
import yaml

from nurec_sim import cli
from nurec_sim.logs import open_clip
from nurec_sim.plugins import load_policy

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "alpasim.md").read_text()
BLOCKS = re.findall(r"```yaml\n# alpasim/(\S+)\n(.*?)```", PAGE, re.DOTALL)
CONFIG = {name: yaml.safe_load(text) for name, text in BLOCKS}
COMMANDS = [
    shlex.split(line)
    for block in re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("nurec-sim ")
]
SERVICES = {"renderer", "driver", "controller", "physics", "trafficsim"}


@pytest.fixture(scope="module")
def clip():
    return open_clip(Path(str(files("nurec_sim.scenarios") / "demo_clip.zip")))


def flag(command, name):
    """The value of a flag, as ``--flag value`` or ``--flag=value``."""
    found = [word.partition("=")[2] or command[i + 1] for i, word in enumerate(command) if word.split("=")[0] == name]
    return found[0]


def test_the_page_has_all_files():
    assert set(CONFIG) == {"user.yaml", "network.yaml", "eval.yaml", "log/run_metadata.yaml"}
    assert set(CONFIG["log/run_metadata.yaml"]) == {"run_uuid", "run_name"}
    (run,) = [line for line in PAGE.splitlines() if line.startswith("python -m alpasim_runtime")]
    words = shlex.split(run)
    assert [flag(words, f"--{part}-config") for part in ("user", "network", "eval")] == [
        name for name in CONFIG if "/" not in name
    ]
    assert flag(words, "--log-dir") == "log"


def test_services_are_skipped_or_have_an_endpoint():
    endpoints, network = CONFIG["user.yaml"]["endpoints"], CONFIG["network.yaml"]
    assert set(network) == SERVICES <= set(endpoints)
    for name in SERVICES:
        used = not endpoints[name]["skip"]
        assert bool(network[name]["endpoints"]) == used == (endpoints[name]["n_concurrent_rollouts"] > 0)
    assert endpoints["physics"]["skip"] == (CONFIG["user.yaml"]["simulation_config"]["physics_update_mode"] == "NONE")


@pytest.mark.parametrize(("service", "verb"), [("renderer", "serve-grpc"), ("driver", "drive-grpc")])
def test_addresses_are_those_of_our_servers(service, verb):
    (command,) = [words for words in COMMANDS if words[1] == verb]
    (endpoint,) = CONFIG["network.yaml"][service]["endpoints"]
    assert endpoint == {"address": f"{flag(command, '--host')}:{flag(command, '--port')}", "managed": False}


def test_scene_cameras_and_times_are_those_of_the_demo_log(clip):
    user = CONFIG["user.yaml"]
    assert [scene["scene_id"] for scene in user["scenes"]] == [f"clipgt-{clip.id}"]
    simulation = user["simulation_config"]
    for camera in simulation["cameras"]:
        model = clip.rig.cameras[camera["logical_id"]]
        assert (camera["width"], camera["height"]) == (model.width_px, model.height_px)
    assert CONFIG["eval.yaml"]["scorers"]["image"]["camera_logical_id"] in clip.rig.cameras
    step_us, force_us = simulation["control_timestep_us"], simulation["force_gt_duration_us"]
    assert force_us % step_us == 0 and force_us < simulation["n_sim_steps"] * step_us
    assert 1_050_001 + simulation["n_sim_steps"] * step_us < clip.span_us[1]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[1])
def test_our_commands_have_these_flags(command, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([command[1], "--help"])
    assert ended.value.code == 0
    known = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    assert {word.split("=")[0] for word in command[2:] if word.startswith("--")} <= known


@pytest.mark.parametrize("path", [DOCS / "alpasim.md", DOCS / "egodriver.md", DOCS / "commands.md"], ids=str)
def test_policies_that_are_served_to_alpasim_can_drive_it(path):
    served = re.findall(r"^nurec-sim drive-grpc (\w+)", path.read_text(), re.MULTILINE)
    assert served
    for name in served:
        needs = load_policy(name).needs
        assert not needs.privileged and not needs.lidars, f"AlpaSim sends {name} neither actors nor sweeps"
