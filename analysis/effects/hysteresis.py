"""Hysteresis between the spool's LVDT and the metering edges.

    x = u - g mean_k (u - x_k), |u - x_k| <= r_k, x_k moves only when pushed

The play operators' half widths r_k spread about w / (2 g) (Krasnosel'skii and Pokrovskii 1989;
Prandtl and Ishlinskii: Brokate and Sprekels 1996, chapter 2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from analysis.effects.base import NULL, Array, Shape
from analysis.effects.valve import ValveEffect
from analysis.signals.conditioning import Signals
from analysis.terms.base import PREPARE, U, kernel
from rig.model.rig import Rig

PLAY_TIME: Final = 5e-4  # [s] time constant of a play operator in simulation
OPERATORS: Final = 8  # of play, where their widths spread
# Widths of the operators over their mean where they spread most: the means of equal parts of an
# exponential distribution, as of friction that builds up along the spool's travel (Dahl 1968).
_ENDS: Final = -np.log1p(-np.arange(OPERATORS) / OPERATORS)
_MOMENTS: Final = np.append((1.0 + _ENDS) * np.exp(-_ENDS), 0.0)
WIDTHS: Final = -OPERATORS * np.diff(_MOMENTS)


@kernel
def _play(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        i = int(par[0])
        u = x[U, i]
        mean = 0.0
        for k in range(OPERATORS):
            pushed = min(max(z[k], u - par[2 + k]), u + par[2 + k])
            dz[k] = (pushed - z[k]) / PLAY_TIME
            mean += pushed / OPERATORS
        x[U, i] = mean + par[1] * (mean - u)


@dataclass(frozen=True)
class SpoolHysteresis(ValveEffect):
    """The opening follows the LVDT with play: |u - x| <= w / 2, x moves only when pushed.

    Backlash of a feedback spring or a linkage. Friction or a magnet reverses the offset u - x along
    some travel: the operators' widths then spread, from 0, all alike, to 1, an exponential
    distribution. g, 1 + the steepness, is the slope of the offset over u just after a reversal; the
    opening moves against the spool where it is above 1. The operators' outputs are hidden states.
    """

    name = "spool_hysteresis"
    smallest_shape = (2e-3,)  # [V]
    mechanism = "spool_dynamics"
    stage = NULL  # before the lag: a pilot has friction, the stage behind it lags
    variable = "the sign of the spool's velocity"
    confounders = ("spool_lag", "valve_deadband", "channel_delay")
    separated_by = (
        "two frequencies of one amplitude: hysteresis stays the same, a lag grows with the rate"
    )
    shape_stems = ("w_hysteresis", "spread", "steepness")
    kernel = _play

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the width [V], up to a quarter of the spool's stroke, and how it reverses."""
        stroke = rig.joints[self.joint].valve.spool_stroke
        grid = (0.002 * stroke, 0.006 * stroke, 0.02 * stroke)
        width, spread, steepness = self.shape_names()
        return (
            Shape(width, "V", 0.0, 0.25 * stroke, grid, 0.0),
            Shape(spread, "", 0.0, 1.0, (0.5,), resolution=True, detail=True, saturates=True),
            Shape(steepness, "", -0.8, 5.0, (0.5,), detail=True),
        )

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the width with reversals that need travel, from slow to steep."""
        if len(shape) > 1:
            return (tuple(shape),)
        return tuple((shape[0], *start) for start in ((0.5, 0.0), (0.9, 1.0), (0.9, 2.5)))

    def hidden(self, rig: Rig) -> int:
        """Return the number of play operators."""
        return OPERATORS

    def half_widths(self, rig: Rig, shape: Sequence[float]) -> Array:
        """Return half of each operator's width (m,) [V]."""
        width, spread, steepness = self.full_shape(rig, shape)
        return 0.5 * width / (1.0 + steepness) * (1.0 + spread * (WIDTHS - 1.0))

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Remove the play from the spool's signal."""
        return self.with_opening(signals, self.opening(rig, signals.u[:, self.joint], shape))

    def opening(self, rig: Rig, u: Array, shape: Sequence[float]) -> Array:
        """Return the opening (n,) [V] along the spool u (n,) [V]."""
        mean = self.operators(rig, u, shape).mean(axis=1)
        return np.asarray(mean + self.full_shape(rig, shape)[2] * (mean - u))

    def operators(self, rig: Rig, u: Array, shape: Sequence[float]) -> Array:
        """Return the operators' outputs (n, m) [V] along the spool u (n,) [V]."""
        u = np.ascontiguousarray(u)
        return np.column_stack([play_output(u, half) for half in self.half_widths(rig, shape)])

    def hidden_path(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the operators' outputs (n, m) [V]."""
        return self.operators(rig, signals.u[:, self.joint], shape)

    def fastest(self, shape: Sequence[float]) -> float:
        """Return the rate at which the simulated play follows the spool."""
        return 1.0 / PLAY_TIME

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, steepness, half of each operator's width [V]."""
        steepness = self.full_shape(rig, shape)[2]
        return np.array([self.joint, steepness, *self.half_widths(rig, shape)], dtype=np.float64)


@njit(cache=True)
def play_output(u, half):  # type: ignore[no-untyped-def]
    """Return the output (n,) of a play operator with input u (n,) and half width `half`."""
    x = np.empty_like(u)
    x[0] = u[0]
    for k in range(1, len(u)):
        x[k] = min(max(x[k - 1], u[k] - half), u[k] + half)
    return x


TERMS = (SpoolHysteresis,)
