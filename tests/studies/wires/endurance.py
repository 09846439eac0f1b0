"""Long streams in real time over every wire: what is lost, late, out of order, what they cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from hil_sim.device.server import VALVES, WIRES
from rig.cli.bench.wire_figures import stream_of
from rig.model.trips import SafetyTrip

HEADER: Final = (
    "wire",
    "minutes",
    "samples",
    "lost",
    "blocks out of order",
    "of a core",
    "late, 99 %",
    "late, worst",
    "without a processor meanwhile",
)


def rows(minutes: float, say: Callable[[str], None]) -> list[tuple[str, ...]]:
    """Stream 16 channels at 1 kHz over each device-timed wire; returns the table's rows."""
    found: list[tuple[str, ...]] = []
    for wire in WIRES:
        if wire == VALVES:  # the host is its clock: some tens of Hz
            continue
        say(f"{wire}: {minutes:g} min in real time")
        try:
            stream = stream_of(wire, 60.0 * minutes)
        except SafetyTrip as trip:  # a computer that stands still for half a second trips
            empty = ("",) * (len(HEADER) - 3)
            found.append((f"`{wire}`", f"{minutes:g}", f"tripped: {_line(trip)}", *empty))
            continue
        found.append(
            (
                f"`{wire}`",
                f"{minutes:g}",
                f"{stream.samples}",
                f"{stream.lost}",
                f"{stream.disordered}",
                f"{100 * stream.core_share:.1f} %",
                f"{1e3 * stream.late_p99:.1f} ms",
                f"{1e3 * stream.late_worst:.1f} ms",
                f"{1e3 * stream.worst_waited:.1f} ms",
            )
        )
    return found


def _line(trip: SafetyTrip) -> str:
    return str(trip).partition(";")[0]
