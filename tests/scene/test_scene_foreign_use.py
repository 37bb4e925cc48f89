"""Foreign scenes are inspected, rendered, imported and served like our own."""

import foreign_files as made
import numpy as np
import pytest
import scene_worlds
from nurec_archives import AT_US, IDS, archive, arrays, picture, psnr, truth

from nurec_sim import cli
from nurec_sim.scene import import_scene, read_scene
from nurec_sim.serving.store import SceneStore


@pytest.fixture
def nurec(tmp_path, monkeypatch):
    """A NuRec archive in the current folder."""
    monkeypatch.chdir(tmp_path)
    return archive(tmp_path / "clip.usdz", {"volume.nurec": made.volume(arrays(), IDS)})


def test_inspect_and_render(nurec, capsys):
    cli.main(["inspect", "clip.usdz"])
    shown = capsys.readouterr().out
    assert "scene clip-1" in shown and "150 of 1 tracks" in shown and "not known: no road map is read" in shown
    cli.main(["render", "clip.usdz", "--out", "frame.png"])
    assert (nurec.parent / "frame.png").stat().st_size > 1000


def test_import_makes_an_archive_of_ours(nurec, capsys):
    cli.main(["import", "clip.usdz", "--out", "ours.usdz"])
    assert "not known: no road map is read" in capsys.readouterr().out
    ours = read_scene("ours.usdz")
    assert ours.provenance["method"] == "foreign" and ours.dynamic.in_box.all()
    assert psnr(picture(ours), picture(truth())) > 50
    with pytest.raises(SystemExit):
        cli.main(["import", "clip.usdz", "--out", "clip.usdz", "--overwrite"])
    with pytest.raises(SystemExit):
        cli.main(["import", "clip.usdz", "--out", "b.usdz", "--up=-y"])


def test_surroundings_for_files_without(nurec, tmp_path):
    world = read_scene(nurec)
    (tmp_path / "garden.nurec").write_bytes(made.volume(made.nurec_arrays({"gaussians": world.static[:50]})))
    scene = import_scene(tmp_path / "garden.nurec", like=world)
    assert scene.rig is world.rig and scene.tracks == world.tracks and len(scene.static) == 50


def test_what_a_file_brings_stays_its_own(nurec):
    world = read_scene(nurec)
    like = scene_worlds.full_scene()
    scene = import_scene(nurec, like=like)
    assert [track.id for track in scene.tracks] == [track.id for track in world.tracks] != [t.id for t in like.tracks]
    assert list(scene.rig.cameras) == list(world.rig.cameras) and scene.span_us == world.span_us
    assert np.array_equal(scene.sky, world.sky) and scene.road_map is like.road_map is not None
    assert "no road map is read" in world.provenance["unknown"] and world.provenance["unknown"][1:]
    assert "no road map is read" not in scene.provenance["unknown"]


def test_the_server_offers_them(nurec, tmp_path):
    (tmp_path / "b").mkdir()
    content = made.stage(made.particle_field(made.gaussians(20, 1, [4, -8, 0], [30, 8, 5])))
    (tmp_path / "b" / "field.usda").write_bytes(content)
    (tmp_path / "b" / "other.usdz").write_bytes(nurec.read_bytes()[:-300])
    store = SceneStore([nurec, tmp_path / "b" / "field.usda", tmp_path / "b" / "other.usdz"])
    assert list(store.ids) == ["clipgt-clip-1", "clipgt-field"] and len(store.faults) == 1
    loaded = store.get("clip-1")
    assert np.array_equal(loaded.scene.static.mean_m, read_scene(nurec).static.mean_m)
    assert len(store.get("field").scene.static) == 20
    assert loaded.scene.span_us[0] <= AT_US
