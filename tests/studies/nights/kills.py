"""Runs killed at random moments over real wires: what was acknowledged is there, outputs are zero.

A worker per wire starts a simulated bench in real time, forks a run, kills it with SIGKILL at a
random moment, half of them drawn over the whole run and half within a phase drawn first (short ones
would else hardly be struck), asks the device itself after its watchdog's period for
its outputs and why it tripped, recovers the run and compares every acknowledged block by checksum.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np

from drivers import make_driver, wire_at
from drivers.base import DeviceError, SampleBlock
from protocols.engine import engine
from protocols.files.plan import Plan, resolve
from protocols.files.schema import Protocol
from rig.bench.latch import STATE_VARIABLE, reset_bench
from rig.bench.session import Bench
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.recover import FINALISED, recover
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events, read_state
from rig.runs.store import is_run
from tests.cli.bench import SHORT

WIRES = ("modbus-tcp", "modbus-rtu", "serial", "can", "can-slcan")
_ACK = struct.Struct("<iqiI")  # stream, tick, samples, checksum
_ARCHIVE = "writing the archive"
_TARGETS = ("connecting", "place", "lock", "centre", "warm-up", "record", "stop", _ARCHIVE)
_GRACE = 0.2  # [s] beyond the watchdog's period before the device is asked
_PROTOCOL = SHORT.replace("repeats: 2", "repeats: 1").replace("duration: 2 s", "duration: 1 s")


@dataclass(frozen=True)
class Kill:
    """One kill: where it struck, and everything that must hold afterwards (`wrong` says what not).

    `acknowledged` and `kept` are samples; `lost` are acknowledged ones that are not in the archive.
    """

    wire: str
    delay: float
    phase: str
    acknowledged: int
    kept: int
    lost: int
    cause: str
    wrong: tuple[str, ...]


class _Noted(Recorder):
    """A recorder that keeps a checksum of each block as soon as it is acknowledged."""

    def __init__(self, folder: Path, rig: Rig, ack: int) -> None:
        super().__init__(folder, rig)
        self._ack = ack

    def append(self, block: SampleBlock, late: float | None) -> None:
        super().append(block, late)
        raw = np.ascontiguousarray(block.data, dtype="<f8").tobytes()
        os.write(self._ack, _ACK.pack(self._stream, block.tick, len(block.data), zlib.crc32(raw)))


def _run(folder: Path, rig: Rig, plan: Plan) -> int:
    """Fork a run; returns the child's number."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        os.setsid()
        sink = os.open(os.devnull, os.O_RDWR)
        for stream in (1, 2):
            os.dup2(sink, stream)
        ack = os.open(folder.with_suffix(".ack"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        with Bench(rig, make_driver(rig.wire, rig), _Noted(folder, rig, ack)) as bench:

            def note(step: str, phase: str, *_: object) -> None:
                bench.event("phase", bench.tick, step=step, phase=phase)

            engine.run(plan, rig, bench, note)
        code = 0
    finally:
        os._exit(code)


def _acknowledged(folder: Path) -> list[tuple[int, int, int, int]]:
    try:
        raw = folder.with_suffix(".ack").read_bytes()
    except FileNotFoundError:
        return []
    return list(_ACK.iter_unpack(raw[: len(raw) // _ACK.size * _ACK.size]))


def _samples(folder: Path, rig: Rig) -> dict[int, dict[int, bytes]]:
    """Return every sample of the archive by stream and tick, from plain h5py."""
    found: dict[int, dict[int, bytes]] = {}
    archive = folder / "records.h5"
    if not archive.exists():
        return found
    with h5py.File(archive) as file:
        groups = [file[name] for name in file if name != "between"]
        groups += list(file["between"].values()) if "between" in file else []
        for group in groups:
            rows = np.column_stack([group[name][:] for name in rig.recorded])
            into = found.setdefault(int(group.attrs["stream"]), {})
            first = int(group.attrs["start_tick"])
            into.update({first + k: row.tobytes() for k, row in enumerate(rows)})
    return found


def _lost(folder: Path, rig: Rig) -> tuple[int, int, int]:
    """Return samples acknowledged, kept, and acknowledged but not kept as they were."""
    kept = _samples(folder, rig)
    total = lost = 0
    for stream, tick, count, crc in _acknowledged(folder):
        total += count
        here = kept.get(stream, {})
        raw = b"".join(here.get(tick + k, b"") for k in range(count))
        lost += 0 if zlib.crc32(raw) == crc else count
    return total, sum(map(len, kept.values())), lost


def _device_says(rig: Rig) -> tuple[bool, str]:
    """Ask the device itself: whether its outputs are at zero, and why it tripped."""
    driver = make_driver(rig.wire, rig)
    try:
        driver.connect()
        cause = driver.trip_cause() or ""
        driver.start()
        commands = driver.read_block().data[:, -len(rig.joints) :]
        return bool((commands == 0.0).all()), cause
    finally:
        driver.close()


def _wait(folder: Path, child: int, target: str) -> None:
    """Wait until a run has entered a phase, or has ended."""
    while _phase(folder) != target:
        found = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        if found is not None:
            return
        time.sleep(0.002)


def _one(folder: Path, rig: Rig, plan: Plan, moment: tuple[str, float], wire: str) -> Kill:
    target, delay = moment
    began = time.monotonic()
    child = _run(folder, rig, plan)
    if target:
        _wait(folder, child, target)
    time.sleep(delay)
    delay = time.monotonic() - began
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    ended = not os.WIFSIGNALED(status)
    time.sleep(rig.wire.watchdog + _GRACE)
    wrong: list[str] = []
    zero, cause = False, ""
    try:
        zero, cause = _device_says(rig)
    except DeviceError as error:
        wrong.append(f"the device does not answer: {error}")
    if not zero:
        wrong.append("outputs not at zero after the watchdog's period")
    phase = _phase(folder) if not ended else "ended before"
    try:
        expected = {"done"} if ended else {"interrupted", "done"}
        # A busy computer may leave the device without its host: that is a trip, and no kill. The
        # archive of such a run may be what the kill then interrupts.
        if cause and (ended or phase == _ARCHIVE):
            expected.add("tripped")
        if is_run(folder):
            recover(folder)
            if read_state(folder) not in expected:
                wrong.append(f"state {read_state(folder)}, expected one of {expected}")
            if recover(folder).message != FINALISED and _acknowledged(folder):
                wrong.append("recovered twice with two results")
        elif _acknowledged(folder):
            wrong.append("samples were acknowledged and there is no run")
    except Exception as error:  # the study counts whatever went wrong
        wrong.append(f"recover: {type(error).__name__}: {error}")
    total, kept, lost = _lost(folder, rig)
    if lost:
        wrong.append(f"{lost} acknowledged samples are lost")
    try:
        reset_bench(rig, make_driver(rig.wire, rig), "the study killed the run")
    except (DeviceError, InputError) as error:
        wrong.append(f"reset: {error}")
    return Kill(wire, round(delay, 3), phase, total, kept, lost, cause, tuple(wrong))


def _phase(folder: Path) -> str:
    """Name where a run was killed, from the last thing it noted."""
    if not is_run(folder):
        return "before the run folder"
    if (folder / "records.h5.tmp").exists():
        return _ARCHIVE
    events = read_events(folder)
    phases = [str(e["phase"]) for e in events if e["event"] == "phase"]
    return phases[-1] if phases else "connecting"


def _moment(rng: np.random.Generator, number: int, longest: float) -> tuple[str, float]:
    """Draw a phase ('' for the whole run) and a time [s] after its begin."""
    if number % 2 == 0:
        return "", float(rng.uniform(0.05, longest))
    return str(rng.choice(_TARGETS)), float(rng.uniform(0.0, 0.5))


def kills_on(wire: str, count: int, seed: int, folder: Path, longest: float) -> list[Kill]:
    """Kill `count` runs on one wire at moments drawn up to `longest` [s] after their start."""
    folder.mkdir(parents=True)
    os.environ[STATE_VARIABLE] = str(folder / "state")
    rng = np.random.default_rng([seed, WIRES.index(wire)])
    bare = load_rig("shinshu-2dof")
    protocol = parse_model(Protocol, _PROTOCOL, "short.yaml")
    with simulated_bench("shinshu-2dof", seed=seed, real_time=True, wire=wire) as endpoint:
        rig = bare.model_copy(update={"wire": wire_at(endpoint, bare.wire)})
        plan = resolve(protocol, rig)
        return [
            _one(folder / f"run{k}", rig, plan, _moment(rng, k, longest), wire)
            for k in range(count)
        ]


def study(count: int, seed: int, folder: Path, longest: float, wires: Sequence[str]) -> list[Kill]:
    """Kill `count` runs in all, the wires side by side."""
    each = [count // len(wires) + (k < count % len(wires)) for k in range(len(wires))]
    with ProcessPoolExecutor(len(wires), mp_context=get_context("spawn")) as pool:
        waiting = [
            pool.submit(kills_on, wire, n, seed, folder / wire, longest)
            for wire, n in zip(wires, each, strict=True)
        ]
        return [kill for one in waiting for kill in one.result()]


def kills_text(found: Sequence[Kill]) -> str:
    """Return the counts as text."""
    lines = [f"{len(found)} runs killed at random moments"]
    for wire in dict.fromkeys(kill.wire for kill in found):
        mine = [kill for kill in found if kill.wire == wire]
        lines.append(
            f"  {wire:11s} {len(mine):3d} kills, {sum(k.acknowledged for k in mine)} samples "
            f"acknowledged, {sum(k.lost for k in mine)} lost, "
            f"{sum(bool(k.wrong) for k in mine)} with anything wrong"
        )
    phases = Counter(kill.phase for kill in found)
    lines += [f"  {count:3d} {phase}" for phase, count in phases.most_common()]
    causes = Counter(kill.cause.partition(" (at")[0] or "no trip of the device" for kill in found)
    lines += [f"  {count:3d} {cause}" for cause, count in causes.most_common()]
    lines += [f"  WRONG {json.dumps(asdict(kill))}" for kill in found if kill.wrong]
    return "\n".join(lines)
