"""What the screen says, word by word."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench.screens.sockets import ChannelView
from rig.model.alarms.states import Alarm, AlarmTable, raised, returned
from rig.tui.app import farewell
from rig.tui.drawing.rows import Row, block, box, row, width_of, window
from rig.tui.following.event_lines import new_lines
from rig.tui.following.history import History
from rig.tui.following.link import Frame, LinkStage
from rig.tui.pages.parts import bar, gauge
from rig.tui.units import Band, age_text, band, clock_text, limit, shown
from rig.tui.words import (
    Freshness,
    Headline,
    Stop,
    StopAnswer,
    headline,
    nearest_margin,
    notices,
)
from tests.tui.glass import endpoint
from tests.tui.recorded import Bench, snapshot, stopped, tripped

HERE = endpoint()
VIEW = snapshot(Bench(), 80)
LIVE = Frame(LinkStage.ATTACHED, (HERE,), HERE, VIEW, received=100.0)


def text_of(line: Row) -> str:
    return "".join(text for text, _ in line)


def said(frame: Frame, stop: Stop | None = None, now: float = 100.0) -> list[tuple[str, str]]:
    return [(n.level, n.text) for n in notices(frame, stop, now, paused=False)]


def test_a_healthy_run_needs_no_notice() -> None:
    assert said(LIVE) == []


@pytest.mark.parametrize(
    ("changes", "word", "level"),
    [
        ({}, "EXCITING", "normal"),
        ({"engine": ""}, "RUNNING", "normal"),
        ({"engine": "prompting"}, "PROMPTING", "ask"),
        ({"engine": "paused"}, "PAUSED", "ask"),
        ({"state": "done"}, "RUN ENDED", "ended"),
        ({"state": "aborted", "message": "stopped by operator"}, "STOPPED", "warn"),
        ({"state": "aborted", "message": "step1 failed"}, "ABORTED", "warn"),
        ({"state": "tripped", "trip": "safety trip: x"}, "TRIPPED", "alarm"),
        ({"state": "aborted", "device": "lost", "message": "no answer"}, "DEVICE LOST", "alarm"),
        (
            {"state": "tripped", "trip": "x", "message": "outputs not confirmed at zero"},
            "OUTPUTS NOT CONFIRMED",
            "alarm",
        ),
    ],
)
def test_the_state_is_one_word_and_the_worst_that_is_true(
    changes: dict[str, str], word: str, level: str
) -> None:
    view = replace(VIEW, **{"engine": "exciting", **changes})
    found = headline(replace(LIVE, snapshot=view), 100.0)
    assert (found.word, found.level) == (word, level)


def test_old_data_and_a_dead_process_change_the_word() -> None:
    assert headline(LIVE, 100.6) == Headline("NO DATA", "warn")
    assert headline(LIVE, 104.0) == Headline("NO DATA", "alarm")
    assert headline(replace(LIVE, stage=LinkStage.ENDED), 100.0) == Headline("RUN GONE", "alarm")


def test_the_nearest_margin_counts_peaks_and_not_what_may_touch_its_end() -> None:
    history = History()
    for k in range(1, 81):
        history.add(snapshot(Bench(), k))
    frame = replace(LIVE, window=history.window(10.0))
    locked = replace(VIEW, roles=["free", "excited"])
    margin = nearest_margin(replace(frame, snapshot=locked))
    assert margin is not None
    assert margin.channel == "piston_2", "joint 1 rests at its end and may"
    low, high = -0.036, 0.036
    peak = 0.022
    assert margin.share == pytest.approx((high - peak) / (high - low), rel=0.02)
    assert nearest_margin(Frame()) is None


def test_warnings_that_stand_are_one_line_with_the_first_cause() -> None:
    supply = Alarm(
        "supply pressure", "supply_pressure", None, 5e6, (5.6e6, 8e6), "Pa", 100, 0.1,
        "The supply pressure is outside its band.", "Check the pump.",
    )  # fmt: skip
    still = replace(supply, check="nothing moves", joint=1, sentence="Nothing moves.", time=0.2)
    table = raised(raised(AlarmTable(), supply), still)
    frame = replace(LIVE, snapshot=replace(VIEW, alarms=table.alarms))
    line = "WARNING  The supply pressure is outside its band. (and 1 more)"
    assert said(frame) == [("warn", line)]
    back = returned(table, supply.key)
    frame = replace(LIVE, snapshot=replace(VIEW, alarms=back.alarms[:1]))
    assert "back within its band" in said(frame)[0][1]
    assert said(replace(LIVE, snapshot=replace(VIEW, alarms=()))) == []


def test_old_data_turns_from_a_warning_into_an_alarm() -> None:
    assert said(LIVE, now=102.0)[0][0] == "warn"
    assert said(LIVE, now=110.0)[0][0] == "alarm"


def test_the_age_includes_how_late_the_block_already_was() -> None:
    late = replace(LIVE, snapshot=replace(VIEW, block_age=1.2))
    assert said(late)[0] == ("warn", "NO DATA for 1.2 s: what is shown is old")


@pytest.mark.parametrize(
    ("answer", "state", "later", "level", "words"),
    [
        (StopAnswer.SENDING, "running", 0.1, "warn", "sending"),
        (StopAnswer.TAKEN, "running", 0.1, "warn", "waiting for the run to confirm"),
        (StopAnswer.TAKEN, "running", 2.5, "alarm", "NOT CONFIRMED for 2.5 s"),
        (StopAnswer.TAKEN, "tripped", 0.1, "normal", "OUTPUTS ZEROED"),
        (StopAnswer.TAKEN, "done", 0.1, "alarm", "NOT CONFIRMED: the run ended"),
        (StopAnswer.NONE, "running", 0.1, "alarm", "NO ANSWER"),
        (StopAnswer.NONE, "done", 0.1, "warn", "the run had ended (done)"),
        (StopAnswer.NOWHERE, "running", 0.1, "alarm", "NOTHING SENT"),
        (StopAnswer.DEVICE, "done", 0.1, "alarm", "Asking its device"),
        (StopAnswer.ZEROED, "done", 0.1, "normal", "OUTPUTS ZEROED: the device confirmed"),
        (StopAnswer.FAILED, "done", 0.1, "alarm", "NO ANSWER"),
    ],
)
def test_a_stop_is_called_what_it_is(
    answer: StopAnswer, state: str, later: float, level: str, words: str
) -> None:
    frame = replace(LIVE, snapshot=replace(VIEW, state=state), received=100.0 + later)
    notice = next(
        n for n in said(frame, Stop(100.0, HERE, answer), 100.0 + later) if "STOP" in n[1]
    )
    assert notice[0] == level
    assert words in notice[1]


@pytest.mark.parametrize(
    ("message", "level"),
    [
        ("stopped by operator (from the screen)", "normal"),
        ("the device does not answer", "alarm"),
        ("stopped by operator; outputs not confirmed at zero", "alarm"),
    ],
)
def test_only_a_run_that_says_it_stopped_confirms_a_stop(message: str, level: str) -> None:
    frame = replace(LIVE, snapshot=replace(VIEW, state="aborted", message=message))
    notice = next(n for n in said(frame, Stop(100.0, HERE, StopAnswer.TAKEN)) if "STOP" in n[1])
    assert notice[0] == level


@pytest.mark.parametrize("state", ["aborted", "tripped", "done"])
def test_outputs_that_may_not_be_zero_stand_above_all_else(state: str) -> None:
    message = "the device does not answer; outputs not confirmed at zero"
    frame = replace(LIVE, snapshot=replace(tripped(VIEW), state=state, message=message))
    level, text = said(frame, Stop(100.0, HERE, StopAnswer.TAKEN))[0]
    assert level == "alarm"
    assert text.startswith("OUTPUTS NOT CONFIRMED AT ZERO: ")
    assert "emergency stop" in text


def test_a_stop_of_another_run_is_never_confirmed_by_the_one_shown() -> None:
    elsewhere = Stop(100.0, endpoint("press", 7), StopAnswer.TAKEN)
    frame = replace(LIVE, snapshot=stopped(VIEW))
    texts = [text for _, text in said(frame, elsewhere)]
    assert any("press (process 7), which is not the run shown: taken" in text for text in texts)
    assert not any("ZEROED" in text for text in texts)
    assert not any("STOP" in text for _, text in said(frame, elsewhere, 200.0))


def test_trouble_in_looking_for_runs_is_shown() -> None:
    assert said(Frame(trouble="/tmp/x: belongs to user 0"))[0][0] == "alarm"


def test_the_log_tells_each_turn_once() -> None:
    first = [line.text for line in new_lines(None, VIEW)]
    assert first[0].startswith("attached to run")
    assert first[1] == "step1 excite  joint 1 locked at its retracted end"
    assert new_lines(VIEW, snapshot(Bench(), 81)) == []
    after = replace(VIEW, step="step2", repeat=2, message="on to joint 1", lost_samples=3)
    texts = [line.text for line in new_lines(VIEW, after)]
    assert texts == ["step2 excite  on to joint 1", "3 samples lost (3 in all)"]
    last = tripped(VIEW)
    trip = [line.text for line in new_lines(VIEW, replace(last, message=str(last.trip)))]
    assert len([text for text in trip if "limit 'pressure'" in text]) == 1
    assert "state: running → tripped" in trip


def test_the_last_words_on_the_terminal() -> None:
    assert "no run was attached" in farewell(Frame())
    assert "GOES ON" in farewell(LIVE)
    assert "had ended (aborted)" in farewell(replace(LIVE, snapshot=stopped(VIEW)))
    by_hand = replace(LIVE, snapshot=replace(VIEW, run="", kind="manual"))
    assert "closed; the manual session GOES ON" in farewell(by_hand)


def test_numbers_wear_the_operators_units() -> None:
    assert shown("Pa").number(9.314e6) == "9.31"
    assert shown("m").number(-0.01234, sign=True) == "−12.3"
    assert shown("m").number(-1e-6, sign=True) == "+0.0"
    assert shown("Pa").number(float("nan")) == "–"
    assert shown("Pa").short(-0.2e6) == "−0.2"
    assert shown("N·m").unit == "N·m"


def test_times_are_short() -> None:
    assert [clock_text(t) for t in (5, 83, 3723, float("nan"))] == ["0:05", "1:23", "1:02:03", "–"]
    assert [age_text(t) for t in (0.051, 3.24, 75, 7200)] == ["0.05 s", "3.2 s", "75 s", "120 min"]


def test_a_value_is_near_a_limit_before_it_is_beyond_it() -> None:
    assert [band(v, -0.2e6, 9e6) for v in (5e6, 8.9e6, 9.1e6, -0.1e6, -0.3e6)] == [
        Band.INSIDE,
        Band.NEAR,
        Band.BEYOND,
        Band.NEAR,
        Band.BEYOND,
    ]
    assert band(1e12, None, None) is Band.INSIDE
    assert limit(1.7e308) is None
    assert limit(float("inf")) is None
    assert limit(0.036) == 0.036


def test_a_bar_shows_limits_travel_and_value() -> None:
    assert bar(0.0, (-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0), 21) == "─├───━━━━━●━━━━━───┤─"
    assert bar(9.0, (-1.0, 1.0), None, (-1.0, 1.0), 11)[-1] == "▶"
    assert bar(-9.0, (-1.0, 1.0), None, (-1.0, 1.0), 11)[0] == "◀"
    assert "●" not in bar(float("nan"), (-1.0, 1.0), None, (-1.0, 1.0), 11)


@given(
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 0).map(float),
    st.floats(1e-3, 1e3),
    st.integers(0, 200),
)
def test_a_bar_is_as_wide_as_asked_and_the_marker_keeps_its_side(
    at: float, low: float, above: float, width: int
) -> None:
    high = low + above
    drawn = bar(at, (low, high), None, (low, high), width)
    assert len(drawn) == width
    if width >= 40 and low < at < high:
        marker, left, right = (drawn.find(c) for c in "●├┤")
        assert left == -1 or left <= marker
        assert right == -1 or marker <= right


@pytest.mark.parametrize("width", [36, 40, 76])
def test_a_gauge_fills_its_line(width: int) -> None:
    view = ChannelView("m", -0.0375, 0.0375, 0.01, [], [])
    line = gauge("piston", view, (0.0, 0.02), (-0.0375, 0.0375), width, Freshness.LIVE)
    assert width_of(line) == width
    assert "+10.0 mm −37.5 " in text_of(line)
    assert text_of(line).endswith(" 37.5")


def test_what_does_not_fit_is_counted_or_ends_in_an_ellipsis() -> None:
    lines = [row(f"line {k}") for k in range(9)]
    assert text_of(block(lines, 20, 4)[-1]).strip() == "↓ 6 more lines"
    assert list(map(text_of, window(lines, 4, 5))) == [
        " ↑ 3 more lines", "line 3", "line 4", "line 5", " ↓ 3 more lines",
    ]  # fmt: skip
    assert text_of(window(lines, 0, 5)[0]) == "line 0"
    assert "bramah check…" in text_of(box("bramah check evening.yaml", lines, 18, 4)[0])
    assert shown("V").short(-250.881, 6) == "−250.9"
