"""Imitation: drives of a town, what the network sees of them, and a run that resumes to the same bytes."""

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from nurec_sim import geometry
from nurec_sim.errors import TrainingError
from nurec_sim.plugins import load_policy
from nurec_sim.training.imitation import drives as made
from nurec_sim.training.imitation.config import ImitationConfig, is_imitation_recipe, read_imitation_config
from nurec_sim.training.imitation.drives import AFTER_S, PATH_M, SIZE_PX, VIEWS, Drives, drive_names, read_drives
from nurec_sim.training.imitation.examples import Examples, varied
from nurec_sim.training.imitation.network import DrivingNetwork
from nurec_sim.training.imitation.trainer import ImitationTrainer
from nurec_sim.types import CameraFrame, CameraModel, Pinhole

CONFIG = ImitationConfig(
    policies=("e2e_1cam", "e2e_2cam"), steps=2, batch=4, warm_up=1, checkpoint_every=1, log_every=1, held_out=2,
    data={"towns": 2, "places": 2, "answers": 2},
)  # fmt: skip
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def drawn(seed: int) -> Drives:
    """Drives as a town gives them, with images of noise: straight on, the expert brakes in the first place only."""
    rng = np.random.default_rng(seed)
    images = rng.integers(1, 256, (2, len(VIEWS), SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    mounts = [geometry.pose(geometry.rotation_from_yaw(np.deg2rad(yaw)) @ FORWARD, np.array([1.5, 0, 1.5]))
              for yaw, _ in VIEWS.values()]  # fmt: skip
    route = np.broadcast_to(np.column_stack([4.0 * np.arange(1, 21), np.zeros(20)]), (2, 2, 20, 2))
    path = np.broadcast_to(np.column_stack([PATH_M, np.zeros(len(PATH_M))]), (2, 2, len(PATH_M), 2))
    later = np.array([[[4.0, 3, 2, 1, 0]] * 2, [[8.0] * 5] * 2])
    single = [np.array(value, np.float32) for value in
              (np.zeros((2, 2)), np.full((2, 2), 8.0), route, np.full((2, 2, 20), 9.0), path, later)]  # fmt: skip
    return Drives(images, np.array(mounts), *single)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    for seed, name in enumerate(drive_names(CONFIG.data)):
        made._write(folder / name, drawn(seed))
    return folder


def test_the_network_is_the_same_in_numpy_and_in_torch():
    policy = load_policy("e2e_2cam")
    network = DrivingNetwork(policy.shapes(), seed=1).eval()
    assert {name: tuple(value.shape) for name, value in network.state_dict().items()} == policy.shapes()
    rng = np.random.default_rng(2)
    images, numbers = rng.integers(0, 256, (2, 64, 128, 3), np.uint8), rng.standard_normal(12).astype(np.float32)
    with torch.no_grad():
        for bias in (p for name, p in network.named_parameters() if name.endswith("bias")):
            bias.uniform_(-0.1, 0.1)
        wanted = network(torch.from_numpy(images)[None], torch.from_numpy(numbers)[None])[0].numpy()
    policy.weights = {name: value.numpy() for name, value in network.state_dict().items()}
    np.testing.assert_allclose(policy.outputs(images, numbers), wanted, atol=1e-5)
    assert np.abs(wanted).max() > 0.05


def test_views_are_turned_as_the_rig_is():
    """A dot on the ground 10 m ahead and 1 m left of the camera, found where a pinhole by hand has it."""
    policy = load_policy("e2e_1cam")
    camera = CameraModel("front", 200, 120, Pinhole(100.0, 100.0, 100.0, 40.0),
                         geometry.pose(FORWARD, np.array([1.5, 0, 1.5])))  # fmt: skip
    rgb = np.full((120, 200, 3), 10, np.uint8)
    rgb[54:57, 89:92] = 250  # u = 100 - 100 * 1 / 10 = 90, v = 40 + 100 * 1.5 / 10 = 55
    frame = CameraFrame(camera, 0, 1, rgb)

    def dot(turn_deg):
        view = policy.view(frame, "front", np.deg2rad(turn_deg)).astype(np.float64)[..., 0]
        rows, columns = np.nonzero(view > 100)
        return np.array([columns.mean(), rows.mean()]) + 0.5

    # Focal length 76, centre (64, 24): u = 64 - 7.6, v = 24 + 11.4.
    np.testing.assert_allclose(dot(0), [56.4, 35.4], atol=0.7)
    # Turned left by atan(1 / 10) it is straight ahead, at distance sqrt(101).
    np.testing.assert_allclose(dot(np.degrees(np.arctan(0.1))), [64.0, 24 + 76 * 1.5 / np.sqrt(101)], atol=0.7)


def test_targets_mean_what_the_policy_drives():
    policy = load_policy("e2e_1cam")
    path = np.column_stack([PATH_M * 0.9, 0.1 * PATH_M])
    again, speeds = policy.answer(policy.targets(path, AFTER_S))
    np.testing.assert_allclose(again, path)
    np.testing.assert_allclose(speeds, AFTER_S)


def test_batches_hold_what_the_drives_say(folder):
    towns = [read_drives(folder / name) for name in drive_names(CONFIG.data)]
    examples = Examples(towns, load_policy("e2e_2cam"), lambda share: None)
    assert examples.images.shape == (8, 2, 64, 128, 3) and examples.brakes.tolist() == [0, 1, 4, 5]
    batch = examples.measuring(8)
    # Speed 8 of 10 m/s, speed limit 9, a straight route and path.
    np.testing.assert_allclose(batch.numbers[0], [0.8, 0.9] + [0.0] * 10, atol=1e-6)
    np.testing.assert_allclose(batch.targets[2], [0.0] * 12 + [0.8] * 5, atol=1e-6)
    noisy = examples.training(CONFIG, 3)
    again = examples.training(CONFIG, 3)
    assert all(np.array_equal(getattr(noisy, name), getattr(again, name)) for name in ("images", "numbers", "targets"))
    assert np.abs(noisy.numbers[:, 3::2]).max() > 0.01  # the route is wrong, the answers are not
    assert np.abs(noisy.targets[:, :12]).max() == 0
    unseen = varied(np.zeros((1, 4, 4, 3), np.uint8), np.random.default_rng(0))
    assert not unseen.any()


def test_a_run_resumes_to_the_same_bytes(folder, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    files = ImitationTrainer(CONFIG, whole, folder).run()
    assert [path.name for path in files] == ["e2e_1cam.safetensors", "e2e_2cam.safetensors"]
    for until in (1, 3, None):
        ImitationTrainer(CONFIG, parts, folder).run(until=until)
    for path in files:
        assert path.read_bytes() == (parts / path.name).read_bytes()
    strip = [[line.split(",")[:2], line.split(",")[3:]] for line in (whole / "curves.csv").read_text().splitlines()]
    again = [[line.split(",")[:2], line.split(",")[3:]] for line in (parts / "curves.csv").read_text().splitlines()]
    assert strip == again and len(strip) == 5
    first, second = (load_file(path) for path in files)
    assert np.abs(first["camera.weight"].astype(np.float64) - second["camera.weight"]).max() < 0.02  # started from it
    with pytest.raises(TrainingError, match="holds a run of another recipe"):
        ImitationTrainer(CONFIG.model_copy(update={"seed": 1}), whole, folder)


def test_recipes_are_checked(tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("profile: imitation\nstepps: 3\n")
    assert is_imitation_recipe(recipe) and not is_imitation_recipe(tmp_path / "none.yaml")
    with pytest.raises(TrainingError, match="stepps.*a recipe has the keys profile, policies, seed"):
        read_imitation_config(recipe)
    with pytest.raises(TrainingError, match="policy 'blind_route' has no network to train"):
        ImitationTrainer(CONFIG.model_copy(update={"policies": ("blind_route",)}), tmp_path, tmp_path)
    (tmp_path / "damaged.npz").write_bytes(b"no")
    with pytest.raises(TrainingError, match="damaged.npz is damaged.*delete it, and it is generated again"):
        read_drives(tmp_path / "damaged.npz")


@pytest.mark.slow
def test_a_town_gives_answers_that_recover():
    """Left of its path the expert steers right, and it brakes for a vehicle that stands in its way."""
    town = made.town_drives(CONFIG.data.model_copy(update={"places": 6, "blocked": 1.0, "answers": 4}), 3, "rays")
    assert town.images.shape == (6, 4, 100, 220, 3) and np.isfinite(town.path_m).all()
    near = np.isfinite(town.route_speed_mps[..., 0])
    beside, steered = town.route_m[..., 0, 1][near], town.path_m[..., 2, 1][near]
    assert np.corrcoef(beside, steered)[0, 1] > 0.7
    assert (town.later_mps[..., 3] < 0.6 * town.speed_mps).any()
