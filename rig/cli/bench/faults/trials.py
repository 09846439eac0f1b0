"""Trial of one fault on one wire: a session moves a joint; its end and its data are recorded.

A trial is a real session: driver, guard and recorder of `bramah run` against a simulated bench in
another process. Joint 1 follows a sine, joint 2 is locked.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from drivers import make_driver
from drivers.base import DeviceError, DeviceLost, OutputLaw, SampleBlock
from hil_sim.device.server import CAN, SLCAN, TCP
from hil_sim.faults import CLASSES
from hil_sim.faults.base import Fault
from hil_sim.faults.device import ClockDrift, ClockJump, DeviceFault, QueueOverrun, Reboots
from hil_sim.faults.wire import WireFault
from rig.bench.guard import EXCITED, JointRole
from rig.bench.latch import BenchState
from rig.bench.session import Bench
from rig.cli.bench.faults.bench import SILENCE, FaultBench
from rig.cli.execution.device import reached_at
from rig.model import channels as ch
from rig.model.alarms.states import Alarm
from rig.model.rig import Rig
from rig.model.trips import DEVICE, SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.runstate import BETWEEN
from rig.runs.store import ARCHIVE

BEGIN: Final = 1.0  # [s] of device time before a fault begins
REAL_BEGIN: Final = 3.0  # [s], in real time: the clock runs while the session starts
WATCHED: Final = 3.0  # [s] of device time observed after a fault began
FRAME_SHARE: Final = 0.1  # share of the frames affected, for `STRIKING` [s]
BUS_SHARE: Final = 0.01  # on a CAN bus, where a block has about thirty frames
STRIKING: Final = 1.0
STALE: Final = "stale data"  # the guard's only limit on wall-clock time
LATE: Final = ("sample gap", STALE)  # limits that a busy computer can exceed without a fault
_TRIES: Final = 5  # attempts to connect, on a busy computer
_AMPLITUDE, _POSITION_GAIN = 0.8, 20.0  # [V], [V/m]
_LOCK: Final = 2e-3  # [m]

# Settings of faults without a default for them.
KEYS: Final[Mapping[str, Mapping[str, Any]]] = {
    "sensor_stuck": {"channel": "cap_pressure_1"},
    "sensor_drift": {"channel": "cap_pressure_1", "rate": 0.1},
    "sensor_noise": {"channel": "cap_pressure_1", "deviation": 0.05},
    "broken_wire": {"channel": "rod_pressure_1"},
    "swapped_channels": {"channel": "cap_pressure_1", "other": "cap_pressure_2"},
    "valve_stuck": {"where": "joint 1"},
    "hose_burst": {"where": "joint 1"},
    "joint_unlocks": {"where": "joint 2", "conductance": 1e-9},
}
_ONCE: Final = frozenset({"stall", "link_half_closed", "link_closed"})


class Diagnosis(StrEnum):
    """Agreement of the message that the operator reads with the injected fault."""

    HARMLESS = "harmless"  # every sample is there and no message was needed
    COUNTED = "counted"  # the run counts the missing samples
    NAMED = "named"
    UNKNOWN = "unknown"  # ended; the message names no cause, or another possible one
    UNNOTICED = "unnoticed"
    WRONG = "wrong"


@dataclass
class TrialOutcome:
    """Result of one trial; `seconds` from the fault to the session's end, None if it did not end.

    The guard received `blocks`; `lost_blocks` of them are missing or altered in records.h5.
    `missing` samples never arrived; the run counts them.
    """

    fault: str
    wire: str
    struck: int = 0  # number of affected frames, 1 for another fault
    error: Exception | None = None
    seconds: float | None = None
    blocks: int = 0
    lost_blocks: int = 0
    missing: int = 0
    zeroed: bool = True
    diagnosis: Diagnosis = Diagnosis.UNKNOWN
    warnings: list[str] = field(default_factory=list)
    alarm: Alarm | None = None  # the guard's first warning after the fault began

    @property
    def message(self) -> str:
        """The message that the operator reads, '' if there is none."""
        if self.error is not None:
            return " ".join(str(self.error).split())
        return "" if self.alarm is None else f"warning: {self.alarm.sentence}"


def kinds() -> dict[str, type[Fault]]:
    """Return the class of every fault of a scenario file by the fault's name."""
    return {kind.fault_name(): kind for kind in CLASSES}


def example(name: str, at: float = BEGIN, wire: str = TCP) -> Fault:
    """Return the fault that trials on a wire use for a name, of a realistic size.

    A fault of machine, sensor or device begins at `at` [s]; a fault of the wire at once.
    """
    kind, keys = kinds()[name], dict(KEYS.get(name, {}))
    if not issubclass(kind, WireFault):
        return kind.model_validate({"name": name, "at": at, **keys})
    if name not in _ONCE:
        keys.update(probability=BUS_SHARE if wire in (CAN, SLCAN) else FRAME_SHARE, until=STRIKING)
    return kind.model_validate({"name": name, **keys})


class _Collector:
    """Collects every block that the guard checked."""

    def __init__(self) -> None:
        self.blocks: list[SampleBlock] = []

    def block(self, block: SampleBlock) -> None:
        self.blocks.append(block)

    def record_begins(self, *_: Any) -> None:
        """Nothing to do."""

    def record_ends(self, *_: Any) -> None:
        """Nothing to do."""


class _Warnings(logging.Handler):
    """Collects the program's log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def try_fault(
    bench: FaultBench, rig: Rig, wire: str, name: str, folder: Path, seed: int, *, realtime: bool
) -> TrialOutcome:
    """Run one trial; `seed` draws the time at which the fault begins.

    Raises DeviceError if no session could start before the fault.
    """
    fault = example(name, REAL_BEGIN if realtime else BEGIN, wire)
    plant_faults = () if isinstance(fault, WireFault) else (fault,)
    endpoint = bench.begin(rig, wire, plant_faults, seed, realtime=realtime)
    reached = reached_at(rig, endpoint)
    outcome, warnings = TrialOutcome(name, wire), _Warnings()
    logging.getLogger().addHandler(warnings)
    try:
        for tries_left in reversed(range(_TRIES)):
            try:
                _session(bench, reached, fault, folder / f"{tries_left}", outcome, seed, realtime)
                break
            except (DeviceError, SafetyTrip):  # before the fault, so caused by a busy computer
                if not tries_left:
                    raise
                rig = with_timeout(rig, 2.0 * rig.wire.timeout)
                endpoint = bench.begin(rig, wire, plant_faults, seed, realtime=realtime)
                reached = reached_at(rig, endpoint)
    finally:
        logging.getLogger().removeHandler(warnings)
        outcome.warnings = warnings.lines
        timeout = 2.0 + (rig.wire.watchdog if realtime else SILENCE)
        outcome.zeroed = bench.at_zero(timeout)
        if isinstance(fault, WireFault):
            outcome.struck = bench.state().struck
        bench.end()
    outcome.struck = outcome.struck or int(not isinstance(fault, WireFault))
    outcome.diagnosis = diagnosis(fault, outcome)
    return outcome


def _session(
    bench: FaultBench,
    rig: Rig,
    fault: Fault,
    folder: Path,
    outcome: TrialOutcome,
    seed: int,
    realtime: bool,
) -> None:
    collector = _Collector()
    period = round(rig.sample_rate)
    wave = _AMPLITUDE * np.sin(2.0 * np.pi * np.arange(period) / period)
    off_laws = [OutputLaw()] * (len(rig.joints) - 1)
    rng = np.random.default_rng(seed)
    fault_start: tuple[float, float] | None = None  # [s] of wall-clock time and of device time
    recorder = Recorder(folder / "run", rig)
    driver = make_driver(rig.wire, rig)
    state = BenchState(rig.wire, folder / "state")
    try:
        with Bench(rig, driver, recorder, signals=False, state=state) as session:
            session.observers.add(collector)
            session.upload(0, wave)
            limit = rig.joints[0].limits.command
            law = OutputLaw(gain=1.0, position_gain=_POSITION_GAIN, limit=limit)
            session.apply([law, *off_laws], restart=True)
            session.run_for(0.3)
            session.guard([EXCITED, *_locked(rig, collector.blocks[-1])])
            session.run_for(0.3 + float(rng.uniform(0.0, 0.3)))
            try:
                if isinstance(fault, WireFault):
                    fault_start = time.monotonic(), session.tick / rig.sample_rate
                    bench.strike([fault])
                    session.run_for(STRIKING + 0.5)
                else:
                    seconds_left = max(fault.at - session.tick / rig.sample_rate, 0.01)
                    fault_start = time.monotonic() + seconds_left * realtime, fault.at
                    session.run_for(seconds_left)
                    session.run_for(WATCHED)
            finally:
                session_end = time.monotonic()
    except (DeviceError, SafetyTrip) as error:
        if fault_start is None:
            raise
        outcome.error = error
        if isinstance(error, SafetyTrip) and error.limit != STALE:
            outcome.seconds = error.device_time - fault_start[1]
        else:
            outcome.seconds = max(0.0, session_end - fault_start[0])
    if outcome.error is None and not isinstance(fault, WireFault):
        alarms = session.alarms.alarms
        raised = [a for a in alarms if a.time >= fault.at and a.check not in LATE]
        outcome.alarm = min(raised, key=lambda alarm: alarm.time, default=None)
        outcome.seconds = outcome.alarm.time - fault.at if outcome.alarm else None
    outcome.blocks = len(collector.blocks)
    outcome.missing = session.lost_samples
    outcome.lost_blocks = _missing_blocks(folder / "run" / ARCHIVE, rig, collector.blocks)


def with_timeout(rig: Rig, seconds: float) -> Rig:
    """Return the rig with another time-out of its device [s]."""
    wire = rig.wire.model_copy(update={"timeout": seconds})
    return rig.model_copy(update={"wire": wire})


def _locked(rig: Rig, block: SampleBlock) -> list[JointRole]:
    roles = []
    for joint in range(2, len(rig.joints) + 1):
        column = rig.recorded.index(ch.channel(rig.position_kind, joint))
        roles.append(JointRole(locked_at=float(block.data[-1, column]), tolerance=_LOCK))
    return roles


def _missing_blocks(archive: Path, rig: Rig, blocks: Sequence[SampleBlock]) -> int:
    """Return how many blocks are missing or altered in an archive."""
    archived: dict[int, np.ndarray] = {}
    with h5py.File(archive, "r") as file:
        for group in file[BETWEEN].values():
            rows = np.column_stack([group[name][:] for name in rig.recorded])
            first = int(group.attrs["start_tick"])
            archived.update((first + row, values) for row, values in enumerate(rows))
    return sum(
        any(
            (tick := block.tick + row) not in archived or not np.array_equal(archived[tick], values)
            for row, values in enumerate(block.data)
        )
        for block in blocks
    )


# -- comparison of the operator's message with the injected fault -------------------------------


def diagnosis(fault: Fault, outcome: TrialOutcome) -> Diagnosis:
    """Return whether the end of a trial names its fault.

    For a fault of sensor or machine, the message must name its channel, joint or supply. For a
    fault of device or wire, it must name device or wire; a limit of the machine is then wrong.
    A limit of another joint is always wrong. Late data leave the cause open.
    """
    error = outcome.error
    if error is None:
        return _without_end(fault, outcome)
    trip = error if isinstance(error, SafetyTrip) else None
    if isinstance(fault, WireFault | DeviceFault):
        return _of_wire(fault, error, trip)
    return Diagnosis.WRONG if trip is None else _of_machine(fault, trip)


def _without_end(fault: Fault, outcome: TrialOutcome) -> Diagnosis:
    if outcome.missing:
        return Diagnosis.COUNTED
    if isinstance(fault, WireFault | ClockDrift):
        return Diagnosis.HARMLESS
    if outcome.alarm is None or isinstance(fault, DeviceFault):
        return Diagnosis.UNNOTICED
    return _of_machine(fault, outcome.alarm)


def _of_wire(fault: Fault, error: Exception, trip: SafetyTrip | None) -> Diagnosis:
    if trip is not None:
        return Diagnosis.UNKNOWN if trip.limit in (DEVICE, *LATE) else Diagnosis.WRONG
    text = str(error)
    if isinstance(fault, Reboots):
        return Diagnosis.NAMED if "restarted" in text else Diagnosis.UNKNOWN
    if isinstance(fault, ClockJump | QueueOverrun):
        return Diagnosis.NAMED if "impossible block" in text else Diagnosis.UNKNOWN
    if isinstance(error, DeviceLost) or "answer" in text or "impossible block" in text:
        return Diagnosis.NAMED
    return Diagnosis.UNKNOWN


def _of_machine(fault: Fault, trip: SafetyTrip | Alarm) -> Diagnosis:
    if isinstance(trip, SafetyTrip) and trip.limit in LATE:
        return Diagnosis.UNKNOWN
    channels_of_fault = {getattr(fault, key, None) for key in ("channel", "other")} - {None}
    if channels_of_fault:
        return Diagnosis.NAMED if trip.channel in channels_of_fault else Diagnosis.WRONG
    joint = getattr(fault, "joint", None)
    if joint is not None and trip.joint == joint + 1:
        return Diagnosis.NAMED
    if ch.kind_of(trip.channel)[0] == ch.SUPPLY if trip.channel else False:
        return Diagnosis.NAMED if joint is None else Diagnosis.UNKNOWN
    return Diagnosis.WRONG
