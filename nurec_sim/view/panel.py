"""The controls of one browser tab; each changes the session's view."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import Matrix4
from nurec_sim.view.picture import Painter, lidar_names
from nurec_sim.view.sources import Opened
from nurec_sim.view.state import Session

FREE, OFF, NOBODY, RECORDING = "free", "off", "none", "recorded drive"
EGO_REACH_M = 10.0
TIME_STEP_S = 0.05


class Panel:
    """Builds the controls and keeps them in step with the view.

    Args:
        gui: viser's GUI of one client.
        session: its view.
        painter: knows what there is to choose from.
        select: called with the id of the selected track, or None.
        reset_eye: called to put the free camera back behind the car.
    """

    def __init__(
        self,
        gui: Any,
        session: Session,
        painter: Painter,
        select: Callable[[str | None], None],
        reset_eye: Callable[[], None],
    ) -> None:
        self._gui, self._session, self._painter = gui, session, painter
        self._opened: Opened = painter.opened
        self._stage, self._select = painter.stage, select
        self._own = threading.local()  # marks changes that did not come from the user, in this thread
        self.status = gui.add_markdown("")
        self._add_time()
        self._add_camera(reset_eye)
        tabs = gui.add_tab_group()
        for label, fill in (("Show", self._add_layers), ("Actors", self._add_actors), ("Compare", self._add_compare)):
            with tabs.add_tab(label):
                fill()
        if self._opened.rollouts:
            with tabs.add_tab("Run"):
                self._add_rollouts()
        self.tabs = tabs

    # ------------------------------------------------------------------------------------------------------- controls

    def _bind(self, control: Any, field: str, read: Callable[[Any], Any] = lambda value: value) -> Any:
        """Lets a control set one field of the view."""
        return self._on(control, lambda value: self._session.change(moving=True, **{field: read(value)}))

    def _on(self, control: Any, act: Callable[[Any], object]) -> Any:
        """Calls ``act`` with the control's value when the user changes it."""

        @control.on_update
        def _(event: Any) -> None:
            if not getattr(self._own, "setting", False):
                act(event.target.value)

        return control

    def _set(self, control: Any, value: Any) -> None:
        """Shows a value that did not come from the user."""
        if control.value != value:
            self._own.setting = True
            try:
                control.value = value
            finally:
                self._own.setting = False

    def _add_time(self) -> None:
        gui, (start_us, end_us) = self._gui, self._stage.times_us(self._session.view)
        seconds = max((end_us - start_us) // 1000 / 1e3, TIME_STEP_S)
        self.time = self._on(gui.add_slider("Time (s)", 0.0, seconds, TIME_STEP_S, 0.0), self._go_to)
        self.play = self._on(gui.add_checkbox("Play", False, hint="at real speed, from the start again at the end"),
                             self._play)  # fmt: skip

    def _go_to(self, seconds: float) -> None:
        start_us, end_us = self._stage.times_us(self._session.view)
        self._session.change(moving=True, t_us=min(start_us + round(seconds * 1e6), end_us))

    def _play(self, on: bool) -> None:
        self._session.playing = on
        self._session.change(moving=True)

    def _add_camera(self, reset_eye: Callable[[], None]) -> None:
        gui, cameras = self._gui, self._opened.worlds[0].rig.cameras
        hint = "a camera of the car, with its lens and shutter, or a free one: drag with the mouse"
        self.camera = self._on(gui.add_dropdown("Camera", (FREE, *cameras), hint=hint), self._choose_camera)
        self.follow = self._on(gui.add_checkbox("Follow the car", True), self._follow)
        self._reset_eye = reset_eye
        self.behind = gui.add_button("Behind the car")
        self.behind.on_click(lambda _: reset_eye())
        with gui.add_folder("Move the car", expand_by_default=False):
            reach = (-EGO_REACH_M, EGO_REACH_M, 0.05, 0.0)
            self.forward, self.left = gui.add_slider("Forward (m)", *reach), gui.add_slider("Left (m)", *reach)
            self.yaw = gui.add_slider("Turned left (deg)", -180.0, 180.0, 1.0, 0.0)
            for control in (self.forward, self.left, self.yaw):
                self._on(control, lambda _: self._move_ego())
            gui.add_button("Back to the recorded path").on_click(lambda _: self.move_ego_to(np.eye(4)))

    def _choose_camera(self, name: str) -> None:
        self._session.change(moving=True, camera=None if name == FREE else name)

    def _follow(self, on: bool) -> None:
        self._session.change(moving=True, follow=on)
        self._reset_eye()

    def _move_ego(self) -> None:
        offset = geometry.pose_from_xyyaw(self.forward.value, self.left.value, math.radians(self.yaw.value))
        self._session.change(moving=True, ego_offset=offset)

    def move_ego_to(self, offset: Matrix4) -> None:
        """Moves the car, and shows where it is."""
        self._session.change(moving=True, ego_offset=offset)
        self.refresh()

    def _add_layers(self) -> None:
        gui, world, view = self._gui, self._opened.worlds[0], self._session.view
        self.layer = self._bind(gui.add_dropdown("Layer", world.layers), "layer")
        self.isp = self._bind(gui.add_checkbox("Colour correction of the camera", view.apply_isp), "apply_isp")
        self.lidar = self._bind(gui.add_dropdown("LiDAR points", lidar_names(self._opened)), "lidar")
        self.boxes = self._bind(gui.add_checkbox("Boxes", view.boxes), "boxes")
        self.names = self._bind(gui.add_checkbox("Labels", view.names), "names")
        self.route = self._bind(gui.add_checkbox("Paths and plans", view.route), "route")
        local = all(each.scene is not None for each in self._opened.worlds)
        hint = "drawn by the browser: a pinhole without shutter, sky or colour correction"
        self.splats = self._bind(gui.add_checkbox("Gaussians in the browser", False, disabled=not local, hint=hint),
                                 "splats")  # fmt: skip

    def _add_actors(self) -> None:
        gui = self._gui
        gui.add_markdown("Click an actor in the free camera, or choose it here; then drag its handle.")
        self.actor = self._on(gui.add_dropdown("Actor", self._actor_names()), self._choose_actor)
        self.shown = self._on(gui.add_checkbox("Shown", True, disabled=True), self._show_actor)
        self.put_back = gui.add_button("Put it back", disabled=True)
        self.put_back.on_click(lambda _: self._put_back())
        gui.add_button("Put all back").on_click(
            lambda _: self._session.change(moving=True, offsets={}, hidden=frozenset())
        )

    def _actor_names(self) -> tuple[str, ...]:
        return (NOBODY, *sorted(track.id for track in self._stage.world(self._session.view).tracks))

    def _choose_actor(self, name: str) -> None:
        self._select(None if name == NOBODY else name)
        self.refresh()
        self._session.change(moving=True)

    def choose_actor(self, track_id: str | None) -> None:
        """Selects a track, or none, as if it had been chosen in the list."""
        self._set(self.actor, track_id or NOBODY)
        self._choose_actor(track_id or NOBODY)

    def _show_actor(self, on: bool) -> None:
        hidden = self._session.view.hidden - {self.actor.value}
        self._session.change(moving=True, hidden=hidden if on else hidden | {self.actor.value})

    def _put_back(self) -> None:
        offsets = {name: pose for name, pose in self._session.view.offsets.items() if name != self.actor.value}
        self._session.change(moving=True, offsets=offsets)

    def _add_compare(self) -> None:
        gui, names = self._gui, [world.name for world in self._opened.worlds]
        self.world = self._on(gui.add_dropdown("Reconstruction", names), self._choose_world)
        self.other = self._on(
            gui.add_dropdown("Right of the wipe", (OFF, *names), disabled=len(names) < 2), self._choose_other
        )
        self.wipe = self._bind(gui.add_slider("Wipe", 0.0, 1.0, 0.01, 0.5, disabled=len(names) < 2), "wipe")
        log = self._opened.clip is not None
        hint = "of the chosen camera, at its nearest frame" if log else "needs the log: --clip LOG"
        choices = (OFF, "beside", "blend")
        self.recorded = self._bind(gui.add_dropdown("Recorded image", choices, disabled=not log, hint=hint), "recorded")
        self.blend = self._bind(gui.add_slider("Weight of the recorded", 0.0, 1.0, 0.01, 0.5, disabled=not log),
                                "blend")  # fmt: skip

    def _choose_world(self, name: str) -> None:
        index = [world.name for world in self._opened.worlds].index(name)
        self._session.change(moving=True, world=index)
        self.layer.options = self._opened.worlds[index].layers

    def _choose_other(self, name: str) -> None:
        names = [world.name for world in self._opened.worlds]
        self._session.change(moving=True, other=None if name == OFF else names.index(name))

    def _add_rollouts(self) -> None:
        gui = self._gui
        self.rollout = self._on(gui.add_dropdown("Rollout", (RECORDING, *self._opened.rollouts)), self.choose_rollout)
        self.event = self._on(gui.add_dropdown("Go to event", (NOBODY,)), self._go_to_event)
        self.events = gui.add_markdown("")

    def choose_rollout(self, name: str) -> None:
        """Shows a rollout from its start, in the scene that it was driven in; or the recording."""
        chosen = None if name == RECORDING else name
        world = self._session.view.world
        if chosen is not None:
            world = self._opened.world_of(self._opened.rollouts[chosen])
        self._session.change(moving=True, rollout=chosen, world=world, ego_offset=np.eye(4))
        start_us, end_us = self._stage.times_us(self._session.view)
        self.time.max = max((end_us - start_us) // 1000 / 1e3, TIME_STEP_S)
        self._session.change(moving=True, t_us=start_us)
        rows = [f"{(t_us - start_us) / 1e6:.1f} s: {text}" for t_us, text in self._painter.events.get(name, ())]
        self.event.options = (NOBODY, *rows)
        self.events.content = "\n".join(f"- {row}" for row in rows) or ("no events" if chosen else "")
        self._set(self.rollout, name)
        self.refresh()

    def _go_to_event(self, text: str) -> None:
        if text != NOBODY:
            self._go_to(float(text.split(" ")[0]))
            self.refresh()

    # -------------------------------------------------------------------------------------------------------- keeping

    def refresh(self) -> None:
        """Shows what the view has become by playing, dragging and clicking."""
        view = self._session.view
        self._set(self.time, round((view.t_us - self._stage.times_us(view)[0]) / 1e6 / TIME_STEP_S) * TIME_STEP_S)
        self._set(self.play, self._session.playing)
        offset = view.ego_offset
        for control, value in (
            (self.forward, offset[0, 3]), (self.left, offset[1, 3]), (self.yaw, math.degrees(geometry.yaw_of(offset))),
        ):  # fmt: skip
            self._set(control, float(np.clip(round(value, 2), control.min, control.max)))
        self._set(self.world, self._opened.worlds[view.world].name)
        someone = self.actor.value != NOBODY
        self.shown.disabled = self.put_back.disabled = not someone
        self._set(self.shown, self.actor.value not in view.hidden)
