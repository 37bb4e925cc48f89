"""Rules about edited scenes; those that change the scene run only where that is allowed."""

from __future__ import annotations

import grpc
import numpy as np

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Skipped, Target, expect
from nurec_sim.serving.wire import sensorsim
from nurec_sim.serving.wire.requests import write_poses

Code = grpc.StatusCode
_NEW = "conformance-actor"


@check("edit-unknown", optional=True)
def unknown(target: Target) -> str:
    """Replacing a track that is not there is refused, or says so in its reply."""
    request = sensorsim.EditAssetsRequest(scene_id=target.scene_id)
    request.replace.add(original_id="no-such-track", replacement_id="no-such-track-either")
    try:
        reply = target.call("edit_assets", request)
    except grpc.RpcError as error:
        if error.code() == Code.UNIMPLEMENTED:
            raise
        return f"{error.code().name}: {error.details()}"
    expect(not reply.success and reply.message, "it says success, or gives no message")
    return reply.message


@check("external-assets-listed", optional=True)
def external_listed(target: Target) -> str:
    """get_external_asset_objects names tracks of the scene only."""
    request = sensorsim.ExternalAssetObjectsRequest(scene_id=target.scene_id)
    ids = set(target.call("get_external_asset_objects", request).track_ids)
    unknown = ids - {track.id for track in target.tracks}
    expect(not unknown, f"{sorted(unknown)} are no tracks of the scene")
    return f"{len(ids)} tracks"


@check("edit-insert-and-restore", optional=True)
def insert_and_restore(target: Target) -> str:
    """An inserted actor is listed until restore_model_parameters brings the original scene back, bit for bit."""
    if not target.allow_changes:
        raise Skipped("it would change the scene for all clients; allow it with --changes")
    if not target.tracks:
        raise Skipped("the scene has no track whose appearance could be used")
    plain = target.call("render_rgb", target.request()).image_bytes
    restore = sensorsim.RestoreModelParametersRequest(scene_id=target.scene_id)
    try:
        _insert(target)
        listed = sensorsim.DynamicObjectsRequest(scene_id=target.scene_id)
        ids = [track.id for track in target.call("get_dynamic_objects", listed).dynamic_objects]
        expect(_NEW in ids, f"{_NEW!r} was inserted, but the tracks are {ids}")
        grown = target.call("render_rgb", target.request()).image_bytes
    finally:
        target.call("restore_model_parameters", restore)
    ids = [track.id for track in target.call("get_dynamic_objects", listed).dynamic_objects]
    expect(_NEW not in ids, f"the scene was restored, but {_NEW!r} is still listed")
    expect(target.call("render_rgb", target.request()).image_bytes == plain, "the restored scene renders differently")
    return "the picture changed and was restored" if grown != plain else "listed and removed again; not in the picture"


def _insert(target: Target) -> None:
    """Puts a copy of some track 12 m ahead of the rig."""
    faults = []
    for track in target.tracks:
        request = sensorsim.EditAssetsRequest(scene_id=target.scene_id)
        entry = request.insert.add(id=_NEW, asset_id=track.asset_id or track.id, semantic_class=track.semantic_class)
        entry.object_size.CopyFrom(track.object_size)
        ahead = target.path.at(target.middle_us)
        ahead[:3, 3] += 12.0 * ahead[:3, 0] + track.object_size.size_z / 2 * ahead[:3, 2]
        for t_us in (target.path.start_us, target.path.end_us):
            sample = entry.trajectory.poses.add(timestamp_us=t_us)
            write_poses(np.stack([ahead]), [sample.pose])
            sample.pose.ClearField("exact")
        try:
            reply = target.call("edit_assets", request)
        except grpc.RpcError as error:
            if error.code() == Code.UNIMPLEMENTED:
                raise
            faults.append(f"{track.id!r}: {error.details()}")
            continue
        if reply.success:
            return
        faults.append(f"{track.id!r}: {reply.message}")
    expect(False, f"no copy of a track could be inserted: {'; '.join(faults)}")
