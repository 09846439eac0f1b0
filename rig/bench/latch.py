"""What outlives a session with a bench: its latched trip, who cleared it, who runs it now.

A bench is what answers at an endpoint, whatever a rig file calls it. Its files stand in a folder of
their own below `state_folder`: `trip.json` while a trip is latched, `resets.jsonl` with every trip
that was cleared, `session.json` while a process of this computer has the bench. A bench that is
reached under two addresses has two folders; the trip latched in the device covers that.
"""

from __future__ import annotations

import json
import logging
import os
import re
from contextlib import suppress
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

log = logging.getLogger(__name__)

STATE_VARIABLE: Final = "BRAMAH_STATE"
_TRIP, _RESETS, _SESSION = "trip.json", "resets.jsonl", "session.json"
_THIS_COMPUTER = frozenset({"localhost", "[::1]"})
_UNREADABLE: Final = "unknown"


@dataclass(frozen=True)
class LatchedTrip:
    """A trip that keeps a bench from running: what it was, when, in which run and on which rig."""

    trip: str
    time: str
    run: str
    rig: str
    operator: str
    host: str


@dataclass(frozen=True)
class Holder:
    """The process of this computer that has a bench, and the run it writes ('' without one)."""

    pid: int
    started: str
    run: str


def state_folder() -> Path:
    """Return the folder for what outlives a session: `BRAMAH_STATE`, or this user's own."""
    named = os.environ.get(STATE_VARIABLE)
    if named:
        return Path(named).absolute()
    base = os.environ.get("XDG_STATE_HOME")
    if base and os.path.isabs(base):
        return Path(base) / "bramah"
    return Path.home() / ".local" / "state" / "bramah"


def _folder_name(wire: Wire) -> str:
    kind, _, place = wire.endpoint.lower().partition("?")[0].partition("://")
    for name in _THIS_COMPUTER:
        place = re.sub(rf"^{re.escape(name)}(?=:|$)", LOCALHOST, place)
    return re.sub(r"[^a-z0-9.-]", "_", f"{kind}_{place}")


class BenchState:
    """The files of the bench behind one wire; `root` is `state_folder()` where not given."""

    def __init__(self, wire: Wire, root: Path | None = None) -> None:
        self.endpoint = wire.endpoint
        self.folder = (state_folder() if root is None else root) / _folder_name(wire)
        self._taken = False

    def prepare(self) -> None:
        """Make the folder; raises InputError where a trip could not be kept."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            sync_to_disk(self.folder.parent)
            if not os.access(self.folder, os.W_OK | os.X_OK):
                raise PermissionError(13, "may not be written")
        except OSError as error:
            raise InputError(
                f"{self.folder}: a safety trip could not be kept here ({error.strerror}); "
                f"set {STATE_VARIABLE} to a folder that you may write"
            ) from error

    # The trip

    def read_trip(self) -> LatchedTrip | None:
        """Return the latched trip, None if there is none; a damaged file is a trip as well."""
        path = self.folder / _TRIP
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            return LatchedTrip(**{key: str(stored[key]) for key in LatchedTrip.__annotations__})
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.warning("%s: cannot be read: %s", path, error)
            about = f"a trip whose note {path} cannot be read"
            return LatchedTrip(about, *[_UNREADABLE] * 5)

    def latch(self, trip: str, rig: Rig, run: Path | None) -> bool:
        """Keep a trip until it is cleared; the first one stays. False (and logged) if it fails."""
        if self.read_trip() is not None:
            return True
        where = "" if run is None else str(run.absolute())
        kept = LatchedTrip(
            trip, runstate.now(), where, rig.name, runstate.user_name(), runstate.here()
        )
        try:
            replace_text(self.folder / _TRIP, json.dumps(asdict(kept)) + "\n")
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
            f"the bench at {self.endpoint} tripped at {trip.time}{run} and stays so: {trip.trip}",
            rig,
        )

    def clear(self, reason: str, device_cause: str | None) -> LatchedTrip | None:
        """Clear the latched trip and keep who did, when and why; returns it. Raises OSError.

        The reason goes into `resets.jsonl` first, then into the events of the tripped run.
        """
        trip = self.read_trip()
        entry = {
            "time": runstate.now(),
            "who": runstate.user_name(),
            "host": runstate.here(),
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

    def take(self, run: Path | None) -> None:
        """Note this process as the one that has the bench; never raises."""
        started = runstate.process_started(os.getpid()) or ""
        holder = Holder(os.getpid(), started, "" if run is None else str(run.absolute()))
        try:
            replace_text(self.folder / _SESSION, json.dumps(asdict(holder)) + "\n")
        except OSError as error:
            log.warning("%s: cannot note who has the bench: %s", self.folder, error)
        self._taken = True

    def release(self) -> None:
        """Remove the note that `take` left; never raises."""
        if self._taken:
            self._taken = False
            with suppress(OSError):
                (self.folder / _SESSION).unlink(missing_ok=True)

    def holder(self) -> Holder | None:
        """Return the living process of this computer that has the bench, None if none is known."""
        try:
            owner = Holder(**json.loads((self.folder / _SESSION).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None
        return owner if runstate.process_alive(owner.pid, owner.started) else None

    def in_use(self, error: DeviceBusy) -> DeviceBusy:
        """Return an error with the process of this computer that has the bench, if one is known."""
        holder = self.holder()
        if holder is None:
            return DeviceBusy(f"{error}; no process of this computer is known to")
        run = f", which writes {holder.run}" if holder.run else ""
        return DeviceBusy(f"{error}: process {holder.pid}{run}; wait for its end or stop it")


def _note_in_run(trip: LatchedTrip, entry: dict[str, Any]) -> None:
    """Append the reset to the events of the run that tripped, if its folder is still there."""
    if not trip.run or not Path(trip.run).is_dir() or trip.host != runstate.here():
        return
    fields = {key: entry[key] for key in ("who", "reason")}
    try:
        events = runstate.EventLog(Path(trip.run))
        events.append("trip cleared", None, fields)
        events.close()
    except RecordingFailed as error:
        log.warning("%s", error)


def reset_bench(rig: Rig, driver: Driver, reason: str) -> str:
    """Clear the trip of a bench, in its device and on this computer; returns what had tripped it.

    Raises InputError without a reason, DeviceError if the device does not obey: the trip then
    stays. Owns `driver`.
    """
    if not reason.strip():
        raise InputError(
            "reset: --reason TEXT is missing; look at the bench, then say what was found and done, "
            'for example --reason "cap sensor of joint 2 replaced"'
        )
    bench = BenchState(rig.wire)
    bench.prepare()
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
    return "; ".join(parts) or "nothing was latched"
