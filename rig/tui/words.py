"""What the screen says in words: header lines, the notices above the bench, gauges."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

from rich.text import Text

from rig.bench.outputs import UNSURE
from rig.bench.screens.sockets import ChannelView, Endpoint, Snapshot
from rig.model import channels as ch
from rig.model.alarms.states import AlarmState, AlarmTable, folded
from rig.tui.link import ENDED_STATES, QUIET, Frame, LinkStage
from rig.tui.story import trip_text
from rig.tui.units import Band, age_text, band, clock_text, limit, shown

VERY_OLD: Final = 3.0  # from here on old data is red instead of yellow [s]
CONFIRM: Final = 2.0  # a stop is confirmed within this time, or the screen says that it was not [s]

STATES: Final = {
    "running": "bold black on green",
    "done": "bold white on blue",
    "aborted": "bold black on yellow",
    "interrupted": "bold black on yellow",
    "tripped": "bold white on red",
}
BANDS: Final = {
    Band.INSIDE: "bold",
    Band.NEAR: "bold yellow",
    Band.BEYOND: "bold white on red",
}
OLD: Final = "grey50"


LINGER: Final = 10.0  # what became of a stop of another run than the one shown stays this long [s]
EMERGENCY: Final = "Use the emergency stop of the bench."


class KeyAnswer(Enum):
    """What became of a stop."""

    SENDING = 0
    TAKEN = 1
    NONE = 2
    NOWHERE = 3  # nothing was attached that it could have gone to


@dataclass(frozen=True)
class Stop:
    """A stop the operator asked for: when (monotonic [s]), of which run, what came back."""

    at: float
    endpoint: Endpoint | None
    answer: KeyAnswer = KeyAnswer.SENDING


@dataclass(frozen=True)
class Notice:
    """One line above the bench; `level` is good, info, warn or alarm."""

    level: str
    text: str


def is_live(frame: Frame, now: float) -> bool:
    """Whether the numbers are fresh enough to be shown as what is so now."""
    return frame.snapshot is not None and not frame.over and frame.age(now) <= QUIET


def notices(frame: Frame, stop: Stop | None, now: float, *, paused: bool) -> list[Notice]:
    """Return what the operator must not miss, the worst first."""
    found: list[Notice] = []
    if frame.trouble:
        found.append(Notice("alarm", f"CANNOT REACH RUNS: {frame.trouble}"))
    snapshot = frame.snapshot
    if snapshot is not None and UNSURE in snapshot.message:
        found.append(Notice("alarm", f"{UNSURE.upper()}: keep away from the machine. {EMERGENCY}"))
    if snapshot is not None and snapshot.trip is not None:
        found.append(Notice("alarm", f"TRIP  {trip_text(snapshot.trip)}"))
    if snapshot is not None and not frame.over:
        found += alarm_notices(snapshot)
    if stop is not None and (stop.endpoint == frame.endpoint or now - stop.at < LINGER):
        found.append(stop_notice(frame, stop, now))
    if frame.over:
        found.append(_ended(frame))
    elif frame.stage is LinkStage.ATTACHED and (age := frame.age(now)) > QUIET:
        level = "alarm" if age > VERY_OLD else "warn"
        what = "what is shown is old" if snapshot else "nothing received yet"
        found.append(Notice(level, f"NO DATA for {age_text(age)}: {what}"))
    if paused:
        found.append(Notice("warn", "DISPLAY PAUSED, the run goes on: p shows it live again"))
    return found


def alarm_notices(snapshot: Snapshot) -> list[Notice]:
    """Return one line on the warnings that stand: the most urgent, and how many there are."""
    groups = folded(AlarmTable(tuple(a for a in snapshot.alarms if not a.trips)))
    if not groups:
        return []
    first, rest = groups[0]
    more = sum(1 + len(others) for _, others in groups[1:]) + len(rest)
    tail = f" (and {more} more)" if more else ""
    back = ", back within its band" if first.state is AlarmState.RETURNED else ""
    return [Notice("warn", f"WARNING  {first.sentence}{back}{tail}")]


def stop_notice(frame: Frame, stop: Stop, now: float) -> Notice:
    """Return what became of the operator's stop; only the run's own word confirms it."""
    if stop.answer is KeyAnswer.NOWHERE:
        return Notice("alarm", "STOP: NOTHING SENT, no run is attached to this screen.")
    if stop.answer is KeyAnswer.NONE:
        if frame.snapshot is not None and frame.snapshot.state in ENDED_STATES:
            return Notice("warn", f"STOP: no answer, the run had ended ({frame.snapshot.state})")
        return Notice("alarm", f"STOP: NO ANSWER from the run. {EMERGENCY}")
    if stop.endpoint is not None and stop.endpoint != frame.endpoint:
        whom = f"{stop.endpoint.rig} (process {stop.endpoint.pid})"
        became = "sending ..." if stop.answer is KeyAnswer.SENDING else "taken"
        return Notice("warn", f"STOP to {whom}, which is not the run shown: {became}")
    return _stop_of_the_shown(frame, stop, now)


def _stop_of_the_shown(frame: Frame, stop: Stop, now: float) -> Notice:
    if frame.snapshot is not None and _zeroed(frame.snapshot):
        return Notice("good", "STOP SENT, OUTPUTS ZEROED: the run confirmed it")
    if stop.answer is KeyAnswer.SENDING:
        return Notice("warn", "STOP: sending ...")
    if frame.over:
        why = frame.snapshot.message if frame.snapshot is not None else ""
        said = f" ({why})" if why else ""
        return Notice("alarm", f"STOP TAKEN, NOT CONFIRMED: the run ended{said}. {EMERGENCY}")
    late = now - stop.at
    if late > CONFIRM:
        return Notice("alarm", f"STOP TAKEN, NOT CONFIRMED for {age_text(late)}. {EMERGENCY}")
    return Notice("warn", "STOP sent and taken; waiting for the run to confirm it ...")


def _zeroed(snapshot: Snapshot) -> bool:
    """Whether the run says that it stopped; it zeroes its outputs before it says so.

    A run that was aborted for another reason, a lost device say, may not have reached them.
    """
    said = snapshot.message.lower()
    stopped = snapshot.state == "aborted" and "stopped" in said
    return (stopped or snapshot.state == "tripped") and UNSURE not in said


def _ended(frame: Frame) -> Notice:
    snapshot = frame.snapshot
    tail = "below is its last picture; waiting for the next run"
    if snapshot is None:
        return Notice("warn", "RUN GONE before it sent anything; waiting for the next run")
    if not frame.over or snapshot.state == "running":
        pid = snapshot.pid
        return Notice("alarm", f"RUN GONE (process {pid} ended without a word): {tail}")
    level = "good" if snapshot.state == "done" else "warn"
    return Notice(level, f"RUN ENDED, {snapshot.state}: {tail}")


def header(frame: Frame, now: float, width: int) -> list[Text]:
    """Return the three lines on top: who and what state, where in the protocol, how fresh."""
    snapshot = frame.snapshot
    if snapshot is None:
        who = frame.endpoint
        about = f"{who.rig} (process {who.pid})" if who else "no run attached"
        return [Text.assemble((" bramah ", "bold reverse"), f" {about}"), Text(), Text()]
    return [_who(snapshot, frame, width), _where(snapshot, width), _fresh(frame, snapshot, now)]


def _who(snapshot: Snapshot, frame: Frame, width: int) -> Text:
    gone = frame.stage is LinkStage.ENDED and snapshot.state == "running"
    state = "GONE" if gone else snapshot.state.upper()
    badge = (f" {state} ", STATES["tripped"] if gone else STATES.get(snapshot.state, "reverse"))
    rig = f" {snapshot.rig}"
    room = max(width - len(rig) - len(state) - 18, 8)
    run = snapshot.run if len(snapshot.run) <= room else "…" + snapshot.run[-(room - 1) :]
    line = Text.assemble((" bramah ", "bold reverse"), (rig, "bold"), "  run ", run)
    line.append(" " * max(width - line.cell_len - len(badge[0]), 1))
    return line.append_text(Text(*badge))


def _where(snapshot: Snapshot, width: int) -> Text:
    line = Text.assemble(" ", (snapshot.step or "–", "bold"))
    if snapshot.phase:
        line.append(f"  {snapshot.phase}")
    if snapshot.repeats > 0:
        line.append(f"  repeat {snapshot.repeat} of {snapshot.repeats}")
    if snapshot.total_s > 0:
        share = min(max(snapshot.done_s / snapshot.total_s, 0.0), 1.0)
        times = f" {share:4.0%}  {clock_text(snapshot.done_s)} of {clock_text(snapshot.total_s)} "
        room = min(max(width - line.cell_len - len(times) - 2, 0), 40)
        full = round(share * room)
        line.append("  ").append("━" * full, "green").append("━" * (room - full), "grey30")
        line.append(times)
    return line


def _fresh(frame: Frame, snapshot: Snapshot, now: float) -> Text:
    age = frame.age(now)
    style = "" if age <= QUIET else "yellow" if age <= VERY_OLD else "bold red"
    line = Text.assemble(f" device {snapshot.device_time:.1f} s")
    if frame.speed > 1.5:
        line.append(f" ({frame.speed:.0f}×)")
    line.append("   age ").append("–" if frame.over else age_text(age), style)
    lost = snapshot.lost_samples
    line.append("   lost ").append(str(lost), "bold red" if lost else "green")
    live = is_live(frame, now)
    for name, label in ((ch.SUPPLY, "supply"), (ch.TEMPERATURE, "oil")):
        view = snapshot.channels.get(name)
        if view is not None:
            line.append(f"   {label} ").append_text(value(view, live=live))
    return line


def value(view: ChannelView, *, live: bool, sign: bool = False) -> Text:
    """Return a channel's newest value with its unit, coloured by its limits; grey when old."""
    how = shown(view.unit)
    style = BANDS[band(view.last, limit(view.low), limit(view.high))] if live else OLD
    return Text.assemble((how.number(view.last, sign=sign), style), (f" {how.unit}", OLD))
