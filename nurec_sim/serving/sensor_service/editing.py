"""Editing: the procedures that insert, remove and replace actors.

An edit makes a copy of the scene, which replaces it for all clients until ``restore_model_parameters`` restores the
original; frames in progress use the scene as it was when they started. A request is applied completely or not at all.
"""

from __future__ import annotations

import asyncio
import math
from collections import defaultdict
from dataclasses import replace

from nurec_sim.errors import NurecSimError, RequestError, TooLargeError, UnknownSceneError
from nurec_sim.scene import edits
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service.core import ServiceCore, run_to_end
from nurec_sim.serving.wire import common, sensorsim
from nurec_sim.types import GaussianScene

MAX_SIZE_M = 100.0
MAX_EDITS = 1000
MAX_ID_LENGTH = 200


class Editing(ServiceCore):
    """Inserts, removes and replaces actors."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._in_work: set[str] = set()
        """Scenes for which an edit is in progress."""

    async def edit_assets(self, request):
        """Replaces and inserts actors, with the appearance of tracks of this or another available scene."""
        scene_id = self._store.resolve(request.scene_id)
        count = len(request.replace) + len(request.insert)
        if count > MAX_EDITS:
            raise TooLargeError(f"a request may make {MAX_EDITS} edits, got {count}")
        async with self._turns[scene_id]:
            taken = {*self._store.edited_ids, *self._in_work}
            if scene_id not in taken and len(taken) >= self._options.max_edited_scenes:
                raise TooLargeError(
                    f"{self._options.max_edited_scenes} scenes are edited, which is all that this server keeps; "
                    "restore one of them first"
                )
            self._in_work.add(scene_id)
            try:
                with await self.lease(scene_id) as loaded:
                    edited = await self._run(self._loading, self._edited, loaded.scene, request)
                    if count:
                        # To its end: a cancelled edit must not finish after the next one.
                        await run_to_end(self._loading, self._store.replace, scene_id, edited)
            finally:
                self._in_work.discard(scene_id)
        return sensorsim.EditAssetsReturn(
            success=True, message=f"{len(request.replace)} replaced or removed, {len(request.insert)} inserted"
        )

    async def restore_model_parameters(self, request):
        """Restores the original scene; no effect if it was not edited."""
        scene_id = self._store.resolve(request.scene_id)
        async with self._turns[scene_id]:
            self._store.restore(scene_id)
        return common.Empty()

    async def get_dynamic_objects(self, request):
        """All actors of the current scene; ``asset_id`` is the track whose appearance one has."""
        scene = await self._scene(request.scene_id)
        reply = sensorsim.DynamicObjectsReturn()
        external = _external_assets(scene)
        for track in (each for each in scene.tracks if each.actor):
            entry = reply.dynamic_objects.add()
            wire.write_track(track, entry)
            entry.asset_id = external.get(track.id, track.id)
        return reply

    async def get_external_asset_objects(self, request):
        """Ids of the tracks that an edit has inserted or given another appearance."""
        return sensorsim.ExternalAssetObjectsReturn(track_ids=_external_assets(await self._scene(request.scene_id)))

    def _edited(self, scene: GaussianScene, request) -> GaussianScene:
        """The scene with all edits of a request; assets are those before it, so two tracks can be swapped."""
        before, external = scene, dict(_external_assets(scene))
        for i, entry in enumerate(request.replace):
            where = f"replace[{i}]"
            if not entry.original_id:
                raise RequestError(f"{where}.original_id is missing; {edits.have(scene)}")
            size_m = _read_size(entry.object_size, where) if entry.HasField("object_size") else None
            try:
                if entry.replacement_id:
                    asset = self._asset(before, entry.replacement_id)
                    scene = edits.replaced_track(scene, entry.original_id, asset, size_m)
                    external[entry.original_id] = entry.replacement_id
                else:
                    scene = edits.without_track(scene, entry.original_id)
                    external.pop(entry.original_id, None)
            except NurecSimError as error:
                raise type(error)(f"{where}: {error}") from error
        for i, entry in enumerate(request.insert):
            where = f"insert[{i}]"
            if not entry.id or not entry.id.isprintable() or len(entry.id) > MAX_ID_LENGTH:
                raise RequestError(f"{where}.id must be a printable text of 1 to {MAX_ID_LENGTH} letters: {entry.id!r}")
            if not entry.asset_id:
                raise RequestError(
                    f"{where}.asset_id is missing: the track whose appearance it gets; {edits.have(scene)}"
                )
            try:
                asset = self._asset(before, entry.asset_id)
                size_m = _read_size(entry.object_size, where) if entry.HasField("object_size") else asset.size_m
                track = replace(wire.read_track(entry), size_m=size_m, label=entry.semantic_class or asset.label)
                scene = edits.with_track(scene, track, asset)
            except NurecSimError as error:
                raise type(error)(f"{where}: {error}") from error
            external[entry.id] = entry.asset_id
        return replace(scene, provenance={**scene.provenance, "external_assets": external})

    def _asset(self, scene: GaussianScene, asset_id: str) -> edits.Asset:
        """The asset of ``track_id``, or of ``scene_id/track_id`` of another scene."""
        if any(track.id == asset_id for track in scene.tracks) or "/" not in asset_id:
            return edits.asset_of(scene, asset_id)
        scene_name, _, track_id = asset_id.partition("/")
        try:
            with self._store.lease(scene_name, self._go_on) as other:
                return edits.asset_of(other.scene, track_id)
        except UnknownSceneError as error:
            raise UnknownSceneError(
                f"asset {asset_id!r} must be a track_id of scene {scene.id!r}, or scene_id/track_id of another: {error}"
            ) from error


def _external_assets(scene: GaussianScene) -> dict[str, str]:
    """Asset ids of the tracks with another appearance than recorded, by track id."""
    return dict(scene.provenance.get("external_assets", {}))


def _read_size(message, where: str) -> edits.Size:
    size_m = (message.size_x, message.size_y, message.size_z)
    if not all(math.isfinite(value) and 0.01 <= value <= MAX_SIZE_M for value in size_m):
        raise RequestError(f"{where}.object_size must lie in 0.01..{MAX_SIZE_M:g} m on each side, got {size_m}")
    return size_m
