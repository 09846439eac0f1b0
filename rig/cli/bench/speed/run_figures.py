"""Times of a run over the wire, and of bare pymodbus with the same requests to the same device.

In virtual time pymodbus sends the requests of the run, so that the device does the same work and
answers with the same bytes; a machine at rest would take less time to simulate. In real time both
read blocks of a machine at rest, each when it is due.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from pymodbus.client import ModbusTcpClient

from drivers import make_driver
from drivers.base import SampleBlock
from drivers.modbus_frames import READ_HOLDING, WRITE_AND_READ, WRITE_MANY, WRITE_ONE
from drivers.modbus_tcp import ModbusTcpDriver, TcpSettings
from drivers.modbus_transport import TcpConnection
from protocols.engine import engine
from protocols.engine.run_inputs import RunInputs
from protocols.engine.states import EngineState, StateMachine
from protocols.files import library
from protocols.files.plan import Overrides, resolve
from rig.bench.guard import GuardSettings
from rig.bench.screens.sockets import Publisher
from rig.bench.session import Bench
from rig.cli.bench.acquisition import bare_modbus
from rig.cli.bench.figure import Figure
from rig.cli.execution.device import reached_at
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.cli.text.output import Say
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.runs.journal import Journal
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig

GROUP: Final = "run"
RIG, PROTOCOL, STEP = "shinshu-2dof", "lock-and-excite", "step1"
ROUNDS: Final = 5
JOURNAL_BLOCK, JOURNAL_BLOCKS = 0.1, 1000  # [s], number


@dataclass(frozen=True)
class _Cost:
    """Processor time of this process and wall time of one block [s]."""

    processor: float
    wall: float


def run_figures(folder: Path, say: Say, seconds: float) -> list[Figure]:
    """Measure a run in virtual time, `seconds` of streaming in real time, and pymodbus in both."""
    say(f"run: {PROTOCOL}, {STEP}, in virtual time, {ROUNDS} times")
    rig = load_rig(RIG)
    pairs = []
    for number in range(ROUNDS):
        bramah, requests, blocks = _protocol_run(rig, folder / f"run-{number}")
        pairs.append((bramah, _repeated(rig, requests, blocks)))
    figures = _figures("virtual time", pairs, 1.3)
    say(f"run: streaming in real time for {ROUNDS} times {seconds / ROUNDS:g} s")
    count = max(10, round(seconds / ROUNDS * rig.sample_rate / 10))
    pairs = []
    for number in range(ROUNDS):
        bramah = _streamed(rig, folder / f"stream-{number}", count)
        pairs.append((bramah, _bare(rig, count)))
    return [*figures, *_figures("real time", pairs, 1.6), *journal_figures(folder, rig)]


def journal_figures(folder: Path, rig: Rig) -> list[Figure]:
    """Measure the wall time to write a block of 100 ms to the journal of a run."""
    n, measured = round(JOURNAL_BLOCK * rig.sample_rate), len(rig.channels)
    rng, saturated, times = np.random.default_rng(0), np.zeros((n, measured), dtype=bool), []
    folder.mkdir(parents=True, exist_ok=True)
    journal = Journal.create(folder / "journal", rig.recorded, measured, rig.sample_rate)
    for k in range(JOURNAL_BLOCKS):
        data = rng.normal(size=(n, len(rig.recorded)))
        block = SampleBlock(k, k * n, data, saturated, 0, tripped=False)
        start = time.perf_counter()
        journal.append(1, block, 0.0)
        times.append(1e3 * (time.perf_counter() - start))
    journal.close()
    name = "a block of 100 ms into the journal"
    return [
        Figure(GROUP, f"{name}, median", float(np.median(times)), "ms"),
        Figure(GROUP, f"{name}, 99 %", float(np.quantile(times, 0.99)), "ms", 5.0),
        Figure(GROUP, f"{name}, worst", max(times), "ms"),
    ]


def _figures(kind: str, pairs: list[tuple[_Cost, _Cost]], limit: float) -> list[Figure]:
    """Return least and median of a block's times, and their ratio to pymodbus with its limit.

    The ratio is of wall time in virtual time, where nothing waits, and of processor time in real
    time.
    """
    figures = []
    costs_of_both = tuple(zip(*pairs, strict=True))
    of: tuple[tuple[str, bool, Callable[[_Cost], float]], ...] = (
        ("processor", kind == "real time", lambda cost: cost.processor),
        ("wall", kind == "virtual time", lambda cost: cost.wall),
    )
    for what, bounded, time_of in of:
        bramah, bare = ([1e3 * time_of(cost) for cost in costs] for costs in costs_of_both)
        name = f"{kind}, a block, {what} time"
        figures += [
            Figure(GROUP, name, min(bramah), "ms"),
            Figure(GROUP, f"{name}, median", float(np.median(bramah)), "ms"),
            Figure(GROUP, f"{name}, bare pymodbus", min(bare), "ms"),
            Figure(GROUP, f"{name}, bare pymodbus, median", float(np.median(bare)), "ms"),
            Figure(
                GROUP, f"{name}, over bare", min(bramah) / min(bare), "x as long",
                limit if bounded else None,
            ),
        ]  # fmt: skip
    return figures


def _cost(work: Callable[[], int]) -> tuple[_Cost, int]:
    """Return the cost of a block and the number of blocks, which `work` returns."""
    start, busy = time.perf_counter(), time.process_time()
    blocks = work()
    busy, wall = time.process_time() - busy, time.perf_counter() - start
    return _Cost(busy / blocks, wall / blocks), blocks


def _recording_driver(rig: Rig) -> tuple[ModbusTcpDriver, list[bytes]]:
    """Return a driver, and the list to which it appends its requests."""
    requests: list[bytes] = []

    class Connection(TcpConnection):
        def _send(self, request: bytes) -> int:
            requests.append(request)
            return super()._send(request)

    class Driver(ModbusTcpDriver):
        @staticmethod
        def connection(wire: Wire, timeout: float) -> TcpConnection:
            at = TcpSettings.of(wire)
            return Connection(at.host, at.port, timeout)

    return Driver(rig.wire, rig), requests


def _protocol_run(rig: Rig, folder: Path) -> tuple[_Cost, list[list[bytes]], int]:
    """Run one step with guard, journal and publisher, as `bramah run` does.

    Return its cost, the requests before, during and after the measurement, and the number of
    blocks during it.
    """
    plan = resolve(library.load(PROTOCOL), rig, Overrides(repeats=1, steps=(STEP,)))
    with simulated_bench(RIG, seed=0) as endpoint:
        reached = reached_at(rig, endpoint)
        machine = StateMachine()
        driver, requests = _recording_driver(reached)
        machine.to(EngineState.CHECKING, PROTOCOL)
        recorder, publisher = Recorder(folder, reached), Publisher(f"bench-{rig.name}")
        with Bench(reached, driver, recorder, publisher, signals=False) as bench:
            first = bench.exchange()
            before = len(requests)

            def work() -> int:
                engine.run(plan, reached, bench, lambda *_: None, RunInputs(machine=machine))
                return (bench.tick - first.tick) // len(first.data)

            cost, blocks = _cost(work)
            ended = len(requests)
    return cost, [requests[:before], requests[before:ended], requests[ended:]], blocks


def _repeated(rig: Rig, requests: list[list[bytes]], blocks: int) -> _Cost:
    """Send the same requests with pymodbus alone."""
    with simulated_bench(RIG, seed=0) as endpoint:
        at = TcpSettings.of(reached_at(rig, endpoint).wire)
        client: Any = ModbusTcpClient(at.host, port=at.port, timeout=2.0)
        client.connect()
        calls = [[_pymodbus_call(client, request) for request in part] for part in requests]

        def ask(part: int) -> int:
            for call in calls[part]:
                call()
            return blocks

        ask(0)
        cost, _ = _cost(lambda: ask(1))
        ask(2)
        client.close()
    return cost


def _pymodbus_call(client: Any, request: bytes) -> Callable[[], object]:
    """Return the pymodbus call that sends a request."""
    function, at = request[0], int.from_bytes(request[1:3], "big")
    words = np.frombuffer(request[1:], ">u2", len(request[1:]) // 2).tolist()
    if function == READ_HOLDING:
        return partial(client.read_holding_registers, at, count=words[1], device_id=1)
    if function == WRITE_ONE:
        return partial(client.write_register, at, words[1], device_id=1)
    if function == WRITE_MANY:
        values = np.frombuffer(request[6:], ">u2").tolist()
        return partial(client.write_registers, at, values, device_id=1)
    assert function == WRITE_AND_READ
    return partial(
        client.readwrite_registers,
        read_address=at,
        read_count=words[1],
        write_address=words[2],
        values=np.frombuffer(request[10:], ">u2").tolist(),
        device_id=1,
    )


def _streamed(rig: Rig, folder: Path, count: int) -> _Cost:
    """Read blocks in real time with guard, journal and publisher."""
    with simulated_bench(RIG, seed=0, real_time=True) as endpoint:
        reached = reached_at(rig, endpoint)
        recorder, publisher = Recorder(folder, reached), Publisher(f"bench-{rig.name}")
        driver = make_driver(reached.wire, reached)
        # Late blocks of a busy computer are to be measured; at rest no trip is needed.
        late = GuardSettings(stale_after=60.0)
        with Bench(reached, driver, recorder, publisher, signals=False, settings=late) as bench:
            bench.run_for(0.5)

            def work() -> int:
                for _ in range(count):
                    bench.exchange()
                return count

            return _cost(work)[0]


def _bare(rig: Rig, blocks: int) -> _Cost:
    """Read blocks in real time with pymodbus alone, each when it is due."""
    with (
        simulated_bench(RIG, seed=0, real_time=True) as endpoint,
        bare_modbus(reached_at(rig, endpoint)) as ask,
    ):
        ask()

        def work() -> int:
            due = time.perf_counter()
            for _ in range(blocks):
                due += 10 / rig.sample_rate
                time.sleep(max(0.0, due - time.perf_counter()))
                ask()
            return blocks

        return _cost(work)[0]
