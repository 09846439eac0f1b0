"""Bandwidth of the motion in records whose excited lines are not known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.rig import Rig
from rig.runs.exchange.settings import EXCHANGE

Array = NDArray[np.float64]


def motion_bandwidth(
    rig: Rig, locked: tuple[int, ...], channels: Mapping[str, Array], rate: float
) -> float | None:
    """Return the frequency [Hz] below which `EXCHANGE.velocity_share` of each velocity's power is.

    `channels` are positions (n,) and others by name, `rate` [Hz]. None where no joint moves, and
    for a record shorter than `EXCHANGE.bandwidth_seconds`, which needs all its rows.
    """
    free = [i for i in range(1, len(rig.joints) + 1) if i not in locked]
    positions = [channels[ch.channel(rig.position_kind, i)] for i in free]
    moving = [x for x in positions if np.ptp(x) > 0.0]
    if not moving or len(moving[0]) < EXCHANGE.bandwidth_seconds * rate:
        return None
    return max(_bandwidth(x, rate) for x in moving)


def _bandwidth(position: Array, rate: float) -> float:
    """Return the bandwidth [Hz] of a position (n,), by a periodogram with Hann's window."""
    spectrum = np.fft.rfft((position - np.mean(position)) * np.hanning(len(position)))
    f = np.fft.rfftfreq(len(position), 1.0 / rate)
    inside = f <= EXCHANGE.highest
    power = np.cumsum((np.abs(spectrum[inside]) * f[inside]) ** 2)
    return float(f[inside][np.searchsorted(power, EXCHANGE.velocity_share * power[-1])])
