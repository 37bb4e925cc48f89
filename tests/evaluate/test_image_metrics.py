import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nurec_sim.evaluate.scores.images import psnr, ssim


def pictures(seed, shape=(24, 31, 3)):
    random = np.random.default_rng(seed)
    reference = random.integers(0, 256, shape).astype(np.uint8)
    noisy = np.clip(reference + random.normal(0, 20, shape), 0, 255).astype(np.uint8)
    return noisy, reference


def ssim_by_the_formula(a, b, span):
    """Wang et al. 2004, window by window."""
    c1, c2, values = (0.01 * span) ** 2, (0.03 * span) ** 2, []
    for row in range(a.shape[0] - 6):
        for column in range(a.shape[1] - 6):
            for channel in range(a.shape[2]):
                x = a[row : row + 7, column : column + 7, channel].astype(float).ravel()
                y = b[row : row + 7, column : column + 7, channel].astype(float).ravel()
                (vx, covariance), (_, vy) = np.cov(x, y)
                top = (2 * x.mean() * y.mean() + c1) * (2 * covariance + c2)
                values.append(top / ((x.mean() ** 2 + y.mean() ** 2 + c1) * (vx + vy + c2)))
    return np.mean(values)


def test_psnr_is_the_formula():
    a, b = pictures(0)
    error = np.mean((a.astype(float) - b) ** 2)
    assert psnr(a, b) == pytest.approx(20 * np.log10(255) - 10 * np.log10(error))
    assert psnr(a / 255.0, b / 255.0) == pytest.approx(psnr(a, b))
    assert psnr(a, a) == float("inf")


@pytest.mark.parametrize("shape", [(24, 31, 3), (7, 7, 1)])
def test_ssim_is_the_formula(shape):
    a, b = pictures(1, shape)
    assert ssim(a, b) == pytest.approx(ssim_by_the_formula(a, b, 255.0), abs=1e-10)
    assert ssim(a / 255.0, b / 255.0) == pytest.approx(ssim(a, b), abs=1e-9)


def test_ssim_agrees_with_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    a, b = pictures(2, (40, 50, 3))
    assert ssim(a, b) == pytest.approx(metrics.structural_similarity(a, b, channel_axis=2), abs=1e-9)


@given(st.integers(0, 2**31))
def test_scores_are_symmetric_and_bounded(seed):
    a, b = pictures(seed, (9, 12, 3))
    assert ssim(a, b) == pytest.approx(ssim(b, a))
    assert -1 <= ssim(a, b) < 1 and ssim(a, a) == pytest.approx(1)
    assert psnr(a, b) == pytest.approx(psnr(b, a))


def test_images_that_cannot_be_compared():
    a = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ValueError, match=r"one shape .* got \(8, 8, 3\), \(8, 9, 3\)"):
        psnr(a, np.zeros((8, 9, 3), np.uint8))
    with pytest.raises(ValueError, match="same dtype"):
        psnr(a, a.astype(np.float32))
    with pytest.raises(ValueError, match="at least 7 x 7"):
        ssim(a[:5], a[:5])
