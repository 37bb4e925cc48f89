"""The parameters of per-scene optimisation: Gaussians, actors in their boxes, responses, and their gradients."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import geometry
from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY, QUAT, RGB, SCALE
from nurec_sim.reconstruct.optimize.compositing import Composite
from nurec_sim.reconstruct.optimize.parameters import Parameters, per_value
from nurec_sim.reconstruct.optimize.responses import borrowed_responses
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame, zeros_by_gaussian
from nurec_sim.render.cpu.backward.repack import repack
from nurec_sim.render.cpu.pack import LABEL, LOG_OPACITY, NEVER_SEEN
from nurec_sim.types import DynamicGaussians


def boxed(scene):
    """The scene with its actor's Gaussians as rigid parts of its box."""
    dynamic, track = scene.dynamic, scene.tracks[0]
    t_us = track.path.start_us
    box_from_world = geometry.inverse(track.path.at(t_us))
    alive, mean, _ = dynamic.at(t_us)
    gaussians = dataclasses.replace(
        dynamic.gaussians[alive], mean_m=geometry.transform_points(box_from_world, mean).astype(np.float32)
    )
    return dataclasses.replace(scene, dynamic=DynamicGaussians.rigid(gaussians, np.zeros(len(alive), np.int32), t_us))


def test_values_give_the_scene_back(lifted):
    for scene in (lifted, boxed(lifted)):
        back = Parameters(scene).scene()
        assert len(back.static) == len(scene.static) and len(back.dynamic) == len(scene.dynamic)
        order = np.lexsort(scene.static.mean_m.T)
        mine = np.lexsort(back.static.mean_m.T)
        assert np.array_equal(back.static.mean_m[mine], scene.static.mean_m[order])
        assert np.allclose(back.static.scale_m[mine], scene.static.scale_m[order], rtol=1e-5)
        assert np.allclose(back.static.normal[mine], scene.static.normal[order], atol=1e-5)
        assert np.allclose(back.dynamic.knot_m, scene.dynamic.knot_m)


def test_gaussians_of_an_actor_are_where_its_box_is_and_gone_when_it_is(lifted):
    scene = boxed(lifted)
    parameters = Parameters(scene)
    t_us = int(scene.tracks[0].path.t_us[2])
    drawn, first = parameters.at(t_us), parameters.static_count
    world = geometry.transform_points(scene.tracks[0].path.at(t_us), scene.dynamic.gaussians.mean_m)
    assert np.allclose(drawn.world.mean[first:], world, atol=1e-5) and (drawn.world.opacity[first:] > 0).all()
    assert (parameters.at(scene.tracks[0].path.end_us + 1).world.opacity[first:] == 0).all()


def test_what_is_rendered_is_what_a_renderer_packs(lifted):
    for scene in (lifted, boxed(lifted)):
        parameters = Parameters(scene)
        drawn = parameters.at(int(scene.tracks[0].path.t_us[1]))
        packed = np.empty_like(drawn.packed)
        repack(0, len(packed), drawn.world, False, packed)
        seen = packed[:, LOG_OPACITY] > NEVER_SEEN
        # Rows that are never seen may hold anything that no kernel divides by.
        for field in (*range(LABEL), LABEL):
            assert np.allclose(drawn.packed[:, field][seen], packed[:, field][seen], atol=1e-6)
        assert np.array_equal(drawn.packed[:, LOG_OPACITY] > NEVER_SEEN, seen)


def test_gradients_in_the_world_go_back_to_the_box(lifted):
    """A box turned by 90 degrees: what pulls along the world's y pulls along the box's x."""
    scene = boxed(lifted)
    turned = geometry.pose_from_xyyaw(5.0, 1.0, np.pi / 2)
    path = dataclasses.replace(scene.tracks[0].path, world_from_body=np.stack([turned] * 4))
    scene = dataclasses.replace(scene, tracks=(dataclasses.replace(scene.tracks[0], path=path),))
    parameters = Parameters(scene)
    drawn, row = parameters.at(path.start_us), parameters.static_count
    by = parameters.gradients
    by.mean[row] = (0, 1, 0)
    parameters.values[row, QUAT : QUAT + 4] = (1, 0, 0, 0)
    by.quat[row] = (0, 0, 0, 1)  # by the world's quaternion (c, 0, 0, s) of 90 degrees, c = s = 0.7071
    parameters.step(drawn, np.array([row, row + 1], np.int32), per_value(0, 0, 0, 0, 0), 1.0)
    assert not by.mean.any() and not by.quat.any(), "the next frame adds to zeros"
    assert parameters.visits[row] == 1 and parameters.visits[row + 1] == 0, "no gradient, no step"
    assert parameters.first[row, MEAN : MEAN + 3] == pytest.approx([0.1, 0, 0], abs=1e-6)
    # q_world = (c w - s z, .., .., c z + s w): the gradient is s by w and c by z, and a turn t about z gives z = t / 2.
    assert parameters.first[row, QUAT : QUAT + 4] == pytest.approx([0, 0, 0, 0.035355], abs=1e-5)


def test_opacity_and_scale_are_pulled_down_where_there_is_a_gradient(lifted):
    parameters = Parameters(lifted)
    drawn = parameters.at(lifted.span_us[0])
    parameters.gradients.mean[0] = (1e-9, 0, 0)
    rows = np.array([0, 1], np.int32)
    opacity, scale = drawn.world.opacity[0].copy(), drawn.world.scale[0].copy()
    parameters.step(drawn, rows, per_value(0, 0, 0, 0, 0), 1.0, opacity=0.2, scale=0.4)
    # d sigmoid(x) / dx = s (1 - s), d exp(x) / dx = exp(x); means over two Gaussians; a tenth in the first moment.
    assert parameters.first[0, OPACITY] == pytest.approx(0.1 * 0.2 / 2 * opacity * (1 - opacity), rel=1e-4)
    assert parameters.first[0, SCALE : SCALE + 3] == pytest.approx(0.1 * 0.4 / 2 * scale, rel=1e-4)
    assert not parameters.first[1].any()


@pytest.mark.parametrize(("images_per_step", "images"), [(3.0, 3), (0.25, 1)])
def test_values_are_held_near_the_start_by_all_images_that_show_them_together(lifted, images_per_step, images):
    """Its x axis lies along the world's y, its y axis along -x; the first visit of as many images as there are."""
    parameters = Parameters(lifted)
    start = parameters.values[0].copy()
    parameters.values[0, MEAN : MEAN + 3] += (0.01, 0.02, 0.001)
    parameters.values[0, QUAT : QUAT + 4] = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    parameters.values[0, SCALE : SCALE + 3] = np.log([0.5, 0.1, 0.002])
    parameters.values[0, OPACITY] -= 0.7
    parameters.values[0, RGB : RGB + 3] += (0.1, -0.2, 0.3)
    parameters.values_changed()
    drawn = parameters.at(lifted.span_us[0])
    parameters.gradients.mean[0] = (1e-12, 0, 0)
    moved = parameters.values[0, MEAN : MEAN + 3] - start[MEAN : MEAN + 3]
    grown = parameters.values[0, SCALE : SCALE + 3] - start[SCALE : SCALE + 3]
    parameters.step(drawn, np.array([0, 1], np.int32), per_value(0, 0, 0, 0, 0), 1.0,
                    keep=per_value(4.0, 9.0, 2.0, 3.0, 5.0), images_per_step=images_per_step)  # fmt: skip
    # A tenth of a gradient goes into the first moment.
    share = 0.1 / images
    own = np.array([moved[1], -moved[0], moved[2]])
    assert parameters.first[0, MEAN : MEAN + 3] == pytest.approx(
        share * 4 * own / np.square([0.5, 0.1, 0.002]), rel=1e-3
    )
    assert not parameters.first[0, QUAT : QUAT + 4].any()
    assert parameters.first[0, SCALE : SCALE + 3] == pytest.approx(share * 2 * grown, rel=1e-3)
    assert parameters.first[0, OPACITY] == pytest.approx(share * 3 * -0.7, rel=1e-3)
    assert parameters.first[0, RGB : RGB + 3] == pytest.approx(share * 5 * np.array([0.1, -0.2, 0.3]), rel=1e-3)
    assert not parameters.first[1].any()


def test_responses_are_borrowed_at_the_same_instant_from_a_camera_of_the_same_kind():
    front, beside, other = camera(), camera("beside", 0.5), camera("other", width=96)
    back = dataclasses.replace(front, id="back", rig_from_camera=front.rig_from_camera @ np.diag([-1.0, 1, -1, 1]))
    rig = Street(cameras=(front, beside, other, back)).rig
    times = {"front": np.array([[0, 0], [100, 100]]), "beside": np.array([[50, 50]])}
    times |= {"other": times["front"], "back": times["front"]}
    known = {"front": np.stack([np.eye(3, 4), 2 * np.eye(3, 4)])}
    found = borrowed_responses(known, times, rig, ["beside", "other", "back"])
    assert found.keys() == {"beside"} and found["beside"][0] == pytest.approx(1.5 * np.eye(3, 4))


def test_gradients_of_the_shown_image_are_those_of_differences():
    random = np.random.default_rng(3)
    seen, sky = camera(width=40, height=24), random.random((6, 8, 8, 3), dtype=np.float32)
    gaussians = zeros_by_gaussian(1)
    gaussians.mean[:], gaussians.quat[:, 0], gaussians.scale[:] = (9.0, 0.3, 1.5), 1.0, (0.3, 1.0, 0.5)
    gaussians.opacity[:], gaussians.features[:] = 0.7, (0.2, 0.6, 0.4)
    frame = Frame(SENSORS.tables(seen), np.stack([seen.rig_from_camera] * 2), False)
    planes = frame.draw(*gaussians)
    response = np.eye(3, 4) + 0.1 * random.random((3, 4))
    weight = random.random((24, 40, 3), dtype=np.float32)
    composite = Composite(frame, sky)
    shown = composite.shown(response)
    through = (1 - planes[0, :24, :40])[..., None]
    expected = (
        np.moveaxis(planes[1:4, :24, :40], 0, -1) + through * np.moveaxis(frame.draw_sky(sky), 0, -1)
    ) @ response[:, :3].T + response[:, 3]
    assert np.allclose(shown, expected, atol=1e-5)
    everywhere = np.ones((24, 40), bool)
    by_planes, by_sky, _, sums = composite.back(response, shown, weight, everywhere)
    by_planes = by_planes.copy()
    assert sums == pytest.approx(np.stack([(weight * shown).sum(axis=(0, 1)), weight.sum(axis=(0, 1))]), rel=1e-4)

    def loss(changed):
        return float((Composite(frame, changed).shown(response) * weight).sum(dtype=np.float64))

    v, u = np.unravel_index(np.argmax(planes[0, :24, :40]), (24, 40))
    for plane in (0, 1, 3):
        was, values = planes[plane, v, u], []
        for step in (0.01, -0.01):
            planes[plane, v, u] = was + step
            values.append(loss(sky))
        planes[plane, v, u] = was
        assert by_planes[plane, v, u] == pytest.approx((values[0] - values[1]) / 0.02, rel=1e-3)
    texel = np.unravel_index(np.argmax(np.abs(by_sky)), by_sky.shape)
    step = np.zeros_like(sky)
    step[texel] = 0.01
    assert by_sky[texel] == pytest.approx((loss(sky + step) - loss(sky - step)) / 0.02, rel=1e-3)
    # The sky changes by pixels that show it alone, and those with the Gaussian still tell how the Gaussian changes.
    open_sky = planes[0, :24, :40] == 0
    by_planes, by_open_sky, _, _ = composite.back(response, shown, weight, open_sky)
    assert by_planes[1, v, u] != 0
    weight[~open_sky] = 0
    _, of_open_sky, _, _ = composite.back(response, shown, weight, everywhere)
    assert np.array_equal(by_open_sky, of_open_sky) and not np.array_equal(by_open_sky, by_sky)


def test_a_mean_moves_along_the_axes_in_proportion_to_its_standard_deviations(lifted):
    """Turned by 90 degrees about z: its x axis lies along the world's y, its y axis along -x."""
    parameters = Parameters(lifted)
    parameters.values[0, QUAT : QUAT + 4] = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    parameters.values[0, SCALE : SCALE + 3] = np.log([0.5, 0.1, 0.002])
    parameters.values_changed()
    before = parameters.values[0, MEAN : MEAN + 3].copy()
    parameters.gradients.mean[0] = (-3e-4, 2e-4, 1e-4)
    drawn = parameters.at(lifted.span_us[0])
    parameters.step(drawn, np.array([0], np.int32), per_value(0.2, 0, 0, 0, 0), 1.0)
    # Adam's first step is the rate against the gradient's sign: a fifth of 0.1, 0.5 and 0.002 m.
    moved = parameters.values[0, MEAN : MEAN + 3] - before
    assert moved == pytest.approx([0.02, -0.1, -0.0004], rel=1e-3, abs=1e-6)


def test_a_disc_is_tilted_less_the_thinner_it_is(lifted):
    """Its normal is its z axis: turns about z are free, those about x and y tilt it."""
    parameters, half = Parameters(lifted), np.sqrt(0.5)
    parameters.values[0, QUAT : QUAT + 4] = (half, 0, half, 0)
    parameters.values[0, SCALE : SCALE + 3] = np.log([0.08, 0.08, 0.002])
    parameters.values_changed()
    before = geometry.matrix_from_quat(parameters.values[0, QUAT : QUAT + 4].astype(float))
    # By a turn about an axis the quaternion changes by q (0, axis / 2): the gradient of the sum of all three turns.
    turn = np.array([[0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    quat = np.array([half, 0, half, 0])
    parameters.gradients.quat[0] = -sum(geometry.quat_multiply(quat, each) for each in turn)
    drawn = parameters.at(lifted.span_us[0])
    parameters.step(drawn, np.array([0], np.int32), per_value(0, 0.02, 0, 0, 0), 1.0)
    after = geometry.matrix_from_quat(parameters.values[0, QUAT : QUAT + 4].astype(float))
    turned = before.T @ after
    tilt = 0.02 * 0.002 / 0.08
    assert [turned[2, 1], turned[0, 2], turned[1, 0]] == pytest.approx([tilt, tilt, 0.02], rel=2e-2)


def test_a_disc_grows_wider_and_not_thicker_and_a_ball_grows_in_all_directions(lifted):
    """The gradient asks for larger standard deviations along all axes: of a disc of 8 x 6 x 0.2 cm, and of a ball."""
    thin = np.array([[0.08, 0.002, 0.06], [0.05, 0.04, 0.045]], np.float32)
    static = dataclasses.replace(lifted.static[:2], scale_m=thin)
    parameters = Parameters(dataclasses.replace(lifted, static=static, dynamic=DynamicGaussians.empty(), tracks=()))
    # Static Gaussians are kept in another order.
    disc, ball = np.exp(parameters.values[:, SCALE + 1]).argsort()
    before = parameters.values[:, SCALE : SCALE + 3].copy()
    parameters.gradients.scale[:2] = -1
    parameters.step(parameters.at(lifted.span_us[0]), np.array([0, 1], np.int32), per_value(0, 0, 0.1, 0, 0), 1.0)
    change = parameters.values[:, SCALE : SCALE + 3] - before
    assert change[disc] == pytest.approx([0.1, 0.0, 0.1], abs=1e-4)
    assert change[ball] == pytest.approx([0.1, 0.1, 0.1], abs=1e-4)
    # Thinner it may become.
    for _ in range(40):
        parameters.gradients.scale[:2] = 1
        parameters.step(parameters.at(lifted.span_us[0]), np.array([0, 1], np.int32), per_value(0, 0, 0.1, 0, 0), 1)
    assert parameters.values[disc, SCALE + 1] == pytest.approx(np.log(1e-3), abs=1e-3)
