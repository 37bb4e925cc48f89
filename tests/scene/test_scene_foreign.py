"""NuRec archives of other programs open as scenes, and are drawn as what they were made from."""

import dataclasses

import foreign_files as made
import numpy as np
import pytest
from nurec_archives import AT_US, IDS, SKY, archive, arrays, background, car_parts, picture, psnr, road, truth

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.scene.precision import archived
from nurec_sim.types import Gaussians


@pytest.mark.parametrize("kind", ["half", "single", "checkpoint"])
def test_nurec_archives_are_drawn_as_what_they_were_made_from(tmp_path, kind):
    if kind == "checkpoint":
        members = {"checkpoint.ckpt": made.checkpoint(arrays(), IDS)}
    else:
        members = {"volume.nurec": made.volume(arrays(), IDS, half=kind == "half")}
    scene = read_scene(archive(tmp_path / "clip.usdz", members))
    assert psnr(picture(scene), picture(truth())) > 50
    assert scene.id == "clip-1" and scene.span_us == (made.START_US, made.START_US + 3_000_001)
    assert (len(scene.static), len(scene.dynamic), len(scene.tracks)) == (500, 150, 1)
    assert np.bincount(scene.static.label).tolist() == [300, 200]


def test_a_rigid_actor_follows_its_track_and_requests(tmp_path):
    scene = read_scene(archive(tmp_path / "clip.usdz", {"volume.nurec": made.volume(arrays(), IDS)}))
    asked = geometry.pose(made.curved_track().path.at(AT_US)[:3, :3], np.array([12.0, 2.5, 1.4]))
    assert psnr(picture(scene, {"car-7": np.stack([asked, asked])}), picture(truth(asked))) > 50
    nothing = dataclasses.replace(truth(), static=Gaussians.concatenate([background(), road()]))
    later = made.START_US + 2_000_000  # the track has ended
    assert psnr(picture(scene, at_us=later), picture(nothing)) > 50
    assert psnr(picture(scene, {"car-7": np.stack([asked, asked])}, later), picture(truth(asked))) > 50


def test_what_was_imported_survives_our_own_archive(tmp_path):
    scene = read_scene(archive(tmp_path / "clip.usdz", {"volume.nurec": made.volume(arrays(), IDS)}))
    again = read_scene(write_scene(scene, tmp_path / "ours.usdz"))
    assert np.array_equal(again.dynamic.in_box, scene.dynamic.in_box)
    assert np.array_equal(picture(again), picture(archived(scene)))
    assert psnr(picture(again), picture(scene)) > 55
    assert again.provenance == scene.provenance


def test_gaussians_come_from_the_nre_frame_to_the_world(tmp_path):
    moved = geometry.pose(np.eye(3), np.array([16.0, -8.0, 2.0]))
    members = {"volume.nurec": made.volume(arrays(moved), IDS, half=False)}
    scene = read_scene(archive(tmp_path / "clip.usdz", members, nre_from_world=moved))
    assert psnr(picture(scene), picture(truth())) > 50
    assert any("taken for the world's" in text for text in scene.provenance["unknown"])


def test_a_turned_nre_frame_turns_colours_and_sky_too(tmp_path):
    turn = geometry.rotation_from_yaw(np.pi / 2)
    nre = geometry.pose(turn, np.zeros(3))
    quat = geometry.quat_from_matrix(turn)
    part = background()
    part = dataclasses.replace(part, sh_rest=part.sh_rest[:, :3] * 3)
    turned = dataclasses.replace(
        part,
        mean_m=(part.mean_m @ turn.T).astype(np.float32),
        quat_wxyz=geometry.quat_multiply(quat[None], part.quat_wxyz).astype(np.float32),
        # Functions of degree 1 are -y, z, -x: what was along x is along y now, and along y along -x.
        sh_rest=np.stack([part.sh_rest[:, 2], part.sh_rest[:, 1], -part.sh_rest[:, 0]], axis=1),
    )
    directions = geometry.cubemap_directions(8)
    sky = ((directions @ turn) * 0.4 + 0.5).astype(np.float32)
    members = {"volume.nurec": made.volume(made.nurec_arrays({"background": turned}, sky=sky), half=False)}
    scene = read_scene(archive(tmp_path / "clip.usdz", members, nre_from_world=nre))
    wanted = dataclasses.replace(truth(), static=part)
    assert psnr(picture(scene), picture(wanted)) > 50


def test_a_volume_of_one_layer_alone(tmp_path):
    (tmp_path / "garden.nurec").write_bytes(made.volume(made.nurec_arrays({"gaussians": background()})))
    scene = read_scene(tmp_path / "garden.nurec")
    assert scene.id == "garden" and len(scene.static) == 300 and list(scene.rig.cameras) == ["camera"]
    unknown = " ".join(scene.provenance["unknown"])
    assert "no sensors, path, times and tracks" in unknown and "no sky: it is black" in unknown


def test_active_degree_and_fourier_colours(tmp_path):
    content = made.nurec_arrays({"background": background()})
    content["gaussians_nodes.background.n_active_features"] = np.array(1, np.int64)
    albedo = content["gaussians_nodes.background.features_albedo"]
    content["gaussians_nodes.background.features_albedo"] = np.stack([albedo, albedo * 9, albedo * -3], axis=1)
    (tmp_path / "a.nurec").write_bytes(made.volume(content))
    scene = read_scene(tmp_path / "a.nurec")
    assert not scene.static.sh_rest[:, 3:].any() and scene.static.sh_rest[:, :3].any()
    assert np.abs(scene.static.rgb - background().rgb).max() < 2e-3
    assert any("over 3 terms of time keep the constant one" in text for text in scene.provenance["unknown"])


def test_broken_rows_are_dropped_and_counted(tmp_path):
    content = {name: values.copy() for name, values in arrays().items()}
    content["gaussians_nodes.background.positions"][3] = np.inf
    content["gaussians_nodes.background.rotations"][5] = 0
    content["gaussians_nodes.road.scales"][7, 1] = np.nan
    content["gaussians_nodes.dynamic_rigids.densities"][11] = np.nan
    scene = read_scene(archive(tmp_path / "clip.usdz", {"volume.nurec": made.volume(content, IDS)}))
    assert (len(scene.static), len(scene.dynamic), scene.provenance["dropped"]) == (497, 149, 4)


def test_exposure_becomes_a_gain_and_the_rest_is_named(tmp_path):
    content = arrays(**{
        "post_processings.0.ppisp.exposure_params": np.array([1.0, 0.0]),
        "post_processings.0.ppisp.crf_params": np.zeros((1, 3, 7)),
        "gaussians_nodes.background.extra_signal": np.zeros((300, 4)),
    })  # fmt: skip
    scene = read_scene(archive(tmp_path / "clip.usdz", {"volume.nurec": made.volume(content, IDS)}))
    assert np.allclose(scene.isp["front"], np.eye(3, 4) * np.sqrt(2), atol=1e-3)
    unknown = " ".join(scene.provenance["unknown"])
    assert "crf_params are not applied" in unknown and "gaussians_nodes.background.extra_signal" in unknown


def test_deformables_are_rigid_and_lost_tracks_are_named(tmp_path):
    content = made.nurec_arrays({"background": background(), "dynamic_deformables": (car_parts(), np.arange(150) % 3)})
    ids = {"dynamic_deformables": ["car-7", "walker-9"]}
    scene = read_scene(archive(tmp_path / "clip.usdz", {"checkpoint.ckpt": made.checkpoint(content, ids)}))
    assert len(scene.dynamic) == 50
    unknown = " ".join(scene.provenance["unknown"])
    assert "deformation network is not evaluated" in unknown
    assert "50 Gaussians belong to no named track" in unknown
    assert "50 Gaussians of 1 tracks without a path are not drawn: 'walker-9'" in unknown
    assert "no settings in the file" in unknown


def test_the_volume_goes_before_the_checkpoint_and_a_damaged_one_is_passed_over(tmp_path):
    good, members = made.volume(arrays(), IDS), {"checkpoint.ckpt": made.checkpoint(arrays(), IDS)}
    scene = read_scene(archive(tmp_path / "a.usdz", {"volume.nurec": good, **members}))
    assert scene.provenance["source"] == "volume.nurec"
    assert "checkpoint.ckpt is not read, because volume.nurec is" in scene.provenance["unknown"]
    scene = read_scene(archive(tmp_path / "b.usdz", {"volume.nurec": good[:-200], **members}))
    assert scene.provenance["source"] == "checkpoint.ckpt"
    assert any("passed over" in text and "cut short" in text for text in scene.provenance["unknown"])


@pytest.mark.parametrize(
    ("config", "text"),
    [({"scale_activation": "softplus"}, "scale_activation 'softplus' is not known"), ({"density_activation": 3}, "3")],
)
def test_activations_that_are_not_known_are_refused(tmp_path, config, text):
    content = made.nurec_arrays({"background": background()})
    data = made.volume(content, config={"layers": {"background": config}})
    (tmp_path / "a.nurec").write_bytes(data)
    with pytest.raises(ArchiveError, match=text):
        read_scene(tmp_path / "a.nurec")


def test_a_stage_places_the_volume_of_an_archive_without_a_rig(tmp_path):
    """A volume in centimetres, turned by 90 degrees about z and moved."""
    body = """    def Volume "gauss"
    {
        float xformOp:rotateZ = 90
        double3 xformOp:translate = (300, 0, -20)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
        rel field:density = </World/gauss/density>
        def OmniNuRecFieldAsset "density"
        {
            asset filePath = @./scene.nurec@
        }
    }"""
    members = {"default.usda": made.stage(body, meters=0.01), "scene.nurec": made.volume(arrays(), IDS)}
    scene = read_scene(made.usdz(tmp_path / "a.usdz", members))
    mean = background().mean_m / 100
    wanted = np.stack([-mean[:, 1] + 3, mean[:, 0], mean[:, 2] - 0.2], axis=1)
    assert np.allclose(scene.static.mean_m[:300], wanted, atol=1e-5)
    assert np.allclose(scene.static.scale_m[:300], background().scale_m / 100, rtol=1e-3)


def test_checkpoints_in_other_precisions_and_memory_orders(tmp_path):
    import torch

    content = made.nurec_arrays({"background": background()})
    state = {f"model.{name}": torch.from_numpy(np.array(values)) for name, values in content.items()}
    positions, scales = (f"model.gaussians_nodes.background.{name}" for name in ("positions", "scales"))
    state[positions] = torch.cat([torch.zeros(7, 3), state[positions]])[7:].T.contiguous().T.double()
    state[scales] = state[scales].bfloat16()
    torch.save({"state_dict": state}, tmp_path / "a.ckpt")
    scene = read_scene(tmp_path / "a.ckpt")
    assert np.allclose(scene.static.mean_m, background().mean_m)
    assert np.allclose(np.log(scene.static.scale_m), np.log(background().scale_m), rtol=1 / 128)


def test_broken_texels_of_the_sky_are_black_and_counted(tmp_path):
    sky = SKY.copy()
    sky[2, 1, 3, 0] = np.nan
    (tmp_path / "a.nurec").write_bytes(made.volume(made.nurec_arrays({"background": background()}, sky=sky)))
    scene = read_scene(tmp_path / "a.nurec")
    assert scene.sky[2, 1, 3, 0] == 0 and np.array_equal(scene.sky[3], SKY[3])
    assert "1 texels of the sky are not finite; shown black" in scene.provenance["unknown"]
