"""The viewer: a web server on this machine, and one session for each browser tab."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
import warnings
from typing import Any

import numpy as np

from nurec_sim.errors import NurecSimError, ServerError
from nurec_sim.view.camera import pose_of, start_pose
from nurec_sim.view.drawing import DrawingThread
from nurec_sim.view.film import FilmControls
from nurec_sim.view.handles import Handles
from nurec_sim.view.panel import Panel
from nurec_sim.view.picture import Image, Painter
from nurec_sim.view.sources import Opened
from nurec_sim.view.state import Session, View

MOVING_QUALITY, FULL_QUALITY = 70, 92
"""JPEG qualities of coarse and full pictures."""
PANEL_EVERY_S = 0.2
"""While playing, the panel and the browser's own Gaussians follow at this interval."""
SAME_EYE = 1e-6


class Viewer:
    """Serves a viewer until it is stopped; use it in a ``with`` block.

    Args:
        opened: what is shown.
        host: address to listen on.
        port: port to listen on; 0 chooses a free one.

    Attributes:
        port: the port that it listens on.

    Raises:
        NurecSimError: viser is not installed.
        ServerError: the port cannot be used.
    """

    def __init__(self, opened: Opened, host: str = "127.0.0.1", port: int = 0) -> None:
        viser = import_viser()
        # A tab may be closed while its picture is drawn.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        _check_port(host, port)
        self.painter = Painter(opened)
        self.tabs: dict[int, Tab] = {}
        self._lock = threading.Lock()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table of its addresses
            self._server = viser.ViserServer(host, port, f"nurec-sim: {opened.worlds[0].id}", verbose=False)
        self.port: int = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()  # beside the picture, not over it
        self._server.scene.set_up_direction("+z")
        self._server.scene.world_axes.visible = False
        eye, target = start_pose()
        start = self._server.initial_camera
        start.position, start.look_at, start.up = eye[:3, 3], target, (0.0, 0.0, 1.0)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()

    def warm_up(self) -> None:
        """Renders a small picture, so that kernels are compiled before the first tab opens."""
        self.painter.paint(View(self.painter.opened.worlds[0].times_us[0], (64, 36)))

    def stop(self) -> None:
        """Closes all tabs' connections, ends their threads, and frees the port."""
        with self._lock:
            tabs, self.tabs = list(self.tabs.values()), {}
        for tab in tabs:
            tab.close()
        with contextlib.redirect_stdout(io.StringIO()):  # viser says that it stops
            self._server.stop()

    def _connect(self, client: Any) -> None:
        tab = Tab(client, self.painter)
        with self._lock:
            self.tabs[client.client_id] = tab

    def _disconnect(self, client: Any) -> None:
        with self._lock:
            tab = self.tabs.pop(client.client_id, None)
        if tab is not None:
            tab.close()


class Tab:
    """One browser tab: its view, its controls, and the thread that draws for it.

    Args:
        client: viser's client.
        painter: paints views.
    """

    def __init__(self, client: Any, painter: Painter) -> None:
        self._client, self._painter = client, painter
        first = painter.opened.worlds[0]
        self.session = Session(View(first.times_us[0]))
        self.session.change(t_us=painter.stage.times_us(self.session.view)[0])
        self.handles = Handles(client, self.session, painter.stage, lambda: self.panel.refresh())
        self.panel = Panel(client.gui, self.session, painter, self._select, self.reset_eye)
        self.film = FilmControls(client, self.panel.tabs, self.session, painter)
        self.thread = DrawingThread(self.session, painter, self._show, self._tell, self._step)
        self.thread.selected = lambda: self.handles.selected
        self._played_s, self._panel_s = time.monotonic(), 0.0
        self._tell("")
        client.camera.on_update(self._eye_moved)
        client.scene.on_click()(self._clicked)
        self._eye_moved(client.camera)
        self.thread.start()

    def close(self) -> None:
        """Ends the drawing thread."""
        self.session.playing = False
        self.thread.stop()

    def reset_eye(self) -> None:
        """Puts the free camera behind the car."""
        view = self.session.view
        stage = self._painter.stage
        car = np.linalg.inv(stage.world_from_browser(view)) @ stage.ego(view, view.t_us)
        eye, target = start_pose()
        camera = self._client.camera
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position = (car @ eye)[:3, 3]
        camera.look_at = (car @ [*target, 1.0])[:3]

    def _eye_moved(self, camera: Any) -> None:
        pose, size = pose_of(camera.position, camera.wxyz), (int(camera.image_width), int(camera.image_height))
        view = self.session.view
        same = np.allclose(pose, view.browser_from_eye, atol=SAME_EYE) and abs(camera.fov - view.fov_rad) < SAME_EYE
        if min(size) > 0 and not (same and size == view.size_px):
            # A camera of the car does not move with the mouse.
            moving = view.camera is None or size != view.size_px
            self.session.change(moving=moving, browser_from_eye=pose, fov_rad=float(camera.fov), size_px=size)

    def _clicked(self, event: Any) -> None:
        if self.session.view.camera is None:
            found = self.handles.pick(np.asarray(event.ray_origin), np.asarray(event.ray_direction))
            self.panel.choose_actor(found)

    def _select(self, track_id: str | None) -> None:
        self.handles.selected = track_id

    def _step(self) -> None:
        """Before each picture: moves time on while playing, and keeps panel, handles and Gaussians in step."""
        now = time.monotonic()
        elapsed_s, self._played_s = now - self._played_s, now
        if self.session.playing:
            start_us, end_us = self._painter.stage.times_us(self.session.view)
            t_us = self.session.view.t_us + round(elapsed_s * 1e6)
            self.session.change(moving=True, t_us=start_us if t_us > end_us else t_us)
        if self.session.playing and now - self._panel_s < PANEL_EVERY_S:
            return
        self._panel_s = now
        if self.session.playing:
            self.panel.refresh()
        self.handles.place()
        if not self.session.view.splats:
            self.handles.hide_splats()
        elif left_out := self.handles.show_splats():
            self._tell(f"The {left_out:,} Gaussians that cover least are left out in the browser.")

    def _show(self, picture: Image, full: bool) -> None:
        if self.session.view.splats and self.session.view.camera is None:
            self._client.scene.set_background_image(None)
            return
        quality = FULL_QUALITY if full else MOVING_QUALITY
        self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)

    def _tell(self, text: str) -> None:
        world = self._painter.stage.world(self.session.view)
        notes = "".join(f"\n\n{note}" for note in (*self._painter.opened.notes, text) if note)
        self.panel.status.content = f"**{world.id}**{notes}"


def import_viser() -> Any:
    """The package viser.

    Raises:
        NurecSimError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise NurecSimError(f'the viewer needs the package viser: pip install "nurec-sim[view]" ({error})') from error
    return viser


def _check_port(host: str, port: int) -> None:
    """Raises if a port cannot be used; viser would silently take the next one.

    Raises:
        ServerError: it is taken, or may not be used.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, OverflowError) as error:
        raise ServerError(f"cannot listen on {host}:{port}: {error}; give another --port") from None
