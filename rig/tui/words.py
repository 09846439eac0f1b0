"""Texts of the screen: the state of the bench, notices, values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

from rig.bench.outputs import UNSURE
from rig.bench.screens.display import LOST
from rig.bench.screens.sockets import ChannelView, Endpoint, Snapshot
from rig.model import channels as ch
from rig.model.alarms.states import AlarmState, AlarmTable, folded
from rig.tui.drawing.rows import Row
from rig.tui.drawing.styles import ALARM, ALARM_TEXT, DIM, STALE, STRONG, SYMBOLS, WARN_TEXT
from rig.tui.following.event_lines import trip_text
from rig.tui.following.link import ENDED_STATES, QUIET, Frame, LinkStage
from rig.tui.units import Band, age_text, band, clock_text, limit, shown

VERY_OLD: Final = 3.0  # from here on old data is red instead of yellow [s]
CONFIRM: Final = 2.0  # a stop not confirmed within this time is reported [s]
LINGER: Final = 10.0  # display time of the result of a stop of another run [s]
RECENT: Final = 1.0  # the nearest margin is that of the last second [s of device time]
EMERGENCY: Final = "Use the emergency stop of the bench."


class Freshness(Enum):
    """Freshness of the numbers on the screen; each has its own look and word."""

    LIVE = "live"
    HELD = "held"  # the operator has paused the display
    STALE = "stale"  # nothing new for longer than QUIET
    DISCONNECTED = "disconnected"  # the device or the run's process has ended
    ENDED = "ended"  # the run is over; this is its last picture


@dataclass(frozen=True)
class Headline:
    """The state of the bench in a word; `level` is normal, ended, ask, warn or alarm."""

    word: str
    level: str

    @property
    def symbol(self) -> str:
        """The level as a shape."""
        return SYMBOLS[self.level]


class StopAnswer(Enum):
    """What became of a stop that the operator sent."""

    SENDING = 0
    TAKEN = 1
    NONE = 2
    NOWHERE = 3  # there was no session to send it to
    DEVICE = 4  # the session did not answer: the device itself is asked
    ZEROED = 5  # the device itself confirmed
    FAILED = 6  # the device did not confirm either


@dataclass(frozen=True)
class Stop:
    """A stop requested by the operator: time (monotonic [s]), run, answer, why it failed."""

    at: float
    endpoint: Endpoint | None
    answer: StopAnswer = StopAnswer.SENDING
    reason: str = ""


@dataclass(frozen=True)
class Notice:
    """One line above the page; `level` is normal, ask, warn or alarm."""

    level: str
    text: str


@dataclass(frozen=True)
class Margin:
    """Distance of a channel from a limit, as a share of the width of its band, and in SI."""

    channel: str
    share: float
    distance: float
    value: float
    limit: float
    unit: str


def freshness(frame: Frame, now: float, *, held: bool = False) -> Freshness:
    """Return the freshness of a frame's numbers."""
    snapshot = frame.snapshot
    if snapshot is not None and (snapshot.device == LOST or _run_gone(frame, snapshot)):
        return Freshness.DISCONNECTED
    if frame.over:
        return Freshness.ENDED
    if snapshot is None or frame.age(now) > QUIET:
        return Freshness.STALE
    return Freshness.HELD if held else Freshness.LIVE


def _run_gone(frame: Frame, snapshot: Snapshot) -> bool:
    return frame.stage is LinkStage.ENDED and snapshot.state not in ENDED_STATES


def headline(frame: Frame, now: float) -> Headline:
    """Return the state of the bench in a word, the worst that applies."""
    snapshot = frame.snapshot
    if snapshot is None:
        return Headline("NO RUN" if frame.endpoint is None else "NO DATA", "ended")
    state = snapshot.state
    cases = (
        (UNSURE in snapshot.message, Headline("OUTPUTS NOT CONFIRMED", "alarm")),
        (snapshot.device == LOST, Headline("DEVICE LOST", "alarm")),
        (state == "tripped" or snapshot.trip is not None, Headline("TRIPPED", "alarm")),
        (_run_gone(frame, snapshot), Headline("RUN GONE", "alarm")),
        (state == "done", Headline("RUN ENDED", "ended")),
        (frame.over, Headline("STOPPED" if _zeroed(snapshot) else state.upper(), "warn")),
        (frame.age(now) > VERY_OLD, Headline("NO DATA", "alarm")),
        (frame.age(now) > QUIET, Headline("NO DATA", "warn")),
        (snapshot.engine in ("prompting", "paused"), Headline(snapshot.engine.upper(), "ask")),
    )
    word = snapshot.engine or state
    return next((head for applies, head in cases if applies), Headline(word.upper(), "normal"))


def nearest_margin(frame: Frame) -> Margin | None:
    """Return the channel closest to a limit in the last second, by share of its band.

    The piston of a joint that moves freely may touch its ends and does not count.
    """
    snapshot = frame.snapshot
    if snapshot is None:
        return None
    best: Margin | None = None
    for name, view in snapshot.channels.items():
        low, high = limit(view.low), limit(view.high)
        kind, joint = place_of(name)
        free = joint is not None and role_of(snapshot, joint) == "free"
        if low is None or high is None or not high > low or (kind == ch.PISTON and free):
            continue
        extremes = frame.window.span(name, frame.device_time - RECENT) or (view.last, view.last)
        if math.isnan(extremes[0]):
            continue
        below, above = extremes[0] - low, high - extremes[1]
        value, edge = (extremes[0], low) if below < above else (extremes[1], high)
        margin = Margin(name, min(below, above) / (high - low), min(below, above), value, edge,
                        view.unit)  # fmt: skip
        if best is None or margin.share < best.share:
            best = margin
    return best


def place_of(name: str) -> tuple[str, int | None]:
    """Return (kind, joint or None) of a channel; an unknown kind is its own name."""
    try:
        return ch.kind_of(name)
    except ValueError:
        return name, None


def role_of(snapshot: Snapshot, joint: int) -> str:
    """Return what the run does with a joint; '' if it does not say."""
    return snapshot.roles[joint - 1] if joint <= len(snapshot.roles) else ""


def run_time(frame: Frame, device_time: float | None = None) -> float:
    """Return the time [s] since the run began, of a device time (default: the newest)."""
    snapshot = frame.snapshot
    if snapshot is None:
        return 0.0
    start = snapshot.device_time - snapshot.done_s
    return (snapshot.device_time if device_time is None else device_time) - start


def time_left(snapshot: Snapshot) -> str:
    """Return the expected time to the run's end, as a clock shows it."""
    return clock_text(max(snapshot.total_s - snapshot.done_s, 0.0))


def notices(frame: Frame, stop: Stop | None, now: float, *, paused: bool) -> list[Notice]:
    """Return the notices, the worst first."""
    listed: list[Notice] = []
    snapshot = frame.snapshot
    if snapshot is not None and UNSURE in snapshot.message:
        listed.append(Notice("alarm", f"{UNSURE.upper()}: keep away from the machine. {EMERGENCY}"))
    if snapshot is not None and snapshot.device == LOST:
        result = (
            snapshot.message
            if frame.over
            else "looking for it; only its own watchdog, if set, zeroes it"
        )
        listed.append(Notice("alarm", f"DEVICE LOST: {result}"))
    if snapshot is not None and snapshot.trip is not None:
        listed.append(Notice("alarm", f"TRIPPED  {trip_text(snapshot.trip)}"))
    if frame.trouble:
        listed.append(Notice("alarm", f"CANNOT REACH RUNS: {frame.trouble}"))
    if stop is not None and (stop.endpoint == frame.endpoint or now - stop.at < LINGER):
        listed.append(stop_notice(frame, stop, now))
    if frame.over:
        listed.append(_ended(frame))
        listed += _not_shown(frame)
    elif frame.stage is LinkStage.ATTACHED and (age := frame.age(now)) > QUIET:
        level = "alarm" if age > VERY_OLD else "warn"
        what = "what is shown is old" if snapshot else "nothing received yet"
        listed.append(Notice(level, f"NO DATA for {age_text(age)}: {what}"))
    if snapshot is not None and not frame.over and snapshot.prompt:
        listed.append(Notice("ask", f"ANSWER: {snapshot.prompt}  (a answers)"))
    elif snapshot is not None and not frame.over and snapshot.engine == "paused":
        listed.append(Notice("ask", "PAUSED: outputs at zero until someone resumes (p)"))
    if snapshot is not None and not frame.over:
        listed += alarm_notices(snapshot)
    if paused:
        listed.append(Notice("warn", "DISPLAY HELD, the run goes on: h shows it live again"))
    return listed


def alarm_notices(snapshot: Snapshot) -> list[Notice]:
    """Return one line on the present warnings: the most urgent, and their number."""
    groups = folded(AlarmTable(tuple(a for a in snapshot.alarms if not a.trips)))
    if not groups:
        return []
    first, rest = groups[0]
    others_count = sum(1 + len(others) for _, others in groups[1:]) + len(rest)
    tail = f" (and {others_count} more)" if others_count else ""
    back = ", back within its band" if first.state is AlarmState.RETURNED else ""
    return [Notice("warn", f"WARNING  {first.sentence}{back}{tail}")]


def stop_notice(frame: Frame, stop: Stop, now: float) -> Notice:
    """Return the result of the operator's stop, which the run or its device confirms."""
    if stop.answer is StopAnswer.NONE:
        if frame.snapshot is not None and frame.snapshot.state in ENDED_STATES:
            return Notice("warn", f"STOP: no answer, the run had ended ({frame.snapshot.state})")
        return Notice("alarm", f"STOP: NO ANSWER from the run. {EMERGENCY}")
    without_run = {
        StopAnswer.NOWHERE: ("alarm", "STOP: NOTHING SENT, no run is attached to this screen."),
        StopAnswer.DEVICE: (
            "alarm",
            f"STOP: NO ANSWER from the run. {EMERGENCY} Asking its device ...",
        ),
        StopAnswer.ZEROED: ("normal", "STOP SENT, OUTPUTS ZEROED: the device confirmed it"),
        StopAnswer.FAILED: (
            "alarm",
            f"STOP: NO ANSWER from the run. {EMERGENCY} Its device: {stop.reason}",
        ),
    }
    if stop.answer in without_run:
        return Notice(*without_run[stop.answer])
    if stop.endpoint is not None and stop.endpoint != frame.endpoint:
        session = f"{stop.endpoint.rig} (process {stop.endpoint.pid})"
        result = "sending ..." if stop.answer is StopAnswer.SENDING else "taken"
        return Notice("warn", f"STOP to {session}, which is not the run shown: {result}")
    return _stop_of_shown_run(frame, stop, now)


def _stop_of_shown_run(frame: Frame, stop: Stop, now: float) -> Notice:
    if frame.snapshot is not None and _zeroed(frame.snapshot):
        return Notice("normal", "STOP SENT, OUTPUTS ZEROED: the run confirmed it")
    if stop.answer is StopAnswer.SENDING:
        return Notice("warn", "STOP: sending ...")
    if frame.over:
        message = frame.snapshot.message if frame.snapshot is not None else ""
        reason = f" ({message})" if message else ""
        return Notice("alarm", f"STOP TAKEN, NOT CONFIRMED: the run ended{reason}. {EMERGENCY}")
    late = now - stop.at
    if late > CONFIRM:
        return Notice("alarm", f"STOP TAKEN, NOT CONFIRMED for {age_text(late)}. {EMERGENCY}")
    return Notice("warn", "STOP sent and taken; waiting for the run to confirm it ...")


def _zeroed(snapshot: Snapshot) -> bool:
    """Return whether the run reports that it stopped, which it does after zeroing its outputs.

    A run aborted for another reason, such as a lost device, may not have zeroed them.
    """
    text = snapshot.message.lower()
    stopped = snapshot.state == "aborted" and "stopped" in text
    return (stopped or snapshot.state == "tripped") and UNSURE not in text


def _ended(frame: Frame) -> Notice:
    snapshot = frame.snapshot
    tail = "below is its last picture; waiting for the next run"
    if snapshot is None:
        return Notice("warn", "RUN GONE before it sent anything; waiting for the next run")
    if not frame.over or snapshot.state not in ENDED_STATES:
        pid = snapshot.pid
        return Notice("alarm", f"RUN GONE (process {pid} ended without a word): {tail}")
    level = "ended" if snapshot.state == "done" else "warn"
    return Notice(level, f"RUN ENDED, {snapshot.state}: {tail}")


def _not_shown(frame: Frame) -> list[Notice]:
    """Return a line on a run of another bench, which only the operator makes the screen show."""
    others = [session for session in frame.sessions if session != frame.endpoint]
    if not others:
        return []
    first = others[0]
    more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
    text = (
        f"NOT SHOWN: a run on {first.rig} (process {first.pid}){more}; "
        f"c or bramah monitor --rig {first.rig} shows it"
    )
    return [Notice("warn", text)]


BANDS: Final = {Band.INSIDE: STRONG, Band.NEAR: WARN_TEXT, Band.BEYOND: ALARM}
NEARNESS: Final = {Band.INSIDE: "", Band.NEAR: "▲", Band.BEYOND: "■"}


def band_of(view: ChannelView) -> Band:
    """Return the position of a channel's newest value: within, in a warning band, or beyond."""
    where = band(view.last, limit(view.low), limit(view.high))
    near = band(view.last, limit(view.warn_low), limit(view.warn_high), margin=0.0)
    return Band.NEAR if where is Band.INSIDE and near is Band.BEYOND else where


def value(view: ChannelView, fresh: Freshness, *, sign: bool = False) -> Row:
    """Return a channel's newest value with its unit; its form says whether it is valid.

    ▲ close to a limit, ■ beyond it, ✕ not a number, ◌ stale, ⊘ disconnected, ‖ held.
    """
    form = shown(view.unit)
    unit = (f" {form.unit}", DIM)
    if fresh is Freshness.DISCONNECTED:
        return (("⊘", ALARM_TEXT), (form.number(view.last, sign=sign), STALE), unit)
    if math.isnan(view.last):
        return (("✕ invalid", ALARM_TEXT),)
    number = form.number(view.last, sign=sign)
    if fresh is Freshness.STALE:
        return (("◌", WARN_TEXT), (number, STALE), unit)
    if fresh is not Freshness.LIVE:
        return (("‖" if fresh is Freshness.HELD else "", DIM), (number, DIM), unit)
    where = band_of(view)
    return ((NEARNESS[where], BANDS[where]), (number, BANDS[where]), unit)
