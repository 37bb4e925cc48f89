"""The thread that draws a session's view: always the newest one, coarse while it moves, full when it is still."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nurec_sim.errors import NurecSimError
from nurec_sim.view.picture import Image, Painter
from nurec_sim.view.state import Session

log = logging.getLogger(__name__)

MOVING_FRAME_S = 1 / 20
"""Time for one picture while the view moves; its resolution follows."""
LEAST_FRAME_S = 1 / 30
"""No more pictures than screens show."""
LEAST_SCALE = 0.25
STILL_AFTER_S = 0.25
"""So long after the last movement the full picture is drawn."""
COARSE_PX = 640 * 360
"""Most pixels of a picture while the view moves."""


class DrawingThread(threading.Thread):
    """Draws the newest view of a session until it is stopped; views that were replaced meanwhile are never drawn.

    Args:
        session: whose view.
        painter: paints it.
        show: called with each picture and whether it is the full one.
        tell: called with the text of an error, and with an empty text once drawing works again.
        before: called before each picture; moves time on while playing.
    """

    def __init__(
        self,
        session: Session,
        painter: Painter,
        show: Callable[[Image, bool], None],
        tell: Callable[[str], None],
        before: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(name="view-drawing", daemon=True)
        self._session, self._painter, self._show, self._tell, self._before = session, painter, show, tell, before
        self._stopped = threading.Event()
        self._scale, self._faulty = 1.0, False
        self.selected: Callable[[], str | None] = lambda: None
        self.drawn = 0
        """Number of pictures so far."""

    def stop(self) -> None:
        """Ends the thread after the picture in progress, and waits for it."""
        self._stopped.set()
        self._session.change()
        if threading.current_thread() is not self:
            self.join()

    def run(self) -> None:
        """Draws until ``stop``."""
        seen, full = -1, False
        while not self._stopped.is_set():
            if not self._session.playing and not self._session.wait(seen, STILL_AFTER_S) and full:
                continue
            if self._stopped.is_set():
                return
            try:
                self._before()
                seen = self._session.version
                full = self._draw()
                if self._faulty:
                    self._faulty = False
                    self._tell("")
            except NurecSimError as error:
                self._fail(str(error))
                full = True  # nothing better until something changes
            except Exception as error:  # a bug: the tab lives on and says so
                log.exception("a view could not be drawn")
                self._fail(f"{type(error).__name__}: {error}")
                full = True

    def _fail(self, text: str) -> None:
        self._faulty = True
        self._session.playing = False
        self._tell(text)

    def _draw(self) -> bool:
        """Draws the view once; whether in full."""
        view = self._session.view
        moving = self._session.playing or self._session.still_s < STILL_AFTER_S
        started = time.perf_counter()
        if not moving:
            self._show(self._painter.paint(view, 1.0, self.selected()), True)
            self.drawn += 1
            return True
        most = (COARSE_PX / self._full_px()) ** 0.5
        scale = min(self._scale, most, 1.0)
        self._show(self._painter.paint(replace(view, moving=True), scale, self.selected()), False)
        self.drawn += 1
        took_s = max(time.perf_counter() - started, 1e-4)
        # Time goes with the number of pixels, about; small steps keep the size from jumping.
        wanted = scale * (MOVING_FRAME_S / took_s) ** 0.5
        self._scale = float(np.clip(wanted, max(LEAST_SCALE, 0.8 * scale), 1.1 * scale))
        self._stopped.wait(LEAST_FRAME_S - took_s if took_s < LEAST_FRAME_S else 0)
        return False

    def _full_px(self) -> int:
        """Pixels of the full picture."""
        view = self._session.view
        if view.camera is None:
            return view.size_px[0] * view.size_px[1]
        camera = self._painter.stage.world(view).rig.cameras[view.camera]
        return camera.width_px * camera.height_px
