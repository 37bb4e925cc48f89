"""The scenes of a server: by name, loaded or reconstructed once on first use, cached within bounds."""

from nurec_sim.serving.store.memory import Lease, LoadedScene, MemoryStats
from nurec_sim.serving.store.recipes import Recipe, content_key
from nurec_sim.serving.store.sources import default_cache_dir, find_sources, is_archive, own_id
from nurec_sim.serving.store.store import SceneEntry, SceneStore
from nurec_sim.serving.store.uploads import Upload, UploadFolder

__all__ = [
    "Lease",
    "LoadedScene",
    "MemoryStats",
    "Recipe",
    "SceneEntry",
    "SceneStore",
    "Upload",
    "UploadFolder",
    "content_key",
    "default_cache_dir",
    "find_sources",
    "is_archive",
    "own_id",
]
