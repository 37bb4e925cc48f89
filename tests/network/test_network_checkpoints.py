"""Weights files: every layout that people have, and files that lie or want to run something."""

import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import safetensors.torch
import torch
from network_weights import KEYS, base_state, part
from torch import nn
from training_files import Contract, assert_same, repacked, training_file

from nurec_sim import network
from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints.depth_anything import depth_anything_3_state
from nurec_sim.network.checkpoints.state_dicts import (
    compare_keys,
    load_state_dict,
    load_weights,
    read_metadata,
    save_weights,
)

# --- layouts


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16, torch.float64])
def test_plain_files_give_what_was_saved(tmp_path: Path, dtype: torch.dtype) -> None:
    state = {name: tensor.to(dtype) for name, tensor in part().state_dict().items()}
    torch.save(state, tmp_path / "w.pth")
    safetensors.torch.save_file(state, tmp_path / "w.safetensors")
    for name in ("w.pth", "w.safetensors"):
        assert_same(load_state_dict(tmp_path / name), state)
        module = part(1)
        load_weights(module, tmp_path / name, "part")
        assert_same(module.state_dict(), {name: tensor.float() for name, tensor in state.items()})


def test_parameters_and_views_of_shared_storage_load(tmp_path: Path) -> None:
    both = torch.arange(12.0).reshape(3, 4)
    torch.save({"a": nn.Parameter(both.T), "b": both[1:, ::2]}, tmp_path / "w.pth")
    torch.save({"state_dict": {"a": nn.Parameter(both.T), "b": both[1:, ::2]}}, tmp_path / "w.ckpt")
    for name in ("w.pth", "w.ckpt"):
        state = load_state_dict(tmp_path / name)
        assert_same(state, {"a": both.T, "b": both[1:, ::2]})
        assert not any(tensor.requires_grad for tensor in state.values())


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_training_files_load_without_their_other_objects(tmp_path: Path, protocol: int) -> None:
    module = part()
    path = training_file(tmp_path / "last.ckpt", module)
    with pytest.raises(pickle.UnpicklingError):
        torch.load(path, weights_only=True)
    assert_same(load_state_dict(path), module.state_dict())
    state = {f"model.{k}": v.bfloat16() for k, v in module.state_dict().items()}
    torch.save({"contract": Contract(), "state_dict": state}, path, pickle_protocol=protocol)
    assert_same(load_state_dict(path), {k: v.bfloat16() for k, v in module.state_dict().items()})


def test_values_of_a_training_file_can_be_written_without_touching_it(tmp_path: Path) -> None:
    path = training_file(tmp_path / "last.ckpt", part())
    before = path.read_bytes()
    load_state_dict(path)["linear.weight"].zero_()
    assert path.read_bytes() == before


def test_a_prefix_before_every_name_is_dropped(tmp_path: Path) -> None:
    state = {"linear.weight": torch.ones(2)}
    torch.save({f"model.{k}": v for k, v in state.items()}, tmp_path / "w.pth")
    assert_same(load_state_dict(tmp_path / "w.pth"), state)
    torch.save({"state_dict": state}, tmp_path / "w.pth")
    assert_same(load_state_dict(tmp_path / "w.pth"), state)
    torch.save({"model.linear.weight": torch.ones(2), "sky.token": torch.ones(1)}, tmp_path / "w.pth")
    assert load_state_dict(tmp_path / "w.pth").keys() == {"model.linear.weight", "sky.token"}


def test_older_names_of_the_isp_projector_are_renewed(tmp_path: Path) -> None:
    old = "post_processing.affine_attention"
    names = [f"{old}.{kind}.{end}" for kind in ("to_k", "to_v", "to_q") for end in ("weight", "bias")]
    torch.save({name: torch.full((2,), float(i)) for i, name in enumerate(names)}, tmp_path / "w.pth")
    state = load_state_dict(tmp_path / "w.pth")
    needed = json.loads((KEYS / "pa_front.json").read_text())
    assert len(state) == 6 and set(state) <= set(needed)
    assert state[f"{old}.kv_projector.to_v.bias"][0] == 3
    torch.save({f"{old}.to_k.bias": torch.ones(1), f"{old}.kv_projector.to_k.bias": torch.ones(1)}, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="twice"):
        load_state_dict(tmp_path / "w.pth")


# --- strictness


def test_wrong_keys_and_shapes_are_listed_and_change_nothing(tmp_path: Path) -> None:
    module = part()
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    state = {name: tensor + 1 for name, tensor in before.items()}
    del state["cuboids_dims_padding"], state["norm.bias"]
    state["sky.query_rays"] = torch.zeros(6, 2, 2, 3)
    state["linear.weight"] = torch.zeros(7, 6)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(WeightsError) as caught:
        load_weights(module, tmp_path / "w.pth", "pa-front")
    text = str(caught.value)
    assert "does not fit profile 'pa-front'" in text
    assert "2 missing: cuboids_dims_padding, norm.bias" in text
    assert "1 unexpected: sky.query_rays" in text
    assert "1 of another shape: linear.weight [7, 6] instead of [7, 5]" in text
    assert_same(module.state_dict(), before)


def test_long_lists_are_counted_and_names_cannot_write_to_the_terminal(tmp_path: Path) -> None:
    differences = compare_keys({}, {f"k{i:03d}": torch.zeros(1) for i in range(45)})
    assert len(differences) == 45
    assert differences.describe().endswith("k019 and 25 more")
    assert not compare_keys({"a": torch.zeros(1)}, {"a": torch.ones(1)})
    assert "\x1b" not in compare_keys({}, {"\x1b[31m" + "x" * 500: torch.zeros(1)}).describe()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_values_that_are_not_finite_are_refused(tmp_path: Path, value: float) -> None:
    module = part()
    state = {name: tensor.double() for name, tensor in part(1).state_dict().items()}
    state["linear.bias"][3] = value
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="1 tensors hold values that are not finite: linear.bias"):
        load_weights(module, tmp_path / "w.pth", "part")
    assert_same(module.state_dict(), part().state_dict())


def test_whole_numbers_are_no_weights(tmp_path: Path) -> None:
    state = part().state_dict() | {"linear.bias": torch.zeros(7, dtype=torch.int64)}
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="1 of another kind of number: linear.bias"):
        load_weights(part(), tmp_path / "w.pth", "part")


# --- files that are not what they should be


@pytest.fixture(params=["plain", "training"])
def good(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "training":
        return training_file(tmp_path / "good.ckpt", part())
    torch.save(part().state_dict(), tmp_path / "good.pth")
    return tmp_path / "good.pth"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"constants.pkl": b"x"}, "TorchScript program"),
        ({"data.pkl": None}, "not one that torch.save writes"),
        ({"data/0": None}, "needs .* bytes, has none"),
        ({"data/0": b"\0" * 139}, "needs .* bytes, has 139 bytes"),
        ({"byteorder": b"big"}, "big-endian"),
    ],
)
def test_archives_that_are_not_whole_are_refused(good: Path, tmp_path: Path, change: dict, text: str) -> None:
    with pytest.raises(WeightsError, match=text):
        load_state_dict(repacked(good, tmp_path / "bad.pth", change))


def test_repacking_alone_does_no_harm(good: Path, tmp_path: Path) -> None:
    state = load_state_dict(repacked(good, tmp_path / "same.pth", {}))
    assert_same(state, load_state_dict(good))


def test_compressed_and_overlapping_entries_are_refused(good: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="compressed"):
        load_state_dict(repacked(good, tmp_path / "bomb.pth", {}, zipfile.ZIP_DEFLATED))
    data = bytearray(good.read_bytes())
    with zipfile.ZipFile(good) as package:
        smallest = min(package.infolist(), key=lambda info: info.file_size)
        root = smallest.filename.split("/")[0].encode()
    # The central directory says that an entry is a gigabyte long.
    at = data.rindex(root + b"/byteorder") - 46
    data[at + 20 : at + 28] = (1 << 30).to_bytes(4, "little") * 2
    bad = tmp_path / "overlap.pth"
    bad.write_bytes(data)
    with pytest.raises(WeightsError, match="overlap"):
        load_state_dict(bad)


def test_cut_off_files_are_refused(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    cut = tmp_path / "cut.pth"
    for length in (10, len(data) // 2, len(data) - 1, len(data) - 30):
        cut.write_bytes(data[:length])
        with pytest.raises(WeightsError, match="damaged or cut off"):
            load_state_dict(cut)
    save_weights(part(), cut, {})
    cut.write_bytes(cut.read_bytes()[:-4])
    with pytest.raises(WeightsError, match="damaged"):
        load_state_dict(cut)


def test_files_of_other_kinds_are_named(tmp_path: Path) -> None:
    path = tmp_path / "w.pth"
    with pytest.raises(WeightsError, match="no weights at"):
        load_state_dict(path)
    path.write_bytes(b"\x7fELF and so on")
    with pytest.raises(WeightsError, match="neither a file of torch.save nor safetensors"):
        load_state_dict(path)
    torch.save({"a": torch.ones(1)}, path, _use_new_zipfile_serialization=False)
    with pytest.raises(WeightsError, match="bare pickle"):
        load_state_dict(path)
    for content in ([torch.ones(1)], {}, {"state_dict": [1]}, Contract()):
        torch.save(content, path)
        with pytest.raises(WeightsError, match="holds no state dict"):
            load_state_dict(path)
    for content in ({"a": torch.ones(1), "step": 3}, {"state_dict": {"a": torch.ones(1), 7: torch.ones(1)}}):
        torch.save(content, path)
        with pytest.raises(WeightsError, match="1 entries of its state dict are no named tensors"):
            load_state_dict(path)


def test_torchscript_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "traced.pt", "w") as package:
        package.writestr("traced/data.pkl", b"\x80\x02}.")
        package.writestr("traced/constants.pkl", b"\x80\x02).")
    with pytest.raises(WeightsError, match="TorchScript program, not weights"):
        load_state_dict(tmp_path / "traced.pt")


# --- saving


def test_saved_weights_come_back_and_replace_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "new" / "w.safetensors"
    save_weights(part(1), path, {"profile": "part", "note": "ü"})
    save_weights(part(), path, {"profile": "part", "note": "ü"})
    assert_same(load_state_dict(path), part().state_dict())
    assert read_metadata(path) == {"profile": "part", "note": "ü"}
    assert os.listdir(path.parent) == ["w.safetensors"]


def test_half_precision_rounds_parameters_and_keeps_buffers(tmp_path: Path) -> None:
    module = part()
    module.cuboids_dims_padding.fill_(1 / 3)
    save_weights(module, tmp_path / "w.safetensors", {}, half=True)
    state = load_state_dict(tmp_path / "w.safetensors")
    assert state["linear.weight"].dtype == torch.float16
    assert torch.equal(state["cuboids_dims_padding"], module.cuboids_dims_padding)
    again = part(1)
    load_weights(again, tmp_path / "w.safetensors", "part")
    assert again.linear.weight.dtype == torch.float32
    assert torch.equal(again.linear.weight, module.linear.weight.half().float())
    nn.init.constant_(module.linear.bias, 1e5)
    with pytest.raises(WeightsError, match="not finite: linear.bias"):
        save_weights(module, tmp_path / "w.safetensors", {}, half=True)
    assert_same(load_state_dict(tmp_path / "w.safetensors"), state)


@pytest.mark.slow
def test_the_same_weights_are_the_same_bytes_in_every_process(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from pathlib import Path\n"
        "from network_weights import part\n"
        "from nurec_sim.network.checkpoints.state_dicts import save_weights\n"
        "save_weights(part(), Path(sys.argv[2]), {'a': '1', 'b': '2', 'c': '3', 'd': '4'})"
    )
    there, here = tmp_path / "there.safetensors", tmp_path / "here.safetensors"
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parents[1] / "helpers"), str(there)], check=True)
    save_weights(part(), here, {"d": "4", "c": "3", "b": "2", "a": "1"})
    assert there.read_bytes() == here.read_bytes()


def test_our_own_profile_goes_to_a_file_and_back(tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    module = network.build("tiny")
    buffers = {name for name, _ in module.named_buffers()}
    assert {"sky.query_rays", "decoder.cuboids_dims_padding"} <= buffers
    wanted = {k: v.clone() if k in buffers else v.half().float() for k, v in module.state_dict().items()}
    save_weights(module, path, {"profile": "tiny"}, half=True)
    for tensor in module.state_dict().values():
        tensor.zero_()
    load_weights(module, path, "tiny")
    assert_same(module.state_dict(), wanted)


# --- the start of training


@pytest.mark.parametrize("prefix", ["model.", ""])
def test_depth_anything_fills_encoder_and_depth_head(prefix: str) -> None:
    needed = json.loads((KEYS / "pa_front.json").read_text())
    given = {prefix + name.removeprefix("model."): tensor for name, tensor in base_state().items()}
    state = depth_anything_3_state(given)
    ours = [name for name in needed if name.startswith(("encoder.", "decoder.depth_head."))]
    assert sorted(state) == sorted(ours)
    assert {name: list(tensor.shape) for name, tensor in state.items()} == {
        name: needed[name]["shape"] for name in ours
    }

    def source(name: str) -> str:
        return list(given)[int(state[name].flatten()[0])].removeprefix("model.")

    block = "decoder.depth_head.fusion_head.refinement_blocks.1"
    assert source(f"{block}.res_block.3.bias") == "head.scratch.refinenet2.resConfUnit1.conv2.bias"
    assert source(f"{block}.main_block.1.weight") == "head.scratch.refinenet2.resConfUnit2.conv1.weight"
    assert source("decoder.depth_head.reassemble.output_layers.3.weight") == "head.scratch.layer4_rn.weight"
    assert source("encoder.vit.blocks.11.attn.q_norm.bias") == "backbone.pretrained.blocks.11.attn.q_norm.bias"
    assert source("encoder.embed_camera.trunk_norm.weight") == "cam_enc.trunk_norm.weight"


def test_position_embeddings_split_row_by_row() -> None:
    positions = torch.arange(10.0).reshape(1, 10, 1)
    state = depth_anything_3_state({"model.backbone.pretrained.pos_embed": positions})
    assert state["encoder.vit.cls_pos_embed"].tolist() == [[0.0]]
    assert state["encoder.vit.img_pos_embed"][1, :, 0].tolist() == [4.0, 5.0, 6.0]
    with pytest.raises(WeightsError, match="pos_embed of shape"):
        depth_anything_3_state({"model.backbone.pretrained.pos_embed": torch.zeros(1, 9, 1)})


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("model.backbone.pretrained.register_tokens", "1 unknown names, such as model.backbone"),
        ("model.head.scratch.refinenet5.out_conv.bias", "1 unknown names"),
        ("encoder.vit.cls_tokens", "nothing named backbone"),
    ],
)
def test_other_files_are_no_depth_anything(name: str, text: str) -> None:
    with pytest.raises(WeightsError, match=text):
        depth_anything_3_state({name: torch.zeros(1)})
