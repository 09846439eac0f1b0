"""An operator opens runs that are over: their log, and what their trace says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.runs.store import create_run
from rig.tui.acting import starts
from rig.tui.browse import BrowserState
from rig.tui.following.link import Frame
from rig.tui.look import PlotView
from rig.tui.pages.trace import run_trace_page
from rig.tui.recorded_run import StoredEffect, read_log, read_trace
from tests.services.children import RIG
from tests.tui.glass import Glass
from tests.tui.stored import log_bytes, run_folder, trace_json
from tests.tui.test_runs_page import Office

SIZES = ((80, 24), (120, 40), (200, 60))


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a run that has a log and a trace, and a corrupt one without either."""
    monkeypatch.setenv("BRAMAH_STATE", str(tmp_path / "state"))
    folder = tmp_path / "runs"
    create_run(folder / "monday", RIG, protocol=None, operator=None)
    (folder / "monday" / "events.jsonl").write_bytes(log_bytes())
    (folder / "monday" / "trace.json").write_text(json.dumps(trace_json()))
    (folder / "broken").mkdir()
    (folder / "broken" / "run.yaml").write_text("format: [1")
    return folder


async def opened(office: Office, shown: Glass, run: str, words: str) -> None:
    """Open what can be done with a run, choose it, and wait until it is read."""
    await office.opened(shown, tab=1 - office.app.browsed.tab)
    await shown.press("home")
    for _ in range([one.path.name for one in office.app.browsed.runs].index(run)):
        await shown.press("down")
    await office.choose(shown, words)
    while any(one is not None and one.reading
              for one in (office.app.browsed.log, office.app.browsed.trace)):  # fmt: skip
        await shown.pilot.pause(0.005)
    await shown.watch()


@pytest.mark.parametrize("size", SIZES)
async def test_the_log_of_a_run_that_is_over_is_read_searched_and_filtered(
    runs: Path, size: tuple[int, int]
) -> None:
    office = Office(runs)
    async with office.app.run_test(size=size) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await opened(office, shown, "monday", "read its log")
        assert "7 of 7" in shown.text
        assert "8.00 s  TRIP limit 'pressure', cap_pressure_2" in shown.text
        assert "in command: process 77 on bench-pc" in shown.text
        assert "record begins record step1_r1" in shown.text
        await shown.press("/")
        for letter in "supply":
            await shown.press(letter)
        await shown.press("enter")
        assert "1 of 7" in shown.text
        assert "TRIP" not in shown.text
        await shown.press("/")
        await shown.press("enter")
        await shown.press("f")
        assert "alarms  2 of 7" in shown.text
        await shown.press("0")
        assert "▸ monday" in shown.text.replace("▸  ", "▸ "), "the run is still marked"


async def test_what_a_run_without_a_log_lacks_is_a_sentence(runs: Path) -> None:
    office = Office(runs)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await opened(office, shown, "broken", "read its log")
        assert "events.jsonl: there is no such file" in shown.sentences
        assert "Traceback" not in shown.text


def test_a_log_cut_off_by_a_kill_is_read_up_to_there(tmp_path: Path) -> None:
    (tmp_path / "events.jsonl").write_bytes(log_bytes()[:-20])
    found = read_log(tmp_path)
    assert len(found.lines) == 6
    assert "the last line was cut off" in found.trouble
    (tmp_path / "events.jsonl").write_bytes(log_bytes().replace(b'"trip"', b'"trip', 1))
    found = read_log(tmp_path)
    assert len(found.lines) == 6
    assert "1 of 7 lines cannot be read, the first is line 6" in found.trouble


def test_a_damaged_log_cannot_command_the_terminal(tmp_path: Path) -> None:
    entry = {"event": "mark", "t": 1.0, "text": "x\x1b]0;owned\x07\x1b[2Jy\nz"}
    (tmp_path / "events.jsonl").write_text(json.dumps(entry) + "\n")
    (line,) = read_log(tmp_path).lines
    assert "\x1b" not in line.text
    assert line.text.isprintable()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10_000), byte=st.integers(0, 255), cut=st.integers(0, 10_000))
def test_whatever_is_damaged_in_log_and_trace_is_said_in_one_line(
    tmp_path: Path, at: int, byte: int, cut: int
) -> None:
    for name, whole in (("events.jsonl", log_bytes()), ("trace.json", trace_bytes())):
        damaged = bytearray(whole)
        damaged[at % len(damaged)] = byte
        (tmp_path / name).write_bytes(bytes(damaged[: cut % len(damaged)]))
    for trouble in (read_log(tmp_path).trouble, read_trace(tmp_path).trouble):
        assert "\n" not in trouble
    assert all(line.text.isprintable() for line in read_log(tmp_path).lines)


def trace_bytes() -> bytes:
    """Return a small stored trace: without curves, for a damage to strike something else too."""
    return json.dumps(trace_json() | {"free_run": None}).encode()


@pytest.mark.parametrize("size", SIZES)
async def test_a_trace_shows_verdict_effects_errors_and_a_free_run_before_and_after(
    runs: Path, size: tuple[int, int]
) -> None:
    office = Office(runs)
    async with office.app.run_test(size=size) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await opened(office, shown, "monday", "before and after of its trace")
        assert "● EXPLAINED" in shown.text
        assert "▸ internal leakage at joint 2" in shown.text
        assert "2.030e-12 ± 0.040e-12 m³/(s·Pa)" in shown.text
        assert "not named: valve deadband at joint 1:" in shown.text
        assert "8.3× → 1.1×" in shown.text
        for _ in range(size[1]):  # to its end
            await shown.press("down")
        assert "piston_2  free run minus measured, step1_r1 [mm]" in shown.text
        assert "before  rms" in shown.text
        assert "after  rms 0.141 mm" in shown.text
        await shown.press("right")
        assert "cap_pressure_2  free run minus measured" in shown.text
        assert "SPACE STOP" in shown.lines[-1]


async def test_a_trace_that_is_not_there_or_damaged_is_a_sentence(runs: Path) -> None:
    office = Office(runs)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await opened(office, shown, "broken", "before and after of its trace")
        assert "trace.json: there is no such file" in shown.sentences
        assert "`trace what its model lacks`" in shown.sentences
        (runs / "monday" / "trace.json").write_text('{"verdict": "clean"}')
        await opened(office, shown, "monday", "before and after of its trace")
        assert "error: Field required" in shown.sentences
        assert "Traceback" not in shown.text


def test_an_effect_of_a_sensor_is_shown_with_it() -> None:
    assert StoredEffect(name="sensor_lag", where="joint 1", at="joint 1 spool").location == (
        "joint 1, spool"
    )
    assert StoredEffect(name="sensor_lag", where="joint 1 cap").location == "joint 1, cap"


def test_a_model_that_a_trace_left_as_it_was_has_one_column(tmp_path: Path) -> None:
    data = trace_json() | {"verdict": "clean", "effects": []}
    data["error"]["after"] = data["error"]["before"]
    data["fit"]["after"] = data["fit"]["before"]
    folder = run_folder(tmp_path / "run")
    (folder / "trace.json").write_text(json.dumps(data))
    browsed = BrowserState(trace=read_trace(folder))
    rows = run_trace_page(PlotView(Frame(), Frame(), 0.0, browsed=browsed), 120, 40)
    text = "\n".join("".join(part[0] for part in line) for line in rows)
    assert "before" not in text
    assert "after" not in text
    assert "1.1×" in text
    assert "→" not in text


def test_a_trace_without_curves_and_with_gaps_is_drawn(tmp_path: Path) -> None:

    data = trace_json()
    data["free_run"]["channels"]["piston_2"]["after"] = [None] * 400
    folder = run_folder(tmp_path / "run")
    for stored in (data, data | {"free_run": None, "effects": []}):
        (folder / "trace.json").write_text(json.dumps(stored))
        browsed = BrowserState(trace=read_trace(folder))
        view = PlotView(Frame(), Frame(), 0.0, browsed=browsed)
        for width, height in (*SIZES, (60, 10)):
            assert len(run_trace_page(view, width, height)) == height


async def test_a_trace_is_started_with_its_result_stored_beside_the_report(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(starts, "begin", lambda words, changed: asked.append(words))
    office = Office(runs)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await office.opened(shown, tab=1)
        (first,) = [one for one in office.app.browsed.runs if one.path.name == "monday"]
        other = replace(first, path=runs / "tuesday", records=4)
        listed = (first, other)
        office.app.browsed = replace(office.app.browsed, runs=listed)
        office.app.look = replace(office.app.look, marked=0)
        await office.choose(shown, "trace what its model lacks")
        assert office.app.dialog is not None
        assert office.app.dialog.choices == ("tuesday",)
        await shown.press("enter")
    monday = runs / "monday"
    assert asked == [
        ("trace", str(monday), "--holdout", str(runs / "tuesday"),
         "--report", str(monday / "trace.html"), "--json", str(monday / "trace.json")),
    ]  # fmt: skip


async def test_a_report_is_opened_where_there_is_a_display_and_named_where_not(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (runs / "monday" / "trace.html").write_text("<p>")
    opened_pages: list[str] = []
    monkeypatch.setattr(starts.webbrowser, "open", lambda page: not opened_pages.append(page))
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    office = Office(runs)
    async with office.app.run_test(size=(160, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await opened(office, shown, "monday", "open its report")
        assert f"no display here; the page is {runs / 'monday' / 'trace.html'}"[:60] in shown.text
        assert not opened_pages
        (runs / "monday" / "trace.html").rename(runs / "trace.html")  # beside a set of runs
        await office.choose(shown, "open its report")
        assert f"the page is {runs / 'trace.html'}"[:60] in shown.text
        monkeypatch.setenv("DISPLAY", ":0")
        await office.choose(shown, "open its report")
        assert opened_pages == [(runs / "trace.html").as_uri()]
