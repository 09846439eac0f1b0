"""Inputs of the bench's converters: one row per channel for the compiled tick loop.

Channel k of `rig.channels` is converted k skews after the tick (the multiplexer runs ahead of the
tick: along the tangent of the true signal), and shows the signal `delay` before that (cubic Hermite
through earlier ticks). Then gain, offset, noise, and the converter code (`rig.model.wire.codes`).
"""

from __future__ import annotations

import math

import numpy as np

from hil_sim.plant.kernel_data import CHANNEL, KIND, Table
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
        row = {
            "kind": KIND[kind],
            "joint": (joint or 1) - 1,
            "noise": sensor.noise * noise,
            "gain": 1.0,
            "lag": sensor.delay - k * rig.sensors.skew,
            "low": low,
            "step": (high - low) / top,
            "scale": top / (high - low),
            "top": top,
        }
        for field, value in row.items():
            table[field][k] = value
    return table


def ring_length(table: Table, period: float) -> int:
    """Return how many ticks of history the longest lag needs."""
    longest = float(np.max(table["lag"], initial=0.0))
    return max(math.ceil(longest / period), 0) + 3
