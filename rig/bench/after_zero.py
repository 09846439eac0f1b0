"""What is recorded after the outputs were zeroed: the proof that they were."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from drivers.base import DeviceError, SampleBlock
from rig.bench.settings import BENCH
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed

log = logging.getLogger(__name__)


def record_zero(
    rig: Rig,
    read: Callable[[], SampleBlock],
    keep: Callable[[SampleBlock], None],
    clock: Callable[[], float],
    seconds: float = BENCH.zero_seconds,
) -> bool | None:
    """Read and keep blocks until `seconds` of samples in a row have every command at zero.

    To be called with the outputs zeroed. Returns True when they are there, False when the device
    still reports a command, None when it or the disk failed before either was known. Ends after
    `seconds + QUEUED` of device time, or that much wall time and two answer times.
    """
    wanted = round(seconds * rig.sample_rate)
    most = round((seconds + BENCH.queued_seconds) * rig.sample_rate)
    deadline = clock() + seconds + BENCH.queued_seconds + 2 * rig.wire.timeout
    quiet = taken = 0
    moving = False
    while quiet < wanted and taken < most and clock() < deadline:
        try:
            block = read()
            keep(block)
        except (DeviceError, RecordingFailed) as error:
            log.warning("%.1f s recorded after zeroing: %s", taken / rig.sample_rate, error)
            return None
        commands = block.data[:, len(rig.channels) :]
        nonzero = np.flatnonzero((commands != 0.0).any(axis=1))
        moving = bool(len(nonzero)) and int(nonzero[-1]) == len(block.data) - 1
        quiet = len(block.data) - 1 - int(nonzero[-1]) if len(nonzero) else quiet + len(block.data)
        taken += len(block.data)
    if moving:
        return False
    return True if quiet >= wanted else None
