"""What happened, as lines for the log: turns of the protocol, messages, losses, trips."""

from __future__ import annotations

from dataclasses import dataclass

from rig.bench.screens.sockets import Snapshot


@dataclass(frozen=True)
class Line:
    """One thing that happened, at a device time [s]; `style` is a rich style."""

    device_time: float
    text: str
    style: str = ""


def tell(last: Snapshot | None, snapshot: Snapshot) -> list[Line]:
    """Return what is new in a snapshot after the one before it (None: it is a run's first)."""
    said: list[tuple[str, str]] = []
    if last is not None and (last.run, last.pid) != (snapshot.run, snapshot.pid):
        last = None
    if last is None:
        said.append((f"attached to run {snapshot.run} on {snapshot.rig}", "bold"))
    if last is None or _turn(snapshot) != _turn(last):
        said.append((_turn(snapshot), "cyan"))
    if snapshot.message and (last is None or snapshot.message != last.message):
        said.append((snapshot.message, ""))
    more = snapshot.lost_samples - (last.lost_samples if last else 0)
    if more > 0:
        said.append((f"{more} samples lost ({snapshot.lost_samples} in all)", "bold red"))
    if snapshot.trip is not None and (last is None or last.trip != snapshot.trip):
        said.append((f"TRIP  {trip_text(snapshot.trip)}", "bold red"))
    if last is not None and snapshot.state != last.state:
        said.append((f"state: {last.state} → {snapshot.state}", "bold"))
    return [Line(snapshot.device_time, text, style) for text, style in said if text]


def _turn(snapshot: Snapshot) -> str:
    repeat = f" repeat {snapshot.repeat} of {snapshot.repeats}" if snapshot.repeats > 0 else ""
    return f"{snapshot.step}{repeat} {snapshot.phase}".strip()


def trip_text(trip: str) -> str:
    """Return a trip's message without its opening words, which the screen says larger."""
    return trip.removeprefix("safety trip: ")
