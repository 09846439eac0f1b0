"""The compiled right-hand side as a Python function, for independent integrators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from analysis.simulation import equations as eq
from analysis.simulation.simulate import Compiled, DrivingInput
from rig.model.records import Array


def rates_of(ready: Compiled, drive: DrivingInput) -> Callable[[float, Array], Array]:
    """Return dy/dt(t, y) of a compiled model under a drive."""
    inputs, work = drive.inputs, ready.work()

    def rates(t: float, y: Array) -> Array:
        dy = np.zeros_like(y)
        eq.evaluate(
            ready.address, t, np.ascontiguousarray(y), dy, inputs, drive.rate, drive.locked,
            ready.geometry, ready.par, ready.context, work,
        )  # fmt: skip
        return dy

    return rates
