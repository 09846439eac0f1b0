"""An hour of the clock unattended: a simulated bench and `bramah run`, each a process of its own.

The memory of the run is read from outside, once in five seconds, and the run folder is judged
afterwards as a person would: its state, its samples, what was lost, and how much disk it took.
"""

from __future__ import annotations

import math
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import yaml

from protocols.files import library
from protocols.files.plan import Overrides, resolve
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.runs.listing.summary import summarise
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_state

_RIG = "shinshu-2dof"
_PROTOCOL = "lock-and-excite"
_EVERY = 5.0  # [s] between two readings of the memory
_SETTLED = 300.0  # [s] after which the memory is compared: compilers and caches have ended by then
_WINDOW = 12  # readings whose median is one figure: a minute
_START = "from rig.cli.main import run; run()"


@dataclass(frozen=True)
class Unattended:
    """Figures of a run in real time; memory is the run's resident set [byte], times [s]."""

    hours: float
    state: str
    exit_code: int
    records: int
    samples: int
    lost: int
    memory_begin: int
    memory_end: int
    growth: float
    growth_anonymous: float
    journal_per_hour: float
    archive_per_hour: float
    seconds: float
    wrong: tuple[str, ...]


def _memory(pid: int) -> tuple[int, int]:
    """Return a process's resident set and the part of it that is no file's [byte]; 0, 0 if gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0, 0
    sizes = {line.split(":")[0]: line.split() for line in lines}
    if "VmRSS" not in sizes or "RssAnon" not in sizes:
        return 0, 0
    return int(sizes["VmRSS"][1]) * 1024, int(sizes["RssAnon"][1]) * 1024


def _rig_text(watchdog: float | None) -> str:
    """Return the shipped rig's file; with another watchdog [s] of the device where stated."""
    text = (resources.files("rig") / "shipped" / f"{_RIG}.yaml").read_text("utf-8")
    if watchdog is None:
        return text
    described = yaml.safe_load(text)
    described["wire"]["watchdog"] = f"{watchdog:g} s"
    return str(yaml.safe_dump(described))


def _repeats(seconds: float) -> int:
    """Return the repeats with which the protocol takes at least `seconds`."""
    rig = load_rig(_RIG)
    protocol = library.load(_PROTOCOL)
    once, twice = (resolve(protocol, rig, Overrides(repeats=k)).seconds for k in (1, 2))
    return max(1, 1 + math.ceil((seconds - once) / (twice - once)))


def unattended(folder: Path, hours: float, seed: int, watchdog: float | None) -> Unattended:
    """Run the protocol for `hours` of the clock over Modbus TCP and judge what it left."""
    folder.mkdir(parents=True, exist_ok=True)
    run, log = folder / "run", folder / "run.log"
    described = folder / "rig.yaml"
    described.write_text(_rig_text(watchdog), "utf-8")
    readings: list[tuple[float, int, int, int]] = []
    began = time.monotonic()
    with (
        simulated_bench(str(described), seed=seed, real_time=True) as endpoint,
        log.open("w", encoding="utf-8") as output,
        subprocess.Popen(
            [
                sys.executable, "-c", _START, "run", _PROTOCOL, "--rig", str(described),
                "--endpoint", endpoint, "--out", str(run), "--unattended",
                "--repeats", str(_repeats(3600.0 * hours)),
            ],
            stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True,
        ) as child,
    ):  # fmt: skip
        try:
            while child.poll() is None:
                time.sleep(_EVERY)
                journal = sum(path.stat().st_size for path in run.glob("journal.sqlite*"))
                whole, anonymous = _memory(child.pid)
                if whole and journal:
                    readings.append((time.monotonic() - began, whole, anonymous, journal))
                    _append(folder / "memory.csv", readings[-1])
        finally:
            child.terminate()
    return _figures(run, child.returncode, np.array(readings), time.monotonic() - began)


def _append(path: Path, reading: tuple[float, int, int, int]) -> None:
    with path.open("a", encoding="ascii") as file:
        file.write(",".join(f"{value:.1f}" for value in reading) + "\n")


def _figures(run: Path, code: int, readings: np.ndarray, seconds: float) -> Unattended:
    summary = summarise(run)
    state = read_state(run)
    hours = (readings[-1, 0] - readings[0, 0]) / 3600.0
    settled = readings[readings[:, 0] - readings[0, 0] >= min(_SETTLED, 0.1 * 3600.0 * hours)]
    first = np.median(settled[:_WINDOW, 1:3], axis=0)
    last = np.median(settled[-_WINDOW:, 1:3], axis=0)
    growth, anonymous = (float(share) for share in last / first - 1.0)
    wrong = [f"state {state}, exit code {code}"] if (state, code) != ("done", 0) else []
    wrong += [f"{summary.lost_samples} samples lost"] if summary.lost_samples else []
    wrong += [f"memory grew by {100 * growth:.1f} %"] if growth >= 0.05 else []
    return Unattended(
        hours=hours,
        state=state,
        exit_code=code,
        records=summary.records,
        samples=summary.samples + summary.outside,
        lost=summary.lost_samples,
        memory_begin=int(first[0]),
        memory_end=int(last[0]),
        growth=growth,
        growth_anonymous=anonymous,
        journal_per_hour=float(readings[:, 3].max()) / hours,
        archive_per_hour=(run / "records.h5").stat().st_size / hours,
        seconds=seconds,
        wrong=tuple(wrong),
    )


def unattended_text(found: Unattended) -> str:
    """Return the figures as text."""
    lines = [
        f"{found.hours:.2f} hours of the clock: {found.state}, {found.records} records, "
        f"{found.samples} samples, {found.lost} lost; memory "
        f"{found.memory_begin / 2**20:.1f} to {found.memory_end / 2**20:.1f} MiB "
        f"({100 * found.growth:+.2f} %, without files {100 * found.growth_anonymous:+.2f} %); "
        f"journal {found.journal_per_hour / 2**20:.0f} MiB an hour, archive "
        f"{found.archive_per_hour / 2**20:.0f} MiB an hour; took {found.seconds:.0f} s"
    ]
    return "\n".join([*lines, *(f"WRONG {text}" for text in found.wrong)])
