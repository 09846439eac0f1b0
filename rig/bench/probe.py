"""One block of every channel, read without changing the device's outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import Driver, ReportsDoubts, SampleBlock
from rig.bench.settings import BENCH
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire.codes import encode_input

GOOD: Final = "ok"
TIMED_SAMPLES: Final = 100  # samples of a host-timed device for measuring their lateness
MOST_BLOCKS: Final = 400  # longest time [s] for reading them


@dataclass(frozen=True)
class Reading:
    """One channel over one block: mean, extremes [SI unit], converter codes, and a mark.

    `mark` is ``ok`` or the reason why the values are not plausible.
    """

    channel: str
    unit: str
    mean: float
    low: float
    high: float
    codes: tuple[int, int]
    mark: str


@dataclass(frozen=True)
class Lateness:
    """Lateness [s] of a host-timed device's samples: mean and standard deviation."""

    samples: int
    mean: float
    jitter: float


def probe(driver: Driver, rig: Rig) -> list[Reading]:
    """Connect, read one block, close; outputs stay at zero. Raises DeviceError, DeviceLost."""
    return probe_timed(driver, rig)[0]


def probe_timed(driver: Driver, rig: Rig) -> tuple[list[Reading], Lateness | None, str | None]:
    """Read one block as `probe` does; several of a host-timed device, to measure the lateness.

    Also returns the cause of the device's trip, None if it has not tripped.
    """
    late: list[NDArray[np.float64]] = []
    try:
        driver.connect()
        cause = driver.trip_cause()
        driver.start()
        block = driver.read_block()
        latest = block
        for _ in range(MOST_BLOCKS):
            if latest.read_at is None or sum(map(len, late)) >= TIMED_SAMPLES:
                break
            latest = driver.read_block()
            if latest.read_at is not None:
                nominal = (latest.tick + np.arange(len(latest.data))) / rig.sample_rate
                late.append((latest.read_at - nominal)[np.isfinite(latest.read_at)])
        driver.stop()
        doubts = driver.doubts() if isinstance(driver, ReportsDoubts) else {}
    finally:
        driver.close()
    samples = np.concatenate(late) if late else np.empty(0)
    n = len(samples)
    timing = Lateness(n, float(samples.mean()), float(samples.std())) if n else None
    marked = [
        replace(reading, mark=doubts.get(reading.channel, reading.mark))
        for reading in readings(block, rig)
    ]
    return marked, timing, cause


def readings(block: SampleBlock, rig: Rig) -> list[Reading]:
    """Return the reading of each channel of a block, in the order of the rig's channels."""
    supply = _supply(block, rig)
    return [_reading(name, k, block, rig, supply) for k, name in enumerate(rig.channels)]


def pressurised(readings: Sequence[Reading]) -> list[str]:
    """Return the chambers and the supply still under pressure, as `joint 1 cap 3.50 MPa`."""
    return [
        f"{place} {reading.mean / 1e6:.2f} MPa"
        for place, reading in _pressures(readings)
        if reading.mean > BENCH.empty_pressure
    ]


def unknown_pressures(readings: Sequence[Reading]) -> list[str]:
    """Return the chambers and the supply whose sensors do not show whether they are empty.

    A broken wire reads the low end of the converter's range, or is not a number.
    """
    return [
        f"{place} ({reading.mark})"
        for place, reading in _pressures(readings)
        if reading.mark != GOOD and not reading.mean > BENCH.empty_pressure
    ]


def _pressures(readings: Sequence[Reading]) -> Iterator[tuple[str, Reading]]:
    """Yield place and reading of each pressure."""
    for reading in readings:
        kind, joint = ch.kind_of(reading.channel)
        if kind == ch.SUPPLY:
            yield "supply", reading
        elif kind in (ch.CAP, ch.ROD):
            yield f"joint {joint} {kind.split('_')[0]}", reading


def _supply(block: SampleBlock, rig: Rig) -> float:
    if ch.SUPPLY in rig.channels:
        return float(np.mean(block.data[:, rig.channels.index(ch.SUPPLY)]))
    return rig.supply.pressure


def _reading(name: str, column: int, block: SampleBlock, rig: Rig, supply: float) -> Reading:
    x = block.data[:, column]
    kind = ch.kind_of(name)[0]
    sensor = rig.sensors.of(kind)
    finite = np.nan_to_num(x)
    codes = encode_input([finite.min(), finite.max()], *sensor.range, sensor.bits)
    return Reading(
        name,
        rig.unit_of(name),
        float(x.mean()),
        float(x.min()),
        float(x.max()),
        (int(codes[0]), int(codes[1])),
        _mark(kind, x, block.saturated[:, column], supply, sensor.noise),
    )


def _mark(
    kind: str, x: NDArray[np.float64], saturated: NDArray[np.bool_], supply: float, noise: float
) -> str:
    if not np.isfinite(x).all():
        return "not a number"
    if saturated.any():
        return "at the end of its converter's range: a broken wire, or a value out of range"
    if kind in (ch.CAP, ch.ROD) and x.mean() > supply + 5 * noise:
        return f"above the supply pressure of {supply / 1e6:.2f} MPa"
    if kind in (ch.CAP, ch.ROD, ch.SUPPLY) and x.mean() < -5 * noise - BENCH.empty_pressure:
        return "below zero"
    return GOOD
