"""LPIPS against plain modules with torchvision's layer lists, and what files are taken and refused."""

import pytest
import safetensors.torch
import torch
from torch import nn

from nurec_sim.errors import WeightsError
from nurec_sim.training.losses.lpips import Lpips, load_lpips

ALEX_TAPS, VGG_TAPS = (1, 4, 7, 9, 11), (3, 8, 15, 22, 29)


def alexnet() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


def vgg16() -> nn.Sequential:
    layers: list[nn.Module] = []
    before = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width == 0:
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
            before = width
    return nn.Sequential(*layers)


def weights(network: nn.Sequential, taps: tuple[int, ...]) -> dict[str, torch.Tensor]:
    """Random ones, under the names that the files have."""
    state = {f"features.{name}": value for name, value in network.state_dict().items()}
    for level, tap in enumerate(taps):
        channels = network[tap - 1].out_channels
        state[f"lin{level}.model.1.weight"] = torch.rand(1, channels, 1, 1)
    return state


def plain_lpips(network, taps, state, image, reference):
    """Step by step, as the paper's equation 1 says."""
    shift = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[None, :, None, None]
    x, y = (((2 * each.permute(2, 0, 1)[None] - 1) - shift) / scale for each in (image, reference))
    total = 0.0
    for number, layer in enumerate(network):
        x, y = layer(x), layer(y)
        if number in taps:
            difference = torch.nn.functional.normalize(x, dim=1) - torch.nn.functional.normalize(y, dim=1)
            factors = state[f"lin{taps.index(number)}.model.1.weight"]
            total = total + (factors * difference**2).sum(1).mean()
    return total


@pytest.mark.parametrize(("make", "taps"), [(alexnet, ALEX_TAPS), (vgg16, VGG_TAPS)])
def test_it_is_what_plain_modules_give(make, taps):
    torch.manual_seed(0)
    network = make()
    state = weights(network, taps)
    image, reference = torch.rand(2, 40, 56, 3)
    twin = image.clone().requires_grad_()
    wanted = plain_lpips(network, taps, state, twin, reference)
    wanted.backward()
    image.requires_grad_()
    found = Lpips(state | {"classifier.1.weight": torch.zeros(1)})(image, reference)
    found.backward()
    assert found.item() == pytest.approx(wanted.item(), rel=1e-5) and found > 0
    assert torch.allclose(image.grad, twin.grad, rtol=1e-3, atol=1e-4 * float(twin.grad.abs().max()))
    assert Lpips(state)(image, image.detach()) == 0


def test_gradients_are_finite_where_no_feature_answers():
    torch.manual_seed(0)
    state = weights(alexnet(), ALEX_TAPS)
    state["features.0.bias"] = torch.full((64,), -100.0)
    image = torch.rand(40, 56, 3, requires_grad=True)
    Lpips(state)(image, torch.rand(40, 56, 3)).backward()
    assert torch.isfinite(image.grad).all()


def test_weights_come_from_one_file_or_from_a_folder(tmp_path):
    torch.manual_seed(0)
    state = weights(alexnet(), ALEX_TAPS)
    image, reference = torch.rand(2, 40, 56, 3)
    wanted = Lpips(state)(image, reference)
    torch.save(state, tmp_path / "all.pth")
    assert load_lpips(tmp_path / "all.pth")(image, reference) == wanted
    folder = tmp_path / "two"
    folder.mkdir()
    with pytest.raises(WeightsError, match="no weights in .*two; it must hold files that end in .pth, .pt, .safeten"):
        load_lpips(folder)
    features = {name: value for name, value in state.items() if name.startswith("features")}
    torch.save(features | {"classifier.1.weight": torch.zeros(3)}, folder / "alexnet.pth")
    safetensors.torch.save_file({k: v for k, v in state.items() if k.startswith("lin")}, folder / "lin.safetensors")
    (folder / "readme.txt").write_text("not weights")
    assert load_lpips(folder)(image, reference) == wanted
    safetensors.torch.save_file({"lin0.model.1.weight": torch.zeros(1)}, folder / "more.safetensors")
    with pytest.raises(WeightsError, match=r"two files in .* hold lin0\.model\.1\.weight"):
        load_lpips(folder)
    with pytest.raises(WeightsError, match="no weights at"):
        load_lpips(tmp_path / "nothing.pth")


def test_other_weights_are_refused():
    state = weights(alexnet(), ALEX_TAPS)
    with pytest.raises(WeightsError, match=r"theirs holds no weights of AlexNet .* it has no features\.0\.weight"):
        Lpips({}, "theirs")
    with pytest.raises(WeightsError, match=r"it has features\.0\.weight \[64, 3, 7, 7\]"):
        Lpips({"features.0.weight": torch.zeros(64, 3, 7, 7)})
    short = {name: value for name, value in state.items() if not name.startswith(("lin3", "features.8"))}
    missing = r"lacks 3 weights of LPIPS over AlexNet: features\.8\.weight, features\.8\.bias, lin3\.model\.1\.weight;"
    with pytest.raises(WeightsError, match=missing):
        Lpips(short)
    with pytest.raises(WeightsError, match=r"lin4\.model\.1\.weight \[1, 512, 1, 1\] instead of \[1, 256, 1, 1\]"):
        Lpips(state | {"lin4.model.1.weight": torch.zeros(1, 512, 1, 1)})
    with pytest.raises(WeightsError, match=r"not finite: features\.0\.bias"):
        Lpips(state | {"features.0.bias": torch.full((64,), torch.inf)})


def test_images_must_fit():
    lpips = Lpips(weights(alexnet(), ALEX_TAPS))
    assert lpips(torch.rand(31, 31, 3), torch.rand(31, 31, 3)) > 0
    for image, other in ((torch.rand(30, 40, 3),) * 2, (torch.rand(40, 40, 3), torch.rand(40, 41, 3))):
        with pytest.raises(ValueError, match=r"LPIPS over AlexNet needs two images .* at least 31 px, got \["):
            lpips(image, other)
