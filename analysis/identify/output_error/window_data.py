"""Data of output error: windows of records, disturbed models, a window's normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify.output_error.shooting import ShootingWindow
from analysis.signals.conditioning import Mask, Signals
from analysis.simulation.simulate import Compiled

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedWindow:
    """One window ready to shoot: inputs, measured outputs (points, 3 F), its place in the data."""

    record: int
    stratum: int
    repeat: int
    part: int
    shooting: ShootingWindow
    measured: Array


@dataclass(frozen=True)
class WindowSource:
    """One record: signals and inputs of the integrator, oil temperature less nominal [K].

    The signals are free of what the model says of sensors.
    """

    signals: Signals
    inputs: Array
    locked: Mask
    kelvin: float


@dataclass(frozen=True)
class ReducedWindow:
    """A window after its start was eliminated: score, information, cost, and how to get back.

    `rest` is the cost that the best start leaves.
    """

    score: Array
    information: Array
    cost: float
    rest: float
    back: Array
    offset: Array
    residual: Array


@dataclass(frozen=True)
class PerturbedModel:
    """The model of one record: as it is, and `pars` (1 + k, parameters) with every nudge.

    `sizes` (k,) are the nudges, `hidden` the terms' own states (n, h) along the record for each.
    """

    ready: Compiled
    pars: Array
    sizes: Array
    hidden: tuple[Array, ...]
