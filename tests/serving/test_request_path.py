"""How many files a request for a frame enters before the renderer, by a profile of a real server over a socket."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from serving_calls import Stub, camera_message, lidar_message, street_server

import nurec_sim
from nurec_sim.render import CpuRenderer
from nurec_sim.serving.wire import ImageFormat

PACKAGE = Path(nurec_sim.__file__).parent
MOST_FILES = 12


class Profile:
    """The files of the package that threads started from now on enter, in order, until the renderer is called."""

    def __init__(self) -> None:
        self._ends = {CpuRenderer.sense.__code__, CpuRenderer.render_lidar.__code__}
        self._watching = False
        self.files: list[str] = []

    def __call__(self, frame, event: str, argument: object) -> None:
        if self._watching and event == "call":
            code = frame.f_code
            path = Path(code.co_filename)
            if code in self._ends:
                self._watching = False
            elif path.is_relative_to(PACKAGE):
                self.files.append(path.relative_to(PACKAGE).as_posix())

    def files_before_renderer(self, procedure, message) -> list[str]:
        """The files, each once, that a request enters; asked once before, so that the scene is in memory."""
        procedure(message, timeout=60)
        self.files.clear()
        self._watching = True
        procedure(message, timeout=60)
        assert not self._watching, "the renderer was not reached"
        return list(dict.fromkeys(self.files))


@pytest.fixture
def profile() -> Iterator[Profile]:
    found, before = Profile(), threading.getprofile()
    threading.setprofile(found)
    yield found
    threading.setprofile(before)


def test_a_request_enters_at_most_twelve_files_before_the_renderer(profile: Profile) -> None:
    image = camera_message(image_format=ImageFormat.PNG, scene_id="clipgt-street")
    sweep = lidar_message(scene_id="clipgt-street")
    with street_server() as address, Stub(address) as stub:
        for procedure, message in ((stub.render_rgb, image), (stub.render_lidar, sweep)):
            files = profile.files_before_renderer(procedure, message)
            assert {"serving/server/gate.py", "serving/wire/requests.py"} <= set(files), files
            assert len(files) <= MOST_FILES, files
