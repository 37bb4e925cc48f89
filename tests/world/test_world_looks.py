import dataclasses
from typing import get_args

import numpy as np
import pytest

from nurec_sim.world.assets import (
    people,
    textures_facades,
    textures_ground,
    textures_people,
    textures_plants,
    textures_signs,
    trees,
)
from nurec_sim.world.assets.fixtures import fixture_parts
from nurec_sim.world.assets.meshes import MeshBuilder, icosphere
from nurec_sim.world.assets.vehicle_families import FAMILIES
from nurec_sim.world.assets.vehicle_meshes import vehicle_parts
from nurec_sim.world.model.sky import Sky
from nurec_sim.world.model.weather import add_fog, illumination
from nurec_sim.world.plan import splits
from nurec_sim.world.plan.town import SIGNS, Prop, PropKind, Weather

WEATHER = Weather("clear", 0.4, 0.7, 0.4, 0.0, 0.0, 0.0)


def rng(seed=1):
    return np.random.default_rng(seed)


def detail(image):
    """Contrast between neighbouring pixels, relative to the brightness."""
    grey = image[..., :3].astype(float).mean(axis=2)
    return np.abs(np.diff(grey, axis=1)).mean() / grey.mean()


def seam(image):
    """How much more the wrap-around differs than other neighbours do."""
    grey = image[..., :3].astype(float).mean(axis=2)
    across, down = np.abs(grey[:, 0] - grey[:, -1]).mean(), np.abs(grey[0] - grey[-1]).mean()
    inside = np.abs(np.diff(grey, axis=1)).mean(), np.abs(np.diff(grey, axis=0)).mean()
    return max(across / inside[0], down / inside[1])


@pytest.mark.parametrize("family", splits.ASPHALTS.all)
def test_asphalt_has_grain_and_no_seams(family):
    image = textures_ground.asphalt(rng(), family, 256)
    assert image.tobytes() == textures_ground.asphalt(rng(), family, 256).tobytes()
    assert detail(image) > 0.04 and seam(image) < 1.6
    assert image.tobytes() != textures_ground.asphalt(rng(2), family, 256).tobytes()


@pytest.mark.parametrize("family", splits.PAVINGS.all)
def test_paving_has_grain(family):
    assert detail(textures_ground.paving(rng(), family, 256)) > 0.03


@pytest.mark.parametrize("family", splits.FACADES.all)
def test_facades_light_up_at_night(family):
    day, dark, lit = (textures_facades.facade(rng(), family, *how) for how in ((0.0, 0.0), (0.0, 2.0), (0.6, 2.0)))
    assert day.shape == lit.shape == (512, 512, 3)
    assert detail(day) > 0.015

    def warm(image):
        return np.mean((image[..., 0] > 140) & (image[..., 0] > image[..., 2].astype(int) + 40))

    assert np.isclose(np.median(dark), np.median(day) / 3, rtol=0.1)
    assert warm(dark) < 0.01 and warm(lit) > 0.03


@pytest.mark.parametrize("family", splits.FOLIAGES.all)
def test_leaves_above_bark(family):
    image = textures_plants.plant(rng(), family)
    bark = int(len(image) * textures_plants.BARK_SHARE)
    leaves = image[:-bark].reshape(-1, 3).mean(axis=0)
    assert detail(image[:-bark]) > 0.15
    assert (leaves[1] > leaves[2]) and (family == "autumn") == (leaves[0] > leaves[1])


def test_unknown_families_are_refused():
    for make, text in (
        (lambda: textures_ground.asphalt(rng(), "mud"), r"no asphalt family 'mud'; have \['cobbled', 'dark'"),
        (lambda: textures_ground.paving(rng(), "mud"), "no paving family 'mud'"),
        (lambda: textures_facades.facade(rng(), "mud", 0, 0), "no facade family 'mud'"),
        (lambda: textures_plants.plant(rng(), "mud"), "no foliage family 'mud'"),
        (lambda: textures_signs.sign(rng(), "mud"), "no sign 'mud'"),
        (lambda: vehicle_parts("tank", (4, 2, 2)), "no vehicle family 'tank'; have .*'hatch'"),
        (lambda: Sky(rng(), dataclasses.replace(WEATHER, preset="hail")), "no sky preset 'hail'"),
        (lambda: illumination(dataclasses.replace(WEATHER, preset="hail")), "no lights for weather preset 'hail'"),
        (lambda: fixture_parts(Prop("tree", 0, 0, 0)), "no fixture of kind 'tree'"),
    ):
        with pytest.raises(ValueError, match=text):
            make()


# ------------------------------------------------------------------------------------------------------ sky and air


@pytest.mark.parametrize("preset", splits.SKIES.all)
def test_skies_have_no_seams_and_end_in_the_horizon(preset):
    sky = Sky(rng(), dataclasses.replace(WEATHER, preset=preset))
    size = 32
    right, left, up, _, front, back = sky.skybox(size).reshape(6, size, size, 3).astype(int)
    # Neighbouring faces of OpenGL's cube; a texel apart, so nearly equal.
    for a, b in ((front[:, -1], right[:, 0]), (right[:, -1], back[:, 0]), (back[:, -1], left[:, 0]),
                 (left[:, -1], front[:, 0]), (front[0], up[-1])):  # fmt: skip
        assert np.median(np.abs(a - b)) <= 14
    around = np.linspace(0, 2 * np.pi, 24)
    level = np.stack([np.cos(around), np.sin(around), np.full(24, 1e-4)], axis=1)[None]
    away = level[:, (level[0] @ sky.sun) < 0.2]
    assert np.abs(sky.colour(away).astype(float) - sky.horizon).max() < 26
    assert illumination(dataclasses.replace(WEATHER, preset=preset)).ambient[0] > 0.2


def test_fog_hides_what_is_far_and_leaves_the_sky():
    sky, rgb = Sky(rng(), WEATHER), np.full((1, 4, 3), 10, np.uint8)
    distance = np.array([[0.0, 1e-3, 100.0, 1e5]], np.float32)
    seen = add_fog(rgb, distance, sky, 0.01)
    assert (seen[0, :2] == 10).all()
    np.testing.assert_allclose(seen[0, 2], 10 * np.exp(-1) + sky.horizon * (1 - np.exp(-1)), atol=1)
    np.testing.assert_allclose(seen[0, 3], sky.horizon, atol=1)
    assert add_fog(rgb, distance, sky, 0.0) is rgb


# ------------------------------------------------------------------------------------------------------------ meshes


def volume(mesh):
    corners = mesh.corners(0.0)[0].reshape(-1, 3, 3)
    return np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6


def test_solids_face_outwards():
    box, block, drum, ball = (MeshBuilder() for _ in range(4))
    box.box([1, 2, 3], [0.5, 1.0, 1.5])
    block.block([0, 0, 0], [1, 2, 3])
    drum.cylinder([0, 0, 0], [0.3, 0.2, 2.0], 0.5, 0.4, sides=40)
    ball.add(*icosphere(3), np.zeros((642, 2)))
    assert np.isclose(volume(box), 6.0) and np.isclose(volume(block), 6.0)
    length = np.linalg.norm([0.3, 0.2, 2.0])
    assert np.isclose(volume(drum), np.pi * length * (0.25 + 0.2 + 0.16) / 3, rtol=0.01)
    assert np.isclose(volume(ball), 4 / 3 * np.pi, rtol=0.02)


def test_normals_are_smooth_below_the_crease_angle_only():
    drum = MeshBuilder()
    drum.cylinder([0, 0, 0], [0, 0, 1], 1.0, sides=24)
    place, normal, _ = drum.corners(38.0)
    side = np.abs(normal[:, 2]) < 0.5
    np.testing.assert_allclose(normal[side, :2], place[side, :2], atol=1e-6)
    assert (np.abs(normal[~side, 2]) > 0.999).all()


@pytest.mark.parametrize("kind", FAMILIES)
def test_vehicles_fill_their_boxes_and_stand_on_their_wheels(kind):
    size = np.array({"bus": (11.4, 2.5, 3.1), "truck": (8.2, 2.4, 3.3), "van": (5.2, 2.0, 2.15)}.get(
        kind, (4.6, 1.85, 1.5)))  # fmt: skip
    parts = vehicle_parts(kind, tuple(size))
    points = np.concatenate([part.points for part in parts.values()])
    np.testing.assert_allclose(points.min(axis=0), -size / 2, atol=1e-9)
    np.testing.assert_allclose(points.max(axis=0), size / 2, atol=1e-9)
    assert np.isclose(parts["wheel"].points[:, 2].min(), -size[2] / 2)
    assert {"paint", "glass", "wheel", "headlight", "taillight", "plate"} <= set(parts)
    assert parts["headlight"].points[:, 0].min() > 0.3 * size[0] and parts["taillight"].points[:, 0].max() < 0
    for part in parts.values():
        uv = part.corners(34.0)[2]
        assert np.isfinite(uv).all()
    assert volume(parts["paint"]) > 0.25 * size.prod() * (0.25 if kind == "truck" else 1.0)


def test_families_are_those_that_the_splits_name():
    assert set(FAMILIES) == set(splits.VEHICLES.all)


def test_people_are_as_tall_as_they_should_be():
    person = people.trunk(rng())
    assert np.isclose(person.points[:, 2].max(), people.HEIGHT_M, atol=0.03)
    knee = people.limb("left_thigh").points[:, 2].min()
    sole = people.HIP_M + knee + people.limb("left_shin").points[:, 2].min()
    assert abs(sole) < 0.03
    standing, walking = people.walking_angles(1.0, 0.0), people.walking_angles(1.0, 1.0)
    assert standing["left_thigh"] == standing["right_thigh"] and walking["left_thigh"] != walking["right_thigh"]
    again = people.walking_angles(1.0 + 2 * np.pi, 1.0)
    np.testing.assert_allclose(list(again.values()), list(walking.values()), atol=1e-9)
    assert {limb.name for limb in people.LIMBS} == set(walking) == set(people.cycling_angles(0.3))
    assert textures_people.person(rng(), (0.9, 0.1, 0.1))[40].mean(axis=0)[0] > 100


def test_branches_leave_room_below_them():
    for family in ("broadleaf", "birch", "autumn"):
        place, normal, uv = trees.tree(rng(), family, 1.0).corners(40.0)
        leaves = uv[:, 1] > textures_plants.BARK_SHARE
        assert place[leaves, 2].min() > 1.5 and 4.5 < place[:, 2].max() < 9.0
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("kind", [kind for kind in get_args(PropKind) if kind not in ("tree", "bush", "hedge")])
def test_every_fixture_has_parts_that_stand_on_the_ground(kind):
    parts = list(fixture_parts(Prop(kind, 0.0, 0.0, 0.0, length_m=5.0)))
    points = np.concatenate([mesh.points for mesh, _, _ in parts])
    assert -1.0 < points[:, 2].min() <= 0.0 and points[:, 2].max() < 9.0


def test_signs_show_their_picture_against_the_traffic():
    for variant, picture in enumerate(SIGNS):
        parts = {material: mesh for mesh, _, material in fixture_parts(Prop("sign", 0, 0, 0, variant))}
        place, normal, uv = parts[f"sign_{picture}"].corners(0.0)
        np.testing.assert_allclose(normal, [[-1.0, 0.0, 0.0]] * len(normal), atol=1e-9)
        right = place[uv[:, 0].argmax()] - place[uv[:, 0].argmin()]
        assert right[1] < 0  # who drives towards +x has -y to the right
        assert textures_signs.sign(rng(), picture).shape == (128, 128, 3)
