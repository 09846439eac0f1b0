"""What the bench's converters see: one row per channel for the compiled tick loop.

Channel k of `rig.channels` is converted k skews after the tick (the multiplexer runs ahead of the
tick: along the tangent of the true signal), and shows the world as it was `delay` before that
(cubic Hermite through earlier ticks). Then gain, offset, noise, and the code of `rig.model.codes`.
"""

from __future__ import annotations

import math

import numpy as np

from hil_sim.kernel_data import CHANNEL, KIND, Table
from rig.model import codes
from rig.model.channels import kind_of
from rig.model.rig import Rig


def channel_table(rig: Rig, noise: float) -> Table:
    """Return the sensors of `rig` in the order of its channels, noise scaled; shape (channels,)."""
    table = np.zeros(len(rig.channels), CHANNEL)
    for k, name in enumerate(rig.channels):
        kind, joint = kind_of(name)
        sensor = rig.sensors.of(kind)
        low, high = sensor.range
        top = (1 << sensor.bits) - 1
        table[k] = (
            KIND[kind],
            (joint or 1) - 1,
            sensor.noise * noise,
            1.0,
            0.0,
            sensor.delay - k * rig.sensors.skew,
            low,
            (high - low) / top,
            top,
        )
    return table


def ring_length(table: Table, period: float) -> int:
    """Return how many ticks of history the longest lag needs."""
    longest = float(np.max(table["lag"], initial=0.0))
    return max(math.ceil(longest / period), 0) + 3


def encode(rig: Rig, measured: codes.Array) -> codes.Codes:
    """Return the AD codes of measured SI values, both (ticks, channels)."""
    out = np.empty(measured.shape, dtype=np.int64)
    for k, name in enumerate(rig.channels):
        sensor = rig.sensors.of(kind_of(name)[0])
        out[:, k] = codes.encode_input(measured[:, k], *sensor.range, sensor.bits)
    return out
