"""The network as a whole: what it refuses, what does not change its answer, how small `tiny` is."""

import dataclasses

import pytest
import torch
from network_inputs import given, straight_drive

from nurec_sim import network
from nurec_sim.network.checkpoints.shared import save_difference
from nurec_sim.network.checkpoints.state_dicts import save_weights
from nurec_sim.network.tensors import SemanticClass

WITHOUT_SKY = dataclasses.replace(network.PROFILES["tiny"], sky=None, observed_sky_px=14)
"""Most of a small clip's time goes into the learned sky."""


@pytest.fixture(scope="module")
def tiny():
    return network.build("tiny", seed=1)


@pytest.fixture(scope="module")
def skyless():
    return network.build(WITHOUT_SKY, seed=1)


def run(model, inputs, **options):
    with torch.inference_mode():
        return model(inputs, **options)


def test_shapes_of_what_comes_out(tiny):
    outputs = run(tiny, straight_drive(6, cameras=3))
    n = 6 * 56 * 84
    assert outputs.context.depth_m.shape == (1, 6, 56, 84)
    assert outputs.context.motion_m.shape == (1, 6, 56, 84, 2, 3)
    assert outputs.gaussians.position_m.shape == (1, n, 3)
    assert outputs.gaussians.motion_m.shape == (1, n, 2, 3)
    assert outputs.sky.shape == (1, 6, 112, 112, 3)
    assert outputs.isp.shape == (1, 3, 3, 4)
    assert outputs.sky_learned
    assert all(torch.isfinite(getattr(outputs.gaussians, f.name)).all() for f in dataclasses.fields(outputs.gaussians))


def test_two_clips_at_once_are_the_clips_one_by_one(tiny):
    inputs = straight_drive(3, clips=2)
    both = run(tiny, inputs)
    for clip in range(2):
        parts = {name: value[clip : clip + 1] for name, value in given(inputs).items()}
        alone = run(tiny, type(inputs)(**parts))
        torch.testing.assert_close(both.context.depth_m[clip : clip + 1], alone.context.depth_m, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(both.isp[clip : clip + 1], alone.isp, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(both.sky[clip : clip + 1], alone.sky, rtol=1e-4, atol=1e-4)


def test_cameras_may_come_in_any_order(skyless):
    inputs = straight_drive(4, cameras=2)
    per_image = {name: value for name, value in given(inputs).items() if name != "rig_from_scene"}
    swapped = {name: value[:, [2, 3, 0, 1]] for name, value in per_image.items()}
    swapped["rig_from_scene"] = inputs.rig_from_scene
    swapped["camera_idxs"] = inputs.camera_idxs
    ours, theirs = run(skyless, inputs), run(skyless, type(inputs)(**swapped))
    torch.testing.assert_close(ours.context.depth_m[:, [2, 3, 0, 1]], theirs.context.depth_m, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(ours.isp[:, [1, 0]], theirs.isp, rtol=1e-4, atol=1e-4)


def test_images_of_a_clip_know_each_other(skyless):
    inputs = straight_drive(3)
    changed = dataclasses.replace(inputs, rgb=torch.cat([inputs.rgb[:, :2], 1 - inputs.rgb[:, 2:]], dim=1))
    difference = (run(skyless, inputs).context.depth_m - run(skyless, changed).context.depth_m)[:, 0].abs()
    assert difference.max() > 1e-4


def test_same_input_same_answer(tiny):
    inputs = straight_drive(2)
    first, second = run(tiny, inputs), run(tiny, inputs)
    assert torch.equal(first.gaussians.position_m, second.gaussians.position_m)
    assert torch.equal(first.sky, second.sky)


def test_without_motion(skyless):
    outputs = run(skyless, straight_drive(2), motion=False)
    assert outputs.context.motion_m is None
    assert outputs.gaussians.motion_m is None


def test_heads_see_a_few_images_at_a_time_without_a_difference(skyless, monkeypatch):
    inputs = straight_drive(5)
    whole = run(skyless, inputs)
    monkeypatch.setattr("nurec_sim.network.dpt.IMAGES_AT_ONCE", 2)
    torch.testing.assert_close(run(skyless, inputs).context.depth_m, whole.context.depth_m, rtol=1e-4, atol=1e-4)


def test_bfloat16_stays_near(skyless):
    inputs = straight_drive(2)
    exact = run(skyless, inputs).context.depth_m
    model = network.build(WITHOUT_SKY, seed=1, precision="bfloat16")
    near = run(model, inputs).context.depth_m
    assert near.dtype == torch.float32
    assert ((near - exact).abs() / exact).median() < 0.02


@pytest.mark.parametrize(("height", "width"), [(60, 84), (56, 80), (14, 28)])
def test_sizes_that_do_not_fit_are_refused(height, width):
    model = network.build("tiny-selective", seed=0)
    with pytest.raises(
        ValueError, match=f"multiples of 14 px wide and high and at least 16 px, got {width} x {height}"
    ):
        run(model, straight_drive(1, height=height, width=width))


def test_images_must_be_sorted_by_camera(skyless):
    inputs = straight_drive(4, cameras=2)
    mixed = dataclasses.replace(inputs, camera_idxs=torch.tensor([[0, 1, 0, 1]]))
    with pytest.raises(ValueError, match=r"sorted by camera.*got camera_idxs \[\[0, 1, 0, 1\]\]"):
        run(skyless, mixed)


def test_unknown_profile():
    with pytest.raises(ValueError, match=r"no network profile 'huge'; have \['pa-front'"):
        network.build("huge")


@pytest.mark.slow
def test_small_profiles_fit_into_a_repository(tmp_path):
    dense, selective = network.build("tiny"), network.build("tiny-selective")
    assert sum(parameter.numel() for parameter in dense.parameters()) < 8.3e6
    save_weights(dense, tmp_path / "dense.safetensors", {}, half=True)
    assert (tmp_path / "dense.safetensors").stat().st_size < 16 << 20
    # The selective one comes without what it shares.
    shared = {name: value for name, value in dense.state_dict().items() if name in selective.state_dict()}
    selective.load_state_dict(shared, strict=False)
    save_weights(selective, tmp_path / "selective.safetensors", {}, half=True)
    part = tmp_path / "part.safetensors"
    save_difference(tmp_path / "selective.safetensors", tmp_path / "dense.safetensors", part)
    assert part.stat().st_size < 8 << 20


def test_same_seed_same_weights():
    states = [network.build("tiny", seed=seed).state_dict() for seed in (3, 3, 4)]
    assert all(torch.equal(a, b) for a, b in zip(states[0].values(), states[1].values(), strict=True))
    assert not torch.equal(states[0]["encoder.vit.img_pos_embed"], states[2]["encoder.vit.img_pos_embed"])


def test_network_needs_neither_torchvision_nor_torch_scatter(skyless):
    import sys

    run(skyless, straight_drive(1))
    assert not {"torchvision", "torch_scatter"} & set(sys.modules)


def test_sky_and_ego_are_not_shown(skyless, monkeypatch):
    bias = skyless.decoder.context_head.fusion_head.after_conv[2].bias
    monkeypatch.setattr(bias, "data", bias.data + torch.tensor([0, 0, 0, 0, 0, 0, 0, 0.8, 0.8, 0, 0]))
    outputs = run(skyless, straight_drive(2))
    probability = outputs.context.logits.softmax(-1)
    shown = 1 - probability[..., SemanticClass.EGO] - probability[..., SemanticClass.SKY]
    hidden = (shown <= 0.5).flatten()
    assert hidden.any()
    assert (outputs.gaussians.opacity[0, hidden] == 0).all()
    assert (outputs.gaussians.opacity[0, ~hidden] > 0).all()
