"""Things in the browser's scene: drag handles of the car and of an actor, Gaussians, and clicks that select."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import Matrix4
from nurec_sim.view.camera import parts_of, pose_of, ray_hits_box
from nurec_sim.view.splats import Splats, moving_splats, static_splats
from nurec_sim.view.state import Session, Stage

HANDLE_SIZE_M = 3.0


class Handles:
    """The drag handles of one browser tab.

    Args:
        client: viser's client.
        session: its view.
        stage: where everything is.
        on_dragged: called after a drag has changed the view, so that the panel shows it.
    """

    def __init__(self, client: Any, session: Session, stage: Stage, on_dragged: Callable[[], None]) -> None:
        self._client, self._session, self._stage, self._on_dragged = client, session, stage, on_dragged
        self.selected: str | None = None
        self._dragging = threading.Event()
        self._ego = self._handle("/car", self._drag_ego)
        self._actor = self._handle("/actor", self._drag_actor)
        self._splats: tuple[int, Any] | None = None
        self._moving_key: tuple | None = None
        self._moving: Any = None

    def _handle(self, name: str, dragged: Callable[[Matrix4], None]) -> Any:
        handle = self._client.scene.add_transform_controls(
            name, scale=HANDLE_SIZE_M, line_width=4.0, depth_test=False, visible=False
        )

        @handle.on_update
        async def _(event: Any) -> None:  # async: viser keeps the order of a drag's events
            if event.phase == "start":
                self._dragging.set()
            view = self._session.view
            dragged(self._stage.world_from_browser(view) @ pose_of(handle.position, handle.wxyz))
            if event.phase == "end":
                self._dragging.clear()
                self._on_dragged()

        return handle

    def _drag_ego(self, world_from_rig: Matrix4) -> None:
        view = self._session.view
        recorded = self._stage.world(view).ego.at(view.t_us)
        self._session.change(moving=True, ego_offset=on_ground(geometry.inverse(recorded) @ world_from_rig))

    def _drag_actor(self, world_from_box: Matrix4) -> None:
        view = self._session.view
        track = self._stage.tracks(view).get(self.selected or "")
        recorded = None if track is None else self._stage.recorded_box(view, track)
        if track is None or recorded is None:
            return
        offset = on_ground(geometry.inverse(recorded) @ world_from_box)
        self._session.change(moving=True, offsets={**view.offsets, track.id: offset})

    def place(self) -> None:
        """Puts the handles where the car and the selected actor are; shows them in the free camera only."""
        view = self._session.view
        free = view.camera is None
        show_ego = free and view.rollout is None
        track = self._stage.tracks(view).get(self.selected or "") if free else None
        box = None if track is None else self._stage.box(view, track)
        if not self._dragging.is_set():
            browser_from_world = geometry.inverse(self._stage.world_from_browser(view))
            if show_ego:
                _put(self._ego, browser_from_world @ self._stage.ego(view, view.t_us))
            if box is not None:
                _put(self._actor, browser_from_world @ box)
        for handle, shown in ((self._ego, show_ego), (self._actor, box is not None)):
            if handle.visible != shown:
                handle.visible = shown

    def pick(self, origin_m: np.ndarray, direction: np.ndarray) -> str | None:
        """The track whose box a ray, in the browser's frame, enters first; None if there is none."""
        view = self._session.view
        world_from_browser = self._stage.world_from_browser(view)
        hits = []
        for track in self._stage.tracks(view).values():
            box = self._stage.box(view, track)
            if box is not None:
                box_from_browser = geometry.inverse(box) @ world_from_browser
                start = geometry.transform_points(box_from_browser, origin_m[None])[0]
                hits.append((ray_hits_box(start, box_from_browser[:3, :3] @ direction, track.size_m), track.id))
        nearest = min(hits, default=(np.inf, None))
        return nearest[1] if np.isfinite(nearest[0]) else None

    def show_splats(self) -> int:
        """Sends the Gaussians of the shown world, those that move again when they have; how many are left out."""
        view = self._session.view
        world, origin = view.world, np.round(self._stage.world(view).ego.position_m[0])
        browser_from_scene = geometry.inverse(self._stage.world_from_browser(view)) @ geometry.pose(np.eye(3), origin)
        left_out = 0
        if self._splats is None or self._splats[0] != world:
            self.hide_splats()
            splats, left_out = static_splats(self._stage, view, origin)
            self._splats = (world, self._add("/static", splats))
        key = (world, view.t_us, tuple(view.offsets.items()), view.hidden, view.rollout)
        if key != self._moving_key:
            if self._moving is not None:
                self._moving.remove()
            splats = moving_splats(self._stage, view, origin)
            self._moving = self._add("/moving", splats) if len(splats.centers) else None
            self._moving_key = key
        for node in (self._splats[1], self._moving):
            if node is not None:
                _put(node, browser_from_scene)
        return left_out

    def hide_splats(self) -> None:
        """Removes the Gaussians from the browser."""
        for node in (self._splats and self._splats[1], self._moving):
            if node is not None:
                node.remove()
        self._splats = self._moving = self._moving_key = None

    def _add(self, name: str, splats: Splats) -> Any:
        return self._client.scene.add_gaussian_splats(name, *splats)


def on_ground(offset: Matrix4) -> Matrix4:
    """An offset without roll, pitch and change of height: cars stay on their wheels."""
    return geometry.pose_from_xyyaw(offset[0, 3], offset[1, 3], float(geometry.yaw_of(offset)))


def _put(node: Any, pose: Matrix4) -> None:
    node.position, node.wxyz = parts_of(pose)
