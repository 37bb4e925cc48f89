"""What of a view other images show, by hand: a wall 10 m ahead, of which a box 5 m ahead hides a part."""

import numpy as np
import pytest

from nurec_sim import sensors
from nurec_sim.evaluate.covisible import TrueImage, covisible
from nurec_sim.types import CameraModel, Pinhole, SensorRequest, Track, Trajectory
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.sense.truth import TrueView

WIDTH, HEIGHT, FOCAL_PX = 80, 40, 40.0
CAMERA = CameraModel("front", WIDTH, HEIGHT, Pinhole(FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2), np.eye(4))
WALL_M, BOX_M = 10.0, 5.0


def image(right_m=0.0, box_m=None, t_us=0):
    """The camera looks along z; the upper half is sky. A box, 2 m wide, is centred at x = ``box_m``."""
    rays, _ = sensors.pixel_rays(CAMERA)
    z = np.full((HEIGHT, WIDTH), WALL_M)
    instance = np.zeros((HEIGHT, WIDTH), np.int32)
    if box_m is not None:
        column_m = rays[..., 0] / rays[..., 2] * BOX_M + right_m
        inside = np.abs(column_m - box_m) < 1
        z[inside], instance[inside] = BOX_M, 1
    sky = (rays[..., 1] < 0) & (instance == 0)
    range_m = np.where(sky, 0, z / rays[..., 2]).astype(np.float32)
    surface = np.where(sky, SurfaceClass.SKY, SurfaceClass.BUILDING).astype(np.uint8)
    blank = np.zeros((HEIGHT, WIDTH, 3))
    view = TrueView(blank.astype(np.uint8), np.where(sky, 0, z).astype(np.float32), surface, instance,
                    blank.astype(np.float32), range_m)  # fmt: skip
    pose = np.eye(4)
    pose[0, 3] = right_m
    return TrueImage(SensorRequest("", CAMERA, t_us, t_us + 1, np.stack([pose, pose])), view)


def standing(box_m):
    pose = np.eye(4)
    pose[:3, 3] = box_m, 0.0, BOX_M
    return Track("box", "automobile", (2.0, 2.0, 2.0), Trajectory(np.array([0, 1]), np.stack([pose, pose])))


def moving(from_m, to_m):
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[:, :3, 3] = (from_m, 0.0, BOX_M), (to_m, 0.0, BOX_M)
    return Track("box", "automobile", (2.0, 2.0, 2.0), Trajectory(np.array([0, 1_000_000]), poses))


def columns(shown, rows):
    """Columns in which all of the rows are shown."""
    return np.flatnonzero(shown[rows].all(axis=0))


def test_an_image_shows_all_that_itself_shows():
    assert covisible(image(), [image()], ()).all()
    assert not covisible(image(), [], ()).any()


def test_what_lies_beyond_the_border_is_not_shown():
    """2 m to the right the wall 10 m ahead moves by 8 pixels, the sky not at all."""
    other = image()
    # A pixel in the corner as far as what lies beyond the right border: not the same.
    other.view.surface[0, 0], other.view.range_m[0, 0] = SurfaceClass.BUILDING, 15.0
    shown = covisible(image(right_m=2.0), [other], ())
    assert shown[1 : HEIGHT // 2].all(), "the sky is as far as can be"
    assert columns(shown, slice(HEIGHT // 2, None)).tolist() == list(range(72))
    both = covisible(image(right_m=2.0), [image(), image(right_m=4.0)], ())
    assert both.all(), "the other image shows the rest"


def test_what_something_hides_is_not_shown():
    """The box hides columns 32 to 47 of the input, so wall from x = -2 to 2 m, and sky in these directions."""
    shown = covisible(image(), [image(box_m=0.0)], [standing(0.0)])
    visible = [*range(32), *range(48, WIDTH)]
    assert columns(shown, slice(HEIGHT // 2, None)).tolist() == visible
    assert columns(shown, slice(HEIGHT // 2)).tolist() == visible


def test_what_moves_is_looked_for_where_it_was():
    """The box moves from x = -1 to 1 m. What shows it where it was shows it; a standing one would not be there."""
    before, after = image(box_m=-1.0), image(box_m=1.0, t_us=1_000_000)
    box = after.view.instance == 1
    assert box.sum() == 16 * HEIGHT
    assert covisible(after, [before], [moving(-1.0, 1.0)])[box].all()
    assert not covisible(after, [before], [standing(1.0)])[box].any()


@pytest.mark.parametrize(("off_m", "shown"), [(0.4, True), (0.5, False)])
def test_surfaces_are_the_same_to_15_cm_and_3_percent(off_m, shown):
    """At 10 m that is 0.45 m along the ray; the pixels in the middle look straight ahead."""
    other = image()
    other.view.range_m[...] -= np.float32(off_m)
    assert covisible(image(), [other], ())[HEIGHT // 2, WIDTH // 2] == shown
