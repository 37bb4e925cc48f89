"""Chunks of a clip become one scene: colours are aligned, layers joined, and it is counted what went where."""

import dataclasses

import numpy as np
import pytest
from chunk_worlds import chunk, drive, image
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import camera, cloud, gaussians, moving_cloud, request, scene

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.feedforward.merging.alignment import LARGEST_GAIN, UNSEEN_WEIGHT, colour_map
from nurec_sim.reconstruct.feedforward.merging.merge import merge_chunks
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.render import CpuRenderer
from nurec_sim.types import Gaussians

SMALL = settings(max_examples=25, deadline=None)
KEEP_ALL = FeedForwardSettings(max_gaussians=None)


# ------------------------------------------------------------------------------------------------------------ colours


def affine(gain=(1.0, 1.0, 1.0), offset=(0.0, 0.0, 0.0), mix=0.0):
    matrix = np.diag(gain) + mix * (np.ones((3, 3)) - np.eye(3))
    return np.concatenate([matrix, np.asarray(offset, np.float64)[:, None]], axis=1)


def shown(row, rgb):
    return rgb @ row[:, :3].T + row[:, 3]


def test_defect_1_static_colours_are_aligned_too():
    """Both chunks saw the same grey; the second calls it brighter by 0.25 and says so in its rows."""
    rows = {"front": affine(offset=(-0.25, -0.25, -0.25))}
    moving = moving_cloud(20)
    first = chunk(gaussians([[5, 0, 0]], rgb=(0.4, 0.4, 0.4)), sky=0.4)
    second = chunk(
        gaussians([[6, 0, 0]], rgb=(0.65, 0.65, 0.65)), isp=rows, sky=0.65,
        dynamic=dataclasses.replace(moving, gaussians=gaussians(moving.gaussians.mean_m, rgb=(0.65, 0.65, 0.65))),
    )  # fmt: skip
    merged = merge_chunks([first, second], KEEP_ALL)
    assert np.allclose(merged.static.rgb, 0.4, atol=1e-6)
    assert np.allclose(merged.dynamic.gaussians.rgb, 0.4, atol=1e-6)
    assert np.allclose(merged.sky, 0.4, atol=1e-6)
    assert np.allclose(merged.isp["front"], np.eye(3, 4))
    assert merged.counts["colours_not_aligned"] == []
    # What came in is as it was.
    assert np.allclose(second.static.rgb, 0.65) and np.allclose(second.sky, 0.65)


def test_no_seam_is_shown_where_chunks_meet():
    """A wall whose halves come from two chunks of different canonical colours, drawn through the rows of the result."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-30, 30) * 0.1 + 0.05, np.arange(-20, 20) * 0.1))
    places = np.stack([np.full(y.size, 5.0), y, z], axis=1)
    display = np.array([0.5, 0.4, 0.3])
    rows = [affine((1.1, 0.9, 1.0), (0.02, 0.0, -0.03), 0.05), affine((0.8, 1.2, 0.9), (0.1, -0.05, 0.05), -0.04)]
    chunks = []
    for row, half in zip(rows, (y > 0, y < 0), strict=True):
        canonical = np.linalg.solve(row[:, :3], display - row[:, 3])
        wall = gaussians(places[half], scale=(0.002, 0.08, 0.08), opacity=0.95, rgb=canonical)
        chunks.append(chunk(wall, [image(camera())], {"front": row}, sky=canonical))
    merged = merge_chunks(chunks, KEEP_ALL)
    world = scene(merged.static, sky=merged.sky, isp=merged.isp)
    rgb = CpuRenderer(world).render_camera(request(camera()), ("rgb",)).rgb
    assert np.abs(rgb.astype(int) - np.round(display * 255).astype(int)).max() <= 1
    unaligned = scene(Gaussians.concatenate([c.static for c in chunks]), sky=merged.sky, isp=merged.isp)
    seam = CpuRenderer(unaligned).render_camera(request(camera()), ("rgb",)).rgb.astype(int)
    assert np.abs(seam[24, 10] - seam[24, 60]).max() > 30


@SMALL
@given(seed=st.integers(0, 10_000), cameras=st.integers(1, 5))
def test_what_the_reference_shows_is_what_the_chunk_showed(seed, cameras):
    """Rows that differ by one change of canonical colours are aligned exactly, whatever the cameras' own rows."""
    rng = np.random.default_rng(seed)
    change = affine(rng.uniform(0.6, 1.6, 3), rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.1, 0.1))
    own, reference = {}, {}
    for name in map(str, range(cameras)):
        row = affine(rng.uniform(0.7, 1.4, 3), rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1))
        own[name] = row
        reference[name] = np.concatenate(
            [row[:, :3] @ change[:, :3], (row[:, :3] @ change[:, 3] + row[:, 3])[:, None]], 1
        )
    colour = colour_map(own, reference)
    assert colour.ridge == 0.0
    rgb = rng.random((50, 3))
    mapped = rgb @ colour.matrix.T + colour.offset
    for name in own:
        assert np.allclose(shown(reference[name], mapped), shown(own[name], rgb), atol=1e-9)
    inside = ((mapped > 0) & (mapped < 1)).all(axis=1)
    assert np.allclose(colour(rgb.astype(np.float32))[inside], mapped[inside], atol=1e-6)
    assert colour(rgb.astype(np.float32)).min() >= 0 and colour(rgb.astype(np.float32)).max() <= 1


def test_cameras_that_disagree_are_met_in_the_least_squares_sense():
    rng = np.random.default_rng(3)
    own = {name: affine(mix=0.02) + rng.normal(0, 0.05, (3, 4)) for name in "abc"}
    reference = {name: affine(mix=-0.02) + rng.normal(0, 0.05, (3, 4)) for name in "abc"}
    colour = colour_map(own, reference)

    def error(y):
        full = [np.vstack([row, (0, 0, 0, 1)]) for row in own.values()]
        return sum(
            np.sum((row @ y - np.vstack([ref, (0, 0, 0, 1)])) ** 2)
            for row, ref in zip(full, reference.values(), strict=True)
        )

    y = np.linalg.inv(np.vstack([np.concatenate([colour.matrix, colour.offset[:, None]], axis=1), (0, 0, 0, 1)]))
    for _ in range(50):
        step = np.zeros((4, 4))
        step[:3] = rng.normal(0, 1e-3, (3, 4))
        assert error(y) <= error(y + step)


@pytest.mark.parametrize(
    "rows",
    [np.zeros((3, 4)), affine((1, 1, 0)), affine((-1, 1, 1)), affine((1e-6, 1, 1)), affine((1e4, 1e4, 1e4)),
     affine(offset=(50, 0, 0)), np.random.default_rng(0).normal(size=(3, 4)) * 3],
    ids=["zero", "no blue", "mirrored", "hardly red", "huge", "far off", "random"],
)  # fmt: skip
def test_absurd_rows_change_colours_only_so_far(rows):
    for own, reference in ((rows, np.eye(3, 4)), (np.eye(3, 4), rows), (rows, affine((0.9, 1, 1.1)))):
        colour = colour_map({"front": own}, {"front": reference})
        gains = np.linalg.svd(colour.matrix, compute_uv=False)
        assert gains.max() <= LARGEST_GAIN * 1.001 and gains.min() >= 1 / LARGEST_GAIN / 1.001
        mapped = colour(np.random.default_rng(1).random((20, 3)).astype(np.float32))
        assert np.isfinite(mapped).all() and mapped.min() >= 0 and mapped.max() <= 1


def test_a_channel_left_open_stays_and_the_others_are_aligned():
    """Neither row says anything of blue: only there is the identity better than what was asked for."""
    own, reference = affine((1.0, 1.0, 0.0)), affine((0.5, 0.8, 0.0))
    colour = colour_map({"front": own}, {"front": reference})
    assert 0 < colour.ridge <= 1e-3
    assert np.allclose(colour.matrix, np.diag([2.0, 1.25, 1.0]), atol=0.01)


@pytest.mark.parametrize("rows", [{"other": affine((2, 2, 2))}, {"front": np.full((3, 4), np.nan)}, {}])
def test_colours_stay_where_nothing_can_be_compared(rows):
    second = chunk(cloud(20, 1), isp=rows, sky=0.9)
    merged = merge_chunks([chunk(cloud(20), sky=0.9), second], dataclasses.replace(KEEP_ALL, merge="concatenate"))
    assert merged.counts["colours_not_aligned"] == [1]
    assert np.array_equal(merged.static.rgb[20:], cloud(20, 1).rgb) and np.allclose(merged.sky, 0.9)
    assert list(merged.isp) == ["front", *(camera_id for camera_id in rows if camera_id != "front")]


def test_a_camera_that_only_a_later_chunk_has_shows_what_it_showed():
    """Its row is written in the reference's colours."""
    own = {"front": affine((0.8, 1.0, 1.2), (0.05, 0, 0)), "left": affine((0.9, 0.9, 0.9), (0, 0.02, 0), 0.05)}
    rgb = np.full((1, 3), 0.5, np.float32)
    second = chunk(gaussians([[6, 0, 0]], rgb=rgb), isp=own)
    merged = merge_chunks([chunk(), second], KEEP_ALL)
    assert list(merged.isp) == ["front", "left"]
    for name in own:
        assert np.allclose(shown(merged.isp[name], merged.static.rgb), shown(own[name], rgb), atol=1e-6)


def test_view_dependent_colours_change_with_the_others():
    static = cloud(10, sh=3)
    second = chunk(static, isp={"front": affine((2.0, 1.0, 0.5))})
    merged = merge_chunks([chunk(cloud(1, sh=3)), second], dataclasses.replace(KEEP_ALL, merge="concatenate"))
    assert np.allclose(merged.static.sh_rest[1:], static.sh_rest * (2.0, 1.0, 0.5), atol=1e-6)


def test_skies_are_weighted_by_how_surely_they_were_seen():
    merged = merge_chunks([chunk(sky=0.2, seen=1.0), chunk(sky=0.8, seen=0.0)], KEEP_ALL)
    assert np.allclose(
        merged.sky, ((1 + UNSEEN_WEIGHT) * 0.2 + UNSEEN_WEIGHT * 0.8) / (1 + 2 * UNSEEN_WEIGHT), atol=1e-6
    )
    assert merged.sky.dtype == np.float32
    unseen = merge_chunks([chunk(sky=0.2, seen=0.0), chunk(sky=0.8, seen=0.0)], KEEP_ALL)
    assert np.allclose(unseen.sky, 0.5, atol=1e-6)


# ------------------------------------------------------------------------------------------------------ the whole of it


def road_trip(number):
    """Chunks along a road, each with what it alone saw, and what it sees far ahead."""
    chunks = []
    for k in range(number):
        static = cloud(40, seed=k, low=(20 * k + 4, -4, -1), high=(20 * k + 60, 4, 2))
        chunks.append(
            chunk(static, drive(camera(), 20.0 * k), dynamic=moving_cloud(5, seed=k), sky=0.1 * k % 1,
                  isp={"front": affine((1 + 0.02 * k, 1.0, 1 - 0.02 * k))})
        )  # fmt: skip
    return chunks


def test_defect_5_more_than_eight_chunks_become_one_scene():
    chunks = road_trip(10)
    merged = merge_chunks(chunks, dataclasses.replace(KEEP_ALL, merge="concatenate"))
    assert len(merged.static) == merged.counts["static"] == 400
    assert np.array_equal(merged.static.mean_m, np.concatenate([c.static.mean_m for c in chunks]))
    assert len(merged.dynamic) == 50 and merged.counts["chunks"] == 10
    owned_ones = merge_chunks(chunks, KEEP_ALL)
    # Every chunk is still there with what it saw from nearest.
    for one in chunks:
        assert (owned_ones.static.mean_m[:, None] == one.static.mean_m[None]).all(axis=2).any()


def test_counts_say_where_gaussians_went():
    chunks = road_trip(3)
    chunks[1] = dataclasses.replace(
        chunks[1], static=dataclasses.replace(chunks[1].static, mean_m=np.where(
            np.arange(40)[:, None] < 3, np.float32(np.nan), chunks[1].static.mean_m)),
    )  # fmt: skip
    told = []
    merged = merge_chunks(
        chunks, FeedForwardSettings(max_gaussians=50), lambda stage, fraction: told.append((stage, fraction))
    )
    counts = merged.counts
    assert counts["static_before"] == [40, 40, 40] and counts["not_drawable"] == [0, 3, 0]
    assert counts["owned_by_others"][0] > 0 and counts["owned_by_others"][-1] >= 0
    assert counts["static_merged"] == 120 - 3 - sum(counts["owned_by_others"]) > 50
    assert 45 <= counts["static"] == len(merged.static) <= 50 and counts["voxel_m"] > 0
    assert counts["dynamic"] == len(merged.dynamic) == 15
    fractions = [fraction for _, fraction in told]
    assert fractions[0] == 0 and fractions[-1] == 1 and fractions == sorted(fractions)


def test_dynamic_gaussians_are_only_joined():
    chunks = road_trip(3)
    merged = merge_chunks(chunks, KEEP_ALL)
    for name in ("knot_t_us", "knot_m", "track"):
        joined = np.concatenate([getattr(c.dynamic, name) for c in chunks])
        assert np.array_equal(getattr(merged.dynamic, name), joined)
        assert getattr(merged.dynamic, name).dtype == joined.dtype


def test_a_single_chunk_stays_as_it_is():
    one = chunk(cloud(30), isp={"front": affine((2, 1, 0.4))}, dynamic=moving_cloud(5))
    keep = one.static[one.static.opacity > 0.01]
    merged = merge_chunks([dataclasses.replace(one, static=keep)], KEEP_ALL)
    assert merged.static is keep and merged.dynamic is one.dynamic and merged.sky is one.sky
    assert np.array_equal(merged.isp["front"], one.isp["front"])


def test_the_same_chunks_give_the_same_bytes():
    first, second = (merge_chunks(road_trip(3), FeedForwardSettings(max_gaussians=60)) for _ in range(2))
    for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal", "label"):
        assert getattr(first.static, name).tobytes() == getattr(second.static, name).tobytes()
    assert first.sky.tobytes() == second.sky.tobytes() and dict(first.counts) == dict(second.counts)


@SMALL
@given(order=st.permutations(range(1, 4)))
def test_only_the_first_chunk_has_a_place_of_its_own(order):
    """The reference of the colours stays; the others may come in any order."""
    chunks = road_trip(4)
    merged, shuffled = (merge_chunks([chunks[k] for k in (0, *rest)], KEEP_ALL) for rest in (range(1, 4), order))

    def rows(layers):
        table = np.concatenate([layers.static.mean_m, layers.static.rgb, layers.static.opacity[:, None]], axis=1)
        return table[np.lexsort(table.T)]

    assert np.allclose(rows(merged), rows(shuffled), atol=1e-6)
    assert np.allclose(merged.sky, shuffled.sky, atol=1e-6)


def test_what_cannot_be_merged_is_refused():
    with pytest.raises(ReconstructError, match="need at least 1, got 0"):
        merge_chunks([], KEEP_ALL)
    with pytest.raises(ReconstructError, match=r"must have one size, got \[\(6, 4, 4, 3\), \(6, 8, 8, 3\)\]"):
        merge_chunks([chunk(), chunk(size=8)], KEEP_ALL)
    assert len(merge_chunks([chunk(), chunk()], KEEP_ALL).static) == 0
