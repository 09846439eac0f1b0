"""Stored state of a bench: its latched trip, cleared trips, and the process that runs it.

A bench is identified by its endpoint, not by the rig's name. Each has a folder in `state_folder`:
`trip.json` while a trip is latched, `resets.jsonl` with every cleared trip, `session.json` while a
process of this computer uses the bench, `lock`, which that process has locked, `rig.yaml`, the rig
of the last session, and `stopped`, written by each `bramah stop` of it. One of all benches is in
`state_folder` itself. A bench with two addresses has two folders; the trip latched in the device
itself covers that case.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from drivers.base import DeviceBusy, Driver
from rig.model.parse import InputError
from rig.model.parts import LOCALHOST, Wire
from rig.model.rig import Rig
from rig.model.trips import Latched, RecordingFailed
from rig.runs import runstate
from rig.runs.files import replace_text, sync_to_disk
from rig.runs.rigs import load_rig
from rig.runs.store import description_of

log = logging.getLogger(__name__)

STATE_VARIABLE: Final = "BRAMAH_STATE"
_TRIP, _RESETS, _SESSION, _LOCK = "trip.json", "resets.jsonl", "session.json", "lock"
_STOPPED: Final = "stopped"
_RIG: Final = "rig.yaml"
_THIS_COMPUTER = frozenset({"localhost", "[::1]"})
_LOOPBACK = 127  # first number of the addresses of this computer
_UNREADABLE: Final = "unknown"


@dataclass(frozen=True)
class LatchedTrip:
    """A trip that blocks a bench: cause, time, run and rig."""

    trip: str
    time: str
    run: str
    rig: str
    operator: str
    host: str


@dataclass(frozen=True)
class Holder:
    """The process of this computer that uses a bench, and the run it writes ('' without one)."""

    pid: int
    started: str
    run: str


def state_folder() -> Path:
    """Return the folder of stored state: `BRAMAH_STATE`, or the user's default."""
    stated = os.environ.get(STATE_VARIABLE)
    if stated:
        return Path(stated).absolute()
    base = os.environ.get("XDG_STATE_HOME")
    if base and os.path.isabs(base):
        return Path(base) / "bramah"
    return Path.home() / ".local" / "state" / "bramah"


def bench_name(endpoint: str) -> str:
    """Return the name of the bench at an endpoint, as of a file: equal for the same bench.

    All names of this computer that need no name server are one: localhost, its own, 127.1.
    """
    kind, _, address = endpoint.lower().partition("?")[0].partition("://")
    host, colon, port = address.rpartition(":")
    if _is_this_computer(host if colon and "/" not in port else address):
        address = f"{LOCALHOST}{colon}{port}" if host else LOCALHOST
    return re.sub(r"[^a-z0-9.-]", "_", f"{kind}_{address}")


def _is_this_computer(host: str) -> bool:
    names = (*_THIS_COMPUTER, socket.gethostname().lower())
    try:
        return host in names or socket.inet_aton(host)[0] == _LOOPBACK
    except OSError:  # no number
        return False


def _load_trip(path: Path) -> LatchedTrip:
    """Read a stored trip; raises OSError, ValueError, KeyError or TypeError."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    return LatchedTrip(**{key: str(stored[key]) for key in LatchedTrip.__annotations__})


def known_rigs() -> list[Path]:
    """Return the descriptions of the rigs that this computer has driven, one for each bench."""
    return sorted(state_folder().glob(f"*/{_RIG}"))


def tripped_rigs() -> list[Path]:
    """Return the descriptions of the rigs that tripped and are not reset."""
    return [path for path in known_rigs() if path.with_name(_TRIP).exists()]


def rigs_in_use() -> list[Path]:
    """Return the descriptions of the rigs whose benches other processes of this computer drive."""
    holders = ((path, _holder(path.parent)) for path in known_rigs())
    return [path for path, holder in holders if holder is not None and holder.pid != os.getpid()]


def rigs_to_stop() -> list[Path]:
    """Return the descriptions of the rigs whose benches this computer may have left driven.

    A process drives them, or the last one ended without confirming that their outputs are at zero.
    """
    held = (path for path in known_rigs() if path.with_name(_SESSION).exists())
    own = os.getpid()
    return [path for path in held if (holder := _holder(path.parent)) is None or holder.pid != own]


def note_stop(endpoint: str = "") -> None:
    """Store that a person stops the bench at an endpoint now, or all benches; never raises."""
    path = _stop_file(endpoint)
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        path.touch()  # its time is all that is read, and the outputs wait for it
    except OSError as error:
        log.warning("%s: cannot be written: %s; a queue may start its next item", path, error)


def stop_time(endpoint: str = "") -> int:
    """Return the time [ns since 1970] of the last `note_stop` of an endpoint, 0 without one."""
    try:
        return _stop_file(endpoint).stat().st_mtime_ns
    except OSError:
        return 0


def _stop_file(endpoint: str) -> Path:
    folder = state_folder()
    return (folder / bench_name(endpoint) if endpoint else folder) / _STOPPED


def holder_at(wire: Wire) -> Holder | None:
    """Return the process of this computer that uses a bench, also under another name of its port.

    A link to a device file, as in /dev/serial/by-id, has a latch of its own: it keeps its name
    where the device file does not.
    """
    holder = BenchState(wire).holder()
    port = _port(wire)
    if holder is None and port is not None:
        in_use = ((path, _port(load_rig(path).wire)) for path in rigs_in_use())
        holder = next((_holder(path.parent) for path, other in in_use if other == port), None)
    return holder


def _port(wire: Wire) -> str | None:
    """Return the device file of a serial wire without links."""
    device = wire.settings.get("device")
    return os.path.realpath(device) if isinstance(device, str) else None


def _holder(folder: Path) -> Holder | None:
    """Return the running process of this computer that uses a bench, None if unknown."""
    try:
        owner = Holder(**json.loads((folder / _SESSION).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return owner if runstate.process_alive(owner.pid, owner.started) else None


class BenchState:
    """The files of the bench at one wire; `root` is `state_folder()` by default."""

    def __init__(self, wire: Wire, root: Path | None = None) -> None:
        self.endpoint = wire.endpoint
        self.folder = (state_folder() if root is None else root) / bench_name(wire.endpoint)
        self._taken = False
        self._lock: int | None = None

    def prepare(self) -> None:
        """Create the folder; raises InputError if a trip could not be stored there."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            sync_to_disk(self.folder.parent)
            if not os.access(self.folder, os.W_OK | os.X_OK):
                raise PermissionError(13, "is not writable")
        except OSError as error:
            raise InputError(
                f"{self.folder}: a safety trip could not be stored here ({error.strerror}); "
                f"set {STATE_VARIABLE} to a folder that you can write to"
            ) from error

    # The trip

    def read_trip(self) -> LatchedTrip | None:
        """Return the latched trip, None if there is none; a damaged file counts as a trip."""
        path = self.folder / _TRIP
        try:
            return _load_trip(path)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.warning("%s: cannot be read: %s", path, error)
            about = f"unknown: its file {path} cannot be read"
            return LatchedTrip(about, *[_UNREADABLE] * 5)

    def latch(self, trip: str, rig: Rig, run: Path | None) -> bool:
        """Store a trip until it is cleared, the first one only; log a failure and return False."""
        if self.read_trip() is not None:
            return True
        where = "" if run is None else str(run.absolute())
        latched = LatchedTrip(
            trip,
            runstate.utc_now(),
            where,
            rig.name,
            runstate.user_name(),
            runstate.computer_name(),
        )
        try:
            replace_text(self.folder / _TRIP, json.dumps(asdict(latched)) + "\n")
        except OSError as error:
            log.error("%s: the trip could not be latched here: %s", self.folder, error)
            return False
        return True

    def refuse_if_tripped(self, rig: Rig) -> None:
        """Raise Latched if an earlier trip was not cleared."""
        trip = self.read_trip()
        if trip is None:
            return
        run = f" in run {trip.run}" if trip.run else ""
        raise Latched(
            f"the bench at {self.endpoint} tripped at {trip.time}{run}, not yet reset: {trip.trip}",
            rig,
        )

    def clear(self, reason: str, device_cause: str | None) -> LatchedTrip | None:
        """Clear and return the latched trip; store who did it, when and why. Raises OSError.

        The reason is written to `resets.jsonl` first, then to the events of the tripped run.
        """
        trip = self.read_trip()
        entry = {
            "time": runstate.utc_now(),
            "who": runstate.user_name(),
            "host": runstate.computer_name(),
            "reason": reason,
            "trip": None if trip is None else asdict(trip),
            "device": device_cause,
        }
        with (self.folder / _RESETS).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        if trip is not None:
            _note_in_run(trip, entry)
        (self.folder / _TRIP).unlink(missing_ok=True)
        sync_to_disk(self.folder)
        return trip

    # The session

    def occupy(self) -> None:
        """Keep other processes of this computer off the bench until `release`.

        A device that knows no sessions (valves on CANopen, an I/O module) would serve two programs
        at once. Raises DeviceBusy where another process has the bench; a folder that cannot be
        written is logged.
        """
        try:
            handle = os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            log.warning("%s: cannot lock the bench: %s", self.folder, error)
            return
        try:
            # A lock of the process: one process may have several sessions with the bench.
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            process = os.pread(handle, 32, 0).decode("ascii", "replace").strip()
            os.close(handle)
            holder = self.holder()
            run = f", which writes {holder.run}" if holder and holder.run else ""
            raise DeviceBusy(
                f"the bench at {self.endpoint} is in use by process {process} of this computer"
                f"{run}; wait for its end or stop it"
            ) from error
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
        self._lock = handle

    @contextmanager
    def occupied(self) -> Iterator[None]:
        """Return a context in which other processes of this computer are kept off (`occupy`)."""
        with suppress(InputError):  # without a folder there is nothing to lock, nor to latch
            self.prepare()
        self.occupy()
        try:
            yield
        finally:
            self.release()

    def describe(self, rig: Rig) -> None:
        """Store the rig, so that `stop` and `reset` know the bench by themselves; never raises."""
        try:
            replace_text(self.folder / _RIG, description_of(rig))
        except OSError as error:
            log.warning("%s: cannot store the rig: %s", self.folder, error)

    def take(self, run: Path | None) -> None:
        """Store this process as the user of the bench; never raises."""
        started = runstate.process_started(os.getpid()) or ""
        holder = Holder(os.getpid(), started, "" if run is None else str(run.absolute()))
        try:
            replace_text(self.folder / _SESSION, json.dumps(asdict(holder)) + "\n")
        except OSError as error:
            log.warning("%s: cannot store which process uses the bench: %s", self.folder, error)
        self._taken = True

    def release(self, *, at_zero: bool = True) -> None:
        """Remove the lock of `occupy` and, with outputs `at_zero`, the entry made by `take`.

        The entry that stays names a bench to stop (`rigs_to_stop`). Never raises.
        """
        if self._taken:
            self._taken = False
            if at_zero:
                self.forget_session()
        handle, self._lock = self._lock, None
        if handle is not None:
            with suppress(OSError):
                os.close(handle)

    def forget_session(self) -> None:
        """Remove the entry of a process that used the bench; never raises."""
        with suppress(OSError):
            (self.folder / _SESSION).unlink(missing_ok=True)

    def holder(self) -> Holder | None:
        """Return the running process of this computer that uses the bench, None if unknown."""
        return _holder(self.folder)

    def in_use(self, error: DeviceBusy) -> DeviceBusy:
        """Return the error with the process of this computer that uses the bench, if known."""
        holder = self.holder()
        if holder is None:
            return DeviceBusy(f"{error}; no known process of this computer uses it")
        run = f", which writes {holder.run}" if holder.run else ""
        return DeviceBusy(f"{error}: process {holder.pid}{run}; wait for its end or stop it")


def _note_in_run(trip: LatchedTrip, entry: dict[str, Any]) -> None:
    """Append the reset to the events of the run that tripped, if its folder is still there."""
    if not trip.run or not Path(trip.run).is_dir() or trip.host != runstate.computer_name():
        return
    fields = {key: entry[key] for key in ("who", "reason")}
    try:
        events = runstate.EventLog(Path(trip.run))
        events.append("trip cleared", None, fields)
        events.close()
    except RecordingFailed as error:
        log.warning("%s", error)


def reset_bench(rig: Rig, driver: Driver, reason: str) -> str:
    """Clear the trip of a bench in its device and on this computer; return the cause.

    Raises InputError without a reason, DeviceError if the device refuses; the trip then stays.
    Closes `driver`.
    """
    if not reason.strip():
        raise InputError(
            "reset: --reason TEXT is missing; inspect the bench, then say what was found and done, "
            'for example --reason "cap sensor of joint 2 replaced"'
        )
    bench = BenchState(rig.wire)
    bench.prepare()
    with bench.occupied():
        try:
            driver.connect()
            cause = driver.trip_cause()
            driver.reset()
        except DeviceBusy as error:
            raise bench.in_use(error) from error
        finally:
            driver.close()
    cleared = bench.clear(reason.strip(), cause)
    parts = [] if cleared is None else [cleared.trip]
    parts += [] if cause is None else [f"device: {cause}"]
    return "; ".join(parts) or "no trip was latched"
