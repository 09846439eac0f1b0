"""Hours of one unattended recording: memory, storage per hour, how long an append takes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from rig.bench.session import Bench
from rig.runs.listing.summary import summarise
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from tests.services.fake_driver import FakeDriver

_BLOCK = 100  # [samples] at 1 kHz: 100 ms
_RECORD_SECONDS = 300.0
_WARM = 0.05  # of the run: allocators and caches have settled by then


@dataclass(frozen=True)
class Endurance:
    """Figures of a long run; memory is the process's resident set [byte], times [s].

    `append_cpu_p99` is the processor's time of an append: what other programs of a busy computer
    add to it on the clock is in `append_p99`.
    """

    hours: float
    samples: int
    kept: int
    append_p50: float
    append_p99: float
    append_max: float
    append_cpu_p99: float
    memory_begin: int
    memory_end: int
    growth: float
    bytes_per_hour: float
    finalise_seconds: float
    seconds: float


def _resident() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise OSError("/proc/self/status: no VmRSS")


class _Timed(Recorder):
    """A recorder that notes how long each append took, and the memory after it."""

    def __init__(self, folder: Path, blocks: int) -> None:
        super().__init__(folder, load_rig("shinshu-2dof"))
        # Allocated and touched now, so that the measurement does not grow with the run.
        self.took = np.full(blocks + 1000, np.nan)
        self.cpu = np.full(blocks + 1000, np.nan)
        self.memory = np.zeros(blocks + 1000, dtype=np.int64)
        self.count = 0

    def append(self, block: SampleBlock, late: float | None) -> None:
        began, cpu = time.perf_counter(), time.thread_time()
        super().append(block, late)
        self.cpu[self.count] = time.thread_time() - cpu
        self.took[self.count] = time.perf_counter() - began
        if self.count % 1000 == 0:
            self.memory[self.count] = _resident()
        self.count += 1


def endure(folder: Path, hours: float) -> Endurance:
    """Record `hours` of a bench's time in blocks of 100 ms and finish the run."""
    began = time.monotonic()
    rig = load_rig("shinshu-2dof")
    blocks = round(hours * 3600.0 * rig.sample_rate / _BLOCK)
    recorder = _Timed(folder, blocks)
    driver: Any = FakeDriver(rig, block_samples=_BLOCK)
    repeat = 0
    with Bench(rig, driver, recorder, signals=False) as bench:
        bench.exchange()
        while recorder.count < blocks:
            repeat += 1
            left = min(round(_RECORD_SECONDS * rig.sample_rate / _BLOCK), blocks - recorder.count)
            with bench.record(step="s", repeat=repeat):
                for _ in range(left):
                    bench.exchange()
        journal = sum(path.stat().st_size for path in folder.glob("journal.sqlite*"))
        finalise = time.monotonic()
    finalise = time.monotonic() - finalise
    took = recorder.took[: recorder.count]
    memory = recorder.memory[: recorder.count][::1000]
    first = int(memory[int(_WARM * len(memory))])
    last = int(memory[-1])
    counted = summarise(folder)
    return Endurance(
        hours,
        recorder.count * _BLOCK,
        counted.samples + counted.outside,
        float(np.percentile(took, 50)),
        float(np.percentile(took, 99)),
        float(took.max()),
        float(np.percentile(recorder.cpu[: recorder.count], 99)),
        first,
        last,
        last / first - 1.0,
        journal / hours,
        finalise,
        time.monotonic() - began,
    )


def endurance_text(found: Endurance) -> str:
    """Return the figures as text."""
    return (
        f"{found.hours:g} simulated hours: {found.samples} samples recorded, {found.kept} kept; "
        f"append of a 100 ms block: p50 {1e3 * found.append_p50:.2f} ms, p99 "
        f"{1e3 * found.append_p99:.2f} ms, longest {1e3 * found.append_max:.1f} ms "
        f"({1e3 * found.append_cpu_p99:.2f} ms of the processor's time at p99); memory "
        f"{found.memory_begin / 2**20:.1f} to {found.memory_end / 2**20:.1f} MiB "
        f"({100 * found.growth:+.2f} %); {found.bytes_per_hour / 2**20:.0f} MiB an hour; archive "
        f"written and verified in {found.finalise_seconds:.0f} s; took {found.seconds:.0f} s"
    )
