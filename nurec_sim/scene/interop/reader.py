"""Reads third-party scene files; missing data get defaults listed in ``provenance``.

In archives with several kinds of Gaussians the first readable one is used: particle fields, ``volume.nurec``,
``checkpoint.ckpt``, PLY files. NuRec files are not extracted, unpickled or executed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files.new_files import temporary_folder
from nurec_sim.files.zip_package import Package
from nurec_sim.scene.checks import check_scene
from nurec_sim.scene.interop.found import Found
from nurec_sim.scene.interop.nurec.checkpoint import read_checkpoint
from nurec_sim.scene.interop.nurec.layers import found_in
from nurec_sim.scene.interop.nurec.rig_sidecars import DATA_INFO, MAP, RIG, TRACKS, Surroundings, read_surroundings
from nurec_sim.scene.interop.nurec.volume import read_volume
from nurec_sim.scene.interop.ply import ply_up, read_ply
from nurec_sim.scene.interop.sky_sidecar import SkySidecar, read_sky, sky_paths
from nurec_sim.scene.interop.spz import read_spz
from nurec_sim.scene.interop.surroundings import colours_in, colours_of, first_colours, surroundings_of, taken_from
from nurec_sim.scene.interop.usd.composition import may_hold
from nurec_sim.scene.interop.usd.particle_field import read_particle_fields
from nurec_sim.scene.transform import joined, transformed, world_from_up
from nurec_sim.scene.usd.dome_texture import sample_cubemap
from nurec_sim.scene.usd.layers import LAYER_SUFFIXES
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene, Label, Track

FIELDS = "particle fields"
SPLAT_FILES: dict[str, tuple[Callable[[Path], tuple[Gaussians, int]], Callable[[Path], str]]] = {
    ".ply": (read_ply, ply_up),
    ".spz": (read_spz, lambda _: "y"),
}
"""Formats with Gaussians only: their readers, and default up axes."""
CONVERTIBLE = (".sog", ".ksplat", ".splat", ".lcc")
_MESHES = ("mesh.ply", "mesh_ground.ply")


def read_foreign(
    path: Path | str,
    *,
    sky: Path | str | None = None,
    like: GaussianScene | Clip | None = None,
    up: str | None = None,
) -> GaussianScene:
    """Reads a third-party scene.

    Args:
        path: a ``.usdz`` of NuRec or with particle fields, a USD layer, a ``.ply``, ``.spz``, ``.nurec`` or ``.ckpt``
            file.
        sky: a sky file that overrides sky and colour corrections; default: ``X.sky.npz`` beside ``X.ply``, if it
            exists.
        like: a scene or a log in the same world that supplies missing data.
        up: up axis, one of ``UP_AXES``, for formats that do not define it; default: y for SPZ; for PLY its comment,
            else z.

    Returns:
        A valid scene; ``provenance["unknown"]`` lists ignored and missing parts.

    Raises:
        ArchiveError: not such a file, damaged, unsafe, or without Gaussians; or ``up`` is invalid or not applicable.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if up is not None:
        world_from_up(up)
    if up not in (None, "z") and suffix not in SPLAT_FILES:
        raise ArchiveError(f"{path}: only for {' and '.join(SPLAT_FILES)} can another axis than z be up; got {up!r}")
    if not path.is_file():
        raise ArchiveError(f"{path}: cannot be opened ({'Is a directory' if path.is_dir() else 'No such file'})")
    around = Surroundings(missing=["no sensors, path, times and tracks: the file holds Gaussians only"])
    sidecar = None
    try:
        if suffix in SPLAT_FILES:
            read, usual_up = SPLAT_FILES[suffix]
            up = up or usual_up(path)
            world_from_file = world_from_up(up)
            around.nre_from_world = geometry.pose(world_from_file.T, np.zeros(3))
            sky = sky or next((file for file in sky_paths(path)[:1] if file.exists()), None)
            sidecar = None if sky is None else read_sky(sky, world_from_file)
            found, source = _splats(read, path), path.name
        elif suffix in LAYER_SUFFIXES:
            found, source = read_particle_fields(path), path.name
        elif suffix == ".nurec":
            found, source = found_in(read_volume(path.read_bytes(), str(path)), str(path)), path.name
        elif suffix == ".ckpt":
            with path.open("rb") as file:
                found, source = found_in(read_checkpoint(file, str(path)), str(path)), path.name
        elif suffix == ".usdz":
            with Package(path) as package:
                around = read_surroundings(package)
                found, source = _find(package, around)
        else:
            allowed = (".usdz", *LAYER_SUFFIXES, *SPLAT_FILES, ".nurec", ".ckpt")
            text = f"{path}: no scene; names of scenes end in {', '.join(allowed)}"
            if suffix in CONVERTIBLE:
                text += (
                    f"; `splat-transform {path.name} {path.stem}.ply` (npm: @playcanvas/splat-transform) makes a PLY"
                )
            raise ArchiveError(text)
        if not found.count:
            raise ArchiveError(f"{path}: {source} holds no Gaussians. {' '.join(found.unknown)}")
        if sky is not None and sidecar is None:
            sidecar = read_sky(sky)
        scene = _assembled(path, found, around, source, like, sidecar)
        taken = taken_from(sky, like) | ({} if up is None else {"up": up})
        scene = dataclasses.replace(scene, provenance=dict(scene.provenance) | taken)
        check_scene(scene)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ArchiveError as error:
        raise error if str(path) in str(error) else ArchiveError(f"{path}: {error}") from error
    return scene


# ------------------------------------------------------------------------------------------------- where Gaussians are


def _splats(read: Callable[[Path], tuple[Gaussians, int]], path: Path) -> Found:
    """Reads a file that has Gaussians only."""
    gaussians, dropped = read(path)
    unknown = ["no moving Gaussians: the file holds one instant", "no LiDAR intensity: the file holds none"]
    if not (gaussians.label == Label.ROAD).any():
        unknown.append("no road: no Gaussian has a road_mask (off-road cannot be judged from the scene)")
    return Found(static=[gaussians], dropped=dropped, unknown=unknown)


def _find(package: Package, around: Surroundings) -> tuple[Found, str]:
    """The Gaussians of an archive, and their source."""
    readers = _readers(package)
    faults: list[str] = []
    volumes: dict[str, np.ndarray] = {}
    for number, (source, read) in enumerate(readers, start=1):
        try:
            found = read()
        except ArchiveError as error:
            faults.append(str(error))
            continue
        if found.count:
            found.unknown += [f"passed over: {fault}" for fault in faults]
            found.unknown += [f"{name} is not read, because {source} is" for name, _ in readers[number:]]
            _name_the_rest(package, found, source)
            if source in volumes and RIG not in package.names:
                found.static = [transformed(part, volumes[source]) for part in found.static]
            return found, source
        around.unknown += found.unknown
        volumes |= found.volumes
    raise ArchiveError(
        f"{package.path}: no Gaussians that can be read: neither nurec_sim/manifest.json (ours), particle fields, "
        f"volume.nurec, checkpoint.ckpt nor a PLY. {' '.join(faults)}".rstrip()
    )


def _readers(package: Package) -> list[tuple[str, Callable[[], Found]]]:
    """Possible sources of Gaussians, in order of preference."""
    names = package.names
    readers: list[tuple[str, Callable[[], Found]]] = []
    # Without a rig the stage defines the transform of a volume.
    kinds = (b"ParticleField",) if RIG in names else (b"ParticleField", b"OmniNuRecFieldAsset")
    if may_hold(package, *kinds):
        readers.append((FIELDS, partial(read_particle_fields, package.path)))
    readers += [(name, partial(_volume, package, name)) for name in names if name.endswith(".nurec")]
    readers += [(name, partial(_checkpoint, package, name)) for name in names if name.endswith(".ckpt")]
    if plys := [name for name in names if name.lower().endswith(".ply") and name not in _MESHES]:
        readers.append((", ".join(plys), partial(_plys, package, plys)))
    return readers


def _volume(package: Package, name: str) -> Found:
    where = f"{package.path}: {name}"
    return found_in(read_volume(package.read(name), where), where)


def _checkpoint(package: Package, name: str) -> Found:
    where = f"{package.path}: {name}"
    with package.open(name) as file:
        return found_in(read_checkpoint(file, where), where)


def _plys(package: Package, names: list[str]) -> Found:
    """The Gaussians of all PLY members."""
    found, faults = Found(), []
    for name in names:
        with temporary_folder() as folder:
            path = folder / "part.ply"
            path.write_bytes(package.read(name))
            try:
                gaussians, dropped = read_ply(path)
            except ArchiveError as error:
                faults.append(str(error).replace(str(path), name))
                continue
        found.static.append(gaussians)
        found.dropped += dropped
    if not found.static:
        raise ArchiveError(" ".join(faults))
    found.unknown += [f"passed over: {fault}" for fault in faults]
    return found


def _name_the_rest(package: Package, found: Found, source: str) -> None:
    """Reports unread members, grouped by folder."""
    read = {RIG, TRACKS, DATA_INFO, MAP, *source.split(", ")}
    ends = (".nurec", ".ckpt", *(LAYER_SUFFIXES if source == FIELDS else ()))
    members = [name for name in package.names if name not in read and not name.lower().endswith(ends)]
    others = sorted({name.split("/")[0] + ("/" if "/" in name else "") for name in members})
    if others:
        more = f" and {len(others) - 30} more" if len(others) > 30 else ""
        found.unknown.append(f"members that are not read: {', '.join(others[:30])}{more}")


# ---------------------------------------------------------------------------------------------------------- the scene


def _assembled(
    path: Path,
    found: Found,
    around: Surroundings,
    source: str,
    like: GaussianScene | Clip | None,
    sidecar: SkySidecar | None,
) -> GaussianScene:
    unknown = [*(around.missing if like is None else ()), *around.unknown, *found.unknown]
    known = surroundings_of(like)
    if around.ego is not None and around.rig is not None:
        known |= {"ego": around.ego, "rig": around.rig, "span_us": around.span_us}
        known["tracks"] = around.tracks or known["tracks"]
        known["camera_times_us"] = {name: times for name, times in around.camera_times_us.items() if len(times)}
    elif like is None:
        unknown.append("the car stands at the origin for one second, one camera looks along x")
    known["road_map"] = around.road_map or known["road_map"]
    if known["road_map"] is None:
        unknown.append("no road map is read")
    # Gaussians are in the NRE frame, path and tracks in the world: everything is brought to the world.
    world_from_nre = geometry.inverse(around.nre_from_world)
    static = joined([_moved(part, world_from_nre) for part in found.static])
    dynamic = _dynamic(found, known["tracks"], known["span_us"][0], unknown)
    own_sky = None if found.sky is None else _turned_sky(found.sky, world_from_nre[:3, :3])
    own_isp = _exposure(found, around, unknown)
    sky, isp = first_colours([colours_in(sidecar), (own_sky, own_isp or None), colours_of(like)], unknown)
    provenance = {"method": "foreign", "file": path.name, "source": source, "dropped": found.dropped,
                  "unknown": unknown}  # fmt: skip
    return GaussianScene(
        id=around.id or path.stem,
        static=static,
        dynamic=dynamic,
        sky=sky,
        isp=isp,
        provenance=provenance,
        **known,
    )


def _exposure(found: Found, around: Surroundings, unknown: list[str]) -> dict[str, Float64[np.ndarray, "3 4"]]:
    """Colour gains of the cameras."""
    if found.exposure and len(found.exposure) != len(around.camera_order):
        unknown.append(f"colour correction: exposure of {len(found.exposure)} cameras, of {len(around.camera_order)}")
        return {}
    gains = zip(around.camera_order, found.exposure, strict=False)
    known = () if around.rig is None else around.rig.cameras
    return {name: np.eye(3, 4) * gain for name, gain in gains if name in known}


def _dynamic(found: Found, tracks: list[Track], t_us: int, unknown: list[str]) -> DynamicGaussians:
    """Rigid parts with their tracks; names may have a scene suffix after ``@``."""
    index_of = {track.id.split("@")[0]: k for k, track in enumerate(tracks)}
    parts: list[Gaussians] = []
    owners: list[np.ndarray] = []
    lost: list[str] = []
    for name, gaussians in found.boxed.items():
        index = index_of.get(name.split("@")[0])
        if index is None:
            lost.append(name)
            continue
        parts += gaussians
        owners += [np.full(len(part), index, np.int32) for part in gaussians]
    if lost:
        count = sum(len(part) for name in lost for part in found.boxed[name])
        shown = ", ".join(ascii(name)[:40] for name in lost[:5])
        unknown.append(f"{count:,} Gaussians of {len(lost)} tracks without a path are not drawn: {shown}")
    if not parts:
        return DynamicGaussians.empty()
    return DynamicGaussians.rigid(joined(parts), np.concatenate(owners), t_us)


def _moved(gaussians: Gaussians, a_from_b: Float64[np.ndarray, "4 4"]) -> Gaussians:
    return gaussians if np.array_equal(a_from_b, np.eye(4)) else transformed(gaussians, a_from_b)


def _turned_sky(sky: np.ndarray, world_from_nre: Float64[np.ndarray, "3 3"]) -> np.ndarray:
    """The sky in world axes, interpolated if rotated."""
    if np.array_equal(world_from_nre, np.eye(3)):
        return sky
    # Row vectors: d @ R is R^T d, the direction in the NRE frame of a world direction d.
    directions = geometry.cubemap_directions(sky.shape[1]) @ world_from_nre
    return sample_cubemap(sky, directions).astype(np.float32)
