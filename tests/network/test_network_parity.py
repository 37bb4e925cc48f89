"""Our network against the reference, number by number, with weights made from key names (data/reference_network)."""

import numpy as np
import pytest
import torch
from reference_network import key_list, made_weight, reference_arrays, reference_inputs, reference_model

from nurec_sim import network
from nurec_sim.network.encoder import normalized
from nurec_sim.network.tensors import SCENE_RESCALE

RAW, POSITION, ACTIVATED, DIRECTION = 1e-4, 5e-4, 5e-5, 1e-3
"""Absolute tolerances: raw maps and features; metres; scales, opacities and colours; quaternions and normals."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("profile", "published"),
    [("pa-front", "pa_front"), ("pa-multiview", "pa_multiview"), ("pq-front", "pq_road"),
     ("pa-full", "full_model_with_sky")],
)  # fmt: skip
def test_state_dict_is_that_of_the_published_checkpoint(profile, published):
    wanted = key_list(published)
    state = network.build(profile, seed=None).state_dict()
    assert list(state) == list(wanted)
    for key, entry in wanted.items():
        assert list(state[key].shape) == entry["shape"], key
        assert str(state[key].dtype) == f"torch.{entry['dtype']}", key


def test_made_weights_are_those_of_the_reference():
    weight = made_weight("encoder.patch_embed_img.proj.weight", (768, 3, 14, 14))
    np.testing.assert_allclose(weight.ravel()[:3], [-0.023489993, 0.00065819663, -0.039162073], rtol=1e-6)
    assert np.abs(weight).sum(dtype=np.float64) == pytest.approx(16133.8004, rel=1e-6)
    bias = made_weight("encoder.vit.blocks.5.attn.q_norm.bias", (64,))
    np.testing.assert_allclose(bias[:3], [-0.060049139, -0.12823328, -0.047584224], rtol=1e-6)


@pytest.fixture(scope="module", params=["pa_front", "pq_road"])
def case(request):
    arrays = reference_arrays(request.param)
    return request.param, reference_model(request.param), reference_inputs(arrays), arrays


def close(ours, reference, atol):
    ours = ours.detach().numpy()
    np.testing.assert_allclose(ours.reshape(reference.shape), reference, rtol=0, atol=atol)


def test_encoder(case):
    _, model, inputs, arrays = case
    encoder = model.encoder
    with torch.inference_mode():
        close(encoder.embed_camera(inputs.c2w, inputs.fov), arrays["mid/camera_tokens"], RAW)
        patches = encoder.patch_embed_img(normalized(inputs.rgb.flatten(0, 1)))
        close(patches[..., ::4], arrays["mid/patch_tokens_ch4"], RAW)
        for feature, block in zip(encoder(inputs.rgb, inputs.c2w, inputs.fov), (5, 7, 9, 11), strict=True):
            close(feature.patches[..., ::4], arrays[f"mid/feat_block{block}_ch4"], RAW)
            close(feature.token, arrays[f"mid/cls_block{block}"], RAW)


def test_heads(case):
    _, model, inputs, arrays = case
    decoder, size = model.decoder, inputs.rgb.shape[2:4]
    images = inputs.rgb.flatten(0, 1).permute(0, 3, 1, 2)
    with torch.inference_mode():
        features = model.features(inputs)
        levels = [feature.patches.flatten(0, 1) for feature in features]
        close(decoder.depth_head(levels, size), arrays["mid/depth_head_raw"], RAW)
        context = decoder.context_head(levels, size, decoder.rgb_fusion, images)
        close(context, arrays["mid/context_head_raw"], RAW)
        if model.profile.decoder == "dense":
            close(decoder.gaussians_head(levels, size), arrays["mid/gaussians_head_raw"], RAW)
        times = inputs.time, inputs.time_before, inputs.time_after
        before, after = decoder.context_motion_head(features, size, *times).unbind(-2)
        close(before * SCENE_RESCALE, arrays["out/motion_flow_prev_raw"], RAW)
        close(after * SCENE_RESCALE, arrays["out/motion_flow_next_raw"], RAW)


def test_whole_forward_pass(case):
    name, model, inputs, arrays = case
    if name == "pq_road":
        model.decoder.fill_road_slots = True
    with torch.inference_mode():
        outputs = model(inputs)
    found = outputs.gaussians
    rows, wanted = slice(None), slice(None)
    names = ("gs_xyz", "gs_rotations_wxyz", "gs_scales", "gs_densities", "gs_rgb", "normals", "semantic_argmax")
    if name == "pq_road":
        # The reference fills its road slots in random order: compare them sorted.
        names = ("positions", "rotations", "scales", "densities", "rgb", "normals", "semantic_class")
        rows, wanted = (road_sorted(source) for source in (found.source[0].numpy(), arrays["out/source_indices"][0]))
        np.testing.assert_array_equal(found.source[0].numpy()[rows], arrays["out/source_indices"][0][wanted])
    ours = (found.position_m, found.quat_wxyz, found.scale_m, found.opacity[..., None], found.rgb, found.normal)
    tolerances = (POSITION, DIRECTION, ACTIVATED, ACTIVATED, ACTIVATED, DIRECTION)
    for key, values, atol in zip(names, ours, tolerances, strict=False):
        reference = arrays[f"out/{key}"].reshape(values.shape)[0]
        np.testing.assert_allclose(values[0].numpy()[rows], reference[wanted], rtol=0, atol=atol, err_msg=key)
    classes = arrays[f"out/{names[-1]}"].reshape(-1)[wanted]
    differing = found.semantic[0].numpy()[rows] != classes
    best = outputs.context.logits.reshape(-1, 5).sort(-1).values[:, -2:].numpy()
    margins = np.diff(best, axis=1)[:, 0][found.source[0].numpy()[rows]]
    assert (margins[differing] < 1e-4).all()
    close(outputs.isp, arrays["out/affine" if name == "pa_front" else "out/affine_matrix"], ACTIVATED)


def road_sorted(source, regular=30 * 64):
    return np.concatenate([np.arange(regular), np.argsort(source[regular:], kind="stable") + regular])
