"""The ego vehicle over images: as its own cameras saw it, in whatever size and lens an image is requested."""

import dataclasses

import numpy as np
import pytest
import render_scenes
from render_scenes import camera, request

from nurec_sim.render import CpuRenderer
from nurec_sim.types import Pinhole, Rig

BONNET = (200, 30, 40)


def driven(wanted=None):
    """A grey world, whose camera ``front`` of 72 x 48 pixels sees a bonnet in its lowest 16 rows."""
    image = np.zeros((48, 72, 4), np.uint8)
    image[32:] = (*BONNET, 255)
    image[32, :, 3] = 51  # a fifth
    world = render_scenes.scene(sky=0.5)
    return dataclasses.replace(world, rig=Rig({"front": camera()}, {}), ego_images={"front": image})


def shown(sensor, **options):
    return CpuRenderer(driven(), threads=1).render_camera(dataclasses.replace(request(sensor), **options)).rgb


def test_the_ego_vehicle_covers_what_it_hides_and_blends_at_its_edge():
    rgb, plain = shown(camera(), show_ego=True), shown(camera())
    np.testing.assert_array_equal(rgb[:32], plain[:32])
    assert (rgb[33:] == BONNET).all() and not (plain[33:] == BONNET).all()
    blended = np.rint(0.2 * np.array(BONNET) + 0.8 * plain[32].astype(float))
    np.testing.assert_allclose(rgb[32], blended, atol=1)


def test_depth_and_labels_show_the_street_behind_it():
    renderer = CpuRenderer(driven(), threads=1)
    frames = [
        renderer.render_camera(dataclasses.replace(request(camera()), show_ego=flag), ("rgb", "depth", "label"))
        for flag in (False, True)
    ]
    np.testing.assert_array_equal(frames[0].depth_m, frames[1].depth_m)
    np.testing.assert_array_equal(frames[0].label, frames[1].label)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_it_follows_the_size_of_the_image(scale):
    own = camera()
    width, height = int(72 * scale), int(48 * scale)
    lens = Pinhole(own.lens.fx_px * scale, own.lens.fy_px * scale, own.lens.cx_px * scale, own.lens.cy_px * scale)
    rgb = shown(camera(width=width, height=height, lens=lens), show_ego=True)
    assert (rgb[int(34 * scale) + 1 : height - 1] == BONNET).all()
    assert not (rgb[: int(32 * scale) - 1] == BONNET).any()


def test_it_stays_in_its_direction_when_the_field_of_view_is_another():
    """With twice the focal length the image shows the middle half: the bonnet, from row 32 of 48 on, from row 40 on."""
    own = camera()
    lens = Pinhole(2 * own.lens.fx_px, 2 * own.lens.fy_px, own.lens.cx_px, own.lens.cy_px)
    rgb = shown(camera(lens=lens), show_ego=True)
    assert (rgb[43:] == BONNET).all() and not (rgb[:39] == BONNET).any()


def test_other_cameras_do_not_see_it():
    other = camera(id="rear")
    np.testing.assert_array_equal(shown(other, show_ego=True), shown(other))
