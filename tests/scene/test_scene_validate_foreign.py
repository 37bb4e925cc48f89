"""Archives of others, damaged ones and hostile ones: helpful lines, never a crash; and the command line."""

import json
import random
import struct
import time
import zipfile
from pathlib import Path

import pytest
from repetition import slow_after
from scene_worlds import full_scene
from spoilt_archives import INFO, RIG, TRACKS, Members, clipgt, complete_scene, edit, members_of

from nurec_sim import cli
from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import Limits
from nurec_sim.files.zip_package import write_package
from nurec_sim.scene import write_scene
from nurec_sim.scene.interop.validate import CONSUMERS, RULES, contents, openusd, same_scene_ids, validate_archive

pytestmark = pytest.mark.usefixtures("quick_maps")
DOCS = Path(__file__).parents[2] / "docs" / "scene_format.md"


@pytest.fixture(scope="module")
def members(tmp_path_factory) -> Members:
    return members_of(complete_scene(), tmp_path_factory.mktemp("validate"))


def lines(path: Path, *consumers: str) -> list[str]:
    """Findings as texts, each of one line that is not endless."""
    texts = [str(finding) for finding in validate_archive(path, consumers or CONSUMERS)]
    assert all("\n" not in text and len(text) < 1500 for text in texts)
    return texts


# ------------------------------------------------------------------------------------------- archives of other programs


def plain_zip(path: Path, members: dict[str, str | bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as package:
        for name, data in members.items():
            package.writestr(name, data)
    return path


def test_an_archive_of_an_exporter_that_forgot_much(tmp_path):
    """Sidecars as third parties write them first: no box, another chunk, a pinhole, no map, no mesh, no metadata."""
    identity = [[float(i == j) for j in range(4)] for i in range(4)]
    model = {"type": "opencv-pinhole", "parameters": {"resolution": [8, 6], "focal_length": [9.0, 9.0]}}
    camera = {"logical_sensor_name": "front", "T_sensor_rig": identity, "camera_model": model}
    drive = {"sequence_id": "s", "T_rig_worlds": [identity] * 2, "T_rig_world_timestamps_us": [0, 100_000],
             "cameras_frame_timestamps_us": {"front@s": [[10, 20]]}, "rig_bbox": None}  # fmt: skip
    rig = {
        "world_to_nre": {"matrix": identity},
        "camera_calibrations": {"front@s": camera},
        "rig_trajectories": [drive],
    }
    tracks = {"tracks_id": [], "tracks_label_class": [], "tracks_flags": [], "tracks_timestamps_us": [],
              "tracks_poses": []}  # fmt: skip
    chunk = {"chunk_0": {"tracks_data": tracks, "cuboidtracks_data": {"cuboids_dims": []}}}
    members = {RIG: json.dumps(rig), TRACKS: json.dumps(chunk), "checkpoint.ckpt": b"\x80\x02"}
    path = plain_zip(tmp_path / "theirs.usdz", members)
    for consumer, text in (
        ("alpasim", "metadata.yaml is missing; needs metadata.yaml"),
        ("alpasim", "rig_trajectories[0].rig_bbox is null; needs rig_bbox {centroid, dim, rot = 0}"),
        ("alpasim", "the first pose is at 0 us; needs times from 1000000 us on"),
        ("alpasim", "neither map_data/, clipgt/, fastmap/ nor map.xodr"),
        ("alpasim", "mesh_ground.ply is missing"),
        ("carla", "data_info.json is missing"),
        ("carla", "sequence_tracks.json has the top-level keys ['chunk_0']; needs the top-level key 'dummy_chunk_id'"),
        ("carla", "camera_model is of type 'opencv-pinhole'; needs camera_model of type ftheta"),
        ("carla", "has no 'T_world_base'"),
        ("carla", "map.xodr is missing"),
        ("openusd", "the first member is 'rig_trajectories.json'; needs a USD layer as the first member"),
        ("own", "theirs.usdz"),
    ):
        assert any(line.startswith(("error", "warning")) and text in line for line in lines(path, consumer)), text


def test_flags_as_lists_are_taken(members, tmp_path):
    split = edit(TRACKS, lambda d: d["dummy_chunk_id"]["tracks_data"].update(tracks_flags=[["CONTROLLABLE"], []]))
    write_package(tmp_path / "a.usdz", split(members))
    assert lines(tmp_path / "a.usdz", "alpasim", "carla") == []


def test_a_parquet_map_hides_the_other_one(members, tmp_path):
    write_package(tmp_path / "a.usdz", clipgt(drop=["lane"])(members))
    (line,) = lines(tmp_path / "a.usdz", "alpasim")
    assert "clipgt/ lacks lane.parquet" in line and "clipgt/ is read before map.xodr" in line


# ------------------------------------------------------------------------------------------------------- hostile input

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
HEADER = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
LIES = {
    "YAML that grows": ("metadata.yaml", BOMB + "scene_id: *i\nsensors: {camera_ids: *i}\n"),
    "YAML in itself": ("metadata.yaml", "&a\nscene_id: *a\nsensors: *a\ntime_range: *a\n"),
    "YAML of months": ("metadata.yaml", "training_date: 2026-13-77\n"),
    "YAML that runs": ("metadata.yaml", "!!python/object/apply:os.system ['touch /tmp/never']"),
    "YAML that is deep": ("metadata.yaml", "[" * 1200),
    "YAML of bytes": ("metadata.yaml", b"\xff\xfe\x00\xd8"),
    "JSON that is deep": (RIG, "[" * 200_000),
    "JSON of large numbers": (RIG, '{"rig_trajectories": [{"T_rig_world_timestamps_us": [1' + "0" * 4000 + "]}]}"),
    "JSON of endless numbers": (RIG, '{"rig_trajectories": [{"T_rig_world_timestamps_us": [1' + "0" * 9000 + "]}]}"),
    "JSON of no text": (TRACKS, b"\xff\xff"),
    "JSON of NaN": (TRACKS, '{"dummy_chunk_id": NaN}'),
    "JSON of ragged tables": (TRACKS, '{"dummy_chunk_id": {"tracks_data": {"tracks_id": ["a"], "tracks_label_class":'
                              '[1],"tracks_flags": [[[]]], "tracks_timestamps_us": [[1, [2]]], "tracks_poses": [{}]},'
                              '"cuboidtracks_data": {"cuboids_dims": ["abc"]}}}'),
    "XML that grows": ("map.xodr", '<!DOCTYPE a [<!ENTITY b "bb">]><OpenDRIVE>&b;<road/></OpenDRIVE>'),
    "XML that is deep": ("map.xodr", "<OpenDRIVE>" + "<a>" * 100_000),
    "XML of an odd code": ("map.xodr", "<?xml version='1.0' encoding='klingon'?><OpenDRIVE/>"),
    "a mesh of many": ("mesh_ground.ply", HEADER.format("binary_little_endian", 10**15) + FACES.format(10**15)),
    "a mesh of fewer than none": ("mesh_ground.ply", HEADER.format("ascii", -3) + FACES.format(-1)),
    "a mesh of beyond": ("mesh_ground.ply", HEADER.format("ascii", 3) + FACES.format(1) + "0 0 0\n" * 3 + "3 0 1 9\n"),
    "a mesh of words": ("mesh_ground.ply", HEADER.format("ascii", 3) + FACES.format(1) + "a b c\n" * 4),
    "a mesh of nothing": ("mesh.ply", "ply\nend_header\n"),
    "a table of nothing": ("clipgt/lane.parquet", b"PAR1" + bytes(64) + b"PAR1"),
}  # fmt: skip


@pytest.mark.parametrize("name, data", LIES.values(), ids=LIES)
def test_hostile_members(members, tmp_path, name, data):
    data = data if isinstance(data, bytes) else data.encode()
    write_package(tmp_path / "a.usdz", members | {name: data})
    start = time.monotonic()
    texts = lines(tmp_path / "a.usdz", "alpasim", "carla", "own")
    assert any(name.split("/")[0] in text for text in texts)
    assert time.monotonic() - start < 30


def test_a_member_that_grows_when_unpacked(members, tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "LIMITS", Limits(json_bytes=100_000))
    path = plain_zip(tmp_path / "a.usdz", members | {TRACKS: bytes(5_000_000)}, zipfile.ZIP_DEFLATED)
    assert any(f"{TRACKS} has more than 100,000 bytes" in text for text in lines(path))


def test_names_that_leave_the_package(members, tmp_path):
    path = plain_zip(tmp_path / "a.usdz", members | {"../../evil.usda": b"#usda 1.0\n"})
    texts = lines(path)
    assert any("names that leave the package: ['../../evil.usda']" in text for text in texts)
    assert any(text.startswith("error: nurec-sim") and "must stay inside" in text for text in texts)


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_damaged_bytes(members, tmp_path, seed):
    """Whatever byte is changed, whoever is asked: lines and nothing else."""
    good = tmp_path / "good.usdz"
    write_package(good, members)
    data, rng = good.read_bytes(), random.Random(seed)
    directory = data.rfind(b"PK\x05\x06")
    start = struct.unpack_from("<I", data, directory + 16)[0]
    path = tmp_path / "a.usdz"
    for number in range(20):
        spoilt = bytearray(data)
        low = 0 if number % 2 else start  # every other time in the directory
        for _ in range(rng.choice((1, 3, 20))):
            spoilt[rng.randrange(low, len(data))] = rng.randrange(256)
        path.write_bytes(spoilt[: rng.choice((len(data), rng.randrange(len(data))))])
        lines(path, "alpasim", "carla", "own")


ODD = [
    None,
    True,
    -1,
    0.5,
    float("nan"),
    float("inf"),
    2**63,
    10**40,
    1e308,
    "",
    "é\n",
    [],
    {},
    [[]],
    [[1, 2], [3]],
    {"a": 1},
]


def places(value, here=()):
    """Paths to everything in a JSON value; of lists to the first two only."""
    yield here
    parts = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, part in parts:
        yield from places(part, (*here, key))


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_odd_values_in_odd_places(members, tmp_path, seed):
    rng = random.Random(seed)
    light = {name: data for name, data in members.items() if not name.endswith((".usdc", ".npy"))}
    for name in (RIG, TRACKS, INFO):
        paths = [path for path in places(json.loads(members[name])) if path]
        for path in rng.sample(paths, min(8, len(paths))):
            document = json.loads(members[name])
            part = document
            for key in path[:-1]:
                part = part[key]
            part[path[-1]] = rng.choice(ODD)
            write_package(tmp_path / "a.usdz", light | {name: json.dumps(document).encode()})
            lines(tmp_path / "a.usdz", "alpasim", "carla")


# -------------------------------------------------------------------------------------- OpenUSD in its own process


def test_the_other_process_says_the_same(members, tmp_path):
    write_package(tmp_path / "a.usdz", members | {"cameras.usdc": b"#usda 1.0\n"})
    here, apart = (validate_archive(tmp_path / "a.usdz", ["openusd"], usd_limit_s=limit) for limit in (None, 100.0))
    assert here == apart and [finding.rule for finding in here] == ["opens"]


@pytest.mark.parametrize(
    "program, text",
    [
        ("import os; os.abort()", "OpenUSD crashed on the package"),
        ("while True: pass", "did not come to an end in 0.5 s"),
    ],
)
def test_a_crash_or_hang_of_the_other_process_is_a_line(members, tmp_path, monkeypatch, program, text):
    monkeypatch.setattr(openusd, "_PROGRAM", ("-c", program))
    write_package(tmp_path / "a.usdz", members)
    (finding,) = validate_archive(tmp_path / "a.usdz", ["openusd"], usd_limit_s=0.5)
    assert finding.rule == "opens" and text in finding.found


# ------------------------------------------------------------------------------------------------- the command line


def run(capsys, *arguments: str) -> tuple[int, str]:
    try:
        cli.main(list(arguments))
    except SystemExit as end:
        return int(end.code or 0), capsys.readouterr().out
    return 0, capsys.readouterr().out


def test_validate_verb(members, tmp_path, capsys):
    good, bad = tmp_path / "good.usdz", tmp_path / "bad.usdz"
    write_package(good, members)
    write_package(bad, {name: data for name, data in members.items() if name not in ("map.xodr", "mesh.ply")})
    assert run(capsys, "validate", str(good)) == (
        0,
        "good.usdz: nothing missing for AlpaSim, CARLA, OpenUSD, nurec-sim\n",
    )
    status, text = run(capsys, "validate", str(bad), "--for", "alpasim, carla")
    assert status == 1
    first, second, third = text.splitlines()
    assert first.startswith("warning: AlpaSim: the archive has neither map_data/") and first.endswith("[map]")
    assert second.startswith("warning: AlpaSim: mesh.ply is missing; needs mesh.ply") and second.endswith("[mesh]")
    assert third == (
        "error: CARLA: map.xodr is missing; needs map.xodr, OpenDRIVE with roads; otherwise the client stops with a "
        "KeyError [map]"
    )
    assert run(capsys, "validate", str(bad), "--for", "alpasim")[0] == 0  # warnings only


def test_validate_as_json(members, tmp_path, capsys):
    write_package(tmp_path / "a.usdz", {name: data for name, data in members.items() if name != "map.xodr"})
    status, text = run(capsys, "validate", str(tmp_path / "a.usdz"), "--json", "--for", "carla")
    document = json.loads(text)
    assert (status, document["errors"], document["consumers"]) == (1, 1, ["carla"])
    (archive,) = document["archives"]
    assert archive["findings"] == [
        {"consumer": "carla", "rule": "map", "severity": "error", "found": "map.xodr is missing",
         "needs": RULES["carla"]["map"].needs, "loses": RULES["carla"]["map"].loses}
    ]  # fmt: skip


def test_two_archives_of_one_scene(members, tmp_path, capsys):
    paths = [tmp_path / "a.usdz", tmp_path / "b.usdz"]
    for path in paths:
        write_package(path, members)
    assert same_scene_ids(paths[:1]) == [] and len(same_scene_ids(paths)) == 1
    status, text = run(capsys, "validate", *map(str, paths), "--for", "alpasim")
    assert status == 1 and "have the same scene_id" in text


def test_who_is_not_known(tmp_path, capsys):
    with pytest.raises(ArchiveError, match="consumers are alpasim, carla, openusd, own; got blender"):
        validate_archive(tmp_path / "a.usdz", ["blender"])
    with pytest.raises(SystemExit) as end:
        cli.main(["validate", "a.usdz", "--for", "blender"])
    assert end.value.code == 1 and "--for takes alpasim, carla" in capsys.readouterr().err


def test_inspect_shows_an_archive(tmp_path, capsys):
    path = write_scene(full_scene(), tmp_path / "a.usdz")
    status, text = run(capsys, "inspect", str(path))
    assert status == 0 and "400 (other" in text and "nothing missing for nurec-sim" in text
    path.write_bytes(path.read_bytes()[:-100])
    status, text = run(capsys, "inspect", str(path))
    assert status == 1 and text.startswith("error: nurec-sim: ") and "cut short" in text


# ------------------------------------------------------------------------------------------------------------- the page


def test_the_page_lists_every_rule():
    text = DOCS.read_text()
    for consumer, rules in RULES.items():
        section = text.split(f"<!-- rules: {consumer} -->")[1].split("<!-- end -->")[0]
        listed = {row.split("`")[1]: row.split("|")[2].strip() for row in section.splitlines() if row.startswith("| `")}
        assert listed == {name: rule.severity for name, rule in rules.items()}
