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
    """A window ready to simulate: inputs, measured outputs (points, 3 F), its record and part."""

    record: int
    stratum: int
    repeat: int
    part: int
    shooting: ShootingWindow
    measured: Array


@dataclass(frozen=True)
class WindowSource:
    """One record: signals and inputs of the integrator, oil temperature above nominal [K].

    The signals are corrected for the model's sensor effects.
    """

    signals: Signals
    inputs: Array
    locked: Mask
    kelvin: float


@dataclass(frozen=True)
class ReducedWindow:
    """A window after its start was eliminated: score, information, cost and back substitution.

    `rest` is the cost at the best start.
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
    """One record's model; `pars` (1 + k, parameters) as it is and with each parameter perturbed.

    `sizes` (k,) are the perturbations, `hidden` the terms' hidden states (n, h) along the record
    for each.
    """

    ready: Compiled
    pars: Array
    sizes: Array
    hidden: tuple[Array, ...]
