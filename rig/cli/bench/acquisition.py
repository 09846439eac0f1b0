"""Quality of acquisition over the wires: lost samples, late blocks, processor time.

The group `acquisition` of `bramah bench` streams every channel through a driver alone, the group
`wires` through driver, guard and recorder, over every wire of a simulated bench in real time in
another process. The driver alone is also compared with the library on which it is based, for the
same bytes to and from the same device in virtual time, where nothing waits.
"""

from __future__ import annotations

import math
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import serial
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from drivers import make_driver
from drivers.base import DeviceInfo, Driver
from drivers.serial_stream import SerialSettings
from hil_sim.device.server import RTU, SERIAL, TCP, VALVES, WIRES
from rig.bench.session import Bench
from rig.cli.bench.figure import Figure
from rig.cli.execution.device import reached_at
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.cli.text.output import Say
from rig.model.parts import WATCHDOG_RANGE, Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FrameDecoder, WireFrame, encode_frame
from rig.model.wire.serial_messages import Message
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig

RIG: Final = "digger-3dof"  # of the group `wires`: 14 measured channels, 3 commands at 1 kHz
MODBUS_RIG: Final = "shinshu-2dof"  # of the group `acquisition`
SEED: Final = 100
GROUP: Final = "wires"
BLOCKS, ROUNDS = 200, 7
_SESSION: Final = 0x0BA2E11B


def acquisition_figures(say: Say, minutes: float) -> list[Figure]:
    """Stream every channel in real time over the wire; count lost and late samples."""
    say(f"acquisition: {minutes:g} min in real time over the wire")
    with simulated_bench(MODBUS_RIG, seed=SEED, real_time=True) as endpoint:
        reached = reached_at(load_rig(MODBUS_RIG), endpoint)
        driver = make_driver(reached.wire, reached)
        try:
            measured = measure_acquisition(driver, driver.connect(), 60.0 * minutes)
        finally:
            driver.close()
    return [
        Figure("acquisition", "samples of every channel", measured["samples"]),
        Figure("acquisition", "samples lost", measured["lost_samples"], "", 0.0),
        Figure("acquisition", "blocks out of order", measured["out_of_order_blocks"], "", 0.0),
        Figure("acquisition", "lateness, mean", 1e3 * measured["lateness_mean_s"], "ms"),
        Figure("acquisition", "lateness, 99 %", 1e3 * measured["lateness_p99_s"], "ms"),
        Figure("acquisition", "lateness, worst", 1e3 * measured["lateness_max_s"], "ms"),
    ]


def measure_acquisition(
    driver: Driver, info: DeviceInfo, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float | int]:
    """Stream for `seconds` of device time, outputs unchanged; count lost samples and time blocks.

    `driver` is connected and `info` is what its `connect` returned. A block's lateness is its
    arrival time (host clock) minus the time of its last sample (device clock), relative to the
    earliest block, after the linear drift between the clocks is removed. It contains the delay
    of the wire, the scheduling of both ends and the block's length, not the clocks' offset.
    Raises ValueError for a device in virtual time, DeviceError and DeviceLost as the driver does.
    """
    if info.virtual_time:
        raise ValueError("lateness cannot be measured on a device in virtual time; use real time")
    required_ticks = round(seconds * info.sample_rate)
    ends: list[float] = []
    arrivals: list[float] = []
    lost = disordered = samples = 0
    driver.start()
    try:
        block = driver.read_block()
        first = expected = block.tick
        while True:
            arrivals.append(clock())
            ends.append((block.tick + len(block.data)) / info.sample_rate)
            samples += len(block.data)
            lost += max(block.tick - expected, 0)
            disordered += block.tick < expected
            expected = max(expected, block.tick + len(block.data))
            if expected - first >= required_ticks:
                break
            block = driver.read_block()
    finally:
        driver.stop()
    late, drift = lateness(np.array(ends), np.array(arrivals))
    return {
        "blocks": len(ends),
        "samples": samples,
        "lost_samples": lost,
        "out_of_order_blocks": disordered,
        "lateness_mean_s": float(late.mean()),
        "lateness_p99_s": float(np.quantile(late, 0.99)),
        "lateness_max_s": float(late.max()),
        "clock_drift_ppm": drift * 1e6,
    }


def lateness(ends: np.ndarray, arrivals: np.ndarray) -> tuple[np.ndarray, float]:
    """Return each block's lateness [s] relative to the earliest, and the clocks' drift [s/s]."""
    late = arrivals - ends
    drift = float(np.polyfit(ends - ends[0], late, 1)[0]) if len(late) > 2 else 0.0
    late = late - drift * (ends - ends[0])
    late -= late.min()
    return late, drift


def waited_seconds() -> float:
    """Return how long [s] this thread was ready to run and had no processor; NaN where unknown.

    Source on Linux: the second number of /proc/thread-self/schedstat [ns].
    """
    try:
        return 1e-9 * int(Path("/proc/thread-self/schedstat").read_text("ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return math.nan


@dataclass(frozen=True)
class Stream:
    """All channels of a wire streamed in real time through driver, guard and recorder.

    `core_share`: processor load of the acquisition process, as a share of one core. Times in
    seconds. `worst_waited`: time that this process waited for a processor before the latest block.
    """

    samples: int
    lost: int
    disordered: int
    core_share: float
    late_p99: float
    late_worst: float
    worst_waited: float


def wire_figures(say: Say, minutes: float) -> list[Figure]:
    """Measure every wire of the simulated bench for `minutes` each.

    Excludes CiA 408 valves, which do not stream: the host samples them at some tens of Hz.
    """
    figures = []
    for wire in WIRES:
        if wire == VALVES:
            continue
        say(f"wires: {wire}, {minutes:g} min in real time, then the bare library")
        figures += acquisition_of(wire, 60.0 * minutes)
        if wire not in _BARE:
            continue
        by_driver, by_library = driver_and_bare(wire)
        ratio = by_driver / by_library
        figures += [
            Figure(GROUP, f"{wire}: a block by the driver", 1e3 * by_driver, "ms"),
            Figure(GROUP, f"{wire}: driver over the bare library", ratio, "x as long", 1.3),
        ]
    return figures


def stream_of(wire: str, seconds: float) -> Stream:
    """Stream all channels of one wire through driver, guard and recorder."""
    rig = load_rig(RIG)
    with (
        simulated_bench(RIG, seed=0, real_time=True, wire=wire) as endpoint,
        tempfile.TemporaryDirectory(prefix="bramah-wires-") as folder,
    ):
        # Late blocks of a stalled computer are to be measured and must not end the session.
        slow_watchdog = rig.wire.model_copy(update={"watchdog": WATCHDOG_RANGE[1]})
        reached = reached_at(rig.model_copy(update={"wire": slow_watchdog}), endpoint)
        recorder = Recorder(Path(folder) / "run", reached)
        with Bench(reached, make_driver(reached.wire, reached), recorder, signals=False) as bench:
            bench.run_for(0.5)  # excludes imports and opening of files
            lost, busy, start = bench.lost_samples, time.process_time(), time.perf_counter()
            ends, arrivals, waits, samples, disordered = [], [], [], 0, 0
            while time.perf_counter() - start < seconds:
                before = bench.tick
                block = bench.exchange()
                arrivals.append(time.perf_counter())
                waits.append(waited_seconds())
                ends.append((block.tick + len(block.data)) / reached.sample_rate)
                samples += len(block.data)
                disordered += block.tick < before
            share = (time.process_time() - busy) / (time.perf_counter() - start)
            lost = bench.lost_samples - lost
    late, _ = lateness(np.array(ends), np.array(arrivals))
    worst = int(late.argmax())
    # The delay arose between the last block in time and this one.
    before_it = np.flatnonzero(late[:worst] < 0.1 * late[worst])
    waited = waits[worst] - waits[int(before_it[-1]) if len(before_it) else 0]
    return Stream(
        samples, lost, disordered, share, float(np.quantile(late, 0.99)), float(late[worst]), waited
    )


def acquisition_of(wire: str, seconds: float) -> list[Figure]:
    """Return the figures of a stream over one wire."""
    stream = stream_of(wire, seconds)
    values = len(load_rig(RIG).recorded)
    share = 1e2 * stream.core_share
    return [
        Figure(GROUP, f"{wire}: samples of {values} values", stream.samples),
        Figure(GROUP, f"{wire}: samples lost", stream.lost, "", 0.0),
        Figure(GROUP, f"{wire}: blocks out of order", stream.disordered, "", 0.0),
        Figure(GROUP, f"{wire}: of one core, driver + guard + recorder", share, "%", 25.0),
        Figure(GROUP, f"{wire}: lateness, 99 %", 1e3 * stream.late_p99, "ms"),
        Figure(GROUP, f"{wire}: lateness, worst", 1e3 * stream.late_worst, "ms", 50.0),
        Figure(GROUP, f"{wire}: without a processor meanwhile", 1e3 * stream.worst_waited, "ms"),
    ]


def driver_and_bare(wire: str) -> tuple[float, float]:
    """Return the times [s] of one block by the driver and by the bare library, best of several."""
    rig = load_rig(RIG)
    by_driver, by_library = [], []
    with simulated_bench(RIG, seed=0, wire=wire) as endpoint:
        reached = reached_at(rig, endpoint)
        for _ in range(ROUNDS):
            with _streaming(reached) as driver:
                by_driver.append(_time_of(driver.read_block))
            with _BARE[wire](reached) as read_one:
                by_library.append(_time_of(read_one))
    return min(by_driver), min(by_library)


def _time_of(read_one: Callable[[], object]) -> float:
    read_one()
    start = time.perf_counter()
    for _ in range(BLOCKS):
        read_one()
    return (time.perf_counter() - start) / BLOCKS


@contextmanager
def _streaming(rig: Rig) -> Iterator[Driver]:
    driver = make_driver(rig.wire, rig)
    driver.connect()
    try:
        driver.start()
        yield driver
    finally:
        driver.close()


@contextmanager
def bare_modbus(rig: Rig) -> Iterator[Callable[[], object]]:
    """Read blocks with pymodbus alone."""
    client, layout = _client(rig.wire), reg.block_layout(len(rig.channels), len(rig.joints))
    client.connect()
    words = [0xFFFF, 0]

    def read_one() -> None:
        words[1] = (words[1] + 1) & 0xFFFF
        answer = client.readwrite_registers(
            read_address=reg.BLOCK.address,
            read_count=layout.words,
            write_address=reg.CONTROL_ACK.address,
            values=words,
            device_id=1,
        )
        words[0] = answer.registers[0]

    try:
        client.write_register(reg.CONTROL_STREAM.address, reg.STREAM_START, device_id=1)
        yield read_one
        client.write_register(reg.CONTROL_STREAM.address, reg.STREAM_STOP, device_id=1)
    finally:
        client.close()


def _client(wire: Wire) -> Any:
    settings = wire.settings
    if wire.kind == RTU:
        return ModbusSerialClient(settings["device"], baudrate=921_600, timeout=2.0)
    return ModbusTcpClient(settings["host"], port=settings["port"], timeout=2.0)


@contextmanager
def _bare_serial(rig: Rig) -> Iterator[Callable[[], object]]:
    """Send messages and receive blocks with pyserial and the frames' encoding alone."""
    settings, heartbeat = SerialSettings.of(rig.wire), 0
    decoder = FrameDecoder()
    with serial.Serial(settings.device, settings.baud, timeout=2.0) as port:

        def send(kind: Message, number: int, payload: bytes = b"") -> None:
            port.write(encode_frame(WireFrame(kind, number, _SESSION, payload)))

        def receive() -> list[WireFrame]:
            frames: list[WireFrame] = []
            while not frames:
                frames = decoder.feed(port.read(1) + port.read(port.in_waiting))
            return frames

        def request(kind: Message, number: int, payload: bytes = b"") -> None:
            send(kind, number, payload)
            receive()

        request(Message.OPEN, 1, struct.pack(">H", 5000))
        request(Message.START, 2)
        last = msg.NOTHING_YET

        def read_one() -> None:
            nonlocal heartbeat, last
            heartbeat = (heartbeat + 1) & 0xFFFF
            send(Message.ALIVE_NOTE, 2, msg.pack_alive(msg.Alive(last, heartbeat)))
            last = struct.unpack_from(">H", receive()[-1].payload, 2)[0]

        yield read_one
        request(Message.CLOSE, 3)


_BARE: Final = {TCP: bare_modbus, RTU: bare_modbus, SERIAL: _bare_serial}
