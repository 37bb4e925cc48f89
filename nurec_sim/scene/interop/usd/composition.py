"""Layers of a USD package or folder, linked so that composition opens no other file.

Each layer is loaded as an anonymous layer, with its references redirected to the other loaded layers. External
references are removed and reported.
"""

from __future__ import annotations

import posixpath
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nurec_sim.errors import ArchiveError
from nurec_sim.files.zip_package import Package, name_fault
from nurec_sim.scene.usd.layers import LAYER_SUFFIXES, open_member

MAX_LAYERS = 2000


@dataclass(frozen=True)
class LayerSource:
    """Layers by name: the members of a package, or the files of a folder."""

    path: Path
    root: str
    members: frozenset[str] | None

    @classmethod
    def of(cls, path: Path) -> LayerSource:
        """The layers of a file; the root of a package is its first layer.

        Raises:
            ArchiveError: a package that cannot be read, or has no layers.
        """
        if path.suffix.lower() != ".usdz":
            return cls(path, path.name, None)
        with Package(path) as package:
            names = [name for name in package.names if name.lower().endswith(LAYER_SUFFIXES)]
        if not names:
            raise ArchiveError(f"{path}: holds no USD layer")
        return cls(path, names[0], frozenset(names))

    def holds(self, name: str) -> bool:
        """Whether a layer of that name may be opened."""
        if name_fault(name) is not None or not name.lower().endswith(LAYER_SUFFIXES):
            return False
        if self.members is not None:
            return name in self.members
        folder = self.path.resolve().parent
        file = (folder / name).resolve()
        # Resolved paths: neither ".." nor symbolic links lead out of the folder.
        return file.is_file() and file.is_relative_to(folder)

    def open(self, name: str) -> Any:
        """Opens a layer without composition.

        Raises:
            ArchiveError: OpenUSD cannot read it.
        """
        from pxr import Sdf, Tf

        if self.members is not None:
            return open_member(self.path, name)
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(self.path.resolve().parent / name))
        except Tf.ErrorException:
            layer = None
        if layer is None:
            raise ArchiveError(f"{self.path.parent / name}: no readable USD layer")
        return layer


def may_hold(package: Package, *kinds: bytes) -> bool:
    """Whether a package may have prims of some types; text layers are searched without OpenUSD."""
    layers = [package.read(name) for name in package.names if name.lower().endswith(LAYER_SUFFIXES)]
    return any(not layer.startswith(b"#usda") or any(kind in layer for kind in kinds) for layer in layers)


def joined_layers(source: LayerSource) -> tuple[Any, list[str]]:
    """The root layer with its references, and notes on removed ones.

    Raises:
        ArchiveError: a layer cannot be read, or there are too many.
    """
    layers: dict[str, Any] = {}
    notes: list[str] = []
    waiting = [source.root]
    while waiting:
        name = waiting.pop()
        if name in layers:
            continue
        if len(layers) == MAX_LAYERS:
            raise ArchiveError(f"{source.path}: more than {MAX_LAYERS:,} layers")
        layers[name] = source.open(name)
        waiting += [inside for _, inside in _references(layers[name], name) if source.holds(inside)]
    for name, layer in layers.items():
        _drop_clips(layer, name, notes)
        for reference, inside in _references(layer, name):
            if inside not in layers:
                notes.append(f"{name} refers to {reference!r:.120}, which is not beside it or no USD layer; not read")
            layer.UpdateCompositionAssetDependency(reference, layers[inside].identifier if inside in layers else "")
        # Verify that nothing else is left, whatever kinds of arcs OpenUSD knows.
        kept = {each.identifier for each in layers.values()}
        if left := [str(each) for each in layer.GetCompositionAssetDependencies() if str(each) not in kept]:
            raise ArchiveError(f"{source.path}: {name} refers to {left[0]!r:.120}, which cannot be taken out")
    _KEPT.extend(layers.values())
    return layers[source.root], notes


_KEPT: list[Any] = []
"""Keeps the anonymous layers alive."""


def _references(layer: Any, name: str) -> list[tuple[str, str]]:
    """References of a layer, as written and relative to the root folder."""
    folder = posixpath.dirname(name)
    return [
        (str(reference), posixpath.normpath(posixpath.join(folder, str(reference))))
        for reference in layer.GetCompositionAssetDependencies()
    ]


def _drop_clips(layer: Any, name: str, notes: list[str]) -> None:
    """Removes value clips, whose files OpenUSD would open on its own."""
    from pxr import Sdf

    def drop(path: Any) -> None:
        spec = layer.GetObjectAtPath(path)
        for key in ("clips", "clipSets"):
            if isinstance(spec, Sdf.PrimSpec) and spec.HasInfo(key):
                spec.ClearInfo(key)
                notes.append(f"{name}: value clips of {path} are not read")

    layer.Traverse(Sdf.Path.absoluteRootPath, drop)
