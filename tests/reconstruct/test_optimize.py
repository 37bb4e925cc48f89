"""Per-scene optimisation: its losses against skimage and finite differences, and what it makes of a street."""

import dataclasses
import signal
from pathlib import Path

import numpy as np
import pytest
from reconstruct_street import Street, camera
from skimage.metrics import structural_similarity

from nurec_sim import cli, geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.reconstruct import LiftSettings, OptimizeSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.optimize import method
from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY, QUAT, SCALE
from nurec_sim.reconstruct.optimize.checkpoint import write_checkpoint
from nurec_sim.reconstruct.optimize.compositing import Composite
from nurec_sim.reconstruct.optimize.depth_loss import depth_loss
from nurec_sim.reconstruct.optimize.image_loss import colour_loss
from nurec_sim.reconstruct.optimize.parameters import Parameters, rate_columns
from nurec_sim.reconstruct.optimize.responses import FrameResponses, borrowed_responses
from nurec_sim.reconstruct.optimize.settings import LearningRates, PosePriors
from nurec_sim.reconstruct.optimize.views import Returns, returns_in, training_views
from nurec_sim.render import CpuRenderer
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame, zeros_by_gaussian
from nurec_sim.render.cpu.backward.repack import repack
from nurec_sim.render.cpu.pack import LABEL, LOG_OPACITY, NEVER_SEEN
from nurec_sim.scene import read_scene, scene_hash, write_scene
from nurec_sim.scene.precision import archived
from nurec_sim.types import DynamicGaussians, SensorRequest

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))
CROSSING = {"moving": ((4.0, 1.8, 1.5), np.column_stack([np.linspace(12, 16, 4), np.full(4, 2.2)]))}


class Flicker(Street):
    """A street whose second image is taken 20 % too bright."""

    def image(self, camera_id, index):
        image = super().image(camera_id, index)
        return np.clip(image * (1.2 if index == 1 else 1.0), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def street():
    return Flicker(frames=4, boxes=CROSSING, cameras=(camera(width=128, height=64), camera("beside", 0.5, 128, 64)))


@pytest.fixture(scope="module")
def lifted(street):
    return reconstruct(street, settings=SMALL, cameras=["front"])


@pytest.fixture(scope="module")
def fitted(street, lifted):
    return method.refine(lifted, street, ["front"], set(), lambda *_: None, OptimizeSettings(seconds=None, steps=60))


def image_of(scene, clip, name, index):
    t_us = int(clip.t_us[index])
    request = SensorRequest(scene.id, clip.rig.cameras[name], t_us, t_us + 1, clip.world_from_camera(name, index))
    return CpuRenderer(scene, threads=1).render_camera(request, ("rgb",)).rgb


def mean_psnr(scene, clip, name):
    return np.mean([psnr(image_of(scene, clip, name, k), clip.image(name, k)) for k in range(clip.frames)])


def test_seen_and_unseen_images_gain(street, lifted, fitted):
    assert mean_psnr(fitted, street, "front") > mean_psnr(lifted, street, "front") + 2
    assert mean_psnr(fitted, street, "beside") > mean_psnr(lifted, street, "beside") + 1


def test_a_frame_taken_brighter_has_a_response_of_its_own(fitted):
    bright, usual = fitted.exposures["front"][1], fitted.exposures["front"][2]
    assert np.diag(bright[:, :3]).mean() / np.diag(usual[:, :3]).mean() == pytest.approx(1.2, abs=0.06)
    assert fitted.exposures["beside"] == pytest.approx(fitted.exposures["front"]), "a camera of the same kind"
    assert fitted.provenance["refined"]["borrowed_responses"] == ["beside"]


def test_the_same_steps_give_the_same_bytes_and_an_archive_keeps_them(street, lifted, fitted, tmp_path):
    few = OptimizeSettings(seconds=None, steps=3)
    one, two = (method.refine(lifted, street, ["front"], set(), lambda *_: None, few) for _ in range(2))
    assert scene_hash(one) == scene_hash(two) != scene_hash(dataclasses.replace(one, exposures={}))
    write_scene(fitted, tmp_path / "a.usdz")
    back = read_scene(tmp_path / "a.usdz")
    kept = archived(fitted)
    assert scene_hash(back) == scene_hash(kept) and back.exposures.keys() == {"front", "beside"}
    assert np.array_equal(image_of(back, street, "front", 1), image_of(kept, street, "front", 1))


def test_frames_begin_with_the_response_that_the_scene_comes_with(lifted):
    """No frame is fitted: the responses are those of the scene, per frame, not those of the camera."""
    darker = np.stack([np.hstack([np.eye(3) * (0.5 + 0.1 * k), np.full((3, 1), 0.01)]) for k in range(4)])
    responses = FrameResponses(dataclasses.replace(lifted, exposures={"front": darker}), {"front": 4, "beside": 1})
    responses.start("front", 2, np.full((4, 4, 3), 0.2, np.float32), np.full((4, 4, 3), 0.4, np.float32))
    assert responses.of("front", 2) == pytest.approx(darker[2])
    responses.start("beside", 0, np.full((4, 4, 3), 0.2, np.float32), np.full((4, 4, 3), 0.3, np.float32))
    given = np.asarray(lifted.isp.get("beside", np.eye(3, 4)))
    assert responses.of("beside", 0)[:, :3] == pytest.approx(1.5 * given[:, :3])


def test_an_interruption_keeps_what_has_been_reached(street, lifted):
    def interrupt(stage, fraction):
        if stage.startswith("fitting, 40 images"):
            raise KeyboardInterrupt

    scene = method.refine(lifted, street, ["front"], set(), interrupt, OptimizeSettings(seconds=None, steps=1000))
    assert scene.provenance["refined"]["steps"] == 40
    assert mean_psnr(scene, street, "front") > mean_psnr(lifted, street, "front")


def test_an_optimisation_resumes_exactly(street, lifted, tmp_path, monkeypatch):
    """Ctrl-C within the fourth step of eight: that step ends, and the rest gives the bytes of an uncut run."""
    whole = OptimizeSettings(seconds=None, steps=8, check_every=2)
    uncut = method.refine(lifted, street, ["front"], set(), lambda *_: None, whole)
    assert uncut.provenance["refined"]["held_out_psnr_db"] > 0
    kept = dataclasses.replace(whole, checkpoint=tmp_path / "state.npz")
    step = method.Optimization.step

    def interrupted(self, number, rate):
        if self.steps == 3:
            signal.raise_signal(signal.SIGINT)
        return step(self, number, rate)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background processes ignore it
    try:
        with monkeypatch.context() as patch:
            patch.setattr(method.Optimization, "step", interrupted)
            method.refine(lifted, street, ["front"], set(), lambda *_: None, kept)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    counts = []
    resume = dataclasses.replace(kept, resume=True)
    with pytest.raises(ReconstructError, match="belongs to another optimisation"):
        method.refine(lifted, street, ["front"], {0}, lambda *_: None, resume)
    again = method.refine(lifted, street, ["front"], set(), lambda stage, _: counts.append(stage), resume)
    assert [text.split(",")[1] for text in counts if text.startswith("fitting")] == [
        f" {k} images" for k in range(5, 9)
    ]
    assert scene_hash(again) == scene_hash(uncut)
    assert not kept.checkpoint.exists(), "the budget is spent"
    with pytest.raises(ReconstructError, match="nothing to resume"):
        method.refine(lifted, street, ["front"], set(), lambda *_: None, resume)
    kept.checkpoint.write_bytes(b"PK")
    with pytest.raises(ReconstructError, match="is not the state of an optimisation"):
        method.refine(lifted, street, ["front"], set(), lambda *_: None, resume)


def test_the_best_state_by_held_out_images_is_kept(street, lifted, monkeypatch):
    """Learning rates far too large after the first check: what was best by then is the result."""
    settings = OptimizeSettings(seconds=None, steps=20, check_every=2, final_rate=1.0)
    step = method.Optimization.step
    monkeypatch.setattr(
        method.Optimization, "step", lambda run, number, rate: step(run, number, 100.0 if run.steps > 9 else rate)
    )
    scene = method.refine(lifted, street, ["front"], set(), lambda *_: None, settings)
    assert 1 <= scene.provenance["refined"]["steps"] <= 10
    run = method.Optimization(scene, training_views(street, scene, ["front"], set()), settings)
    assert run.checked == [1, 3]
    assert np.mean([psnr(image_of(scene, street, "front", k), street.image("front", k)) for k in run.checked]) == (
        pytest.approx(scene.provenance["refined"]["held_out_psnr_db"], abs=0.1)
    )


def test_a_wrong_pose_is_corrected(street, lifted):
    views = training_views(street, lifted, ["front"], set())
    wrong = views[2].world_from_camera.copy()
    wrong[:, :3, 3] += (0.0, 0.04, 0.0)
    views[2] = dataclasses.replace(views[2], world_from_camera=wrong)
    settings = OptimizeSettings(
        seconds=None, steps=60, final_rate=0.3, rates=LearningRates(0, 0, 0, 0, 0, 0), correct_poses=True,
        poses=PosePriors(shift_m=0.05),
    )  # fmt: skip
    run = method.Optimization(lifted, views, settings)
    run.run(lambda *_: None)
    assert run.poses.of(2)[4] == pytest.approx(-0.04, abs=0.015)
    assert max(np.abs(run.poses.of(k)[4]) for k in (0, 1, 3)) < 0.02
    told = run.scene(street).provenance["refined"]["poses"]["front"]
    assert told["largest_shift_m"] > 0.02 and abs(told["time_offset_ms"]) < 2


def test_the_method_is_lift_and_a_fit_and_needs_images(street):
    scene = reconstruct(street, "optimized", cameras=["front"], settings=OptimizeSettings(seconds=None, steps=1))
    assert scene.provenance["method"] == "lift" and scene.provenance["refined"]["steps"] == 1
    with pytest.raises(ReconstructError, match="needs images; have no cameras"):
        reconstruct(street, "lift", cameras=[], settings=SMALL, refine=OptimizeSettings(steps=1))
    with pytest.raises(ValueError, match="needs a budget"):
        OptimizeSettings(seconds=None)
    with pytest.raises(ValueError, match="seconds must be positive and finite, got -1"):
        OptimizeSettings(seconds=-1)


def test_view_dependent_colours_are_refused(lifted):
    sh = dataclasses.replace(lifted.static, sh_rest=np.zeros((len(lifted.static), 3, 3), np.float32))
    with pytest.raises(ReconstructError, match="view-dependent colours"):
        Parameters(dataclasses.replace(lifted, static=sh))


# ------------------------------------------------------------------------------------------------------------ losses


def test_the_loss_of_colour_is_that_of_skimage_and_its_gradient_that_of_differences():
    random = np.random.default_rng(0)
    shown, recorded = random.random((2, 24, 30, 3), dtype=np.float32)
    recorded = 0.6 * shown + 0.4 * recorded
    loss, gradient = colour_loss(shown, recorded, 0.2)
    _, similarity = structural_similarity(shown, recorded, channel_axis=2, data_range=1.0, gaussian_weights=True,
                                          sigma=1.5, use_sample_covariance=False, full=True)  # fmt: skip
    inner = (slice(5, -5), slice(5, -5))  # borders differ: zeros here, reflection there
    only_dssim = colour_loss(shown, recorded, 1.0)[0]
    assert np.abs(shown - recorded).mean() * 0.8 + 0.2 * only_dssim == pytest.approx(loss, rel=1e-5)
    assert 1 - similarity[inner].mean() == pytest.approx(only_dssim, abs=0.05)
    for v, u, c in ((0, 0, 0), (12, 15, 1), (23, 7, 2), (6, 29, 0)):
        step = np.zeros_like(shown)
        step[v, u, c] = 2e-3
        difference = (colour_loss(shown + step, recorded, 0.2)[0] - colour_loss(shown - step, recorded, 0.2)[0]) / 4e-3
        assert gradient[v, u, c] == pytest.approx(difference, rel=0.02, abs=2e-6)


def plane_image(height=20, width=30):
    """Depth of a slanted plane 1 / (0.1 + 0.004 u + 0.002 v) at pixel centres, half opaque somewhere."""
    v, u = np.mgrid[:height, :width] + 0.5
    depth = 1 / (0.1 + 0.004 * u + 0.002 * v)
    alpha = np.where(u < 15, 0.7, 0.95)
    return alpha.astype(np.float32), (alpha * depth).astype(np.float32)


def test_returns_on_a_plane_have_no_error_between_pixels():
    alpha, distance = plane_image()
    uv = np.array([[7.3, 4.9], [20.81, 13.02], [12.5, 9.5]])
    depth = 1 / (0.1 + 0.004 * uv[:, 0] + 0.002 * uv[:, 1])
    by_alpha, by_distance = np.zeros_like(alpha), np.zeros_like(alpha)
    assert depth_loss(Returns(uv, depth), alpha, distance, None, 1.0, 0.0, by_alpha, by_distance) < 1e-6
    # Twice as far along rays of z = 0.5 is the same plane.
    half = np.full_like(alpha, 0.5)
    assert depth_loss(Returns(uv, depth), alpha, 2 * distance, half, 1.0, 0.0, by_alpha, by_distance) < 1e-6
    nearer = depth_loss(Returns(uv, depth * 0.9), alpha, distance, None, 1.0, 0.0, by_alpha, by_distance)
    assert nearer == pytest.approx(0.1, rel=1e-4)


def test_gradients_of_the_loss_of_depth_are_those_of_differences():
    alpha, distance = plane_image()
    uv = np.array([[7.3, 4.9], [20.81, 13.02], [3.0, 15.2]])
    returns = Returns(uv, np.array([7.9, 4.4, 7.2]))
    by_alpha, by_distance = np.zeros_like(alpha), np.zeros_like(alpha)

    def loss(a, d):
        return depth_loss(returns, a, d, None, 0.7, 0.3, np.zeros_like(alpha), np.zeros_like(alpha))

    depth_loss(returns, alpha, distance, None, 0.7, 0.3, by_alpha, by_distance)
    for row, column in ((4, 6), (5, 7), (12, 20), (13, 21), (14, 2)):
        for image, gradient in ((0, by_alpha), (1, by_distance)):
            step = np.zeros((2, *alpha.shape), np.float32)
            step[image, row, column] = 1e-3
            difference = (loss(alpha + step[0], distance + step[1]) - loss(alpha - step[0], distance - step[1])) / 2e-3
            assert gradient[row, column] == pytest.approx(difference, rel=0.02, abs=1e-5)


def test_returns_behind_others_are_left_out():
    seen = camera(width=192, height=96)
    pose = np.stack([seen.rig_from_camera] * 2)
    ahead = np.array([[11.5, 0.0, 1.5], [11.5, 0.05, 1.5], [21.5, 0.02, 1.5], [21.5, 5.0, 1.5], [-5.0, 0, 1.5]])
    found = returns_in(seen, pose, ahead)
    assert found.depth_m.tolist() == pytest.approx([10.0, 10.0, 20.0])
    assert found.uv_px[0].tolist() == pytest.approx([96.0, 48.0])


def test_returns_of_labelled_boxes_are_left_out(street, lifted):
    """The moving box is 2 m to the left; without its label its returns would count as static."""
    views = training_views(street, lifted, ["front"], set())
    unlabelled = training_views(street, dataclasses.replace(lifted, tracks=()), ["front"], set())
    assert all(len(a.returns) < len(b.returns) for a, b in zip(views, unlabelled, strict=True))
    assert all(len(view.returns) == 0 for view in training_views(street, lifted, ["front"], {0, 1, 2, 3}))


# -------------------------------------------------------------------------------------------------------- parameters


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
    parameters.step(drawn, np.array([row, row + 1], np.int32), rate_columns(0, 0, 0, 0, 0), 1.0)
    assert not by.mean.any() and not by.quat.any(), "the next frame adds to zeros"
    assert parameters.visits[row] == 1 and parameters.visits[row + 1] == 0, "no gradient, no step"
    assert parameters.first[row, MEAN : MEAN + 3] == pytest.approx([0.1, 0, 0], abs=1e-6)
    # q_world = (c w - s z, .., .., c z + s w), so its last component's gradient is s by w and c by z.
    assert parameters.first[row, QUAT : QUAT + 4] == pytest.approx([0.07071, 0, 0, 0.07071], abs=1e-5)


def test_opacity_and_scale_are_pulled_down_where_there_is_a_gradient(lifted):
    parameters = Parameters(lifted)
    drawn = parameters.at(lifted.span_us[0])
    parameters.gradients.mean[0] = (1e-9, 0, 0)
    rows = np.array([0, 1], np.int32)
    opacity, scale = drawn.world.opacity[0].copy(), drawn.world.scale[0].copy()
    parameters.step(drawn, rows, rate_columns(0, 0, 0, 0, 0), 1.0, opacity=0.2, scale=0.4)
    # d sigmoid(x) / dx = s (1 - s), d exp(x) / dx = exp(x); means over two Gaussians; a tenth in the first moment.
    assert parameters.first[0, OPACITY] == pytest.approx(0.1 * 0.2 / 2 * opacity * (1 - opacity), rel=1e-4)
    assert parameters.first[0, SCALE : SCALE + 3] == pytest.approx(0.1 * 0.4 / 2 * scale, rel=1e-4)
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
    by_planes, by_sky, _, sums = composite.back(response, shown, weight)
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


def test_reconstruct_keeps_the_state_beside_its_output_and_resumes_only_an_optimisation(
    street, lifted, tmp_path, monkeypatch, capsys
):
    def interrupted(log, method, *, refine, **others):
        write_checkpoint(refine.checkpoint, "key", {})
        asked.append(refine)
        return lifted

    asked = []
    monkeypatch.setattr("nurec_sim.reconstruct.reconstruct", interrupted)
    monkeypatch.setattr("nurec_sim.logs.open_clip", lambda path: street)
    monkeypatch.chdir(tmp_path)
    cli.main(["reconstruct", "street", "--refine", "60", "--out", "a.usdz"])
    assert "--resume goes on" in capsys.readouterr().out and (tmp_path / "a.usdz.refine.npz").exists()
    cli.main(["reconstruct", "street", "--refine", "60", "--out", "a.usdz", "--resume"])
    assert [each.resume for each in asked] == [False, True] and asked[0].checkpoint == Path("a.usdz.refine.npz")
    with pytest.raises(SystemExit):
        cli.main(["reconstruct", "street", "--resume"])
    assert "--resume goes on with an optimisation; give --refine" in capsys.readouterr().err
