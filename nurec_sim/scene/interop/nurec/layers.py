"""Converts a NuRec state to Gaussians, sky and exposure: activations, layers, tracks.

Conventions of NuRec: rotations are ``wxyz`` of any length, scales are logarithms, densities logits, colours harmonics
of 3DGS. Layers with ``gaussian_cuboid_ids`` are rigid parts in the frames of boxes, the others are in the NRE frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.checks import MAX_FACE_TEXELS
from nurec_sim.scene.interop.columns import Columns, sigmoid
from nurec_sim.scene.interop.found import Found
from nurec_sim.scene.interop.nurec.state import GAUSSIANS, NurecState
from nurec_sim.types import Label

NEEDED = ("positions", "rotations", "scales", "densities", "features_albedo")
_SHOWN = 8
_ACTIVATIONS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "sigmoid": sigmoid,
    "exp": np.exp,
    "normalize": lambda values: values,  # done for all
    "none": lambda values: values,
    "identity": lambda values: values,
}
_USUAL = {"density_activation": "sigmoid", "scale_activation": "exp", "rotation_activation": "normalize"}


def found_in(state: NurecState, where: str) -> Found:
    """The contents of a state, in the NRE frame.

    Raises:
        ArchiveError: no layer of Gaussians, arrays that do not fit each other, or an activation that is not known.
    """
    found = Found()
    layers = sorted({name.split(".")[1] for name in state.arrays if name.startswith(GAUSSIANS)})
    if not layers:
        raise ArchiveError(f"{where}: no layers of Gaussians ({GAUSSIANS}<layer>.positions)")
    for layer in layers:
        _add_layer(found, state, layer, where)
    _add_background(found, state, where)
    _add_exposure(found, state, where)
    if state.others:
        shown = ", ".join(_short(name) for name in state.others[:_SHOWN])
        rest = f" and {len(state.others) - _SHOWN} more" if len(state.others) > _SHOWN else ""
        found.unknown.append(f"not read of {where.rsplit(': ', 1)[-1]}: {shown}{rest}")
    return found


# --------------------------------------------------------------------------------------------------------- Gaussians


def _add_layer(found: Found, state: NurecState, layer: str, where: str) -> None:
    prefix = f"{GAUSSIANS}{layer}."
    arrays = {name.removeprefix(prefix): array for name, array in state.arrays.items() if name.startswith(prefix)}
    if missing := [name for name in NEEDED if name not in arrays]:
        found.unknown.append(f"layer {_short(layer)} is not drawn: it has no {', '.join(missing)}")
        return
    what = f"{where}: layer {_short(layer)}"
    settings = _settings(found, state, layer)
    columns = _columns(found, arrays, settings, layer, what)
    columns.check(what)
    ids = arrays.get("gaussian_cuboid_ids")
    if ids is None and not layer.startswith("dynamic_"):
        label = Label.ROAD if layer == "road" else Label.OTHER
        gaussians, dropped = columns.gaussians(label)
        found.static.append(gaussians)
        found.dropped += dropped
        return
    if ids is None or ids.dtype.kind != "i" or ids.shape != (len(columns.mean_m),):
        found.unknown.append(f"layer {_short(layer)} is not drawn: nothing tells which track each Gaussian belongs to")
        return
    if layer == "dynamic_deformables":
        found.unknown.append(f"layer {layer}: its deformation network is not evaluated; its things move as rigid ones")
    _add_tracks(found, columns, ids, state.track_ids.get(layer, ()), layer)


def _add_tracks(found: Found, columns: Columns, ids: np.ndarray, names: Sequence[str], layer: str) -> None:
    nameless = (ids < 0) | (ids >= len(names))
    if nameless.any():
        found.unknown.append(f"layer {_short(layer)}: {int(nameless.sum()):,} Gaussians belong to no named track")
    # Sorted by track, so that one split gives the rows of each.
    order = np.argsort(ids, kind="stable")
    order = order[~nameless[order]]
    for rows in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1):
        if len(rows):
            gaussians, dropped = columns.rows(rows).gaussians(Label.MOVABLE)
            found.boxed.setdefault(names[int(ids[rows[0]])], []).append(gaussians)
            found.dropped += dropped


def _columns(
    found: Found, arrays: Mapping[str, np.ndarray], settings: Mapping[str, Any], layer: str, what: str
) -> Columns:
    albedo, densities, n = arrays["features_albedo"], arrays["densities"], len(np.atleast_1d(arrays["positions"]))
    if albedo.ndim == 3 and albedo.shape[1] > 0:
        if albedo.shape[1] > 1:
            found.unknown.append(
                f"layer {_short(layer)}: colours that change over {albedo.shape[1]} terms of time keep the constant one"
            )
        albedo = albedo[:, 0]
    if densities.shape != (n, 1):
        raise ArchiveError(f"{what}: densities must be {(n, 1)}, got {densities.shape}")
    activated = {}
    for name, key in (("scales", "scale_activation"), ("densities", "density_activation")):
        with np.errstate(over="ignore", invalid="ignore"):
            activated[name] = _activation(settings, key, what)(arrays[name].astype(np.float64)).astype(np.float32)
    _activation(settings, "rotation_activation", what)
    return Columns(
        mean_m=arrays["positions"],
        quat_wxyz=arrays["rotations"],
        scale_m=activated["scales"],
        opacity=activated["densities"][:, 0],
        dc=albedo,
        rest=_harmonics(arrays, n, what),
    )


def _harmonics(arrays: Mapping[str, np.ndarray], n: int, what: str) -> np.ndarray | None:
    """Coefficients [n,k,3] up to the active degree; a file pads all degrees to 3."""
    specular, active = arrays.get("features_specular"), arrays.get("n_active_features")
    if specular is None or specular.size == 0:
        return None
    if specular.ndim != 2 or len(specular) != n or specular.shape[1] not in (9, 24, 45):
        raise ArchiveError(f"{what}: features_specular must be [{n}, 9, 24 or 45], got {specular.shape}")
    rest = specular.reshape(n, -1, 3)
    if active is not None and active.size == 1:
        degree = int(active.reshape(-1)[0])
        if 0 <= degree < 3 and (degree + 1) ** 2 - 1 < rest.shape[1]:
            rest = rest.copy()
            rest[:, (degree + 1) ** 2 - 1 :] = 0
    return rest


def _settings(found: Found, state: NurecState, layer: str) -> Mapping[str, Any]:
    """A layer's settings; unusual kernels are reported."""
    layers = state.config.get("layers")
    settings = layers.get(layer) if isinstance(layers, Mapping) else None
    if not isinstance(settings, Mapping):
        usual = ", ".join(f"{key} {value}" for key, value in _USUAL.items())
        found.unknown.append(f"layer {_short(layer)}: no settings in the file; taken for {usual}")
        return {}
    particle = settings.get("particle")
    if isinstance(particle, Mapping):
        for key, usual_value in (("density_kernel_planar", False), ("density_kernel_degree", 2)):
            if particle.get(key, usual_value) != usual_value:
                given = _short(particle[key])
                found.unknown.append(f"layer {_short(layer)}: {key} {given}; drawn as plain Gaussians")
    return settings


def _activation(settings: Mapping[str, Any], key: str, what: str) -> Callable[[np.ndarray], np.ndarray]:
    name = settings.get(key, _USUAL[key])
    if not isinstance(name, str) or name not in _ACTIVATIONS:
        raise ArchiveError(f"{what}: {key} {_short(name)} is not known; known are {sorted(_ACTIVATIONS)}")
    return _ACTIVATIONS[name]


# ------------------------------------------------------------------------------------------------- sky and exposure


def _add_background(found: Found, state: NurecState, where: str) -> None:
    textures = state.arrays.get("background.textures")
    settings = state.config.get("background")
    kind = settings.get("name") if isinstance(settings, Mapping) else None
    if textures is None:
        if kind not in (None, "skip-background"):
            found.unknown.append(f"the sky: a background of kind {_short(kind)} is not read")
        return
    if isinstance(settings, Mapping) and settings.get("composite_in_linear_space"):
        found.unknown.append("the sky is meant to be blended in linear light; it is blended as it is stored")
    found.sky = _cubemap(found, textures, where)


def _cubemap(found: Found, textures: np.ndarray, where: str) -> Float32[np.ndarray, "6 h h 3"]:
    """The faces, in the order and with the axes of ``geometry.cubemap_directions``."""
    size = textures.shape[2] if textures.ndim == 5 else 0
    if textures.shape != (1, 6, size, size, 3) or not 1 <= size <= MAX_FACE_TEXELS or textures.dtype.kind != "f":
        raise ArchiveError(f"{where}: background.textures must be [1, 6, s, s, 3], got {textures.shape}")
    colours = textures[0].astype(np.float32)
    broken = ~np.isfinite(colours)
    if broken.any():
        found.unknown.append(f"{int(broken.any(axis=-1).sum()):,} texels of the sky are not finite; shown black")
    return np.where(broken, np.float32(0), colours)


def _add_exposure(found: Found, state: NurecState, where: str) -> None:
    """Exposure of each camera, the mean of its frames; values are camera-major powers of two."""
    parts = {name.rsplit(".", 1)[-1]: array for name, array in state.arrays.items() if ".ppisp." in name}
    exposure = parts.get("exposure_params")
    others = sorted(set(parts) - {"exposure_params"})
    if others:
        found.unknown.append(f"colour correction: {', '.join(others)} are not applied")
    if exposure is None:
        return
    cameras = next((len(parts[name]) for name in others if parts[name].ndim == 3), 0)
    if exposure.ndim != 1 or not cameras or len(exposure) % cameras or not np.isfinite(exposure).all():
        found.unknown.append(f"colour correction: exposure_params {exposure.shape} of {cameras} cameras is not applied")
        return
    found.exposure = np.exp2(exposure.astype(np.float64).reshape(cameras, -1).mean(axis=1)).tolist()


def _short(value: object) -> str:
    return ascii(value)[:60] if not isinstance(value, str) or not value.isprintable() else repr(value)[:60]
