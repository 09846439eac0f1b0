"""Bandwidth of the motion in records whose excited lines are not known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.records import bridged
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
    positions = [bridged(channels[ch.channel(rig.position_kind, i)]) for i in free]
    moving = [x for x in positions if np.ptp(x) > 0.0]
    if not moving or len(moving[0]) < EXCHANGE.bandwidth_seconds * rate:
        return None
    return max(_bandwidth(x, rate) for x in moving)


def _bandwidth(position: Array, rate: float) -> float:
    """Return the bandwidth [Hz] of a position (n,), by a periodogram with Hann's window.

    Lines that noise may cause do not count. White noise is measured in the upper half of the
    spectrum, where its power is exponentially distributed about the mean, median / ln 2.
    """
    power = np.abs(np.fft.rfft((position - np.mean(position)) * np.hanning(len(position)))) ** 2
    f = np.fft.rfftfreq(len(position), 1.0 / rate)
    noise = float(np.median(power[f > 0.25 * rate])) / np.log(2.0)
    inside = f <= EXCHANGE.highest
    seen = np.where(power > EXCHANGE.above_noise * noise, power, 0.0)[inside]
    if not seen.any():
        return EXCHANGE.highest
    velocity = np.cumsum(seen * f[inside] ** 2)
    return float(f[inside][np.searchsorted(velocity, EXCHANGE.velocity_share * velocity[-1])])
