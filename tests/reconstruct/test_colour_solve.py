"""Colours that are solved for: images gain, frames get responses, and what no image shows stays as it was."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.reconstruct import ColourSettings, LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift import colour_solve, method
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import scene_hash
from nurec_sim.scene.usd.dome_texture import sample_cubemap
from nurec_sim.types import DynamicGaussians, Gaussians, Pinhole, SensorRequest

SETTINGS = LiftSettings(sky_px=32, views=ViewSettings(levels=32), colours=ColourSettings(rounds=0))
SOLVED = dataclasses.replace(SETTINGS, colours=ColourSettings())
RED, BLUE, WHITE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)
CROSSING = {"moving": ((4.0, 1.8, 1.5), np.column_stack([np.linspace(12, 16, 4), np.full(4, 2.2)]))}


class BrightFrame(Street):
    """A street whose third image is taken 15 % too bright."""

    def image(self, camera_id, index):
        image = super().image(camera_id, index)
        return np.clip(image * (1.15 if index == 2 else 1.0), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def street():
    return BrightFrame(frames=4, boxes=CROSSING, cameras=(camera(width=128, height=64), camera("beside", 0.5, 128, 64)))


@pytest.fixture(scope="module")
def lifted(street):
    return reconstruct(street, settings=SETTINGS, cameras=["front"])


def solved_from(scene, street):
    return colour_solve.solve_colours(scene, street, ["front"], SOLVED, lambda fraction: None).scene


@pytest.fixture(scope="module")
def solved(street, lifted):
    return solved_from(lifted, street)


def mean_psnr(scene, clip, name):
    scores = []
    for k in range(clip.frames):
        t_us = int(clip.t_us[k])
        request = SensorRequest(scene.id, clip.rig.cameras[name], t_us, t_us + 1, clip.world_from_camera(name, k))
        frame = CpuRenderer(scene, threads=1).render_camera(request, ("rgb",))
        scores.append(psnr(frame.rgb, clip.image(name, k)))
    return np.mean(scores)


def test_seen_and_unseen_images_gain(street, lifted, solved):
    assert mean_psnr(solved, street, "front") > mean_psnr(lifted, street, "front") + 1
    assert mean_psnr(solved, street, "beside") > mean_psnr(lifted, street, "beside") + 0.5


def test_a_frame_taken_brighter_has_a_gain_of_its_own(solved):
    bright, usual = solved.exposures["front"][2], solved.exposures["front"][1]
    assert np.diag(bright[:, :3]).mean() / np.diag(usual[:, :3]).mean() == pytest.approx(1.15, abs=0.06)
    assert solved.exposures["beside"] == pytest.approx(solved.exposures["front"]), "a camera of the same kind"


def test_results_do_not_depend_on_the_number_of_threads(street, lifted, solved, monkeypatch):
    monkeypatch.setattr(colour_solve, "usable_cores", lambda: 3)
    assert scene_hash(solved_from(lifted, street)) == scene_hash(solved)


@pytest.mark.slow
def test_the_method_solves(street, lifted, monkeypatch):
    """What it has lifted, before that is rounded to half floats, as archives are: colours of few pixels follow that."""
    solves = []

    def noted(*given):
        solves.append((given, colour_solve.solve_colours(*given)))
        return solves[0][1]

    monkeypatch.setattr(method, "solve_colours", noted)
    scene = reconstruct(street, settings=SOLVED, cameras=["front"])
    (((before, clip, cameras, *_), (solved, pixels)),) = solves
    assert before.static.mean_m == pytest.approx(lifted.static.mean_m, abs=0.01)
    assert clip.id == street.id and cameras == ["front"]
    shown = pixels > 2 * method.SHOWN_PX
    assert shown.any() and np.abs(scene.static.rgb - solved.static.rgb)[shown].max() < 0.01
    assert np.abs(solved.static.rgb - before.static.rgb)[shown].max() > 0.1
    assert scene.exposures["front"] == pytest.approx(solved.exposures["front"], abs=0.01)


def surfels_after_a_solve(monkeypatch, colour, pixels):
    """Colours of surfels that have this one after the solve, where all pixels that were lifted are red."""
    street = Street(frames=2, cameras=(camera(width=64, height=32),))

    def solve(scene, *_):
        lifted = np.arange(len(scene.static)) < scene.provenance["counts"]["lifted"]
        static = dataclasses.replace(scene.static, rgb=np.where(lifted[:, None], RED, colour).astype(np.float32))
        return colour_solve.Solved(dataclasses.replace(scene, static=static), np.where(lifted, 0.0, pixels))

    monkeypatch.setattr(method, "solve_colours", solve)
    scene = reconstruct(street, settings=SETTINGS)
    lifted = scene.provenance["counts"]["lifted"]
    assert 0 < lifted < len(scene.static)
    assert scene.static.rgb[:lifted] == pytest.approx(np.tile(RED, (lifted, 1)), abs=1e-3), "they keep theirs"
    return scene.static.rgb[lifted:]


@pytest.mark.parametrize(("pixels", "colour"), [(0.0, RED), (0.09, RED), (0.11, BLUE)])
def test_surfels_that_images_hardly_show_are_coloured_by_the_others(monkeypatch, pixels, colour):
    got = surfels_after_a_solve(monkeypatch, BLUE, pixels)
    assert got == pytest.approx(np.tile(colour, (len(got), 1)), abs=1e-3)


def test_surfels_that_are_white_in_images_stay_white(monkeypatch):
    """Pixels that are white in image and scene count nothing in the solve; other surfels no image shows."""
    white = (surfels_after_a_solve(monkeypatch, WHITE, 0.0) > 0.99).all(axis=1)
    assert 0 < white.sum() < len(white)


@pytest.mark.parametrize(("pixels", "size"), [(8 * 4 * 128 * 64, (64, 128)), (8 * 4 * 128 * 64 - 1, (32, 64))])
def test_images_are_taken_whole_if_all_that_are_taken_have_few_enough_pixels(street, lifted, monkeypatch, pixels, size):
    """Eight times each of four images, beside working views of half their size."""
    sizes, step = set(), colour_solve.ColourSolve.step

    def spied(self, image):
        sizes.add(image.rgb.shape[:2])
        return step(self, image)

    monkeypatch.setattr(colour_solve.ColourSolve, "step", spied)
    settings = dataclasses.replace(
        SETTINGS, views=ViewSettings(width_px=64, levels=32), colours=ColourSettings(pixels=pixels)
    )
    colour_solve.solve_colours(lifted, street, ["front"], settings, lambda fraction: None)
    assert sizes == {size}


def test_shares_of_pixels_add_up_to_their_opacity(street, lifted):
    """Each image once, however often it is taken."""
    bare = dataclasses.replace(lifted, dynamic=DynamicGaussians.empty(), tracks=())
    _, pixels = colour_solve.solve_colours(bare, street, ["front"], SOLVED, lambda fraction: None)
    opaque = 0.0
    for k in range(street.frames):
        t_us = int(street.t_us[k])
        pose = street.world_from_camera("front", k)
        request = SensorRequest(bare.id, street.rig.cameras["front"], t_us, t_us + 1, pose)
        opaque += CpuRenderer(bare, threads=1).render_camera(request, ("rgb", "alpha")).alpha.sum()
    assert pixels.min() == 0, "some are behind others"
    assert pixels.sum() == pytest.approx(opaque, rel=0.05)


def test_what_no_image_shows_keeps_its_colour(street, lifted):
    behind = dataclasses.replace(lifted.static[:5], mean_m=np.full((5, 3), -30.0, np.float32))
    more = dataclasses.replace(lifted, static=Gaussians.concatenate([lifted.static, behind]))
    result = solved_from(more, street)
    assert np.array_equal(result.static.rgb[-5:], behind.rgb)
    assert not np.array_equal(result.static.rgb[:-5], lifted.static.rgb)
    assert (result.static.rgb >= 0).all() and np.array_equal(result.static.mean_m, more.static.mean_m)


def test_few_images_are_taken_of_a_long_log_and_the_others_lie_between(street, lifted):
    settings = dataclasses.replace(SOLVED, colours=ColourSettings(images=2))
    exposures = colour_solve.solve_colours(lifted, street, ["front"], settings, lambda fraction: None).scene.exposures
    first, second, third, last = exposures["front"]
    assert second == pytest.approx((first + third) / 2) and last == pytest.approx(third)


class UnlikeLenses(Street):
    """A grey sky that a longer lens shows brighter to the left and darker to the right, as no response does."""

    def image(self, camera_id, index):
        grey = np.full(256, 128.0) if camera_id == "front" else np.linspace(158, 98, 256)
        return np.broadcast_to(grey[:, None], (128, 256, 3)).astype(np.uint8)


def test_the_image_of_a_longer_lens_leaves_no_edge_in_the_sky(lifted):
    wide = camera(width=256, height=128)
    long = dataclasses.replace(wide, id="long", lens=Pinhole(720.0, 720.0, 128.0, 64.0))
    street = UnlikeLenses(frames=4, cameras=(wide, long))
    sky = np.full((6, 128, 128, 3), 0.5, np.float32)
    empty = dataclasses.replace(lifted, static=Gaussians.empty(), dynamic=DynamicGaussians.empty(), tracks=(), sky=sky)
    empty = dataclasses.replace(empty, rig=street.rig, isp={})
    solved = colour_solve.solve_colours(empty, street, ["front", "long"], SOLVED, lambda fraction: None).scene
    bearing = np.linspace(-20, 20, 400)  # the long lens ends at 10 degrees, where it is 12 % too bright or dark
    ahead = np.stack([np.cos(np.radians(bearing)), np.sin(np.radians(bearing)), 0 * bearing], axis=1)
    grey = sample_cubemap(solved.sky, ahead).mean(axis=1)
    steps = np.abs(grey[10:] - grey[:-10])  # over 1 degree; the weights fall over 4
    assert np.ptp(grey) > 0.03, "the long lens takes part"
    # 0.12 over the 4 degrees of the fall, and 0.24 over the 20 of the longer lens itself.
    assert steps.max() < 0.12 / 4 + 0.24 / 20


class DarkFrame(Street):
    """A white sky over grey hills, white as well in a frame that is taken with 0.6 of the others' exposure."""

    def image(self, camera_id, index):
        image = np.full((64, 128, 3), 255, np.uint8)
        image[32:] = 120 * (0.6 if index == 2 else 1.0)
        return image


def test_a_sky_that_is_white_in_a_dark_frame_is_brighter_than_white(lifted):
    street = DarkFrame(frames=4, cameras=(camera(width=128, height=64),))
    sky = np.full((6, 64, 64, 3), 0.5, np.float32)
    empty = dataclasses.replace(lifted, static=Gaussians.empty(), dynamic=DynamicGaussians.empty(), tracks=(), sky=sky)
    solved = solved_from(dataclasses.replace(empty, rig=street.rig, isp={}), street)
    white = sample_cubemap(solved.sky, np.array([[1.0, 0.0, 0.1]]))[0]
    dark, usual = (solved.exposures["front"][k, :, :3].diagonal() for k in (2, 1))
    assert (dark < 0.75 * usual).all(), "gains are pulled to 1 a little"
    assert (dark * white > 0.97).all()
