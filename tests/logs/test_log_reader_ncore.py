"""Sequences of NCore V4 written by NVIDIA's package, and its projections against ours."""

import json
import shutil
import sys

import numpy as np
import pytest
import tiny_clip
from ncore_files import camera_parameters, lidar_parameters, write_ncore

from nurec_sim import logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs.readers import _ncore_models
from nurec_sim.logs.readers.ncore_v4 import NcoreReader


@pytest.fixture(scope="module")
def ncore():
    return pytest.importorskip("ncore.data.v4")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return logs.open_clip(tiny_clip.write(tmp_path_factory.mktemp("tiny") / "tiny"))


@pytest.fixture(scope="module")
def sequence(ncore, clip, tmp_path_factory):
    return write_ncore(tmp_path_factory.mktemp("ncore"), clip)


def test_a_sequence_gives_what_was_written(clip, sequence):
    opened = logs.open_clip(sequence)
    assert (opened.id, opened.format) == ("tiny", "ncore-v4")
    assert {"dataset": "NCore V4", "town": "made up", "beams of top": "as given by the log"} == opened.facts
    assert np.allclose(opened.ego.at(clip.ego.t_us), clip.ego.world_from_body, atol=1e-12)
    assert sorted(opened.rig.cameras) == sorted(clip.rig.cameras) and list(opened.rig.lidars) == ["top"]
    for name, camera in clip.rig.cameras.items():
        found = opened.rig.cameras[name]
        assert found.shutter == camera.shutter and (found.windshield is None) == (camera.windshield is None)
        assert np.allclose(found.rig_from_camera, camera.rig_from_camera, atol=1e-12)
        assert np.array_equal(opened.camera_times_us(name), clip.camera_times_us(name))
        for index in range(clip.frame_count(name)):
            assert np.array_equal(opened.image(name, index), clip.image(name, index))
            assert np.allclose(opened.world_from_camera(name, index), clip.world_from_camera(name, index), atol=1e-9)
        assert opened.ego_mask(name)[-2:].all() and not opened.ego_mask(name)[:-2].any()


def test_points_are_moved_to_the_end_of_the_sweep(clip, sequence):
    opened = logs.open_clip(sequence)
    for index in range(clip.sweep_count("top")):
        sweep, given = opened.sweep("top", index), clip.sweep("top", index)
        assert (sweep.start_us, sweep.end_us, sweep.t_us) == (given.start_us, given.end_us, given.end_us)
        # The ray without a return is left out; float32 directions err by a micrometre,
        # interpolated poses by less than half a millimetre.
        assert np.abs(sweep.xyz_world_m - given.xyz_world_m).max() < 1e-3
        assert np.array_equal(sweep.point_t_us, given.point_t_us) and np.allclose(sweep.intensity, given.intensity)


def test_cuboids_become_tracks(clip, sequence):
    opened = {track.id: track for track in logs.open_clip(sequence).tracks}
    assert sorted(opened) == ["7", "cone"]
    for track in clip.tracks:
        found = opened[track.id]
        assert (found.label, found.size_m, found.controllable) == (track.label, track.size_m, track.controllable)
        assert np.array_equal(found.path.t_us, track.path.t_us)
        assert np.allclose(found.path.world_from_body, track.path.world_from_body, atol=1e-6)


def test_the_reader_keeps_the_contract_in_every_layout(ncore, clip, sequence, tmp_path):
    assert logs.check_reader(sequence, NcoreReader()) == []
    assert logs.open_clip(sequence.parent).id == "tiny"
    folders = write_ncore(tmp_path / "folders", clip, "directory")
    assert np.array_equal(logs.open_clip(folders.parent).image("left", 1), clip.image("left", 1))


@pytest.mark.parametrize("name", ["front", "left", "wide"])
def test_lenses_project_as_nvidias(ncore, clip, name):
    """Pixels of rays in front of each camera, by the package's own models and by ours."""
    from ncore.sensors import camera_model_from_parameters

    parameters = camera_parameters(clip.rig.cameras[name])
    camera = _ncore_models.camera_model(name, parameters, np.eye(4))
    rays = np.array([[x, y, 1.0] for x in (-0.3, 0.0, 0.35) for y in (-0.25, 0.0, 0.2)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    theirs = camera_model_from_parameters(parameters, device="cpu").camera_rays_to_image_points(rays.astype(np.float32))
    ours, valid = sensors.project(camera, rays)[:2]
    assert valid.all() and theirs.valid_flag.all()
    assert np.abs(theirs.image_points.numpy() - ours).max() < 2e-3


def test_beams_of_lidars_point_as_nvidias(ncore, clip):
    from ncore.sensors import lidar_model_from_parameters

    parameters = lidar_parameters(clip.rig.lidars["top"])
    lidar, _ = _ncore_models.lidar_model("top", parameters, np.eye(4))
    rows, columns = np.indices((16, 90)).reshape(2, -1)
    elements = np.stack([rows, columns], axis=1)
    theirs = lidar_model_from_parameters(parameters, device="cpu").elements_to_sensor_rays(elements)
    assert np.allclose(theirs.numpy(), sensors.beam_directions(lidar).reshape(-1, 3), atol=1e-5)


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.ncore4.zarr.itar").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "ncore.data.v4", None)
    with pytest.raises(ClipError, match=r"NCore V4 needs the extra 'ncore': pip install 'nurec-sim\[ncore\]'"):
        logs.open_clip(tmp_path)


def test_damaged_and_doubled_files_are_refused(ncore, clip, sequence, tmp_path):
    part = next(sequence.parent.glob("*.ncore4-front.zarr.itar"))
    (tmp_path / part.name).write_bytes(part.read_bytes()[:-600])
    with pytest.raises(ClipError, match="NCore V4: it cannot be read: ValueError"):
        logs.open_clip(tmp_path)
    shutil.copy(part, tmp_path / part.name)
    with pytest.raises(ClipError, match="NCore V4: it cannot be read: AssertionError: PosesComponent group 'default'"):
        logs.open_clip(tmp_path)


def test_pickled_arrays_are_not_read(ncore, clip, tmp_path):
    """zarr would unpickle them, and so run what a file brings along."""
    write_ncore(tmp_path, clip, "directory")
    store = next(tmp_path.glob("*.ncore4-top.zarr"))
    array = sorted(store.rglob("distance_m/.zarray"))[0]
    meta = json.loads(array.read_text()) | {
        "dtype": "|O",
        "filters": [{"id": "pickle", "protocol": 5}],
        "fill_value": 0,
    }
    import ncore.impl.data.stores as stores
    import zarr

    array.write_text(json.dumps(meta))
    folder = zarr.storage.DirectoryStore(str(store))
    del folder[".zmetadata.cbor.xz"]
    stores.consolidate_compressed_metadata(folder)
    opened = logs.open_clip(tmp_path)
    with pytest.raises(ClipError, match="pickled data could run code and is not read"):
        opened.sweep("top", 0)
