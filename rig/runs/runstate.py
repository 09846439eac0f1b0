"""Status files of a run folder: state, owner, events.

`state` is one word, replaced atomically. `owner.json` names the process that writes the folder,
with its start time so that a reused process number is not mistaken for it. `events.jsonl` has one
JSON object per line, each on the disk before the next begins; a torn last line is ignored. An
event's `t` [s] counts from the run's first sample; `tick` is the device's clock, `time` the host's.
"""

from __future__ import annotations

import getpass
import json
import logging
import os
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from rig.model.trips import RecordingFailed
from rig.runs.files import json_text, replace_text

log = logging.getLogger(__name__)

RUNNING: Final = "running"
DONE: Final = "done"
ABORTED: Final = "aborted"
TRIPPED: Final = "tripped"
INTERRUPTED: Final = "interrupted"
STATES: Final = (RUNNING, DONE, ABORTED, TRIPPED, INTERRUPTED)

HEADER: Final = "run.yaml"
JOURNAL: Final = "journal.sqlite"
EVENTS: Final = "events.jsonl"
BETWEEN: Final = "between"  # group of records.h5 for samples outside all records
_STATE, _OWNER = "state", "owner.json"


def computer_name() -> str:
    """Return this computer's name."""
    return socket.gethostname()


def user_name() -> str:
    """Return the name of this process's user."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user id without a name, as in containers
        return str(os.getuid())


def utc_now() -> str:
    """Return the wall clock as ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@dataclass(frozen=True)
class Owner:
    """The process that writes a run."""

    pid: int
    started: str
    host: str


def process_started(pid: int) -> str | None:
    """Return the kernel's start time of a process as text; None if there is no such process."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        if Path("/proc/self/stat").exists():
            return None
    except OSError:
        return ""
    else:
        fields = stat.rpartition(")")[2].split()
        return None if fields[0] in ("Z", "X") else fields[19]
    try:  # without /proc: test with signal 0
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:
        return ""
    return ""


def process_alive(pid: int, started: str = "") -> bool:
    """Return whether process `pid` runs and, with `started`, is still the same one."""
    began = process_started(pid)
    if began is None:
        return False
    return not (began and started) or began == started


def take_ownership(folder: Path) -> None:
    """Store this process as the writer of the run."""
    owner = Owner(os.getpid(), process_started(os.getpid()) or "", computer_name())
    replace_text(folder / _OWNER, json.dumps(asdict(owner)) + "\n")


def release_ownership(folder: Path) -> None:
    """Remove the entry of the run's writer."""
    (folder / _OWNER).unlink(missing_ok=True)


def read_owner(folder: Path) -> Owner | None:
    """Return the process that writes the run, None without a valid entry."""
    try:
        return Owner(**json.loads((folder / _OWNER).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def owner_alive(owner: Owner | None) -> bool:
    """Return whether the run's writer is running; True if this machine cannot determine it."""
    if owner is None or owner.host != computer_name():
        return False
    return process_alive(owner.pid, owner.started)


def write_state(folder: Path, state: str) -> None:
    """Replace the state; raises OSError. One that stands already is not written again."""
    with suppress(OSError):
        if (folder / _STATE).read_bytes() == f"{state}\n".encode():
            return
    replace_text(folder / _STATE, state + "\n")


def read_state(folder: Path) -> str:
    """Return the state; a run in state `running` whose writer died is `interrupted`."""
    try:
        word = (folder / _STATE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        word = RUNNING
    if word in STATES and word != RUNNING:
        return word
    return RUNNING if owner_alive(read_owner(folder)) else INTERRUPTED


class EventLog:
    """Appends events to a run; raises RecordingFailed when it cannot."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / EVENTS
        try:
            self._stream = self.path.open("ab+")
            self._end_torn_line()
        except OSError as error:
            raise RecordingFailed(f"{self.path}: cannot be written: {error.strerror}") from error

    def _end_torn_line(self) -> None:
        if self._stream.seek(0, os.SEEK_END) == 0:
            return
        self._stream.seek(-1, os.SEEK_END)
        if self._stream.read(1) != b"\n":
            self._stream.write(b"\n")

    def append(self, event: str, tick: int | None, fields: Mapping[str, Any]) -> None:
        """Write one event, on the disk when this returns."""
        entry = {"time": utc_now(), "event": event, "tick": tick, **fields}
        line = json_text(entry) + "\n"
        try:
            self._stream.write(line.encode())
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise RecordingFailed(f"{self.path}: cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Close the file; never raises."""
        try:
            self._stream.close()
        except OSError as error:
            log.warning("%s: %s", self.path, error)


@dataclass(frozen=True)
class StreamClock:
    """The clock of one stream: its first tick and the time of that tick [s] since the run began.

    `host` is the wall clock (ISO 8601, UTC) at the arrival of the stream's first block.
    """

    tick: int
    began: float
    host: str

    def at(self, tick: int, sample_rate: float) -> float:
        """Return the time [s] since the run began of a device tick."""
        return self.began + (tick - self.tick) / sample_rate


STREAM: Final = "stream begins"


def stream_clocks(events: Iterable[Mapping[str, Any]]) -> dict[int, StreamClock]:
    """Return the clocks of all streams from a run's events."""
    clocks: dict[int, StreamClock] = {}
    for event in events:
        if event.get("event") == STREAM:
            with suppress(KeyError, TypeError, ValueError):
                began, host = float(event["t"]), str(event["time"])
                clocks[int(event["stream"])] = StreamClock(int(event["tick"]), began, host)
    return clocks


def read_events(folder: Path) -> list[dict[str, Any]]:
    """Return the events of a run, without a line left incomplete by a kill."""
    try:
        raw = (folder / EVENTS).read_bytes()
    except OSError:
        return []
    events = []
    for line in raw.splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict):
            events.append(entry)
    return events
