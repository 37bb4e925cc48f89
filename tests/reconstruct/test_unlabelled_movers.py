"""What moves without a label: in the picture, never an actor; and actors that nobody labelled are called so."""

import dataclasses
import json
import zipfile

import numpy as np
from metrics_worlds import flat_street
from serving_world import camera_request, scene

from nurec_sim.report import ReportScene
from nurec_sim.report.page import _reconstructions
from nurec_sim.runs.scene_file import record_scene
from nurec_sim.scene import read_scene, scene_hash, summary, write_scene
from nurec_sim.scene.precision import archived
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.types import Needs, Plan


def with_mover():
    """The street whose moving car no box names; the parked one is labelled."""
    known = scene()
    mover = dataclasses.replace(known.tracks[0], id="moving-1", labelled=False, actor=False, controllable=False)
    return dataclasses.replace(known, tracks=(mover, known.tracks[1]))


def without_labels():
    known = scene()
    return dataclasses.replace(known, tracks=(dataclasses.replace(known.tracks[0], id="moving-1", labelled=False),))


def test_archives_keep_who_is_an_actor_and_older_ones_are_read(tmp_path):
    for made in (with_mover(), without_labels(), scene()):
        path = write_scene(made, tmp_path / "a.usdz", overwrite=True)
        back = read_scene(path)
        assert [(t.id, t.labelled, t.actor) for t in back.tracks] == [(t.id, t.labelled, t.actor) for t in made.tracks]
        assert scene_hash(back) == scene_hash(archived(made))
    with zipfile.ZipFile(path) as file:  # of the scene whose tracks are all labelled: written as it always was
        facts = json.loads(file.read("nurec_sim/scene.json"))
        assert set(facts["tracks"][0]) == {"type", "id", "label", "size_m", "path", "controllable"}


def test_clients_are_told_of_actors_only(tmp_path):
    made = with_mover()
    path = write_scene(made, tmp_path / "a.usdz")
    with zipfile.ZipFile(path) as file:
        (chunk,) = json.loads(file.read("sequence_tracks.json")).values()
    assert chunk["tracks_data"]["tracks_id"] == ["parked-1"] and len(chunk["cuboidtracks_data"]["cuboids_dims"]) == 1
    server = SensorServer(SceneStore([made, dataclasses.replace(scene(), id="labelled")]), port=0)
    with server as address, RemoteSensors(address, "street") as mover, RemoteSensors(address, "labelled") as labelled:
        assert [track.id for track in mover.tracks()] == ["parked-1"]
        (shown,), (same,) = mover.sense([camera_request()]), labelled.sense([camera_request()])
        assert np.array_equal(shown.rgb, same.rgb), "it stays in the picture"
        assert (shown.rgb[..., 0].astype(int) - shown.rgb[..., 2] > 100).any()


class Looks:
    name, needs = "looks", Needs(privileged=True)

    def reset(self, rig, seed):
        self.seen = set()

    def plan(self, observation):
        self.seen |= {actor.id for actor in observation.actors}
        steps = np.arange(1, 51)
        return Plan(observation.t_us + 100_000 * steps, np.column_stack([1.0 * steps, 0 * steps, 0 * steps]))


def test_metrics_and_privileged_policies_meet_actors_only():
    policy = Looks()
    rollout = run_rollout(Scenario(name="a", duration_s=1.0), policy, lambda requests: [], with_mover())
    assert rollout.status == "ok" and policy.seen == {"parked-1"}
    assert set(rollout.actors) == set(rollout.actor_labels) == set(rollout.actor_sizes_m) == {"parked-1"}
    blamed = Scenario(name="a", duration_s=1.0, actors={"moving-1": {"hide": True}})
    assert "actors ['moving-1'] are not in the scene" in run_rollout(blamed, policy, lambda r: [], with_mover()).error


def test_the_report_names_what_nobody_labelled():
    street, _ = flat_street()
    movers, found, labelled = (record_scene(dataclasses.replace(made, static=street.static, ego=street.ego))
                               for made in (with_mover(), without_labels(), scene()))  # fmt: skip
    assert movers.counts["tracks"] == 1 and movers.counts["unlabelled movers"] == 1 and movers.actors_known
    (text,) = (text for text in movers.unknown if "unlabelled" in text)
    assert text.startswith("1 unlabelled movers without a box in the log are rendered but are not actors")
    assert text.endswith(": moving-1 (like automobile, 0.0 to 2.0 s)")
    shown = _reconstructions([ReportScene("street", "dense", counts=movers.counts)])
    assert "<dt>actors</dt><dd>1</dd>" in shown and "<dt>unlabelled movers</dt><dd>1</dd>" in shown
    (text,) = (text for text in found.unknown if "labelled" in text)
    assert text.startswith("1 actors were detected by motion and are unlabelled")
    assert found.counts["tracks"] == 1 and "unlabelled movers" not in found.counts and found.actors_known
    assert not any("labelled" in text for text in labelled.unknown)
    assert dict(summary(with_mover()))["tracks"] == "1 actors, 1 additional unlabelled movers"
    assert dict(summary(without_labels()))["tracks"] == "1 actors, 1 of them detected by motion, unlabelled"
    assert dict(summary(scene()))["tracks"] == "2"
