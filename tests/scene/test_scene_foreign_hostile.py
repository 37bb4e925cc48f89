"""Foreign files that are damaged or hostile are refused with ArchiveError; nothing in them is run."""

import gzip
import io
import os
import pickle
import random
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

import foreign_files as made
import numpy as np
import pytest
from nurec_archives import ONE_ACTOR, small_arrays
from ply_files import standard, values

from nurec_sim.errors import ArchiveError
from nurec_sim.scene import read_scene

MUTATIONS = 36
"""Of each kind; ``NUREC_SIM_MUTATIONS`` sets another number."""


def refused(path, text):
    with pytest.raises(ArchiveError, match=text) as caught:
        read_scene(path)
    assert str(path) in str(caught.value)


def volume_file(path, state, **more):
    content = {"nre_data": {"version": "1", "model": "nre", "config": {}, "state_dict": state}} | more
    path.write_bytes(gzip.compress(made.packed(content)))
    return path


def array(key, values, shape=None):
    return {key: values.tobytes(), f"{key}.shape": list(values.shape) if shape is None else shape}


# -------------------------------------------------------------------------------------------------------------- volume


@pytest.mark.parametrize("part", [0.05, 0.5, 0.99])
def test_cut_volumes(tmp_path, part):
    data = made.volume(small_arrays(), ONE_ACTOR)
    (tmp_path / "a.nurec").write_bytes(data[: int(len(data) * part)])
    refused(tmp_path / "a.nurec", "cut short|not a gzip file")


def test_bombs(tmp_path):
    path = tmp_path / "a.nurec"
    path.write_bytes(gzip.compress(bytes(200_000_000), 9))
    refused(path, "bytes that unpack to more than")
    path.write_bytes(gzip.compress(struct.pack(">BI", 0xDD, 2**32 - 1) * 200))
    refused(path, "holds more than 262,144 values|damaged, or no msgpack object")
    path.write_bytes(gzip.compress(b"\x91" * 100_000 + b"\xc0"))
    refused(path, "damaged, or no msgpack object")
    path.write_bytes(gzip.compress(b"\x81\xa8nre_data\xc7\x04\x05abcd"))
    refused(path, "extension type 5; none is read")
    path.write_bytes(gzip.compress(b"\x81\xa8nre_data\xd6\xff\0\0\0\0"))  # a time stamp
    refused(path, "no NuRec volume")


KEY = ".gaussians_nodes.background.positions"


@pytest.mark.parametrize(
    ("state", "text"),
    [
        ({}, "no layers of Gaussians"),
        ({KEY: 3}, "positions must be bytes with a shape"),
        ({KEY: b"1234"}, "positions must be bytes with a shape"),
        (array(KEY, np.zeros(6), [2**40, 2**40]), "cannot have 48 bytes"),
        (array(KEY, np.zeros(6), [0, 3]), "cannot have 48 bytes"),
        (array(KEY, np.zeros(6), [-2, -3]), "impossible shape"),
        (array(KEY, np.zeros(6), [2, True]), "impossible shape"),
        (array(KEY, np.zeros(6), [1] * 60), "impossible shape"),
        (array(KEY, np.zeros(6), [6, 3]), "cannot have 48 bytes"),
        (array(KEY, np.zeros((2, 3))), "holds no Gaussians"),
    ],
)
def test_arrays_that_are_not_what_they_say(tmp_path, state, text):
    refused(volume_file(tmp_path / "a.nurec", state), text)


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("rotations", np.zeros((6, 3)), r"rotations must be \(6, 4\), got \(6, 3\)"),
        ("densities", np.zeros(6), "densities must be"),
        ("features_specular", np.zeros((6, 44)), "features_specular must be"),
        ("scales", np.zeros((7, 3)), r"scales must be \(6, 3\)"),
        ("features_albedo", np.zeros((6, 0, 3)), "colours must be"),
    ],
)
def test_layers_whose_arrays_do_not_fit(tmp_path, name, values, text):
    content = small_arrays() | {f"gaussians_nodes.background.{name}": values}
    (tmp_path / "a.nurec").write_bytes(made.volume(content, ONE_ACTOR))
    refused(tmp_path / "a.nurec", text)


# ---------------------------------------------------------------------------------------------------------- checkpoint


class Trap:
    """Runs when unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


def test_checkpoints_are_never_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    good = made.checkpoint(small_arrays(), ONE_ACTOR)
    (tmp_path / "good.ckpt").write_bytes(good)
    with zipfile.ZipFile(tmp_path / "good.ckpt") as source, zipfile.ZipFile(tmp_path / "a.ckpt", "w") as writer:
        for name in source.namelist():
            writer.writestr(name, pickle.dumps({"state_dict": Trap()}) if name.endswith(".pkl") else source.read(name))
    refused(tmp_path / "a.ckpt", "'state_dict' is missing")
    (tmp_path / "b.ckpt").write_bytes(pickle.dumps(Trap()))
    refused(tmp_path / "b.ckpt", "no file of torch.save")
    assert not os.path.exists("unpickled")
    assert len(read_scene(tmp_path / "good.ckpt").static) == 6


def test_a_checkpoint_that_shows_the_same_values_many_times(tmp_path):
    import torch

    one = torch.zeros(100_000, 3)
    state = {f"model.gaussians_nodes.layer{k}.positions": one for k in range(2000)}
    torch.save({"state_dict": state}, tmp_path / "a.ckpt")
    refused(tmp_path / "a.ckpt", "the same values again and again")


# ------------------------------------------------------------------------------------------------------------ sidecars


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("rig_trajectories.json", [], "must hold an object"),
        ("rig_trajectories.json", {}, "at least one trajectory"),
        ("rig_trajectories.json", {"world_to_nre": {"matrix": [[2, 0, 0, 0]] * 4}}, "no rigid transform"),
        ("rig_trajectories.json", {"rig_trajectories": [{"T_rig_worlds": []}]}, "times: "),
        ("sequence_tracks.json", {"a": 1}, "needs the objects"),
        ("sequence_tracks.json", {"a": {"tracks_data": {}, "cuboidtracks_data": {}}}, "needs lists of equal length"),
    ],
)
def test_sidecars_without_what_they_are_for(tmp_path, name, content, text):
    members = {"volume.nurec": made.volume(small_arrays(), ONE_ACTOR)} | made.json_sidecars(**{name: content})
    refused(made.usdz(tmp_path / "a.usdz", members), text)


# ----------------------------------------------------------------------------------------------------------- mutations


def mutated(data, rng):
    """A copy with a few bytes changed, cut out, doubled or cut off."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 20])):
        at, kind = rng.randrange(len(data)), rng.random()
        if kind < 0.6:
            data[at] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        elif kind < 0.75:
            del data[at : at + rng.randrange(1, 20)]
        elif kind < 0.9:
            data[at:at] = data[at : at + rng.randrange(1, 20)]
        elif len(data) > 100:
            del data[rng.randrange(50, len(data)) :]
        data = data or bytearray(b"x")
    return bytes(data)


def mutated_volume(rng):
    return {"volume.nurec": gzip.compress(mutated(zlib.decompress(made.volume(small_arrays(), ONE_ACTOR), 31), rng), 1)}


def mutated_checkpoint(rng):
    return {"checkpoint.ckpt": mutated(made.checkpoint(small_arrays(), ONE_ACTOR), rng)}


def mutated_pickle(rng):
    """The instructions alone are changed, behind a fitting checksum."""
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(made.checkpoint(small_arrays(), ONE_ACTOR))) as source:
        with zipfile.ZipFile(result, "w") as writer:
            for name in source.namelist():
                data = source.read(name)
                writer.writestr(name, mutated(data, rng) if name.endswith("data.pkl") else data)
    return {"checkpoint.ckpt": result.getvalue()}


def mutated_sidecars(rng):
    files = made.json_sidecars([made.curved_track()])
    name = rng.choice(list(files))
    return files | {name: mutated(files[name], rng)}


def mutated_ply(rng):
    with tempfile.TemporaryDirectory() as folder:
        return {"points.ply": mutated(standard(Path(folder) / "a.ply", values(5, k=3)).read_bytes(), rng)}


MAKERS = [mutated_volume, mutated_checkpoint, mutated_pickle, mutated_sidecars, mutated_ply]


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.filterwarnings("error")
def test_mutated_archives_give_only_archive_errors(tmp_path, make):
    good = {"volume.nurec": made.volume(small_arrays(), ONE_ACTOR), **made.json_sidecars([made.curved_track()])}
    if make not in (mutated_volume, mutated_sidecars):
        del good["volume.nurec"]
    opened = 0
    for seed in range(int(os.environ.get("NUREC_SIM_MUTATIONS", MUTATIONS))):
        path = made.usdz(tmp_path / f"{seed}.usdz", good | make(random.Random(seed)))
        try:
            read_scene(path)
            opened += 1
        except ArchiveError as error:
            assert str(path) in str(error)
        path.unlink()
    assert opened < int(os.environ.get("NUREC_SIM_MUTATIONS", MUTATIONS))


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_mutated_stages_give_only_archive_errors(tmp_path, suffix):
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(made.stage(made.particle_field(made.gaussians(6, 1, [4, -8, 0], [30, 8, 5]))).decode())
    layer.Export(str(tmp_path / f"good{suffix}"))
    good = (tmp_path / f"good{suffix}").read_bytes()
    for seed in range(int(os.environ.get("NUREC_SIM_MUTATIONS", MUTATIONS)) // 12):
        path = tmp_path / f"{seed}{suffix}"
        path.write_bytes(mutated(good, random.Random(seed)))
        try:
            read_scene(path)
        except ArchiveError as error:
            assert str(path) in str(error)
