"""The sky of the ablation: the sky decoder's contract, a profile of its own, and smooth skies only."""

import dataclasses

import pytest
import torch
from network_inputs import given, straight_drive

from nurec_sim import network
from nurec_sim.network.checkpoints.fit import needed_state
from nurec_sim.network.checkpoints.state_dicts import load_weights, save_weights
from nurec_sim.network.model import InstantNuRec
from nurec_sim.network.profiles import SkySize
from nurec_sim.network.sky import cubemap
from nurec_sim.network.sky.learned import SkyDecoder
from nurec_sim.network.sky.mlp import SkyMlp


def small(kind: str) -> network.Profile:
    size = SkySize(28, 48, 1, 3, (24, 48, 48, 48), kind)
    return dataclasses.replace(network.PROFILES["tiny"], name=f"small-{kind}", sky=size)


@pytest.fixture(scope="module")
def model():
    return network.build(small("mlp"), seed=2)


def test_profiles_differ_in_the_sky_only():
    tiny, ours = needed_state("tiny"), needed_state("tiny-sky-mlp")
    rest = [
        {name: value.shape for name, value in state.items() if not name.startswith("sky.")} for state in (tiny, ours)
    ]
    assert rest[0] == rest[1] and len(rest[0]) < min(len(tiny), len(ours))
    count = [sum(value.numel() for name, value in state.items() if name.startswith("sky.")) for state in (tiny, ours)]
    assert 0.3 < count[1] / count[0] < 3
    with torch.device("meta"):
        kinds = [type(InstantNuRec(network.PROFILES[name]).sky) for name in ("tiny", "tiny-sky-mlp")]
    assert kinds == [SkyDecoder, SkyMlp]


def test_the_network_gives_the_decoders_kind_of_sky(model):
    inputs = straight_drive(3, clips=2)
    with torch.inference_mode():
        outputs = model(inputs)
        again = model(inputs)
    assert outputs.sky.shape == (2, 6, 28, 28, 3) and outputs.sky.dtype == torch.float32
    assert outputs.sky_learned and outputs.sky_seen.shape == (2, 6, 28, 28, 1) and bool((outputs.sky_seen == 1).all())
    assert outputs.sky.min() >= 0 and outputs.sky.max() <= 1
    assert torch.equal(outputs.sky, again.sky)
    assert not torch.allclose(outputs.sky[0], outputs.sky[1])  # it depends on the clip


def test_clips_do_not_mix(model):
    inputs = straight_drive(2, clips=2)
    alone = {name: value[1:] for name, value in given(inputs).items()}
    with torch.inference_mode():
        both, second = model(inputs).sky, model(type(inputs)(**alone)).sky
    torch.testing.assert_close(both[1:], second, rtol=1e-4, atol=1e-5)


def test_half_precision_and_files(model, tmp_path):
    inputs = straight_drive(2)
    save_weights(model, tmp_path / "sky.safetensors", {"of": "test"})
    twin = network.build(small("mlp"), seed=None, precision="bfloat16")
    load_weights(twin, tmp_path / "sky.safetensors", "small-mlp")
    with torch.inference_mode():
        exact, rough = model(inputs).sky, twin(inputs).sky
        twin.precision = "float32"
        assert torch.equal(twin(inputs).sky, exact)
    assert rough.dtype == torch.float32 and (rough - exact).abs().max() < 0.05


def learnt(kind: str, truth: torch.Tensor, steps: int) -> float:
    """How far a sky is from the truth after so many steps, the best of the last ten."""
    inputs = straight_drive(2)
    model = network.build(small(kind), seed=0)
    patches = torch.randn(1, 2, 4, 6, 2 * model.profile.encoder.width, generator=torch.Generator().manual_seed(1))
    optimiser = torch.optim.Adam(model.sky.parameters(), 4e-3)
    losses = []
    for _ in range(steps):
        sky = model.sky(patches, inputs.rgb, inputs.rays[..., 3:])[0]
        loss = (sky - truth).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return min(losses[-10:])


@pytest.mark.slow
def test_it_learns_a_smooth_sky_quickly_and_clouds_later_than_the_decoder():
    """What the paper finds: an MLP over directions is slow to learn what changes quickly between them."""
    down = cubemap.directions(28)[..., 1:2]
    smooth = torch.cat([0.5 + 0.2 * down, 0.6 + 0.2 * down, 0.8 + 0.1 * down], dim=-1)
    coarse = torch.rand(6, 3, 7, 7, generator=torch.Generator().manual_seed(0))
    clouds = torch.nn.functional.interpolate(coarse, size=28).permute(0, 2, 3, 1) - 0.5
    cloudy = (smooth + 0.4 * clouds).clamp(0, 1)
    assert learnt("mlp", smooth, 60) < 0.02
    slow, quick = learnt("mlp", cloudy, 70), learnt("decoder", cloudy, 70)
    assert slow > 0.06 and slow > 1.3 * quick
