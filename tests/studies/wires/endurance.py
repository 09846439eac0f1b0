"""Long streams in real time over every wire: what is lost, late, out of order, what they cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from hil_sim.device.server import VALVES, WIRES
from rig.cli.bench.acquisition import stream_of
from rig.model.parse import InputError
from rig.model.trips import SafetyTrip

STREAMED: Final = tuple(wire for wire in WIRES if wire != VALVES)  # there the host is the clock
SECTION: Final = "long streams"
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


def chosen(wires: Sequence[str]) -> tuple[str, ...]:
    """Return the wires to stream over, all of them by default; raises InputError for another."""
    for wire in wires:
        if wire not in STREAMED:
            raise InputError(f"--wire {wire}: expected one of: {' '.join(STREAMED)}")
    return tuple(wires) or STREAMED


def rows(wires: Sequence[str], minutes: float, say: Callable[[str], None]) -> list[tuple[str, ...]]:
    """Stream 16 channels at 1 kHz over device-timed wires; returns the table's rows."""
    found: list[tuple[str, ...]] = []
    for wire in wires:
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


def with_rows_of(page: Path, rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return rows in the order of the wires, with those of the page's table for the others.

    Raises InputError where the page is not there.
    """
    if not page.is_file():
        raise InputError(f"{page}: no such page")
    table = page.read_text("utf-8").partition(f"<!-- {SECTION} -->")[2].partition("<!--")[0]
    lines = [line for line in table.splitlines() if line.startswith("| `")]
    kept = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines]
    by_wire = {row[0].strip("`"): row for row in (*kept, *rows)}
    return [by_wire[wire] for wire in STREAMED if wire in by_wire]


def _line(trip: SafetyTrip) -> str:
    return str(trip).partition(";")[0]
