"""Verbs of `bramah` that the operator starts from the screen, each a separate process.

The screen never holds the hardware: closing or killing it does not affect these processes.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Final

from rig.queue.processes import BRAMAH, reason_in, start

POLL: Final = 0.1  # time between two looks at a verb's output [s]
TAIL: Final = 400  # lines of a verb's output that are shown
MEANINGS: Final = {
    0: "done",
    1: "could not be done",
    2: "refused",
    3: "SAFETY TRIP",
    4: "DEVICE LOST",
    130: "stopped",
}


@dataclass(frozen=True)
class VerbJob:
    """One verb: its arguments, process, output so far, and exit code once it has ended."""

    words: tuple[str, ...]
    pid: int = 0
    lines: tuple[str, ...] = ()
    code: int | None = None
    reason: str = ""
    output: str = ""

    @property
    def title(self) -> str:
        """The command line as typed."""
        return " ".join(("bramah", *self.words))

    @property
    def ended(self) -> str:
        """The meaning of its exit code, with the reason; empty while it runs."""
        if self.code is None:
            return ""
        meaning = MEANINGS.get(self.code, f"ended with code {self.code}")
        return f"{meaning}: {self.reason}" if self.reason else meaning

    def result(self) -> Any:
        """Return its JSON on standard output; None if there is none."""
        try:
            return json.loads(self.output)
        except ValueError:
            return None


def begin(words: Sequence[str], changed: Callable[[VerbJob], None]) -> None:
    """Start a verb; `changed` is called at its start, with its output and at its end."""
    # Closed by the thread that watches the child.
    output, errors = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
    job = VerbJob(tuple(words))
    try:
        process = start([*BRAMAH, *words], output, errors)
    except OSError as error:
        changed(replace(job, code=1, reason=f"cannot be started: {error.strerror}"))
        return
    job = replace(job, pid=process.pid)
    changed(job)
    watcher = threading.Thread(
        target=_watch, args=(job, process, output, errors, changed), name="bramah-job", daemon=True
    )
    watcher.start()


def _watch(
    job: VerbJob,
    process: subprocess.Popen[bytes],
    output: IO[bytes],
    errors: IO[bytes],
    changed: Callable[[VerbJob], None],
) -> None:
    with output, errors:
        code = None
        while code is None:
            with suppress(subprocess.TimeoutExpired):
                code = process.wait(POLL)
            text = _text(errors)
            lines = tuple(text.splitlines()[-TAIL:])
            if code is None and lines == job.lines:
                continue
            job = replace(job, lines=lines)
            if code is not None:
                reason = reason_in(text) if code else ""
                job = replace(job, code=code, reason=reason, output=_text(output))
            changed(job)


def _text(stream: IO[bytes]) -> str:
    # The child writes at the shared offset: read without moving it.
    size = os.fstat(stream.fileno()).st_size
    return os.pread(stream.fileno(), size, 0).decode(errors="replace")


def rig_of_run(run: str, rig: str) -> str:
    """Return the rig of a run as an argument of a verb: the run's description, else its name."""
    header = Path(run) / "run.yaml"
    return str(header) if run and header.is_file() else rig
