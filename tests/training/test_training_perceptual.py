"""The perceptual distance: what it ranks worse than what, its gradient, and what it does to a blur of an L1 loss."""

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from nurec_sim.evaluate.scores.images import psnr, ssim
from nurec_sim.training.losses.perceptual import _Filtered, _gabor_bank, perceptual_distance


def picture(height: int = 160, width: int = 240) -> np.ndarray:
    """Sky, houses and a road with markings and grain, soft enough to be shifted by parts of a pixel."""
    rng = np.random.default_rng(3)
    v, u = np.meshgrid(np.linspace(-0.6, 0.6, height), np.linspace(-1, 1, width), indexing="ij")
    image = np.where(v[..., None] < 0, [0.4, 0.6, 0.9] + 0.3 * v[..., None], [0.35, 0.35, 0.37])
    distance = 1 / np.maximum(v, 0.02)
    for lane in (-1.5, 0.3, 2.0):
        paint = (v > 0.02) & (np.abs(u * distance - lane) < 0.15) & (np.sin(2 * distance + lane) > 0)
        image = np.where(paint[..., None], 0.95, image)
    for column in range(0, width, 12):
        image[height // 6 : height // 2, column : column + 7] += rng.uniform(-0.3, 0.3)
    for size in (3, 8, 20):
        grain = rng.normal(size=(height // size, width // size, 3))
        image += 0.04 * cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.GaussianBlur(image.clip(0, 1).astype(np.float32), (0, 0), 0.6)


def shifted(image: np.ndarray, right_px: float, down_px: float = 0.0) -> np.ndarray:
    moved = cv2.warpAffine(
        image, np.float32([[1, 0, right_px], [0, 1, down_px]]), image.shape[1::-1],
        flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    return moved.clip(0, 1)


def distortions(image: np.ndarray) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(image.shape).astype(np.float32)
    changed = {"same": image}
    changed |= {f"shift {px}": shifted(image, px, px / 2) for px in (0.25, 0.5, 1, 2)}
    changed |= {f"blur {sigma}": cv2.GaussianBlur(image, (0, 0), sigma) for sigma in (0.7, 1, 1.5, 2.5)}
    changed |= {f"noise {sigma}": (image + sigma * noise).clip(0, 1) for sigma in (0.01, 0.03, 0.08)}
    changed |= {f"ghost {px}": (image + shifted(image, px)) / 2 for px in (1, 3, 6)}
    changed |= {f"cast {gain}": (image * np.float32([1 + gain, 1, 1 - gain])).clip(0, 1) for gain in (0.03, 0.1, 0.2)}
    changed |= {f"brighter {by}": (image + np.float32(by)).clip(0, 1) for by in (0.02, 0.05, 0.1)}
    return changed


def distance(image: np.ndarray, reference: np.ndarray) -> float:
    return float(perceptual_distance(*(torch.from_numpy(np.ascontiguousarray(each)) for each in (image, reference))))


@pytest.fixture(scope="module")
def table() -> dict[str, tuple[float, float, float]]:
    """Distance, PSNR and SSIM of every distortion (shown with ``pytest -s``)."""
    image = picture()
    rows = {
        name: (distance(each, image), psnr(each, image), ssim(each, image)) for name, each in distortions(image).items()
    }
    print("\ndistortion      distance  PSNR dB   SSIM")
    for name, (far, decibel, alike) in rows.items():
        print(f"{name:14} {far:9.4f} {decibel:8.1f} {alike:6.3f}")
    return rows


def test_every_distortion_costs_more_the_stronger_it_is(table):
    assert table["same"][0] == pytest.approx(0, abs=1e-6)
    for kind in ("shift", "blur", "noise", "ghost", "cast", "brighter"):
        costs = [far for name, (far, _, _) in table.items() if name.startswith(kind)]
        assert len(costs) >= 3 and costs == sorted(costs) and costs[0] > 1e-3
        assert costs[-1] > 2 * costs[0]


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ("shift 0.5", "blur 1"),
        ("shift 1", "blur 1.5"),
        ("shift 0.5", "ghost 3"),
        ("shift 1", "ghost 6"),
        ("cast 0.03", "blur 1"),
        ("brighter 0.02", "blur 1"),
        ("noise 0.01", "blur 1"),
        ("shift 0.25", "noise 0.03"),
    ],
)
def test_what_eyes_mind_less_costs_less(table, better, worse):
    assert table[better][0] < table[worse][0]


def test_sharp_but_shifted_is_better_than_blurred_where_psnr_and_ssim_see_no_difference(table):
    (sharp, sharp_db, sharp_ssim), (blurred, blurred_db, blurred_ssim) = table["shift 0.5"], table["blur 1"]
    assert sharp_db == pytest.approx(blurred_db, abs=0.5) and sharp_ssim == pytest.approx(blurred_ssim, abs=0.005)
    assert sharp < 0.75 * blurred
    assert table["shift 1"][0] < 0.9 * table["blur 1.5"][0] and table["shift 1"][1] < table["blur 1.5"][1] - 2


def test_the_gradient_is_that_of_finite_differences():
    torch.manual_seed(0)
    image, reference = torch.rand(2, 24, 33, 3, dtype=torch.float64)
    image.requires_grad_()
    (gradient,) = torch.autograd.grad(perceptual_distance(image, reference), image)
    direction = torch.randn_like(image)
    with torch.no_grad():
        step = 1e-5 * direction
        slope = (perceptual_distance(image + step, reference) - perceptual_distance(image - step, reference)) / 2e-5
    assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=1e-4)


def test_the_quick_convolution_is_a_convolution():
    torch.manual_seed(0)
    plane = torch.rand(2, 1, 13, 17, dtype=torch.float64, requires_grad=True)
    bank = _gabor_bank().double()
    weights = torch.rand(2, len(bank), 9, 13, dtype=torch.float64)
    (quick,) = torch.autograd.grad((_Filtered.apply(plane, bank) * weights).sum(), plane)
    (plain,) = torch.autograd.grad((functional.conv2d(plane, bank) * weights).sum(), plane)
    assert torch.allclose(quick, plain, atol=1e-12)
    assert torch.equal(_Filtered.apply(plane, bank), functional.conv2d(plane, bank))


def test_gradients_are_finite_where_nothing_is_to_be_seen():
    for level in (0.0, 0.5):
        image = torch.full((32, 48, 3), level, requires_grad=True)
        reference = torch.full((32, 48, 3), 0.5)
        perceptual_distance(image, reference).backward()
        assert torch.isfinite(image.grad).all()
    reference.requires_grad_()
    perceptual_distance(torch.rand(32, 48, 3, requires_grad=True), reference).backward()
    assert reference.grad is None


def test_small_images_use_fewer_scales_and_smaller_ones_are_refused():
    torch.manual_seed(0)
    image, reference = torch.rand(2, 8, 60, 3)
    assert perceptual_distance(image, image) < 1e-6 < perceptual_distance(image, reference)
    for wrong in (torch.rand(7, 60, 3), torch.rand(8, 60, 4), torch.rand(8, 60)):
        with pytest.raises(ValueError, match=r"at least 8 px are needed, got \["):
            perceptual_distance(wrong, wrong)
    with pytest.raises(ValueError, match=r"got \[8, 60, 3\], \[9, 60, 3\]"):
        perceptual_distance(image, torch.rand(9, 60, 3))


@pytest.mark.slow
def test_beside_an_l1_loss_it_brings_an_uncertain_picture_nearer_to_the_truth():
    """One image has to explain pictures that lie now here and now there, as renderings from uncertain depth do."""
    image, rng = picture(64, 96), np.random.default_rng(1)
    seen = [torch.from_numpy(shifted(image, *rng.normal(0, 1.5, 2))) for _ in range(24)]
    results = {}
    for weight in (0.0, 1.0):
        guess = torch.full((64, 96, 3), 0.5, requires_grad=True)
        optimiser = torch.optim.Adam([guess], 0.03)
        for step in range(144):
            optimiser.param_groups[0]["lr"] = 0.03 * (1 - step / 144) + 1e-3
            true = seen[step % len(seen)]
            loss = (guess - true).abs().mean() + weight * perceptual_distance(guess, true)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        found = guess.detach().clamp(0, 1).numpy()
        results[weight] = psnr(found, image), ssim(found, image), edges(found) / edges(image)
    assert results[1.0][0] > results[0.0][0] + 1.0  # dB
    assert results[1.0][1] > results[0.0][1] + 0.004
    assert results[0.0][2] < results[1.0][2] < 1


def edges(image: np.ndarray) -> float:
    """How sharp an image is, fine grain aside."""
    return float(np.abs(cv2.Laplacian(cv2.GaussianBlur(image, (0, 0), 0.7), cv2.CV_32F)).mean())
