"""Recording after the outputs were zeroed, as proof that they are at zero."""

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
    seconds: float,
) -> bool | None:
    """Record blocks until every command has been zero for `seconds` of consecutive samples.

    Call with the outputs zeroed. Returns True for such samples, False if the device still reports
    a command, None if the device or the disk failed first. Ends after `seconds` plus
    `BENCH.queued_seconds` of device time, or that much wall time plus two answer times.
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
