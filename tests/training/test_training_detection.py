"""The detector's training: images of a town, mirrored samples, thresholds, and a run that resumes to the same bytes."""

import json

import numpy as np
import pytest
import torch

from nurec_sim.errors import TrainingError
from nurec_sim.network.checkpoints.state_dicts import read_metadata
from nurec_sim.network.detector.codec import Detections
from nurec_sim.network.detector.detector import Detector
from nurec_sim.network.detector.model import DetectorNetwork
from nurec_sim.network.detector.objects import FOCAL_PX, Labelled
from nurec_sim.training.detection import images as made
from nurec_sim.training.detection.config import DetectorConfig, SceneSettings, is_detector_recipe, read_detector_config
from nurec_sim.training.detection.examples import CROP_PX, Examples, mirrored
from nurec_sim.training.detection.images import SIZE_PX, TownImages, image_files, read_images
from nurec_sim.training.detection.trainer import DetectorTrainer, _best, best_scores, detection_loss
from nurec_sim.types import Pinhole

CONFIG = DetectorConfig(
    steps=2, batch=2, warm_up=1, checkpoint_every=1, log_every=1, held_out=2, data={"towns": 2, "images": 2}
)


def drawn(seed: int) -> TownImages:
    """Images of noise with one car each, 12 m ahead and to the right."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (2, SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    objects = Labelled(
        np.zeros(2, np.int64), np.array([[2.0, 1.0, 12.0]] * 2), np.array([[4.5, 1.8, 1.5]] * 2), np.array([0.4] * 2),
        np.full(2, 900.0), np.full(2, 600.0), np.ones(2, bool), FOCAL_PX,
    )  # fmt: skip
    return TownImages(images, np.ones(2, np.int64), objects)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    for seed, name in enumerate(image_files(CONFIG.data)):
        made._write(folder / name, drawn(seed))
    return folder


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    run = tmp_path_factory.mktemp("run")
    DetectorTrainer(CONFIG, run, folder).run()
    return run


def test_a_run_that_is_interrupted_ends_with_the_same_bytes(folder, run, tmp_path):
    DetectorTrainer(CONFIG, tmp_path, folder).run(until=1)
    DetectorTrainer(CONFIG, tmp_path, folder).run()
    assert (tmp_path / "detector.safetensors").read_bytes() == (run / "detector.safetensors").read_bytes()
    rows = (run / "curves.csv").read_text().splitlines()
    assert len(rows) == 3 and rows[0].startswith("step,") and rows[2].startswith("2,")


def test_the_weights_are_a_detector_with_its_thresholds(run):
    detector = Detector(run / "detector.safetensors")
    facts = read_metadata(run / "detector.safetensors")
    assert detector.scores.tolist() == json.loads(facts["scores"]) and facts["steps"] == "2"


def test_another_recipe_is_refused(folder, run):
    with pytest.raises(TrainingError, match="a run of another recipe"):
        DetectorTrainer(CONFIG.model_copy(update={"seed": 1}), run, folder)


def test_the_loss_falls_on_one_batch(folder):
    examples = Examples([read_images(folder / name) for name in image_files(CONFIG.data)])
    batch, model = examples.training(CONFIG, 0), DetectorNetwork().train()
    again = examples.training(CONFIG, 0)
    assert np.array_equal(batch.images, again.images) and batch.heat.max(axis=(1, 2, 3)).tolist() == [1, 1]
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    losses = []
    for _ in range(6):
        loss, _figures = detection_loss(model, batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.8 * losses[0]


def test_a_mirrored_view_is_that_of_a_mirrored_world():
    town = drawn(0)
    lens = Pinhole(FOCAL_PX, FOCAL_PX, 150.0, 100.0)
    image, other, objects = mirrored(town.images[0], lens, town.of_image(0))
    assert np.array_equal(image[:, 0], town.images[0][:, -1])
    u = FOCAL_PX * 2 / 12 + 150
    assert other.fx_px * objects.centre_m[0, 0] / 12 + other.cx_px == pytest.approx(SIZE_PX[0] - u)
    assert objects.heading_rad[0] == -0.4


def test_crops_keep_image_rays_and_maps_together():
    """A dot at the middle of the car: u = 176 + 343 * 2 / 12, v = 112 + 343 / 12."""
    town = drawn(0)
    town.images[:] = 40
    town.images[:, 138:143, 231:236] = 250
    examples = Examples([town])
    for step in range(3):
        batch = examples.training(CONFIG, step)
        for image, tangents, heat in zip(batch.images, batch.tangents, batch.heat, strict=True):
            assert image.shape == (3, CROP_PX[1], CROP_PX[0])
            row, column = np.argwhere(heat[0] >= 1)[0]
            cell = slice(4 * row, 4 * row + 4), slice(4 * column, 4 * column + 4)
            # The ray of the cell points at the car, mirrored or not, and the cell shows the dot.
            ray = tangents[:, *cell].mean(axis=(1, 2))
            assert np.abs(np.abs(ray) - [2 / 12, 1 / 12]).max() < 2.1 / FOCAL_PX
            assert image[0][cell].mean() > image[0].mean() + 40


def test_the_threshold_is_where_f1_is_best():
    # Of 4 objects: keeping 3 detections finds 3 without errors, F1 = 6 / 7; the fifth brings 8 / 9.
    rows = np.array([[0.9, 1], [0.8, 1], [0.7, 1], [0.6, 0], [0.5, 1], [0.4, 0]])
    assert _best(rows, 4) == (0.5, pytest.approx(8 / 9, abs=1e-4))
    assert _best(rows[:4], 4) == (0.7, pytest.approx(6 / 7, abs=1e-4))
    assert _best(rows[3:4], 4) == (1.0, 0.0)


def test_thresholds_by_kind():
    examples = Examples([drawn(0)])
    found = Detections(np.array([0, 1, 0]), np.array([[2, 1, 12.0], [2, 1, 12], [9, 1, 30]]), np.ones((3, 3)),
                       np.zeros(3), np.array([0.9, 0.8, 0.3]))  # fmt: skip
    scores, f1 = best_scores({0: found, 1: found}, examples)
    assert scores == [0.9, 1.0] and f1 == [1.0, 0.0]


def test_recipes_are_strict(tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text("profile: detector\nsteps: 3\ndata: {towns: 4}\n")
    assert is_detector_recipe(path) and read_detector_config(path).data == SceneSettings(towns=4)
    path.write_text("profile: detector\nstep: 3\n")
    with pytest.raises(TrainingError, match=r"step: Extra inputs are not permitted; a recipe has the keys profile, se"):
        read_detector_config(path)


def test_a_damaged_file_is_named(folder, tmp_path):
    path = tmp_path / "town.npz"
    path.write_bytes((folder / image_files(CONFIG.data)[0]).read_bytes()[:-100])
    with pytest.raises(TrainingError, match="is damaged"):
        read_images(path)


@pytest.mark.slow
def test_objects_are_where_the_town_shows_them():
    town = made.town_images(SceneSettings(images=3), 3, "rays")
    assert town.images.shape == (3, SIZE_PX[1], SIZE_PX[0], 3)
    again = made.town_images(SceneSettings(images=1), 3, "rays")
    assert np.array_equal(again.images[0], town.images[0])
    assert sum(int(town.of_image(k).visible.sum()) for k in range(3)) >= 3
