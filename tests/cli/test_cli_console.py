"""What verbs show: tables in any width, and how far long work is."""

import io
import re
import time

import pytest
from rich.console import Console

from nurec_sim.cli import progress as progress_module
from nurec_sim.cli.console import part_of
from nurec_sim.cli.progress import shown
from nurec_sim.cli.tables import draw_table

HEADING = ["policy", "reconstruction", "rollouts", "failed", "collision", "off-road", "(C+O)/2", "road unknown",
           "progress", "scene score"]  # fmt: skip
POLICIES = ["camera_road_follower", "constant_velocity", "lidar_aeb", "log_replay", "route_follower"]
RESULTS = [[name, "lift", str(k), "0", "0.00", "0.25", "not known", "0.12", "1.00", "0.93"]
           for k, name in enumerate(POLICIES)]  # fmt: skip


def drawn(width: int, *table: object) -> list[str]:
    file = io.StringIO()
    draw_table(Console(file=file, width=width), "a title", *table)
    return file.getvalue().splitlines()


@pytest.mark.parametrize("width", [60, 80, 120, 160])
def test_nothing_is_cut_off_or_broken_in_any_width(width: int) -> None:
    lines = drawn(width, RESULTS, HEADING)
    assert max(map(len, lines)) <= width
    words = set(re.findall(r"[\w()/+.-]+", " ".join(lines)))
    assert words >= {word for row in [HEADING, *RESULTS] for cell in row for word in cell.split()}
    assert "…" not in "".join(lines)


def test_what_is_too_wide_is_turned_round_and_keeps_its_rows_together() -> None:
    lines = drawn(80, RESULTS, HEADING)
    assert re.fullmatch("policy +camera_road_follower +constant_velocity +lidar_aeb +log_replay *", lines[1])
    assert re.fullmatch("rollouts +0 +1 +2 +3 *", lines[3])
    assert re.fullmatch("road unknown +0.12 +0.12 +0.12 +0.12 *", lines[8])
    assert re.fullmatch("policy +route_follower *", lines[12]) and re.fullmatch("rollouts +4 *", lines[14])
    wide = drawn(160, RESULTS, HEADING)
    assert any(re.search("constant_velocity.* lift .* 1 .* 0 .* 0.00 .* 0.25", line) for line in wide)


def test_headings_break_before_anything_else_gives_way() -> None:
    rows = [["front", "12345.67", "0.1"], ["left", "1.00", "0.2"]]
    heading = ["sensor", "frames or sweeps", "longest gap in seconds"]
    assert any("longest gap in seconds" in line for line in drawn(80, rows, heading))
    narrow = drawn(40, rows, heading)
    assert max(map(len, narrow)) <= 40 and not any("longest gap" in line for line in narrow)
    assert any(re.search("front .* 12345.67 .* 0.1", line) for line in narrow)


def test_texts_wrap_and_long_words_fold() -> None:
    rows = [["what", "a policy that steers for room on road-coloured ground, and more"], ["path", "/very" * 20]]
    lines = drawn(40, rows)
    assert max(map(len, lines)) <= 40
    assert "".join(re.findall(r"/very|/ver|/ve|/v|/|very|ery|ry|y", " ".join(lines[5:]))).count("v") >= 20
    assert drawn(40, [], ["name", "size"])[0].strip() == "a title"


def told(monkeypatch: pytest.MonkeyPatch, work, every_s: float = 0.02, terminal: bool = False) -> str:
    """What is shown of ``work``, which is given the function to call with its progress and the text so far."""
    monkeypatch.setattr(progress_module, "EVERY_S", every_s)
    file = io.StringIO()
    console = Console(file=file, width=80, force_terminal=terminal)
    with shown(console, "driving") as advance:
        work(advance, file.getvalue)
    return file.getvalue()


def wait_until(condition) -> None:
    for _ in range(4000):
        if condition():
            return
        time.sleep(0.005)
    raise AssertionError("waited in vain")


def test_lines_say_what_is_done_how_much_and_how_long_it_takes(monkeypatch) -> None:
    clock = iter(range(0, 100_000, 10))  # whoever looks at the clock finds it ten seconds later

    def work(advance, text) -> None:
        wait_until(lambda: text().count("\n") >= 2)
        advance("policy a", 0.25)
        wait_until(lambda: text().count("25%") >= 2)
        advance("policy a", 0.5)
        wait_until(lambda: text().count("50%") >= 2)

    with monkeypatch.context() as patch:
        patch.setattr(progress_module.time, "monotonic", lambda: next(clock))
        lines = told(monkeypatch, work).splitlines()
    assert re.fullmatch(r"driving, \d+ s so far", lines[0])
    assert re.fullmatch(r"driving: policy a, 50%, \d+ (s|min) so far, \d+ (s|min) left", lines[-1])
    assert len(lines) >= 6


def test_quick_work_says_nothing_without_a_terminal(monkeypatch) -> None:
    assert told(monkeypatch, lambda advance, _: advance("policy a", 0.5), every_s=10.0) == ""


def test_a_terminal_gets_a_bar_with_the_time_left(monkeypatch) -> None:
    stage = "a stage with so long a name that it and the bar have no room beside each other"

    def work(advance, text) -> None:
        advance(stage, 0.0)
        wait_until(lambda: "0%" in text())
        advance(stage, 0.5)
        wait_until(lambda: "50%" in text() and "s left" in text())

    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", told(monkeypatch, work, terminal=True))
    shown_lines = re.split(r"[\r\n]+", text)
    assert any("50%" in line and re.search(r"\d s left", line) for line in shown_lines), shown_lines
    assert max(map(len, shown_lines)) <= 80


def left_after(*samples: tuple[float, float], now: float) -> float | None:
    """Seconds left by what was told at some times."""
    clock = 0.0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress_module.time, "monotonic", lambda: clock)
        work = progress_module._Work("work")
        for seconds, fraction in samples:
            clock = seconds
            work.advance("", fraction)
        clock = now
        return work.left_s


def test_the_time_left_is_that_of_the_pace_of_late() -> None:
    assert left_after(now=5.0) is None
    assert left_after((0.0, 0.0), now=5.0) is None
    assert left_after((0.0, 0.0), (30.0, 0.75), now=30.0) == pytest.approx(10.0)
    assert left_after((0.0, 0.5), (30.0, 0.75), now=30.0) == pytest.approx(30.0)  # half was there at the beginning
    # what was found done in the first second does not make the rest look quick
    resumed = [(0.0, 0.0), (1.0, 0.8), *((float(t), 0.8 + 0.001 * t) for t in range(2, 101))]
    assert left_after(*resumed, now=100.0) == pytest.approx(100.0, rel=0.05)
    assert left_after((0.0, 0.0), (10.0, 0.9), (20.0, 0.0), (30.0, 0.5), now=30.0) == pytest.approx(10.0)  # begun anew


def test_parts_of_some_work_are_told_as_shares_of_it() -> None:
    told: list[tuple[str, float]] = []
    part_of(lambda stage, fraction: told.append((stage, fraction)), 1, 4, "street")("depth", 0.5)
    part_of(lambda stage, fraction: told.append((stage, fraction)), 0, 1, "street")("depth", 0.5)
    assert told == [("street (2 of 4), depth", 0.375), ("depth", 0.5)]
