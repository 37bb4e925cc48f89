"""The viewer in a real browser, and its command."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import view_worlds
from browser import Browser

from nurec_sim import cli, scene
from nurec_sim.errors import ServerError

viser = pytest.importorskip("viser", reason='the viewer needs viser: pip install "nurec-sim[view]"')

from nurec_sim.view import Viewer  # noqa: E402
from nurec_sim.view.film import path_views  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def viewer():
    with Viewer(view_worlds.opened((view_worlds.world(0), view_worlds.world(1)))) as running:
        yield running


@pytest.fixture(scope="module")
def page(viewer, tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("chromium"), (900, 560)) as browser:
        browser.open(f"http://127.0.0.1:{viewer.port}/")
        browser.wait(lambda: viewer.tabs, "a tab connects")
        yield browser


@pytest.fixture
def tab(page, viewer):
    (tab,) = viewer.tabs.values()
    settled(page, tab)
    return tab


def settled(page, tab):
    """Waits until the full picture has been drawn, and the browser has had time to show it."""

    def full():
        version, drawn = tab.session.version, tab.thread.drawn
        time.sleep(0.4)
        return (version, drawn) == (tab.session.version, tab.thread.drawn) and drawn > 0

    page.wait(full, "the view stands still")


def stop_playing(page, tab):
    """Clicks on Play, again if nothing happens: on a busy machine the panel may be drawn anew under the click."""
    for _ in range(4):
        page.drag(*[control(page, "Play")] * 2, steps=1)
        with contextlib.suppress(AssertionError):
            return page.wait(lambda: not tab.session.playing, "play stops", 8.0)
    raise AssertionError("play does not stop")


CANVAS = """(() => {
  const areas = [...document.querySelectorAll("canvas")].map(each => each.getBoundingClientRect());
  const largest = areas.reduce((a, b) => a.width * a.height > b.width * b.height ? a : b);
  return [largest.x, largest.y, largest.width, largest.height];
})()"""
"""Script: place and size of the scene in pixels of the page."""


def canvas(page):
    """The part of the page without panel and notices."""
    return page.picture()[250:, :560].astype(int)


def changed(page, before, least=4.0):
    """Waits until the page looks different."""
    page.wait(lambda: np.abs(canvas(page) - before).mean() > least, "the picture changes")


def control(page, label):
    """Centre in pixels of the control beside a label of the panel."""
    script = """(wanted => {
      const found = [...document.querySelectorAll("label, span, div")].filter(
        e => e.children.length == 0 && e.textContent.trim() == wanted && e.getBoundingClientRect().width > 0)[0];
      if (!found) return null;
      let row = found;
      while (row && !row.querySelector("input, button")) row = row.parentElement;
      const place = row.querySelector("input:not([type=hidden]), button").getBoundingClientRect();
      return [place.x + place.width / 2, place.y + place.height / 2];
    })"""
    place = page.wait(lambda: page.run(f"{script}({label!r})"), f"a control {label!r}")
    return tuple(place)


def test_it_opens_and_shows_what_the_renderer_draws(page, tab):
    assert not page.errors

    def off():
        # Apart from notices and the car's handle, and JPEG aside, the same picture.
        region = (slice(300, 550), slice(10, 260))
        return np.abs(page.picture()[region].astype(int) - tab._painter.paint(tab.session.view)[region]).mean()

    page.wait(lambda: off() < 4, "the renderer's picture is shown")  # the page fades in
    width, height = tab.session.view.size_px
    assert 400 < width < 900 and height == 560  # the rest is the panel's


def test_dragging_moves_the_camera_and_play_moves_time(page, tab):
    before, pose = canvas(page), tab.session.view.browser_from_eye
    page.drag((120, 500), (300, 470))
    page.wait(lambda: not np.allclose(tab.session.view.browser_from_eye, pose), "the camera moves")
    changed(page, before)
    tab.reset_eye()
    settled(page, tab)
    t_us, drawn = tab.session.view.t_us, tab.thread.drawn
    page.drag(*[control(page, "Play")] * 2, steps=1)
    page.wait(lambda: tab.session.view.t_us > t_us + 300_000 and tab.thread.drawn > drawn + 3, "time goes on")
    page.wait(lambda: tab.panel.time.value > 0.2, "the panel follows")
    stop_playing(page, tab)


def test_toggles_and_comparison(page, tab):
    for act, undo in (
        (lambda: page.drag(*[control(page, "Boxes")] * 2, steps=1), lambda: setattr(tab.panel.boxes, "value", False)),
        (lambda: setattr(tab.panel.layer, "value", "label"), lambda: setattr(tab.panel.layer, "value", "rgb")),
        (lambda: setattr(tab.panel.layer, "value", "support"), lambda: setattr(tab.panel.layer, "value", "rgb")),
        (lambda: setattr(tab.panel.other, "value", "dense"), lambda: setattr(tab.panel.other, "value", "off")),
        (lambda: setattr(tab.panel.camera, "value", "fish"), lambda: setattr(tab.panel.camera, "value", "free")),
    ):
        settled(page, tab)
        before = canvas(page)
        act()
        changed(page, before, 0.3)
        undo()
    settled(page, tab)
    assert not page.errors


def test_an_actor_is_selected_by_a_click_and_moved_by_its_handle(page, tab):
    tab.panel.time.value = 0.5
    tab.reset_eye()
    settled(page, tab)
    stage, view = tab._painter.stage, tab.session.view
    track = stage.tracks(view)["car-1"]

    def clicked():
        # Where the browser's camera sees the car now: it glides to its place.
        eye = tab.session.view
        centre = np.linalg.inv(stage.world_from_browser(eye) @ eye.browser_from_eye) @ stage.box(eye, track)[:, 3]
        # In pixels of the page; a busy browser renders, and reports to the server, fewer of them.
        left, top, width, height = page.run(CANVAS)
        focal = height / 2 / np.tan(eye.fov_rad / 2)
        at = left + width / 2 + focal * centre[0] / centre[2], top + height / 2 + focal * centre[1] / centre[2]
        page.drag(at, at, steps=0)
        time.sleep(0.5)
        return tab.handles.selected == "car-1"

    page.wait(clicked, "the car is selected")
    assert tab.panel.actor.value == "car-1" and not tab.panel.shown.disabled
    settled(page, tab)
    place = tab.handles._actor.position
    assert np.allclose((stage.world_from_browser(view) @ [*place, 1])[:3], stage.box(view, track)[:3, 3], atol=1e-3)
    aside = np.linalg.inv(stage.world_from_browser(view)) @ stage.box(view, track)
    aside[:3, 3] += [0.5, 1.5, 3.0]  # 3 m up, which a car cannot
    tab.handles._drag_actor(stage.world_from_browser(view) @ aside)
    moved = stage.box(tab.session.view, track)
    assert np.isclose(moved[2, 3], stage.box(view, track)[2, 3], atol=0.05)
    assert np.hypot(*(moved - stage.box(view, track))[:2, 3]) == pytest.approx(np.hypot(0.5, 1.5), abs=0.05)
    tab.panel._put_back()
    tab.panel.choose_actor(None)
    assert not tab.session.view.offsets


def test_the_panel_moves_the_car_and_shows_rollouts(tab):
    panel = tab.panel
    panel.left.value, panel.yaw.value = 2.0, 30.0
    view = tab.session.view
    assert np.allclose(view.ego_offset[:2, 3], [0, 2]) and np.isclose(np.arctan2(*view.ego_offset[1::-1, 0]), np.pi / 6)
    panel.move_ego_to(np.eye(4))
    assert (panel.left.value, panel.yaw.value) == (0, 0)
    panel.rollout.value = "hits"
    assert tab.session.view.rollout == "hits" and panel.time.max == pytest.approx(0.9)
    assert "front contact with automobile car-1" in panel.events.content
    panel.event.value = next(text for text in panel.event.options if "contact" in text)
    assert tab.session.view.t_us > view_worlds.START_US + 100_000
    panel.rollout.value = "recorded drive"
    assert tab.session.view.rollout is None and tab.session.view.t_us == view_worlds.START_US


def test_gaussians_in_the_browser(page, tab):
    settled(page, tab)
    before = canvas(page)
    tab.panel.splats.value = True
    page.wait(lambda: tab.handles._splats is not None and tab.handles._moving is not None, "Gaussians are sent")
    changed(page, before)  # no sky there
    tab.panel.splats.value = False
    page.wait(lambda: tab.handles._splats is None, "Gaussians are removed")
    page.wait(lambda: np.abs(canvas(page) - before).mean() < 2, "the picture is back")


def test_films_are_made_and_errors_told(tab):
    sent = []
    tab._client.send_file_download = lambda name, content: sent.append((name, content))
    tab.session.change(size_px=(64, 36))
    tab.film.film(lambda: path_views(tab.film.keys, 1.0))
    assert tab.film.told.content == "**No film:** a camera path needs at least 2 key views, got 0" and not sent
    tab.film._add_key()
    tab.film._add_key()
    tab.film.film(lambda: path_views(tab.film.keys, 1.0))
    assert sent[0][0] == "nurec-sim.mp4" and b"ftyp" in sent[0][1][:12]
    assert not tab.film.film_path.disabled


def test_a_closed_browser_leaves_no_thread(page, viewer):
    (tab,) = viewer.tabs.values()
    page.close()
    page.wait(lambda: not viewer.tabs and not tab.thread.is_alive(), "the tab is gone")


def test_viser_is_asked_for(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit):
        cli.main(["view", str(tmp_path / "any.usdz")])
    assert 'the viewer needs the package viser: pip install "nurec-sim[view]"' in capsys.readouterr().err


def test_ports_and_hosts(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ServerError, match="cannot listen on 127.0.0.1:.*in use; give another --port"):
            Viewer(view_worlds.opened((view_worlds.world(),)), port=taken.getsockname()[1])
    with pytest.raises(SystemExit):
        cli.main(["view", "any.usdz", "--host", "0.0.0.0"])
    assert "refused to listen at '0.0.0.0', which other machines can reach; forward the port" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_stops_at_ctrl_c(tmp_path):
    scene.write_scene(view_worlds.scene(), tmp_path / "street.usdz")
    command = [
        sys.executable,
        "-m",
        "nurec_sim.cli",
        "view",
        str(tmp_path / "street.usdz"),
        "--port",
        "0",
        "--threads",
        "1",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"})
    try:
        line = process.stdout.readline()
        assert line.startswith("Viewing street at http://127.0.0.1:") and "(Ctrl-C stops)" in line
        assert "ssh -L" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        assert process.stdout.read() == "stopped\n"
    finally:
        process.kill()
        process.communicate()
