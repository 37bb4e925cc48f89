"""Videos of rollouts: a frame per state, the same bytes every time, nothing rendered twice."""

import dataclasses
import os
import subprocess
import sys

import av
import numpy as np
import pytest
from metrics_worlds import failed_rollout, flat_street, rollout, standing, straight_poses
from striped_images import striped

from nurec_sim import runs, sim
from nurec_sim.errors import RequestError
from nurec_sim.types import Needs, Plan


def test_video_decodes_to_one_frame_per_state_and_is_the_same_every_time(tmp_path):
    run = rollout(straight_poses(13), {"parked": standing(13, 9.0, 0.0)})
    camera = run.rig.cameras["front"]
    first = runs.record_video(run, striped, camera, tmp_path / "a.mp4", width_px=161)
    second = runs.record_video(run, striped, camera, tmp_path / "b.mp4", width_px=161)
    assert first.read_bytes() == second.read_bytes()
    with av.open(str(first)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert float(stream.average_rate) == 10.0
    assert len(frames) == 13 and frames[0].shape == (90, 160, 3)
    assert frames[0][:30].mean(axis=(0, 1)) == pytest.approx((120, 170, 230), abs=6)
    bar = frames[-1][-8:]
    assert frames[0][-8:].astype(int).max() > 150, "the caption is bright"
    assert (bar[..., 0].astype(int) - bar[..., 2] > 60).any(), "the alarm is orange after the contact"
    data = first.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "plays before it is loaded"


ENCODES = """
import hashlib, io
import numpy as np
from nurec_sim.runs.video import write_video

def pictures():
    for index in range(20):
        picture = np.full((96, 160, 3), 120, np.uint8)
        for car in range(20):
            x, y = (7 * car + index * (car % 7 - 3)) % 140, (11 * car + index * (car % 5 - 2)) % 80
            picture[y : y + 12, x : x + 20] = (11 * car, 90, 250 - 12 * car)
        yield picture

target = io.BytesIO()
write_video(target, pictures())
print(hashlib.sha256(target.getvalue()).hexdigest())
"""


@pytest.mark.slow
def test_the_bytes_of_a_video_do_not_depend_on_what_memory_held_before():
    """glibc fills allocated memory with MALLOC_PERTURB_: an encoder that reads what it never wrote gives two."""
    command = [sys.executable, "-c", ENCODES]
    digests = {
        subprocess.run(command, env={**os.environ, "MALLOC_PERTURB_": fill}, capture_output=True, check=True).stdout
        for fill in ("85", "170")
    }
    assert len(digests) == 1


def test_video_refuses_what_it_cannot_show(tmp_path):
    run = rollout(straight_poses(3))
    camera = run.rig.cameras["front"]
    with pytest.raises(RequestError, match="without states"):
        runs.record_video(failed_rollout(), striped, camera, tmp_path / "a.mp4")
    with pytest.raises(RequestError, match="returned 0 frames for 3 requests"):
        runs.record_video(run, lambda requests: [], camera, tmp_path / "a.mp4")
    small = [dataclasses.replace(frame, rgb=np.zeros((4, 4, 3), np.uint8)) for frame in striped_of(run)]
    with pytest.raises(RequestError, match=r"expected an image of 64x36, got one of \(4, 4, 3\)"):
        runs.record_video(run, lambda requests: small, camera, tmp_path / "a.mp4", width_px=64)


def test_images_that_the_policy_got_are_not_rendered_again(tmp_path):
    """Two of five states were seen by the policy: three are rendered, and the two are shown."""
    run = rollout(straight_poses(5))
    seen = {int(run.t_us[index]): np.full((91, 161, 3), 250, np.uint8) for index in (1, 3)}
    rendered = []

    def sense(requests):
        rendered.extend(request.start_us for request in requests)
        return striped(requests)

    path = runs.record_video(run, sense, run.rig.cameras["front"], tmp_path / "a.mp4", width_px=161, seen=seen)
    assert rendered == [int(t) for t in run.t_us[[0, 2, 4]]]
    with av.open(str(path)) as container:
        tops = [frame.to_ndarray(format="rgb24")[:40].mean() for frame in container.decode(video=0)]
    assert np.round(tops, -1).tolist() == [170, 250, 170, 250, 170]


class Looks:
    """Sees the front camera at every plan, and drives straight."""

    name, needs = "looks", Needs(cameras=("front",), image_width_px=32)

    def reset(self, rig, seed): ...

    def plan(self, observation):
        t = np.arange(1, 51) * 100_000
        return Plan(observation.t_us + t, np.column_stack([t * 8e-6, 0 * t, 0 * t]))


def test_the_video_of_a_policy_that_sees_at_every_state_renders_only_the_log_replay_and_the_end(tmp_path):
    """States 0 to 6, log until 3: the policy sees 3, 4 and 5, so the video renders 0, 1, 2 and 6, at its size."""
    scenario = sim.make_scenario({"name": "fast", "duration_s": 0.6, "warm_up_s": 0.3, "replan_s": 0.1})
    calls = []

    def sense(requests):
        calls.append([(request.start_us, request.sensor.width_px) for request in requests])
        return striped(requests)

    scene, _ = flat_street()
    run = runs.execute([scene], scenario, [Looks()], lambda scene: sense, tmp_path, stamp="a")
    t = [int(scene.ego.t_us[0]) + 100_000 * index for index in range(7)]
    assert calls == [[(t[3], 32)], [(t[4], 32)], [(t[5], 32)], [(t[0], 32), (t[1], 32), (t[2], 32)], [(t[6], 32)]]
    with av.open(str(run / "street/lift/looks/0/front.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 7


def test_a_video_that_cannot_be_written_fails_at_once(tmp_path):
    from nurec_sim.runs.video import write_video

    with pytest.raises(OSError):
        write_video(tmp_path / "absent" / "a.mp4", (np.zeros((16, 16, 3), np.uint8) for _ in range(50)))


def striped_of(run):
    from nurec_sim.runs.video import _request

    return striped([_request(run, index, run.rig.cameras["front"], None) for index in range(len(run.states))])


def test_the_ego_vehicle_is_requested_where_the_scene_knows_it(tmp_path):
    run = rollout(straight_poses(3))
    asked = []

    def sense(requests):
        asked.extend(request.show_ego for request in requests)
        return striped(requests)

    for flag in (True, False):
        runs.record_video(run, sense, run.rig.cameras["front"], tmp_path / "a.mp4", width_px=64, show_ego=flag)
    assert asked == [True] * 3 + [False] * 3
