"""The scene archive: a ``.usdz`` that stores a GaussianScene and opens in USD tools and AlpaSim.

Layout, see ``docs/scene_format.md``: USD layers are authoritative for geometry and appearance; ``nurec_sim/`` has data
that USD cannot represent exactly; JSON, YAML, PLY and XODR files at the root are for other simulators. Nothing is
pickled. The same scene gives the same bytes. Numbers are kept at the precision of ``scene.precision``.
"""

from __future__ import annotations

import dataclasses
import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.files.npy import array_from_npy, npy_bytes
from nurec_sim.files.zip_package import Package, write_package
from nurec_sim.scene import codec, knots, pictures
from nurec_sim.scene.checks import check_scene
from nurec_sim.scene.describe import scene_hash
from nurec_sim.scene.facts import facts_from_json, scene_facts
from nurec_sim.scene.precision import archived
from nurec_sim.scene.sidecars import ftheta_fits, sidecars
from nurec_sim.scene.usd.actors import actors_layer, field_paths, read_columns
from nurec_sim.scene.usd.cameras import cameras_layer
from nurec_sim.scene.usd.dome_texture import latlong_exr
from nurec_sim.scene.usd.fields import gather, read_field
from nurec_sim.scene.usd.layers import (
    ACTORS_LAYER,
    CAMERAS_LAYER,
    SKY_TEXTURE,
    STATIC_LAYER,
    open_member,
    root_layer,
    static_layer,
)
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, RoadMap

FORMAT_VERSION = 3
"""Version 1 had float32 everywhere, and the knots of all moving Gaussians; version 2 all normals, halves instead of
bytes, the sky as an array, and columns of moving Gaussians as members. Both are still read."""
MANIFEST = "nurec_sim/manifest.json"
FACTS, ISP, SKY = "nurec_sim/scene.json", "nurec_sim/isp.json", "nurec_sim/sky_cubemap.png"
SKY_OF_VERSION_2 = "nurec_sim/sky_cubemap.npy"
EXPOSURES = "nurec_sim/exposures.json"
EGO_IMAGES = "nurec_sim/ego_images"
TRUTH = (STATIC_LAYER, ACTORS_LAYER, FACTS, ISP)
"""Members required by ``read_archive`` besides the sky, those of ``scene.knots`` and the optional ``EXPOSURES``; others
are for other programs."""


def write_scene(
    scene: GaussianScene, path: Path | str, *, overwrite: bool = False, derived_map: RoadMap | None = None
) -> Path:
    """Writes a scene archive atomically.

    Args:
        scene: the scene; validated first. The archive keeps ``scene.precision.archived(scene)``.
        path: ends in ``.usdz``; missing folders are created.
        overwrite: whether an existing file may be replaced.
        derived_map: a map for other simulators (``map.xodr``) that is not part of the scene, for a scene without a map.

    Returns:
        The path.

    Raises:
        ArchiveError: the file exists, the name does not end in ``.usdz``, or the scene is invalid.
    """
    path = Path(path)
    if path.suffix != ".usdz":
        raise ArchiveError(f"a scene archive's name must end in .usdz, got {path.name!r}")
    if path.exists() and not overwrite:
        raise ArchiveError(f"{path} exists; pass overwrite=True to replace it")
    check_scene(scene)
    scene = archived(scene)
    fits = ftheta_fits(scene)
    arrays, columns = knots.knot_arrays(scene.dynamic)
    with ThreadPoolExecutor(1) as beside:
        hashed, texture = beside.submit(scene_hash, scene), beside.submit(latlong_exr, scene.sky)
        layers = {
            "default.usda": root_layer(scene, FORMAT_VERSION),
            STATIC_LAYER: static_layer(scene.static),
            ACTORS_LAYER: actors_layer(scene, columns),
            CAMERAS_LAYER: cameras_layer(scene, fits),
        }
        digest, sky = hashed.result(), texture.result()
    members = {
        **layers,
        SKY_TEXTURE: sky,
        **sidecars(scene, digest, fits, derived_map),
        FACTS: codec.dump(scene_facts(scene), FACTS),
        ISP: codec.dump(scene.isp, ISP, indent=2),
        SKY: pictures.png_of_sky(scene.sky),
        **{name: npy_bytes(array) for name, array in arrays.items()},
    }
    if scene.exposures:
        members[EXPOSURES] = codec.dump(scene.exposures, EXPOSURES)
    for camera, image in scene.ego_images.items():
        members[f"{EGO_IMAGES}/{camera}.png"] = pictures.png_of_ego_image(image)
    members[MANIFEST] = codec.dump(_manifest(scene, digest, members), MANIFEST, indent=2)
    write_package(path, members)
    return path


def read_archive(path: Path | str) -> GaussianScene:
    """Reads a scene archive written by ``write_scene``, of this version of the format or an earlier one.

    Nothing is extracted, unpickled or executed, and no file outside the archive is opened.

    Raises:
        ArchiveError: not such an archive, damaged, modified, unsafe, or an invalid scene.
    """
    path = Path(path)
    with Package(path) as package:
        manifest = _read_manifest(package)
        version, counts = manifest["version"], manifest["counts"]
        columns_there = knots.columns_of(version, bool(counts.get("dynamic_in_box")))
        column_members = () if version > 2 else map(knots.member_of, columns_there)
        sky_member = SKY if version > 2 else SKY_OF_VERSION_2
        _check_hashes(package, manifest, (*TRUTH, sky_member, *knots.KINDS, *column_members))
        facts_json = codec.load(package.read(FACTS, LIMITS.json_bytes), f"{path}: {FACTS}")
        facts = facts_from_json(facts_json, f"{path}: {FACTS}")
        static_usd = open_member(path, STATIC_LAYER)
        static = _read_fields(static_usd, ["/Static/background", "/Static/road"], counts["static"], f"{path}: static")
        actors_usd = open_member(path, ACTORS_LAYER)
        moving = _read_fields(actors_usd, field_paths(actors_usd), counts["dynamic"], f"{path}: dynamic")
        if not len(moving):  # no field is there to tell which optional ones they have
            harmonics = np.zeros((0, counts["dynamic_sh_rest"], 3), np.float32) if counts["dynamic_sh_rest"] else None
            drop = np.zeros(0, np.float32) if counts.get("dynamic_ray_drop") else None
            falloff = np.zeros(0, np.float32) if counts.get("dynamic_falloff") else None
            moving = dataclasses.replace(moving, sh_rest=harmonics, ray_drop=drop, falloff=falloff)
        if version > 2:
            columns = read_columns(actors_usd, columns_there, f"{path}: dynamic")
        else:
            kinds = knots.COLUMN_KINDS
            columns = {name: _array(package, knots.member_of(name), kinds[name]) for name in columns_there}
        arrays = {name: _array(package, name, kind) for name, kind in knots.KINDS.items()}
        dynamic = DynamicGaussians(moving, *knots.knots_of(arrays, columns, moving.mean_m, str(path)))
        isp_json = codec.load(package.read(ISP, LIMITS.json_bytes), f"{path}: {ISP}")
        isp = codec.from_json(codec.mapping(codec.array(np.float64, 3, 4)), isp_json, f"{path}: {ISP}")
        scene = GaussianScene(
            static=static,
            dynamic=dynamic,
            sky=_sky(package, sky_member),
            isp=isp,
            exposures=_exposures(package, manifest),
            ego_images=_ego_images(package, manifest),
            **facts,
        )
    try:
        check_scene(scene)
    except ArchiveError as error:
        raise ArchiveError(f"{path}: {error}") from error
    return scene


def archive_faults(path: Path | str) -> list[str]:
    """All faults of an archive as texts; empty if it is readable and unmodified."""
    try:
        with Package(Path(path)) as package:
            manifest = _read_manifest(package)
            faults = []
            for name in manifest["sha256"]:
                try:
                    _check_hashes(package, manifest, (name,))
                except ArchiveError as error:
                    faults.append(str(error))
        if not faults:
            read_archive(path)
        return faults
    except ArchiveError as error:
        return [str(error)]


# -------------------------------------------------------------------------------------------------------- manifest


def _manifest(scene: GaussianScene, digest: str, members: dict[str, bytes]) -> dict[str, Any]:
    harmonics = scene.dynamic.gaussians.sh_rest
    return {
        "format": "nurec_sim scene archive",
        "version": FORMAT_VERSION,
        "scene_id": scene.id,
        "scene_sha256": digest,
        "units": {"length": "m", "time": "us", "angle": "rad", "axes": "z up", "colour": "display (sRGB)"},
        "layers": {"static": STATIC_LAYER, "dynamic": ACTORS_LAYER, "sky": SKY, "isp": ISP, "facts": FACTS},
        "classes": {label.name.lower(): int(label) for label in Label},
        "counts": {
            "static": len(scene.static),
            "dynamic": len(scene.dynamic),
            "dynamic_sh_rest": 0 if harmonics is None else harmonics.shape[1],
            "dynamic_ray_drop": int(scene.dynamic.gaussians.ray_drop is not None),
            **({} if scene.dynamic.gaussians.falloff is None else {"dynamic_falloff": 1}),
            **({} if scene.dynamic.in_box is None else {"dynamic_in_box": 1}),
        },
        "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in members.items()},
    }


def _read_manifest(package: Package) -> dict[str, Any]:
    if MANIFEST not in package.names:
        raise ArchiveError(
            f"{package.path}: {MANIFEST} is missing, so this is no scene archive of nurec_sim; "
            "what was changed in archives of other programs cannot be told"
        )
    where = f"{package.path}: {MANIFEST}"
    manifest = codec.load(package.read(MANIFEST, LIMITS.json_bytes), where)
    if not isinstance(manifest, dict) or manifest.get("format") != "nurec_sim scene archive":
        raise ArchiveError(f"{where}: not the manifest of a nurec_sim scene archive")
    if manifest.get("version") not in range(1, FORMAT_VERSION + 1):
        raise ArchiveError(
            f"{where}: format version {manifest.get('version')!r}; this nurec_sim reads versions 1 to {FORMAT_VERSION}"
        )
    for key, decoder in (("counts", codec.mapping(codec.integer)), ("sha256", codec.mapping(codec.text))):
        codec.from_json(decoder, manifest.get(key), f"{where}: {key}")
    missing = {"static", "dynamic", "dynamic_sh_rest"} - set(manifest["counts"])
    if missing:
        raise ArchiveError(f"{where}: counts lacks {sorted(missing)}")
    if manifest["counts"]["dynamic_sh_rest"] not in (0, 3, 8, 15):
        given = manifest["counts"]["dynamic_sh_rest"]
        raise ArchiveError(f"{where}: counts: dynamic_sh_rest must be 0, 3, 8 or 15, got {given}")
    return manifest


def _check_hashes(package: Package, manifest: dict[str, Any], names: tuple[str, ...]) -> None:
    for name in names:
        promised = manifest["sha256"].get(name)
        if promised is None:
            raise ArchiveError(f"{package.path}: {MANIFEST} does not list {name}")
        if package.sha256(name) != promised:
            raise ArchiveError(f"{package.path}: {name} was changed or damaged: its hash differs from {MANIFEST}")


# ----------------------------------------------------------------------------------------------------------- parts


def _read_fields(layer, paths: list[str], count: int, what: str) -> Gaussians:
    from pxr import Tf

    try:
        return gather([read_field(layer, path, what) for path in paths], count, what)
    except Tf.ErrorException as error:
        raise ArchiveError(f"{what}: the USD layer is damaged") from error


def _exposures(package: Package, manifest: dict[str, Any]) -> dict[str, np.ndarray]:
    """Per-frame responses, if any."""
    if EXPOSURES not in manifest["sha256"]:
        return {}
    _check_hashes(package, manifest, (EXPOSURES,))
    where = f"{package.path}: {EXPOSURES}"
    raw = codec.load(package.read(EXPOSURES, LIMITS.json_bytes), where)
    return codec.from_json(codec.mapping(codec.array(np.float64, -1, 3, 4)), raw, where)


def _sky(package: Package, name: str) -> np.ndarray:
    if name == SKY_OF_VERSION_2:
        return _array(package, name, "f").astype(np.float32)
    return pictures.sky_of_png(package.read(name), f"{package.path}: {name}")


def _ego_images(package: Package, manifest: dict[str, Any]) -> dict[str, np.ndarray]:
    """What the cameras see of the ego vehicle, if anything."""
    names = [name for name in manifest["sha256"] if name.startswith(f"{EGO_IMAGES}/")]
    _check_hashes(package, manifest, tuple(names))
    return {
        name.removeprefix(f"{EGO_IMAGES}/").removesuffix(".png"): pictures.ego_image_of_png(
            package.read(name), f"{package.path}: {name}"
        )
        for name in names
    }


def _array(package: Package, name: str, kinds: str) -> np.ndarray:
    return array_from_npy(package.read(name), f"{package.path}: {name}", kinds)
