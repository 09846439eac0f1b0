"""Write results to standard output or files, progress to standard error."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TextIO

import typer

from rig.model.units import clock

Say = Callable[[str], None]  # shows the user a line of progress
LINE_SECONDS: Final = 3.0  # [s] between the lines of a countdown, and before the first


def progress(message: str) -> None:
    """Print a message to standard error; after a failure nothing more is printed there.

    A closed pipe, or a log on a full disk, must not end a run.
    """
    if sys.stderr is None:  # closed by the caller; print would write to standard output
        return
    try:
        # One write: lines of several threads stay apart.
        print(f"{message}\n", end="", file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr.fileno())


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal; one that the shell has closed is None."""
    return stream is not None and stream.isatty()


def discard(descriptor: int) -> None:
    """Discard everything unwritten of an open file and all that is written to it later."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, descriptor)
    os.close(null)


def condition_text(condition: float) -> str:
    """Return a condition number with one decimal, a large one with an exponent."""
    return f"{condition:.1f}" if condition < 1e5 else f"{condition:.1e}"


def clock_text(seconds: float) -> str:
    """Return a time as 0:07, 12:30 or 3:05:00."""
    return clock(round(max(0.0, seconds)))


class Countdown:
    """Reports progress and remaining time; called with the share done, 0 to 1.

    Reports nothing within the first LINE_SECONDS, so not at all for short work. While the share
    stays the same, it reports for how long, since no remaining time follows from it, and reports
    again when that time has doubled.
    """

    def __init__(
        self,
        what: str,
        say: Callable[[str], None] = progress,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what, self._say, self._clock = what, say, clock
        self._start = self._last_line = self._reached = clock()
        self._share = 0.0

    def __call__(self, share: float) -> None:
        """Report the share done so far, at most once every LINE_SECONDS."""
        now = self._clock()
        rises = share > self._share
        if rises:
            self._share, self._reached = share, now
        pause = LINE_SECONDS if rises else max(LINE_SECONDS, self._last_line - self._reached)
        if now - self._last_line < pause or not 0.0 < share < 1.0:
            return
        self._last_line = now
        percent = f"{self._what}: {100 * share:.0f} %"
        if rises:
            remaining = (now - self._start) * (1.0 - share) / share
            self._say(f"{percent}, about {clock_text(remaining)} left")
        else:
            self._say(f"{percent} for {clock_text(now - self._reached)}, time left unknown")


def write_json(path: Path | None, data: Any) -> None:
    """Write `data` as JSON to `path` (``-``: standard output; None: nowhere); NaN becomes null."""
    if path is None:
        return
    from rig.runs.files import json_text, write_text

    text = json_text(data, indent=2) + "\n"
    if str(path) == "-":
        print(text, end="")  # to nowhere where standard output is closed
        return
    write_text(path, text)


def print_result(json_file: Path | None, data: Any, text: str) -> None:
    """Write a result as JSON and print its text, except where the JSON is printed."""
    write_json(json_file, data)
    if json_file != Path("-"):
        typer.echo(text)


@contextmanager
def printed_at_end(json_file: Path | None, text: Callable[[], str]) -> Iterator[None]:
    """Print a result after its files are written, also if one of them cannot be written.

    Nothing is printed where the JSON document goes to standard output.
    """
    try:
        yield
    finally:
        if json_file != Path("-"):
            print(text())


def table(header: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[str] = ()) -> str:
    """Return a table as text: the first column and those in `left` left-aligned, others right."""
    widths = [max(len(row[k]) for row in (header, *rows)) for k in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(width) if k == 0 or name in left else cell.rjust(width)
            for k, (name, cell, width) in enumerate(zip(header, row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    ]
    return "\n".join((lines[0], "-" * len(lines[0]), *lines[1:]))
