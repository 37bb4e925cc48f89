"""Weights files that want to run something, to take all memory, or are damaged."""

import pickle
import zipfile
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from network_weights import part
from training_files import Contract, Runs, assert_same, repacked, training_file

from nurec_sim.errors import WeightsError
from nurec_sim.files.torch_pickle import OTHER, StoredTensor, read_tensor_pickle
from nurec_sim.network.checkpoints.state_dicts import load_state_dict, save_weights

# --- files that want to run something, or to take all memory


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    trace, path = tmp_path / "ran", tmp_path / "w.pth"
    state = {f"model.{k}": v for k, v in part().state_dict().items()}
    torch.save({"state_dict": state, "hook": Runs(trace)}, path)
    assert_same(load_state_dict(path), part().state_dict())
    torch.save({"state_dict": state | {"model.x": Runs(trace)}}, path)
    with pytest.raises(WeightsError, match="no named tensors: 'x'"):
        load_state_dict(path)
    torch.save({"a": torch.ones(1), "b": Runs(trace)}, path)
    with pytest.raises(WeightsError, match="no named tensors: 'b'"):
        load_state_dict(path)
    # Run and thrown away (POP) before a proper dictionary follows.
    torch.save({"a": torch.ones(1)}, path)
    with zipfile.ZipFile(path) as package:
        proper = package.read("w/data.pkl")
    hidden = b"\x80\x02cposix\nsystem\n(U" + bytes([len(f"touch {trace}")]) + f"touch {trace}".encode() + b"tR0"
    with pytest.raises(WeightsError, match="holds more than tensors"):
        load_state_dict(repacked(path, tmp_path / "hidden.pth", {"data.pkl": hidden + proper[2:]}))
    assert not trace.exists()


def tensor_pickle(count: object = 4, offset: object = 0, shape: object = (2, 2), stride: object = (2, 1)) -> bytes:
    """{'a': tensor} as torch.save writes it, with these figures."""
    storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpu" + number(count) + b"tQ"
    figures = number(offset) + b"(" + b"".join(map(number, shape)) + b"t(" + b"".join(map(number, stride)) + b"t"
    return (
        b"\x80\x02}X\x01\0\0\0actorch._utils\n_rebuild_tensor_v2\n("
        + storage
        + figures
        + b"\x89ccollections\nOrderedDict\n)RtRs."
    )


def number(value: int) -> bytes:
    return pickle.dumps(value, 2)[2:-1]


def test_the_hand_written_pickle_is_what_torch_reads(tmp_path: Path) -> None:
    torch.save({"a": torch.arange(4.0).reshape(2, 2)}, tmp_path / "w.pth")
    same = repacked(tmp_path / "w.pth", tmp_path / "same.pth", {"data.pkl": tensor_pickle()})
    assert_same(load_state_dict(same), {"a": torch.arange(4.0).reshape(2, 2)})


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ({"count": 10**9}, "needs 4,000,000,000 bytes, has 16 bytes"),
        ({"count": 2**70}, "needs .* bytes, has 16 bytes"),
        ({"count": -4}, "a reference to values"),
        ({"offset": 1}, "larger than its 4 stored values"),
        ({"offset": -1}, "impossible shape"),
        ({"stride": (3, 1)}, "larger than its 4 stored values"),
        ({"stride": (-2, 1)}, "impossible shape"),
        ({"stride": (1,)}, "impossible shape"),
        ({"shape": (-2, -2)}, "impossible shape"),
        ({"shape": (2**62, 2**62, 0), "stride": (1, 1, 1)}, "impossible shape"),
        ({"shape": (10**9, 10**9), "stride": (0, 0)}, "larger than its 4 stored values"),
        ({"shape": (5,), "stride": (0,)}, "larger than its 4 stored values"),
    ],
)
def test_tensors_stay_within_what_is_stored(tmp_path: Path, figures: dict, text: str) -> None:
    torch.save({"a": torch.arange(4.0)}, tmp_path / "w.pth")
    bad = repacked(tmp_path / "w.pth", tmp_path / "bad.pth", {"data.pkl": tensor_pickle(**figures)})
    with pytest.raises(WeightsError, match=text):
        load_state_dict(bad)


def test_a_long_list_of_tensors_is_refused_before_it_is_read(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(1)}, tmp_path / "w.pth")
    bad = repacked(tmp_path / "w.pth", tmp_path / "bad.pth", {"data.pkl": b"\x80\x02" + bytes((32 << 20) + 1)})
    with pytest.raises(WeightsError, match="more than 32 MiB"):
        load_state_dict(bad)


@pytest.mark.parametrize(
    ("data", "result"),
    [
        (b"\x80\x02}r\xff\xff\xff\xff.", {}),  # a memo slot far away
        (b"\x80\x02)" + b"".join(b"q\0h\0h\0\x86" for _ in range(5000)) + b".", None),  # pairs of pairs of pairs
        (b"\x80\x02})" + b"q\0h\0\x86" * 200 + b"Ns.", {OTHER: None}),  # such pairs as a key: hashing takes 2^200 steps
        (b"(" * 100_000 + b"t" * 100_000 + b".", None),  # deep nesting
        (b"\x80\x02}(X\x01\0\0\0aK\x01X\x01\0\0\0aK\x02u.", {"a": 2}),
    ],
)
def test_bombs_take_no_more_than_their_length(data: bytes, result: object) -> None:
    found = read_tensor_pickle(data)
    if result is not None:
        assert found == result


@pytest.mark.parametrize(
    "data",
    [b"", b"\x80\x02", b"\x80\x02}", b"}", b"t.", b".", b"h\x05.", b"}K\x01s.", b"R.", b"\x80\x02K\x01Q.", b"\xff."]
    + [b"B\xff\xff\xff\xffabc.", b"\x8e" + b"\xff" * 8 + b".", b"I1x\n."],
)
def test_malformed_pickles_are_one_kind_of_error(data: bytes) -> None:
    with pytest.raises(ValueError):
        read_tensor_pickle(data)


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(changes=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=6))
def test_damaged_pickles_never_escape(changes: list[tuple[int, int]]) -> None:
    data = bytearray(tensor_pickle() + pickle.dumps({"a": Contract(), "b": [{1, 2}, 3.0, "x" * 300]}, 4))
    data[len(tensor_pickle()) - 1 : len(tensor_pickle())] = b"0"  # the first part goes on into the second
    for at, value in changes:
        data[at % len(data)] = value
    try:
        found = read_tensor_pickle(bytes(data))
    except ValueError:
        return
    assert not isinstance(found, Contract)


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("whole")
    torch.save(part().state_dict(), folder / "w.pth")
    save_weights(part(), folder / "w.safetensors", {"profile": "part"})
    training_file(folder / "w.ckpt", part())
    return [path.read_bytes() for path in sorted(folder.iterdir())]


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(
    which=st.integers(0, 2),
    from_end=st.booleans(),
    changes=st.lists(st.tuples(st.integers(0, 900), st.integers(0, 255)), min_size=1, max_size=4),
)
def test_damaged_files_are_read_or_refused(
    whole_files: list[bytes], tmp_path: Path, which: int, from_end: bool, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(whole_files[which])
    for at, value in changes:
        data[(-1 - at if from_end else at) % len(data)] = value
    (tmp_path / "w").write_bytes(data)
    try:
        state = load_state_dict(tmp_path / "w")
    except WeightsError as error:
        assert str(tmp_path / "w") in str(error)
        return
    assert all(isinstance(tensor.double().sum().item(), float) for tensor in state.values())


def test_stored_tensors_say_where_they_lie() -> None:
    found = read_tensor_pickle(tensor_pickle(count=9, offset=3, shape=(2, 2), stride=(3, 1)))
    assert isinstance(found, dict) and isinstance(found["a"], StoredTensor)
    assert (found["a"].values.kind, found["a"].values.entry, found["a"].offset) == ("torch.FloatStorage", "0", 3)
