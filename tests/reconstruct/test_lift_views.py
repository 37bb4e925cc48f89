"""Working views, which frames they are of, and the limits that follow from a log and its images."""

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.lift import lifting, splat
from nurec_sim.reconstruct.lift.method import _settings_for
from nurec_sim.reconstruct.lift.settings import (
    ColourSettings,
    LiftSettings,
    ViewSettings,
)
from nurec_sim.reconstruct.lift.views import choose_frames, key_pixels, read_views, tiles_of
from nurec_sim.types import CameraModel, Fisheye, Pinhole, Shutter


@pytest.mark.parametrize("lens", ["plain", "distorted", "fisheye"])
def test_views_project_like_their_camera(lens):
    front = camera(width=320, height=160)
    if lens == "distorted":
        front = CameraModel("front", 320, 160, Pinhole(150, 150, 160, 80, radial=(-0.1, 0.02, 0, 0, 0, 0)),
                            front.rig_from_camera)  # fmt: skip
    if lens == "fisheye":
        front = CameraModel("front", 320, 160, Fisheye(100, 100, 160, 80, max_angle_rad=1.6), front.rig_from_camera)
    clip = Street(frames=1, cameras=(front,))
    options = ViewSettings()
    views = read_views(clip, ["front"], {}, options)
    assert len(views) == len(tiles_of(front, options)) and (lens != "fisheye" or len(views) >= 2)
    world_from_camera = clip.world_from_camera("front", 0)[0]
    errors = []
    for view in views:
        tile = view.tile
        assert tile.valid.mean() > 0.5
        v, u = np.nonzero(tile.valid)
        some = slice(None, None, 997)
        points = lifting.points_of(view, np.full(tile.valid.shape, 0.1, np.float32))[v[some], u[some]]
        uv, seen = sensors.project(front, geometry.transform_points(geometry.inverse(world_from_camera), points))
        for x, pixel, ok, row, column in zip(points, uv, seen, v[some], u[some], strict=True):
            a, b, z = splat.project_point(view.packed[None], 0, *x)
            assert (a, b) == pytest.approx((column + 0.5, row + 0.5), abs=1e-3) and z == pytest.approx(10, rel=1e-5)
            recorded = clip.image("front", 0)
            if ok and 1 < pixel[0] < 319 and 1 < pixel[1] < 159:
                near = recorded[int(pixel[1]) - 1 : int(pixel[1]) + 2, int(pixel[0]) - 1 : int(pixel[0]) + 2]
                errors.append(np.abs(near.astype(int) - view.rgb[row, column]).min(axis=(0, 1)).max())
    assert len(errors) > 10 and np.mean(np.array(errors) < 12) > 0.85


@pytest.mark.parametrize(("half_field_deg", "tiles", "least"), [(39.5, 1, 0.985), (55.0, 2, 0.985), (85.0, 3, 0.96)])
def test_tiles_show_all_that_a_wide_lens_does_at_its_resolution(half_field_deg, tiles, least):
    """But what is steep: 54 degrees in the middle of a tile, less at its sides."""
    f = 320 / np.radians(half_field_deg)
    wide = CameraModel("front", 640, 400, Fisheye(f, f, 320, 200), np.eye(4))
    found = tiles_of(wide, ViewSettings())
    rays, _ = sensors.pixel_rays(wide)
    shown = np.zeros(rays.shape[:2], bool)
    for tile in found:
        x, y, z = np.moveaxis(rays @ tile.camera_from_tile, -1, 0)
        u, v = tile.focal_px * x / z + tile.center_px[0], tile.focal_px * y / z + tile.center_px[1]
        shown |= (z > 0) & (u >= 0) & (u < tile.width) & (v >= 0) & (v < tile.height)
    steep = np.abs(rays[..., 1]) > 1.4 * np.cos(np.radians(40)) * np.hypot(rays[..., 0], rays[..., 2])
    assert len(found) == tiles and shown[~steep].mean() > least
    assert all(tile.focal_px == pytest.approx(f, rel=1e-3) for tile in found)
    if tiles == 2:  # one plane is 2 tan(55 deg) = 2.86 wide, two are 4 tan(27.5 deg) = 2.08, and as much less high
        (plane,) = tiles_of(wide, ViewSettings(max_field_deg=120))
        assert sum(tile.valid.sum() for tile in found) < 2.1 / 2.86 * plane.valid.sum()


def test_tiles_count_as_views():
    fisheye = CameraModel("front", 320, 160, Fisheye(100, 100, 160, 80), camera().rig_from_camera)
    clip = Street(frames=50, cameras=(fisheye,))
    views = read_views(clip, ["front"], {}, ViewSettings(max_views=10, max_frames=25))
    assert [view.frame for view in views] == [frame for frame in range(0, 50, 6) for _ in range(3)]
    assert [view.frame for view in views if view.key] == [0, 0, 0, 24, 24, 24, 48, 48, 48]


def test_rolling_shutter_points_project_back():
    base = camera()
    rolling = CameraModel("front", 192, 96, base.lens, base.rig_from_camera, Shutter.TOP_TO_BOTTOM)

    class Rolling(Street):
        def world_from_camera(self, camera_id, index):
            pair = super().world_from_camera(camera_id, index)
            pair[1, 0, 3] += 0.3
            return pair

    clip = Rolling(frames=1, cameras=(rolling,))
    (view,) = read_views(clip, ["front"], {}, ViewSettings())
    assert np.linalg.norm(view.drift_m) == pytest.approx(0.3)
    points = lifting.points_of(view, np.full((96, 192), 0.2, np.float32))
    uv, seen, _ = sensors.project_rolling(rolling, clip.world_from_camera("front", 0), points[::9, ::17].reshape(-1, 3))
    v, u = np.mgrid[0:96:9, 0:192:17] + 0.5
    assert seen.all()
    assert np.abs(uv - np.column_stack([u.ravel(), v.ravel()])).max() < 0.15


@pytest.mark.parametrize(("budget", "width_px"), [(86_000, 640), (85_000, 320), (1_000, 320)])
def test_views_are_narrower_where_their_pixels_outnumber_the_budget(budget, width_px):
    """Four key frames of 640 x 400 have 1,024,000 pixels, 12 for each of 85,333 Gaussians; half is the least width."""
    clip = Street(frames=7, cameras=(camera(width=640, height=400),))
    given = LiftSettings(views=ViewSettings(width_px=640, pixels=1, max_views=4, budget=budget))
    views = _settings_for(clip, ["front"], given).views
    (tile,) = tiles_of(clip.rig.cameras["front"], views)
    assert (tile.width, views.budget) == (width_px, budget)
    assert key_pixels(clip, ["front"], views) == 4 * width_px * width_px * 400 // 640


def test_frames_are_thinned_evenly():
    frames = choose_frames(Street(frames=50), ["front"], 1, ViewSettings(max_views=10, max_frames=25))
    assert [frame for _, frame, _ in frames] == list(range(0, 50, 2))
    # Nine of the 25, spread from the first to the last one: three frames apart.
    assert [frame for _, frame, key in frames if key] == list(range(0, 50, 6))


@pytest.mark.parametrize(("frames", "keys"), [(8, [0, 2, 5, 7]), (9, [0, 2, 4, 6, 8]), (2, [0]), (1, [0])])
def test_the_last_frame_is_a_key_frame_as_the_first_is(frames, keys):
    chosen = choose_frames(Street(frames=frames), ["front"], 1, ViewSettings(max_views=-(-frames // 2)))
    assert [frame for _, frame, key in chosen if key] == keys


@pytest.mark.parametrize(
    ("path_m", "duration_s", "lengths"),
    [
        (20.0, 5.0, 1.0),  # a short log has all limits as they are
        (125.0, 5.0, 2.5),  # the longer of path and duration counts
        (0.0, 15.0, 3.0),
        (5000.0, 600.0, 8.0),  # no more than this
    ],
)
def test_limits_follow_the_length_of_the_log(path_m, duration_s, lengths):
    given = LiftSettings(views=ViewSettings(max_views=40, max_frames=240, budget=900_000, pixels=10**6, width_px=640))
    longer = given.for_log(path_m, duration_s, [(640, 400, 10)])
    views = longer.views
    assert (views.max_views, views.max_frames) == (40 * lengths, 240 * lengths)
    assert (views.budget, views.pixels) == (900_000 * lengths, 10**6 * lengths)
    assert (longer.colours.images, longer.colours.pixels) == (60 * lengths, 50 * 10**6 * lengths)
    assert views.width_px == 640 and longer.points == given.points


@pytest.mark.parametrize(
    ("make", "changed", "message"),
    [
        (ViewSettings, {"budget": -5}, "budget must be 1 or more, got -5"),
        (ViewSettings, {"levels": 1}, "levels must be 2 or more, got 1"),
        (ViewSettings, {"neighbours": -1}, "neighbours must be 0 or more, got -1"),
        (ViewSettings, {"max_field_deg": 0.0}, "max_field_deg must be above 0 and below 180, got 0.0"),
        (ViewSettings, {"pixels_per_gaussian": float("nan")}, "pixels_per_gaussian must be 1 or more, got nan"),
        (ViewSettings, {"min_depth_m": 200.0}, "below max_depth_m, got 200.0 and 150.0"),
        (ColourSettings, {"rounds": -1}, "rounds must be 0 or more, got -1"),
        (ColourSettings, {"images": 0}, "images must be 1 or more, got 0"),
        (ColourSettings, {"pixels": 0}, "pixels must be 1 or more, got 0"),
        (ColourSettings, {"trust": -0.1}, "trust must be 0 or more, got -0.1"),
        (ColourSettings, {"gain_pull": float("nan")}, "gain_pull must be 0 or more, got nan"),
        (LiftSettings, {"duration_s": 0.0}, "duration_s must be positive and finite, got 0.0"),
        (LiftSettings, {"most_lengths": 0.5}, "most_lengths must be 1 or more, got 0.5"),
        (LiftSettings, {"most_detail": 0.0}, "most_detail must be 1 or more, got 0.0"),
    ],
)
def test_impossible_settings_are_named(make, changed, message):
    with pytest.raises(ValueError, match=message):
        make(**changed)


@pytest.mark.parametrize(
    ("width_px", "reduction"),
    [(800, 1), (1200, 1), (1201, 2), (1242, 2), (1600, 2), (1920, 2), (2000, 2), (2048, 3), (3848, 5), (100, 1)],
)
def test_images_are_reduced_by_the_whole_number_that_comes_nearest(width_px, reduction):
    """To 800 pixels; of two as near the smaller, which keeps more: 1200 stays, and 2000 becomes 1000 and not 667."""
    assert ViewSettings().reduction_of(width_px) == reduction


@pytest.mark.parametrize(
    ("path_m", "images", "limits"),
    [
        (20.0, [(1242, 375, 51)], 1.0),  # 621 x 187 a camera
        (20.0, [(700, 500, 100)], 1.0),  # just what one length is for
        (20.0, [(700, 500, 100)] * 3, 3**0.5),
        (20.0, [(1400, 1000, 100)] * 3, 3**0.5),  # worked on at 700 x 500
        (20.0, [(1600, 900, 100)] * 6, 2.0),  # 800 x 450 and six of them: 2.48, but no more than 2
        (100.0, [(1600, 900, 100)] * 6, 4.0),  # twice as long
        (300.0, [(1600, 900, 100)] * 6, 8.0),  # six times as long, but no more than 8
        (20.0, [], 1.0),
    ],
)
def test_limits_follow_what_the_cameras_see_at_once(path_m, images, limits):
    """With the square root of the pixels beyond 350,000, all cameras together; the number of views does not."""
    given = LiftSettings(views=ViewSettings(budget=100_000, max_views=40), colours=ColourSettings(images=50))
    more = given.for_log(path_m, 1.0, images)
    assert more.views.budget == round(100_000 * limits) and more.colours.images == round(50 * limits)
    assert more.views.max_views == round(40 * max(path_m / 50, 1.0))


def test_short_logs_of_large_images_are_worked_on_in_more_detail():
    """8 million pixels: 12 images of 1936 x 1216 fit at half their size; of 300 none does, as in long logs."""
    settings = ViewSettings()
    assert settings.widened([(1936, 1216, 2)] * 6).width_px == 968
    assert settings.widened([(1936, 1216, 50)] * 6) == settings
    assert settings.widened([(1242, 375, 51)]) == settings  # 23.8 million at full size, 5.9 at half
    assert settings.widened([(1600, 900, 1)] * 5).width_px == 1600  # 7.2 million
    assert settings.widened([(320, 192, 10)]) == settings and settings.widened([]) == settings
