"""Videos of a camera path, or of the view while time goes on."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import NurecSimError, RequestError
from nurec_sim.runs.video import write_video
from nurec_sim.view.picture import Image, Painter
from nurec_sim.view.state import Session, View

RATE_HZ = 20
MOST_FRAMES = 3600


def path_views(keys: Sequence[View], seconds: float) -> list[View]:
    """Views along a path through key views: time, pose and field of view of the free camera are interpolated.

    Raises:
        RequestError: fewer than two keys, or a film of no or too many frames.
    """
    if len(keys) < 2:
        raise RequestError(f"a camera path needs at least 2 key views, got {len(keys)}")
    count = _checked(seconds)
    marks = np.arange(len(keys), dtype=np.int64) * 1_000_000
    asked = np.linspace(0, marks[-1], count).astype(np.int64)
    poses = geometry.interpolate_poses(marks, np.stack([key.browser_from_eye for key in keys]), asked)
    times = np.interp(asked, marks, [key.t_us for key in keys])
    fields = np.interp(asked, marks, [key.fov_rad for key in keys])
    return [
        replace(keys[0], t_us=round(t_us), browser_from_eye=pose, fov_rad=float(fov_rad), camera=None, moving=False)
        for t_us, pose, fov_rad in zip(times, poses, fields, strict=True)
    ]


def time_views(view: View, times_us: tuple[int, int]) -> list[View]:
    """The same view at every time, at real speed.

    Raises:
        RequestError: too many frames.
    """
    count = _checked((times_us[1] - times_us[0]) / 1e6)
    times = np.linspace(times_us[0], times_us[1], count)
    return [replace(view, t_us=round(t_us), moving=False) for t_us in times]


def _checked(seconds: float) -> int:
    count = round(seconds * RATE_HZ)
    if not 2 <= count <= MOST_FRAMES:
        raise RequestError(
            f"a film has 2 to {MOST_FRAMES} frames at {RATE_HZ} a second, got {seconds:g} s: {count} frames"
        )
    return count


def film_of(
    painter: Painter, views: Sequence[View], progress: Callable[[float], None] = lambda fraction: None
) -> bytes:
    """Renders views in full and returns them as an MP4 with H.264.

    Raises:
        NurecSimError: a view cannot be rendered.
    """

    def pictures() -> Iterator[Image]:
        for index, view in enumerate(views):
            yield _even(painter.paint(view))
            progress((index + 1) / len(views))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_video(path, pictures(), RATE_HZ)
        return path.read_bytes()


def _even(picture: Image) -> Image:
    """A picture with even sides, as H.264 wants them."""
    return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]


class FilmControls:
    """The tab with which films are made; they are downloaded by the browser.

    Args:
        client: viser's client.
        tabs: the group of tabs that it is added to.
        session: its view.
        painter: renders the film.
    """

    def __init__(self, client: Any, tabs: Any, session: Session, painter: Painter) -> None:
        self._client, self._session, self._painter = client, session, painter
        self.keys: list[View] = []
        gui = client.gui
        with tabs.add_tab("Film"):
            self.told = gui.add_markdown("")
            self.add = gui.add_button("Add this view to the camera path")
            self.clear = gui.add_button("Clear the path")
            self.seconds = gui.add_slider("Seconds", 1.0, 60.0, 0.5, 5.0)
            self.film_path = gui.add_button("Film the camera path (MP4)")
            self.film_time = gui.add_button("Film the whole time in this view (MP4)")
            self.bar = gui.add_progress_bar(0.0, visible=False)
        self.add.on_click(lambda _: self._add_key())
        self.clear.on_click(lambda _: self._clear())
        self.film_path.on_click(lambda _: self.film(lambda: path_views(self.keys, self.seconds.value)))
        self.film_time.on_click(
            lambda _: self.film(lambda: time_views(session.view, painter.stage.times_us(session.view)))
        )
        self._clear()

    def _add_key(self) -> None:
        self.keys.append(self._session.view)
        self._tell_keys()

    def _clear(self) -> None:
        self.keys.clear()
        self._tell_keys()

    def _tell_keys(self) -> None:
        self.told.content = f"{len(self.keys)} key views of the free camera, each with its time."

    def film(self, views: Callable[[], Sequence[View]]) -> None:
        """Makes a film and sends it to the browser; what is wrong is said in the tab."""
        buttons = (self.film_path, self.film_time)
        for button in buttons:
            button.disabled = True
        self.bar.visible = True
        try:
            film = film_of(self._painter, views(), self._show_progress)
            self._client.send_file_download("nurec-sim.mp4", film)
            self.told.content = f"Film of {len(film) / 1e6:.1f} MB sent."
        except (NurecSimError, OSError) as error:
            self.told.content = f"**No film:** {error}"
        finally:
            self.bar.visible = False
            for button in buttons:
                button.disabled = False

    def _show_progress(self, fraction: float) -> None:
        self.bar.value = 100 * fraction
