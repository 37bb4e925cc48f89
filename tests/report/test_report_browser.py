"""The report in a browser: its figures keep their heights, and a narrow page nowhere scrolls sideways as a whole."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Browser
from test_report import figures, street_report

from nurec_sim.report import render_report

pytestmark = pytest.mark.slow
DRAWN = "[...document.querySelectorAll('.plot')].filter(each => each._fullLayout)"
HEIGHTS = f"Object.fromEntries({DRAWN}.map(each => [each.id, [each.clientHeight, each._fullLayout.height]]))"
SIDEWAYS = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def text() -> str:
    return render_report(street_report())


@pytest.fixture
def page(text: str, tmp_path: Path) -> Iterator[Browser]:
    file = tmp_path / "report.html"
    file.write_text(text, encoding="utf-8")
    with Browser(tmp_path / "chromium", (1400, 900)) as browser:
        browser.open(file.as_uri())
        browser.wait(lambda: browser.run(HEIGHTS), "figures are drawn")
        yield browser


def test_figures_keep_their_heights_when_the_window_changes(page: Browser, text: str) -> None:
    page.run("document.querySelectorAll('details.card').forEach(each => { each.open = true; })")
    wanted = {name: [figure["layout"]["height"]] * 2 for name, figure in figures(text)["figures"].items()}
    page.wait(lambda: page.run(HEIGHTS) == wanted, "all figures have their heights")
    for width in (1000, 390):
        page("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        page.wait(
            lambda width=width: page.run(f"{DRAWN}.every(each => each._fullLayout.width < {width})"), "it follows"
        )
        assert page.run(HEIGHTS) == wanted, width
        assert page.run(SIDEWAYS) == 0, width
    assert page.errors == []
