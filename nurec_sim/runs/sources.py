"""The scenes of a run: archives, and logs reconstructed by one or more methods, on one server."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nurec_sim.errors import NurecSimError, RunError
from nurec_sim.reconstruct import OptimizeSettings
from nurec_sim.runs.common_truth import with_common_truth
from nurec_sim.runs.scene_file import reconstruction_of
from nurec_sim.scene import alpasim_id
from nurec_sim.serving.store import Recipe, SceneStore, find_sources, is_archive, own_id
from nurec_sim.types import GaussianScene

DEFAULT_METHOD = "lift"


@dataclass(frozen=True)
class Offer:
    """One reconstruction on the server.

    ``clip`` is the log that it is made from, None for an archive; ``hold_out_every`` what was kept out of it; ``title``
    its method or file, for progress.
    """

    scene_id: str
    served_as: str
    clip: Path | None = None
    hold_out_every: int = 0
    title: str = ""


def offer_all(
    store: SceneStore, sources: Iterable[Path], methods: Sequence[str] = (), hold_out_every: int = 0,
    refine: OptimizeSettings | None = None,
) -> list[Offer]:  # fmt: skip
    """Adds every source to a server's scenes; several reconstructions of one log get names of their own.

    Args:
        store: of the server.
        sources: archives, logs, or folders of them.
        methods: how logs become scenes, one scene per method; default ``lift``.
        hold_out_every: every N-th image of a log is kept out of its reconstructions, as far as it has so many.
        refine: optimisation of every reconstruction of a log; None for none.

    Raises:
        NurecSimError: a source cannot be opened, or a method is unknown or named twice.
    """
    methods = tuple(methods) or (DEFAULT_METHOD,)
    if len(set(methods)) < len(methods):
        raise RunError(f"each method may be given once, got {list(methods)}")
    found: dict[str, list[tuple[Path, Recipe | None]]] = {}
    for path in [each for source in sources for each in find_sources(Path(source))]:
        if is_archive(path):
            found.setdefault(alpasim_id(own_id(path)), []).append((path, None))
            continue
        every = _possible_hold_out(path, hold_out_every)
        recipes = [Recipe(method, refine=refine, hold_out_every=every) for method in methods]
        found.setdefault(alpasim_id(own_id(path)), []).extend((path, recipe) for recipe in recipes)
    offers = []
    for scene_id, ways in found.items():
        for number, (path, recipe) in enumerate(ways):
            clip = None if recipe is None else path
            every = 0 if recipe is None else recipe.hold_out_every
            # A lone one keeps all its names, for clients that know it by its file.
            name = f"{scene_id}@{number}" if len(ways) > 1 else ""
            title = path.stem if recipe is None else recipe.method
            offers.append(Offer(scene_id, store.offer(path, name, recipe), clip, every, title))
    return offers


def load_all(
    store: SceneStore, offers: Sequence[Offer], progress: Callable[[str, float], None]
) -> list[tuple[Offer, GaussianScene]]:
    """Loads or reconstructs what was offered; reconstructions of one log get the same facts and names that differ.

    Raises:
        NurecSimError: one cannot be loaded, or two of one name are not of the same log.
    """
    loaded: dict[str, list[tuple[Offer, GaussianScene]]] = {}
    for index, offer in enumerate(offers):

        def part(stage: str, share: float, index: int = index, offer: Offer = offer) -> None:
            progress(f"{offer.title}: {stage}", (index + share) / len(offers))

        scene = store.get(offer.served_as, part).scene
        loaded.setdefault(offer.scene_id, []).append((offer, scene))
    result = []
    for group in loaded.values():
        names = _names(store, group)
        scenes = with_common_truth([scene for _, scene in group])
        for (offer, _), scene, name in zip(group, scenes, names, strict=True):
            if name != reconstruction_of(scene):
                scene = dataclasses.replace(scene, provenance={**scene.provenance, "reconstruction": name})
            result.append((offer, scene))
    return result


def _names(store: SceneStore, group: Sequence[tuple[Offer, GaussianScene]]) -> list[str]:
    """The methods; where one occurs twice, with the name of the file."""
    methods = [reconstruction_of(scene) for _, scene in group]
    names: list[str] = []
    for (offer, _), method in zip(group, methods, strict=True):
        origin = store.source(offer.served_as).origin
        if methods.count(method) > 1 and offer.clip is None and isinstance(origin, Path):
            method = f"{method} {origin.stem}"
        names.append(method)
    return [
        name if names.count(name) == 1 else f"{name} {1 + names[:place].count(name)}"
        for place, name in enumerate(names)
    ]


def _possible_hold_out(path: Path, every: int) -> int:
    """``every``, or 0 for a log with a camera that has fewer images."""
    if not every:
        return 0
    from nurec_sim.logs import open_clip

    try:
        clip = open_clip(path)
    except (NurecSimError, OSError):
        return 0  # the store says why it cannot be opened
    counts = [len(clip.camera_times_us(camera)) for camera in clip.rig.cameras]
    return every if counts and min(counts) >= every else 0
