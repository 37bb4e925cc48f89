"""A headless Chromium, driven over its DevTools protocol."""

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

START_S = 30.0
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)


class Browser:
    """One page of a Chromium of our own; use it in a ``with`` block."""

    def __init__(self, folder: Path, size_px: tuple[int, int] = (1280, 720)) -> None:
        from websockets.sync.client import connect

        program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if program is None:
            pytest.skip("no Chromium here (chromium, chromium-browser, google-chrome)")
        self.process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={folder}", f"--window-size={size_px[0]},{size_px[1]}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            port_file = folder / "DevToolsActivePort"
            self.wait(lambda: port_file.exists() and len(port_file.read_text().split()) == 2, "Chromium starts")
            port = port_file.read_text().split()[0]
            pages = json.loads(urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10).read())
            address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
            self._socket = connect(address, max_size=None)
        except BaseException:
            self._kill()
            raise
        self._ids = itertools.count(1)
        self.errors: list[str] = []
        self("Runtime.enable")
        self(
            "Emulation.setDeviceMetricsOverride", width=size_px[0], height=size_px[1], deviceScaleFactor=1, mobile=False
        )

    def __enter__(self):
        return self

    def __exit__(self, *exc_info):
        self.close()

    def close(self):
        """Ends Chromium; a second call does nothing."""
        self._socket.close()
        self._kill()

    def _kill(self):
        # The whole group: Chromium starts many processes.
        self.process.terminate()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(5)

    def __call__(self, method: str, **params):
        """A call of the protocol; JavaScript errors meanwhile are collected."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            reply = json.loads(self._socket.recv(timeout=60))
            if reply.get("method") == "Runtime.exceptionThrown":
                details = reply["params"]["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description", details["text"]))
            if reply.get("id") == number:
                assert "error" not in reply, reply["error"]
                return reply["result"]

    def open(self, url: str) -> None:
        self("Page.enable")
        self("Page.navigate", url=url)

    def run(self, script: str):
        """The value of a JavaScript expression."""
        result = self("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def picture(self, file: Path | None = None) -> np.ndarray:
        """A screenshot, RGB."""
        data = base64.b64decode(self("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            file.write_bytes(data)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8, pause_s: float = 0.02) -> None:
        """A drag with the left mouse button."""
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        self("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for step in range(1, steps + 1):
            x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            self("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **mouse)
            time.sleep(pause_s)
        self("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **mouse)

    @staticmethod
    def wait(holds, what: str, timeout_s: float = START_S):
        """Waits until something holds; fails with its name if it does not in time."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            if value := holds():
                return value
            time.sleep(0.1)
        raise AssertionError(f"{what}: not within {timeout_s} s")
