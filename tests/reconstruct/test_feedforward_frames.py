import dataclasses
import itertools
import random

import numpy as np
import pytest
from feedforward_clip import START_US, clip_of, frame_times, looking, pinhole
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim.errors import ReconstructError
from nurec_sim.network.profiles import PROFILES
from nurec_sim.reconstruct.feedforward.inputs.frames import choose_cameras, chunk_windows
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings

FRONT, MULTIVIEW = PROFILES["pa-front"], PROFILES["pa-multiview"]
RELEASE = FeedForwardSettings(chunking="non-overlapping")
ONE = frame_times(1, 1)


def windows(clip, chosen=None, profile=MULTIVIEW, **changes):
    chosen = list(clip.cameras) if chosen is None else chosen
    return chunk_windows(clip, chosen, profile, dataclasses.replace(FeedForwardSettings(), **changes))


# --------------------------------------------------------------------------------------------------------- cameras

SURROUND = {
    "a": (looking(0), 30.0),  # tele
    "b": (looking(1.5), 118.0),
    "c": (looking(66), 120.0),
    "d": (looking(-63), 120.0),
    "e": (looking(147), 70.0),
    "f": (looking(-150), 70.0),
    "g": (looking(180), 60.0),
    "h": (looking(62), 40.0),  # a narrow one beside c
}


@pytest.mark.parametrize("seed", range(6))
def test_cameras_are_chosen_by_where_they_look_whatever_their_order(seed):
    names = list(SURROUND)
    random.Random(seed).shuffle(names)
    clip = clip_of(*(pinhole(n, SURROUND[n][0], field_deg=SURROUND[n][1]) for n in names), times=ONE)
    assert choose_cameras(clip, MULTIVIEW) == ("b", "c", "d", "e", "f")
    assert choose_cameras(clip, FRONT) == ("b",)


def test_three_cameras_where_the_rig_has_no_second_pair():
    names = ("d", "a", "c", "g")
    clip = clip_of(*(pinhole(n, SURROUND[n][0], field_deg=SURROUND[n][1]) for n in names), times=ONE)
    assert choose_cameras(clip, MULTIVIEW) == ("a", "c", "d")


def test_a_stereo_pair_is_one_view_and_a_lone_side_camera_no_pair():
    pair = [pinhole("left", looking(0.02, y=0.3)), pinhole("right", looking(-0.01, y=-0.3))]
    assert choose_cameras(clip_of(*pair, times=ONE), MULTIVIEW) == ("left",)
    assert choose_cameras(clip_of(*pair, pinhole("side", looking(60)), times=ONE), MULTIVIEW) == ("left",)
    sides = [pinhole(f"{side}{k}", looking(60 * sign + k)) for side, sign in (("l", 1), ("r", -1)) for k in (0, 4)]
    assert choose_cameras(clip_of(*pair, *sides, times=ONE), MULTIVIEW) == ("left", "l0", "r0")


def test_a_camera_without_frames_is_not_chosen():
    cameras = [pinhole("wide", looking(0), field_deg=120), pinhole("tele", looking(0), field_deg=30)]
    clip = clip_of(*cameras, times={"wide": ONE[:0], "tele": ONE})
    assert choose_cameras(clip, FRONT) == ("tele",)
    with pytest.raises(ReconstructError, match=r"cameras \['wide'\] have no frames"):
        choose_cameras(clip, FRONT, ["wide"])


def test_named_cameras_are_checked_and_keep_their_order():
    clip = clip_of(*(pinhole(n, SURROUND[n][0]) for n in "abcd"), times=ONE)
    assert choose_cameras(clip, MULTIVIEW, ["d", "a", "c"]) == ("d", "a", "c")
    with pytest.raises(ReconstructError, match=r"'pa-multiview' takes 1 or 3 or 5 cameras, got 2: \['a', 'b'\]"):
        choose_cameras(clip, MULTIVIEW, ["a", "b"])
    with pytest.raises(ReconstructError, match=r"has no camera \['x'\]; have \['a', 'b', 'c', 'd'\]"):
        choose_cameras(clip, MULTIVIEW, ["x"])
    with pytest.raises(ReconstructError, match="once"):
        choose_cameras(clip, MULTIVIEW, ["a", "a", "b"])
    with pytest.raises(ReconstructError, match="takes 5 cameras, but clip 'made' has 3"):
        choose_cameras(clip, dataclasses.replace(MULTIVIEW, cameras=(5,)))


# ---------------------------------------------------------------------------------------------------------- chunks


def test_release_sampling_of_20_seconds():
    """Two chunks of 18 times without a half step; frames by the end of their exposure (spec 1.1)."""
    times = frame_times(601, 33_333, exposure_us=30_000)
    clip = clip_of(pinhole("a"), times=times)
    chunks = chunk_windows(clip, ["a"], FRONT, RELEASE)
    start = clip.ego.start_us  # the poses begin less than 0.1 s before the first exposure ends
    end = min(clip.ego.end_us, int(times[-1, 1]) + 100_000)
    assert len(chunks) == int(np.ceil((end - start) / 13.5e6)) == 2
    for k, frame in enumerate(itertools.chain(*(chunk.frames["a"] for chunk in chunks))):
        assert frame == np.abs(times[:, 1] - start - k * (end - start) / 36).argmin()
    assert [len(chunk.frames["a"]) for chunk in chunks] == [18, 18]
    assert chunks[1].frames["a"][-1] < 600 - 10, "the release does not see the last part"
    assert chunks[0].span_us == (int(times[0, 0]), int(times[chunks[0].frames["a"][-1], 1]))


def test_release_interval_is_where_poses_and_cameras_agree():
    times = {"a": frame_times(100, 100_000), "b": frame_times(60, 100_000, first_us=START_US + 2_000_000)}
    clip = clip_of(pinhole("a"), pinhole("b", looking(60)), times=times)
    (chunk,) = chunk_windows(clip, ["a", "b"], FRONT, RELEASE)
    assert chunk.frames["a"][0] == 19, "0.1 s before the first frame of b"
    assert chunk.frames["b"][0] == 0
    assert chunk.frames["a"][-1] < 79


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seconds=st.floats(0.0, 90.0),
    rate_hz=st.sampled_from([1.0, 3.0, 10.0, 29.97]),
    count=st.integers(1, 18),
    overlap=st.sampled_from([0.0, 0.1, 0.25, 0.5]),
    second_hz=st.sampled_from([2.0, 10.0, 30.0]),
)
def test_overlapping_chunks(seconds, rate_hz, count, overlap, second_hz):
    steps = {"a": round(1e6 / rate_hz), "b": round(1e6 / second_hz)}
    times = {name: frame_times(int(seconds * 1e6 / step) + 1, step, exposure_us=9_000) for name, step in steps.items()}
    clip = clip_of(pinhole("a"), pinhole("b", looking(60)), times=times)
    chunks = windows(clip, frames=count, overlap=overlap, max_chunks=1000)
    first, last = (
        pick(int(times[name][k, 1]) for name in times) for pick, k in ((max, 0), (min, -1))
    )  # what both have
    slack = max(steps.values())
    for chunk in chunks:
        frames = np.array([chunk.frames["a"], chunk.frames["b"]])
        assert 1 <= frames.shape[1] <= count
        assert (np.diff(frames, axis=1) > 0).all()
        ends = np.stack([times[name][row, 1] for name, row in zip("ab", frames, strict=True)])
        assert np.abs(ends[0] - ends[1]).max() <= slack
        assert np.diff(ends, axis=1).max(initial=0) <= 500_000 + 2 * slack
    assert [chunk.index for chunk in chunks] == list(range(len(chunks)))
    assert abs(chunks[0].span_us[0] + 9_000 - first) <= slack
    assert chunks[-1].span_us[1] >= last - 2 * slack, "the last part is seen"
    length = (count - 1) * 0.5
    if last - first <= length * 1e6:
        assert len(chunks) == 1
    for before, after in itertools.pairwise(chunks):
        assert any(after.frames[name][-1] > before.frames[name][-1] for name in "ab")
        assert after.span_us[0] <= before.span_us[1] + 500_000 + 2 * slack


def test_overlapping_chunks_share_frames():
    clip = clip_of(pinhole("a"), times=frame_times(601, 33_333))
    chunks = windows(clip, overlap=0.25)
    assert len(chunks) == 3
    for before, after in itertools.pairwise(chunks):
        shared = set(before.frames["a"]) & set(after.frames["a"])
        assert len(shared) == round(0.25 * 18) and shared == set(after.frames["a"][: len(shared)])
    assert chunks[0].frames["a"][0] == 0 and chunks[-1].frames["a"][-1] == 600
    rates = [17e6 / (chunk.span_us[1] - chunk.span_us[0]) for chunk in chunks]
    assert min(rates) >= 2 and max(rates) <= 4


def test_a_single_camera_shows_more_frames_in_the_same_time():
    tiny, both = PROFILES["tiny"], clip_of(pinhole("a"), pinhole("b", looking(60)), times=frame_times(601, 33_333))
    for seconds, alone, with_another in ((5, 36, 18), (1, 8, 4)):
        log = clip_of(pinhole("a"), pinhole("b", looking(60)), times=frame_times(30 * seconds + 1, 33_333))
        one, two = (
            chunk_windows(log, names, tiny, FeedForwardSettings(profile="tiny")) for names in (("a",), ("a", "b"))
        )
        assert len(one) == len(two) == 1
        assert [len(chunk.frames["a"]) for chunk in (*one, *two)] == [alone, with_another]
    alone, together = (chunk_windows(both, names, tiny, FeedForwardSettings()) for names in (("a",), ("a", "b")))
    assert len(alone) == len(together) and alone[0].span_us[1] == pytest.approx(together[0].span_us[1], rel=0.1)
    asked = chunk_windows(both, ("a",), tiny, FeedForwardSettings(frames=18))
    assert [chunk.frames["a"] for chunk in asked] == [chunk.frames["a"] for chunk in together]
    with pytest.raises(ReconstructError, match=r"'tiny' takes 1 to 36 frames per camera, got 37"):
        chunk_windows(both, ("a",), tiny, FeedForwardSettings(frames=37))
    with pytest.raises(ReconstructError, match=r"'tiny' takes 1 to 18 frames per camera, got 36"):
        chunk_windows(both, ("a", "b"), tiny, FeedForwardSettings(frames=36))
    release = chunk_windows(both, ("a",), tiny, FeedForwardSettings(chunking="non-overlapping"))
    assert max(len(chunk.frames["a"]) for chunk in release) <= 18


@pytest.mark.parametrize("chunking", ["overlapping", "non-overlapping"])
@pytest.mark.parametrize(
    ("count", "step_us"), [(1, 100_000), (2, 100_000), (3, 1_000_000), (10, 100_000), (51, 103_439)]
)
def test_short_logs_give_no_frame_twice(count, step_us, chunking):
    cameras = [pinhole("a"), pinhole("b", looking(60)), pinhole("c", looking(-60))]
    times = {c.id: frame_times(count, step_us, first_us=START_US + 17_000 * k) for k, c in enumerate(cameras)}
    (chunk,) = windows(clip_of(*cameras, times=times), chunking=chunking)
    frames = np.array(list(chunk.frames.values()))
    assert (np.diff(frames, axis=1) > 0).all()
    shown = np.array([times[name][list(row), 1] for name, row in chunk.frames.items()])
    assert np.ptp(shown, axis=0).max() <= step_us + 34_000, "every step sees all cameras at about the same time"
    if chunking == "overlapping":
        assert frames[0, 0] == 0 and frames[0, -1] == count - 1
        assert frames.shape[1] == {1: 1, 2: 2, 3: 3, 10: 4, 51: 18}[count]


@pytest.mark.parametrize("chunking", ["overlapping", "non-overlapping"])
def test_frames_do_not_depend_on_the_epoch(chunking):
    def frames(first_us):
        times = frame_times(500, 33_367, first_us=first_us, exposure_us=21_111)
        return [c.frames for c in windows(clip_of(pinhole("a"), times=times), chunking=chunking)]

    assert frames(1_000_000) == frames(START_US) == frames(START_US + 1)


def test_refusals_of_chunking():
    clip = clip_of(pinhole("a"), times=frame_times(1000, 100_000))
    with pytest.raises(ReconstructError, match=r"99\.9 s at 18 frames .* are 15 chunks, but max_chunks is 4"):
        windows(clip, max_chunks=4)
    with pytest.raises(ReconstructError, match=r"'pa-multiview' takes 1 to 18 frames per camera, got 19"):
        windows(clip, frames=19)
    with pytest.raises(ReconstructError, match=r"overlap must lie in 0\.\.0\.5, got 0\.9"):
        windows(clip, overlap=0.9)
    times = {"a": frame_times(3, 100_000), "b": frame_times(3, 100_000, first_us=START_US + 5_000_000)}
    with pytest.raises(ReconstructError, match="no time in common"):
        windows(clip_of(pinhole("a"), pinhole("b", looking(60)), times=times))
