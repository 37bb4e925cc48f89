"""Lanes from OpenDRIVE maps of other programs, against places worked out by hand."""

import foreign_files as made
import numpy as np
import pytest
from nurec_archives import small_arrays

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene import read_scene
from nurec_sim.scene.opendrive.reader import ecef_from_map, lanes_from

LANES = """<lanes><laneOffset s="0" a="{offset}" b="0" c="0" d="0"/><laneSection s="0">
<left><lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left><center/>
<right><lane id="-2" type="driving"><width sOffset="0" a="4" b="0.1" c="0" d="0"/></lane>
<lane id="-1" type="shoulder"><width sOffset="0" a="1" b="0" c="0" d="0"/></lane></right></laneSection></lanes>"""


def xodr(shape, length, x=0.0, y=0.0, heading=0.0, offset=0.0, geo=""):
    return f"""<?xml version="1.0"?><OpenDRIVE><header><geoReference>{geo}</geoReference></header>
<road length="{length}"><planView><geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{length}">{shape}</geometry>
</planView><elevationProfile><elevation s="0" a="1" b="0.1" c="0" d="0"/></elevationProfile>
{LANES.format(offset=offset)}</road></OpenDRIVE>""".encode()


def test_a_straight_road_has_its_lanes_beside_it():
    left, right = lanes_from(xodr("<line/>", 10, 5, 7, np.pi / 2, 0.5), "a")
    assert np.allclose(left[[0, -1]], [[5 - 2, 7, 1], [5 - 2, 17, 2]])
    # Beyond a shoulder of 1 m, 4 m wide at the start and 5 m at the end.
    assert np.allclose(right[[0, -1]], [[5 + 2.5, 7, 1], [5 + 3, 17, 2]])


def test_curves_end_where_they_must():
    quarter = 20 * np.pi / 2
    left, _ = lanes_from(xodr('<arc curvature="0.05"/>', quarter), "a")
    assert np.allclose(left[-1, :2], [18.5, 20], atol=0.01)
    s = (np.arange(100_000) + 0.5) / 100_000
    heading = 0.1 * 30 * s**2 / 2
    end = 30 * np.array([np.cos(heading).mean(), np.sin(heading).mean()])
    left, _ = lanes_from(xodr('<spiral curvStart="0" curvEnd="0.1"/>', 30), "a")
    normal = np.array([-np.sin(1.5), np.cos(1.5)])
    assert np.allclose(left[-1, :2], end + 1.5 * normal, atol=0.01)
    poly = 'aU="0" bU="10" cU="0" dU="0" aV="0" bV="0" cV="2" dV="0"'
    left, _ = lanes_from(xodr(f"<paramPoly3 {poly}/>", 10.2), "a")
    slope = np.array([10, 4]) / np.hypot(10, 4)
    assert np.allclose(left[-1, :2], [10 - 1.5 * slope[1], 2 + 1.5 * slope[0]], atol=0.01)


def test_the_map_is_placed_by_its_geodetic_origin():
    """A place north of the world's origin: one arc minute of latitude is a nautical mile, give or take."""
    base = ecef_from_map(xodr("<line/>", 1, geo="+lat_0=48.0 +lon_0=11.0 +=alt_0=100"), "a")
    north = ecef_from_map(xodr("<line/>", 1, geo="+lat_0=48.0166666667 +lon_0=11.0 +alt_0=100"), "a")
    shift = (geometry.inverse(base) @ north)[:3, 3]
    assert abs(shift[0]) < 1e-6 and abs(shift[1] - 1853) < 2 and abs(shift[2]) < 1
    assert np.isclose(np.linalg.norm(base[:3, 3]), 6_366_800, atol=1500)
    assert ecef_from_map(xodr("<line/>", 1, geo="+proj=tmerc"), "a") is None


@pytest.mark.parametrize(("y", "text"), [(0.0, "no drivable areas"), (500.0, "m away from the path")])
def test_a_map_is_used_if_it_lies_where_the_car_drove(tmp_path, y, text):
    members = {"volume.nurec": made.volume(small_arrays()), "map.xodr": xodr("<line/>", 60, -5, y, 0, -1.5)}
    scene = read_scene(made.usdz(tmp_path / "a.usdz", members | made.json_sidecars()))
    assert any(text in each for each in scene.provenance["unknown"])
    assert (scene.road_map is None) == (y > 0)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"<a/>", "no OpenDRIVE map"),
        (b"<OpenDRIVE>", "no XML, or damaged"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><OpenDRIVE/>", "entities are not read"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><OpenDRIVE/>".encode("utf-16"), "XML must be UTF-8"),
        (xodr("<line/>", 1e12), "roads of more than"),
        (xodr("<line/>", "nan"), "finite number"),
        (xodr("<circle/>", 5), "<circle> is not known"),
        (xodr("<arc/>", 5), "needs a finite number as 'curvature'"),
    ],
)
def test_maps_that_cannot_be_read(data, text):
    with pytest.raises(ArchiveError, match=text):
        lanes_from(data, "map.xodr")
