"""One fault on one wire: a session that moves a joint, what ended it, what the run then holds.

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
from hil_sim.link.served import SERVED
from rig.bench.guard import EXCITED, JointRole
from rig.bench.latch import BenchState
from rig.bench.session import Bench
from rig.cli.bench.faults.bench import SILENCE, FaultBench
from rig.cli.device import reached_at
from rig.model import channels as ch
from rig.model.alarms.states import Alarm
from rig.model.rig import Rig
from rig.model.trips import DEVICE, SafetyTrip
from rig.runs.archive import NAME
from rig.runs.recorder import Recorder
from rig.runs.runstate import BETWEEN

BEGIN: Final = 1.0  # [s] of device time before a fault begins
REAL_BEGIN: Final = 3.0  # in real time, in which the clock runs while the session is begun
WATCHED: Final = 3.0  # [s] of device time that a fault is watched for
SHARE: Final = 0.1  # of the frames struck, for `STRIKING` [s]
BUS_SHARE: Final = 0.01  # on a CAN bus, where a block is some thirty frames
STRIKING: Final = 1.0
STALE: Final = "stale data"  # the guard's limit that is one of the wall's clock
LATE: Final = ("sample gap", STALE)  # limits that a busy computer passes, whatever else is wrong
_TRIES: Final = 5  # at connecting, on a busy computer
_AMPLITUDE, _PULL = 0.8, 20.0  # [V], [V/m]
_LOCK: Final = 2e-3  # [m]

# What a fault needs to be said beside its name; the others stand by their defaults.
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
    """How well what the operator reads fits what was done."""

    HARMLESS = "harmless"  # every sample there, nothing to say
    COUNTED = "counted"  # what is missing is counted in the run
    NAMED = "named"
    UNKNOWN = "unknown"  # ended, by a message that names another possible cause or none
    UNNOTICED = "unnoticed"
    WRONG = "wrong"


@dataclass
class TrialOutcome:
    """What one trial showed; `seconds` from the fault's begin to the end, None without an end.

    `blocks` were given to the guard, `lost_blocks` of them are not in records.h5 as they came;
    `missing` samples never came, and the run counts them.
    """

    fault: str
    wire: str
    struck: int = 0
    error: Exception | None = None
    seconds: float | None = None
    blocks: int = 0
    lost_blocks: int = 0
    missing: int = 0
    zeroed: bool = True
    diagnosis: Diagnosis = Diagnosis.UNKNOWN
    warnings: list[str] = field(default_factory=list)
    alarm: Alarm | None = None  # the first warning of the guard after the fault's begin

    @property
    def message(self) -> str:
        """What the operator reads, '' where nothing is said."""
        if self.error is not None:
            return " ".join(str(self.error).split())
        return "" if self.alarm is None else f"warning: {self.alarm.sentence}"


def kinds() -> dict[str, type[Fault]]:
    """Return every fault of the scenario file by its name."""
    return {kind.fault_name(): kind for kind in CLASSES}


def example(name: str, at: float = BEGIN, wire: str = TCP) -> Fault:
    """Return a fault of a name as the trials on a wire use it: of a size that a bench may show.

    A fault of machine, sensor or device begins at `at` [s], one of the wire at once.
    """
    kind, keys = kinds()[name], dict(KEYS.get(name, {}))
    if not issubclass(kind, WireFault):
        return kind.model_validate({"name": name, "at": at, **keys})
    if name not in _ONCE:
        keys.update(probability=BUS_SHARE if wire in (CAN, SLCAN) else SHARE, until=STRIKING)
    return kind.model_validate({"name": name, **keys})


class _Collector:
    """Keeps every block that the guard saw."""

    def __init__(self) -> None:
        self.blocks: list[SampleBlock] = []

    def block(self, block: SampleBlock) -> None:
        self.blocks.append(block)

    def record_begins(self, *_: Any) -> None:
        """Nothing to do."""

    def record_ends(self, *_: Any) -> None:
        """Nothing to do."""


class _Warnings(logging.Handler):
    """Collects what a program's log says meanwhile."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def try_fault(
    bench: FaultBench, rig: Rig, wire: str, name: str, folder: Path, seed: int, *, realtime: bool
) -> TrialOutcome:
    """Run one trial; the fault begins at an instant that the seed draws.

    Raises DeviceError where no session could be begun before the fault.
    """
    fault = example(name, REAL_BEGIN if realtime else BEGIN, wire)
    early = () if isinstance(fault, WireFault) else (fault,)
    endpoint = bench.begin(rig, wire, early, seed, realtime=realtime)
    reached = reached_at(rig, endpoint)
    outcome, warnings = TrialOutcome(name, wire), _Warnings()
    logging.getLogger().addHandler(warnings)
    try:
        for tries_left in reversed(range(_TRIES)):
            try:
                _session(bench, reached, fault, folder / f"{tries_left}", outcome, seed, realtime)
                break
            except (DeviceError, SafetyTrip):  # before the fault: a computer too busy
                if not tries_left:
                    raise
                rig = _more_patient(rig)
                endpoint = bench.begin(rig, wire, early, seed, realtime=realtime)
                reached = reached_at(rig, endpoint)
    finally:
        logging.getLogger().removeHandler(warnings)
        outcome.warnings = warnings.lines
        patience = 2.0 + (rig.wire.watchdog if realtime else SILENCE)
        outcome.zeroed = bench.at_zero(patience)
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
    off = [OutputLaw()] * (len(rig.joints) - 1)
    rng = np.random.default_rng(seed)
    began: tuple[float, float] | None = None  # [s] of the wall's clock and of the device's
    recorder = Recorder(folder / "run", rig)
    driver = make_driver(rig.wire, rig)
    state = BenchState(rig.wire, folder / "state")
    try:
        with Bench(rig, driver, recorder, signals=False, state=state) as session:
            session.observers.add(collector)
            session.upload(0, wave)
            limit = rig.joints[0].limits.command
            law = OutputLaw(gain=1.0, position_gain=_PULL, limit=limit)
            session.apply([law, *off], restart=True)
            session.run_for(0.3)
            session.guard([EXCITED, *_locked(rig, collector.blocks[-1])])
            session.run_for(0.3 + float(rng.uniform(0.0, 0.3)))
            try:
                if isinstance(fault, WireFault):
                    began = time.monotonic(), session.tick / rig.sample_rate
                    bench.strike([fault])
                    session.run_for(STRIKING + 0.5)
                else:
                    seconds_left = max(fault.at - session.tick / rig.sample_rate, 0.01)
                    began = time.monotonic() + seconds_left * realtime, fault.at
                    session.run_for(seconds_left)
                    session.run_for(WATCHED)
            finally:
                ended = time.monotonic()
    except (DeviceError, SafetyTrip) as error:
        if began is None:
            raise
        outcome.error = error
        if isinstance(error, SafetyTrip) and error.limit != STALE:
            outcome.seconds = error.device_time - began[1]
        else:
            outcome.seconds = max(0.0, ended - began[0])
    if outcome.error is None and not isinstance(fault, WireFault):
        alarms = session.alarms.alarms
        raised = [a for a in alarms if a.time >= fault.at and a.check not in LATE]
        outcome.alarm = min(raised, key=lambda alarm: alarm.time, default=None)
        outcome.seconds = outcome.alarm.time - fault.at if outcome.alarm else None
    outcome.blocks = len(collector.blocks)
    outcome.missing = session.lost_samples
    outcome.lost_blocks = _not_in(folder / "run" / NAME, rig, collector.blocks)


def _more_patient(rig: Rig) -> Rig:
    wire = rig.wire.model_copy(update={"timeout": 2.0 * rig.wire.timeout})
    return rig.model_copy(update={"wire": wire})


def _locked(rig: Rig, block: SampleBlock) -> list[JointRole]:
    roles = []
    for joint in range(2, len(rig.joints) + 1):
        column = rig.recorded.index(ch.channel(rig.position_kind, joint))
        roles.append(JointRole(locked_at=float(block.data[-1, column]), tolerance=_LOCK))
    return roles


def _not_in(archive: Path, rig: Rig, blocks: Sequence[SampleBlock]) -> int:
    """Return how many blocks are not in an archive, sample by sample."""
    kept: dict[int, np.ndarray] = {}
    with h5py.File(archive, "r") as file:
        for group in file[BETWEEN].values():
            rows = np.column_stack([group[name][:] for name in rig.recorded])
            first = int(group.attrs["start_tick"])
            kept.update((first + row, values) for row, values in enumerate(rows))
    return sum(
        any(
            (tick := block.tick + row) not in kept or not np.array_equal(kept[tick], values)
            for row, values in enumerate(block.data)
        )
        for block in blocks
    )


# -- what the operator reads against what was done ----------------------------------------------


def diagnosis(fault: Fault, outcome: TrialOutcome) -> Diagnosis:
    """Return how well the end of a trial fits its fault.

    A message names a fault of a sensor or of the machine by its channel, joint or supply, one of
    the device or of the wire by saying that it is there. A limit of the machine named for a fault
    of wire or device is wrong, and so is one of another joint. Late data are true, and unknown.
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
    own = {getattr(fault, key, None) for key in ("channel", "other")} - {None}
    if own:
        return Diagnosis.NAMED if trip.channel in own else Diagnosis.WRONG
    joint = getattr(fault, "joint", None)
    if joint is not None and trip.joint == joint + 1:
        return Diagnosis.NAMED
    if ch.kind_of(trip.channel)[0] == ch.SUPPLY if trip.channel else False:
        return Diagnosis.NAMED if joint is None else Diagnosis.UNKNOWN
    return Diagnosis.WRONG


def wires() -> tuple[str, ...]:
    """Name the wires that trials are made on: those that a faulty link stands on."""
    return SERVED
