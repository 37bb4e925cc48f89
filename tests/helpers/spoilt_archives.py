"""Good archives spoilt in one place: ways to break them, and what each break of a sidecar must be called."""

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from datetime import date
from pathlib import Path

import polars
import yaml
from scene_worlds import START_US, full_scene

from nurec_sim.scene import archive, write_scene
from nurec_sim.types import GaussianScene

Members = dict[str, bytes]
Spoil = Callable[[Members], Members]

RIG, TRACKS, INFO, META = "rig_trajectories.json", "sequence_tracks.json", "data_info.json", "metadata.yaml"
CAMERA = 'roof@clip-é "7"'


def complete_scene() -> GaussianScene:
    """One of everything, with nothing that any consumer would miss: only the wildest lens is left out."""
    scene = full_scene()
    plain = {name: camera for name, camera in scene.rig.cameras.items() if name != "front"}
    return dataclasses.replace(scene, rig=dataclasses.replace(scene.rig, cameras=plain), isp={})


def members_of(scene: GaussianScene, folder: Path) -> Members:
    with zipfile.ZipFile(write_scene(scene, folder / "good.usdz")) as package:
        return {name: package.read(name) for name in package.namelist()}


def hashed(members: dict[str, bytes]) -> dict[str, bytes]:
    """The members with a manifest that fits them: so that our own reader has nothing to say about a change."""
    if archive.MANIFEST not in members:
        return members
    manifest = json.loads(members[archive.MANIFEST])
    manifest["sha256"] = {n: hashlib.sha256(d).hexdigest() for n, d in members.items() if n != archive.MANIFEST}
    return members | {archive.MANIFEST: json.dumps(manifest).encode()}


# Ways to break an archive: each takes and gives its members.


def without(name):
    return lambda members: {key: data for key, data in members.items() if key != name}


def put(name, data):
    return lambda members: members | {name: data}


def edit(name, change):
    """Changes the value of a JSON or YAML member in place."""

    def spoil(members):
        value = yaml.safe_load(members[name]) if name.endswith("yaml") else json.loads(members[name])
        change(value)
        text = yaml.safe_dump(value) if name.endswith("yaml") else json.dumps(value)
        return members | {name: text.encode()}

    return spoil


def drive(change):
    return edit(RIG, lambda document: change(document["rig_trajectories"][0]))


def camera(change):
    return edit(RIG, lambda document: change(document["camera_calibrations"][CAMERA]))


def lens(**changes):
    return camera(lambda one: one["camera_model"]["parameters"].update(changes))


def frames(times):
    return drive(lambda one: one["cameras_frame_timestamps_us"].update({CAMERA: times}))


def track(name, value, index=0):
    return edit(TRACKS, lambda document: document["dummy_chunk_id"]["tracks_data"][name].__setitem__(index, value))


def clipgt(drop=(), **tables):
    """The six tables of a map in AlpaSim's parquet form."""
    key = {"clip_id": "c", "map_id": "1", "kind": "LANE"}
    rail = [{"x": float(x), "y": 0.0, "z": 0.0} for x in range(3)]
    rows = {name: [{"key": key, name: {"location": rail}}] for name in
            ("association", "road_boundary", "clip", "traffic_sign", "wait_line")}  # fmt: skip
    rows["lane"] = [{"key": key, "lane": {"left_rail": rail, "right_rail": rail}}]

    def spoil(members):
        added = {}
        for name, table in (rows | tables).items():
            if name not in drop:
                buffer = io.BytesIO()
                (table if isinstance(table, polars.DataFrame) else polars.DataFrame(table)).write_parquet(buffer)
                added[f"clipgt/{name}.parquet"] = buffer.getvalue()
        return members | added

    return spoil


def xodr(shape, width, y=0.0):
    """A straight lane along x, about y."""
    return f"""<OpenDRIVE><header><geoReference>+lat_0=0 +lon_0=0</geoReference></header><road id="0" junction="-1">
<planView><geometry s="0" x="-5" y="{y + width / 2}" hdg="0" length="60">{shape}</geometry></planView><lanes>
<laneSection s="0"><right><lane id="-1" type="driving"><width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road></OpenDRIVE>""".encode()


def both(*rules):
    return {f"{consumer} {rule}" for rule in rules for consumer in ("alpasim", "carla")}


OUT_OF_PATH = START_US + 60_000_000
UNEQUAL = {"left_rail": [{"x": 0.0, "y": 0.0, "z": 0.0}] * 3, "right_rail": [{"x": 0.0, "y": 0.0, "z": 0.0}] * 2}
KEY = {"clip_id": "c", "map_id": "1", "kind": "LANE"}
PLY = (b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
       b"element face 1\nproperty list uchar int vertex_indices\nend_header\n%s")  # fmt: skip

SIDECAR_BREAKS: dict[str, tuple[Spoil, set[str]]] = {
    # --------------------------------------------------------------------------------------- metadata.yaml (2.1)
    "no metadata": (without(META), {"alpasim metadata-file"}),
    "metadata is a list": (put(META, b"[1]"), {"alpasim metadata-file"}),
    "metadata is no YAML": (put(META, b"a: [b"), {"alpasim metadata-file"}),
    **{f"metadata without {key}": (edit(META, lambda m, key=key: m.pop(key)), {"alpasim metadata-fields"})
       for key in ("scene_id", "version_string", "training_date", "dataset_hash", "uuid", "is_resumable", "sensors",
                   "logger", "time_range")},
    "the date is a date": (edit(META, lambda m: m.update(training_date=date(2026, 1, 2))), {"alpasim metadata-fields"}),
    "resumable maybe": (edit(META, lambda m: m.update(is_resumable="no")), {"alpasim metadata-fields"}),
    "camera ids are numbers": (edit(META, lambda m: m["sensors"].update(camera_ids=[1])), {"alpasim metadata-fields"}),
    "no lidar ids": (edit(META, lambda m: m["sensors"].pop("lidar_ids")), {"alpasim metadata-fields"}),
    "the end is a text": (edit(META, lambda m: m["time_range"].update(end="late")), {"alpasim metadata-fields"}),
    "seconds for microseconds": (edit(META, lambda m: m.update(time_range={"start": 1.7e9, "end": 1.7e9 + 4})),
                                 {"alpasim time-range"}),
    # -------------------------------------------------------------------------------- rig_trajectories.json (2.2)
    "no rig": (without(RIG), both("rig-file")),
    "the rig is no JSON": (put(RIG, b"{"), both("rig-file")),
    "no trajectories": (edit(RIG, lambda d: d.pop("rig_trajectories")), both("rig-file")),
    "two trajectories": (edit(RIG, lambda d: d["rig_trajectories"].append({})), both("one-trajectory")),
    "no trajectory": (edit(RIG, lambda d: d.update(rig_trajectories=[])), both("one-trajectory")),
    "no sequence": (drive(lambda t: t.pop("sequence_id")), {"alpasim sequence-id"}),
    "no world_to_nre": (edit(RIG, lambda d: d.pop("world_to_nre")), {"alpasim world-to-nre"}),
    "world_to_nre is 3x4": (edit(RIG, lambda d: d["world_to_nre"]["matrix"].pop()), {"alpasim world-to-nre"}),
    "world_to_nre moves": (edit(RIG, lambda d: d["world_to_nre"]["matrix"][0].__setitem__(3, 40.0)),
                           {"alpasim one-frame"}),
    "no poses": (drive(lambda t: t.pop("T_rig_worlds")), both("path")),
    "a pose too few": (drive(lambda t: t["T_rig_worlds"].pop()), both("path")),
    "a pose of three rows": (drive(lambda t: t["T_rig_worlds"][0].pop()), both("path")),
    "a time twice": (drive(lambda t: t["T_rig_world_timestamps_us"].__setitem__(1, t["T_rig_world_timestamps_us"][0])),
                     both("path")),
    "times are floats": (drive(lambda t: t["T_rig_world_timestamps_us"].__setitem__(0, 0.5)), both("path")),
    "a mirrored pose": (drive(lambda t: t["T_rig_worlds"][3][2].__setitem__(2, -1.0)), both("path")),
    "a pose of NaN": (drive(lambda t: t["T_rig_worlds"][3][2].__setitem__(2, float("nan"))), both("path")),
    "one pose": (drive(lambda t: (t.update(T_rig_worlds=t["T_rig_worlds"][:1],
                                           T_rig_world_timestamps_us=t["T_rig_world_timestamps_us"][:1]))),
                 {"alpasim duration", "alpasim first-frame", "carla pose-range"}),
    "times before half a second": (drive(lambda t: t["T_rig_world_timestamps_us"].__setitem__(0, 400_000)),
                                   {"alpasim start-time"}),
    "no camera": (edit(RIG, lambda d: d.update(camera_calibrations={})), both("calibrations")),
    "a camera without a name": (camera(lambda c: c.pop("logical_sensor_name")), both("calibrations")),
    "no frame times": (drive(lambda t: t.pop("cameras_frame_timestamps_us")), {"alpasim frame-times"}),
    "a camera without frames": (drive(lambda t: t["cameras_frame_timestamps_us"].pop(CAMERA)), {"alpasim frame-times"}),
    "an empty list of frames": (frames([]), {"alpasim frame-times"}),
    "a frame without length": (frames([[START_US + 9, START_US + 9]]), {"alpasim frame-times"}),
    "a frame of three times": (frames([[START_US + 9, START_US + 10, START_US + 11]]), {"alpasim frame-times"}),
    "a frame twice": (frames([[START_US + 9, START_US + 10]] * 2), {"alpasim frame-times"}),
    "frames of floats": (frames([[START_US + 0.5, START_US + 10.5]]), {"alpasim frame-times"}),
    "all frames too late": (frames([[OUT_OF_PATH, OUT_OF_PATH + 9]]), {"alpasim first-frame"}),
    "some frames too late": (frames([[START_US + 60_009, START_US + 60_010], [OUT_OF_PATH, OUT_OF_PATH + 9]]),
                             {"alpasim frames-inside"}),
    "a first frame at once": (frames([[START_US + 9, START_US + 49_999]]), {"alpasim shutter-room"}),
    "no box": (drive(lambda t: t.pop("rig_bbox")), {"alpasim rig-box"}),
    "the box is null": (drive(lambda t: t.update(rig_bbox=None)), {"alpasim rig-box"}),
    "a flat box": (drive(lambda t: t["rig_bbox"].update(dim=[4.0, 0.0, 1.0])), {"alpasim rig-box"}),
    "a turned box": (drive(lambda t: t["rig_bbox"].update(rot=[0, 0, 0.1])), {"alpasim rig-box"}),
    "no base frame": (edit(RIG, lambda d: d.pop("T_world_base")), both("base-frame")),
    # ---------------------------------------------------------------------------------- sequence_tracks.json (2.3)
    "no tracks file": (without(TRACKS), both("tracks-file")),
    "tracks are a list": (put(TRACKS, b"[]"), both("tracks-file")),
    "two chunks": (edit(TRACKS, lambda d: d.update(other={})), {"alpasim tracks-key"}),
    "another key": (edit(TRACKS, lambda d: d.update(chunk_0=d.pop("dummy_chunk_id"))), {"carla tracks-key"}),
    "no dims": (edit(TRACKS, lambda d: d["dummy_chunk_id"].pop("cuboidtracks_data")), both("tracks-fields")),
    "no flags": (edit(TRACKS, lambda d: d["dummy_chunk_id"]["tracks_data"].pop("tracks_flags")), both("tracks-fields")),
    "ids are numbers": (track("tracks_id", 7), both("tracks-fields")),
    "a flag too few": (edit(TRACKS, lambda d: d["dummy_chunk_id"]["tracks_data"]["tracks_flags"].pop()),
                       both("tracks-lengths")),
    "flags are numbers": (track("tracks_flags", 3, 1), both("track-flags")),
    "a flat cuboid": (edit(TRACKS, lambda d: d["dummy_chunk_id"]["cuboidtracks_data"]["cuboids_dims"][0].pop()),
                      both("track-dims")),
    "a sample without a pose": (edit(TRACKS, lambda d: d["dummy_chunk_id"]["tracks_data"]["tracks_poses"][0].pop()),
                                both("track-samples")),
    "track times go back": (track("tracks_timestamps_us", [START_US + 5, START_US + 4], 1), both("track-samples")),
    "a long quaternion": (track("tracks_poses", [[0, 0, 0, 0, 0, 0, 1.1], [0, 0, 0, 0, 0, 0, 1]], 1),
                          both("track-quaternions")),
    "one sample": (lambda m: track("tracks_poses", [[0, 0, 0, 0, 0, 0, 1]], 1)(
        track("tracks_timestamps_us", [START_US], 1)(m)), {"alpasim track-two-samples"}),
    "an id twice": (track("tracks_id", "1:car"), {"alpasim track-ids"}),
    "a car that moves uncontrolled": (track("tracks_flags", "DYNAMIC"), {"alpasim static-moves"}),
    # ------------------------------------------------------------------------------------------- maps, meshes (2.4)
    "no map": (without("map.xodr"), {"alpasim map", "carla map"}),
    "a map of another kind": (put("map.xodr", b"<osm/>"), {"alpasim xodr", "carla map"}),
    "a map that is cut": (put("map.xodr", b"<OpenDRIVE><road>"), {"alpasim xodr", "carla map"}),
    "a map without roads": (put("map.xodr", b"<OpenDRIVE/>"), {"alpasim xodr", "carla map"}),
    "a map that is nowhere": (put("map.xodr", b"<OpenDRIVE><road/></OpenDRIVE>"), {"alpasim xodr", "carla map-origin"}),
    "a map without an origin": (
        put("map.xodr", b"<OpenDRIVE><header><geoReference>+proj=utm</geoReference></header><road/></OpenDRIVE>"),
        {"alpasim xodr-lanes", "carla map-origin"}),
    "a map of cubics": (put("map.xodr", xodr("<paramPoly3/>", 3.5)), {"alpasim xodr-lanes"}),
    "a map elsewhere": (put("map.xodr", xodr("<line/>", 3.5, y=500)),
                        {"alpasim lane-under-path", "alpasim offroad-agrees"}),
    "a lane as wide as half a car": (put("map.xodr", xodr("<line/>", 1.0)),
                                     {"alpasim lane-under-path", "alpasim offroad-on-path", "alpasim offroad-agrees"}),
    "a good clipgt": (clipgt(), set()),
    "a clipgt and no base frame": (lambda m: edit(RIG, lambda d: d.pop("T_world_base"))(clipgt()(m)),
                                   {"carla base-frame"}),
    "no wait lines": (clipgt(drop=["wait_line"]), {"alpasim clipgt"}),
    "no lanes": (clipgt(lane=polars.DataFrame({"key": [KEY], "lane": [UNEQUAL]}).head(0)), {"alpasim clipgt"}),
    "unequal rails": (clipgt(lane=[{"key": KEY, "lane": UNEQUAL}]), {"alpasim clipgt"}),
    "keys of numbers": (clipgt(clip=[{"key": 3, "clip": 4}]), {"alpasim clipgt"}),
    "a table that is none": (lambda m: clipgt()(m) | {"clipgt/lane.parquet": b"PAR1"}, {"alpasim clipgt"}),
    "no ground": (without("mesh_ground.ply"), {"alpasim mesh-ground"}),
    "ground of squares": (put("mesh_ground.ply", PLY % (4, b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n")),
                          {"alpasim mesh-ground"}),
    "ground elsewhere": (put("mesh_ground.ply", PLY % (3, b"900 0 0\n901 0 0\n901 1 0\n3 0 1 2\n")),
                         {"alpasim mesh-under-path"}),
    "no mesh": (without("mesh.ply"), {"alpasim mesh"}),
    # --------------------------------------------------------------------------------------------- CARLA's own files
    "no data info": (without(INFO), {"carla data-info"}),
    "no sequence id": (edit(INFO, lambda d: d.pop("sequence_id")), {"carla data-info"}),
    "no pose range": (edit(INFO, lambda d: d.pop("pose-range")), {"carla data-info"}),
    "a pose range that is too long": (edit(INFO, lambda d: d["pose-range"].update({"end-timestamp_us": OUT_OF_PATH})),
                                      {"carla pose-range"}),
    "no interval": (edit(INFO, lambda d: d.pop("sequence_timestamp_interval_us")), {"carla interval"}),
    "another sequence": (edit(INFO, lambda d: d.update(sequence_id="other")), {"carla scene-name"}),
    "a camera without a pose": (camera(lambda c: c.pop("T_sensor_rig")), {"carla camera-pose"}),
    "a pinhole": (camera(lambda c: c["camera_model"].update(type="opencv-pinhole")), {"carla camera-model"}),
    "no distortion key": (camera(lambda c: c["camera_model"]["parameters"].pop("external_distortion_parameters")),
                          {"carla camera-model"}),
    "no angle": (lens(max_angle=0), {"carla camera-model"}),
    "one polynomial": (lens(angle_to_pixeldist_poly=[]), {"carla polynomials"}),
    "a reference of another name": (lens(reference_poly="FORWARD"), {"carla polynomials"}),
    "polynomials of two lenses": (lens(angle_to_pixeldist_poly=[0, 900.0, 0, 0, 0, 0]), {"carla polynomials-agree"}),
    "a poor fit": (camera(lambda c: c.update(ftheta_fit_error_px={"rms": 1.0, "max": 4.0})), {"carla fit-error"}),
    "a slow shutter": (lens(shutter_type="SLOW"), {"carla shutter"}),
}  # fmt: skip
