"""Quality of acquisition over a wire: lost samples, late blocks, scatter of arrival times."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.base import DeviceInfo, Driver


def measure_acquisition(
    driver: Driver,
    info: DeviceInfo,
    seconds: float,
    clock: Callable[[], float] = time.perf_counter,
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
