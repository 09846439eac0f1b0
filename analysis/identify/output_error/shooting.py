"""Many trajectories of one window at once, all by the same fixed steps (RK4), compiled.

Sensitivities are differences of neighbouring trajectories. An adaptive integrator would choose
other steps for each, and that noise divided by a small difference is no derivative; with one grid
for all the differences are smooth ("internal numerical differentiation", Bock 1981). A step spans
two samples of the inputs, so that its midpoint is a sample and nothing is interpolated; it is cut
into parts where a term's hidden state (a contact's deflection, a lagging spool) relaxes faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.simulation import integrator
from analysis.simulation.simulate import Compiled
from analysis.terms.base import OUT_ROWS, X_ROWS, Used

Array = NDArray[np.float64]

SAMPLES_PER_STEP = 2


@njit(cache=True, error_model="numpy", nogil=True)
def _shoot(model, pars, starts, inputs, rate, locked, geometry, first, every, parts, out, work):  # type: ignore[no-untyped-def]
    """Fill out (P, points, size), a point every `every` steps of `parts` each; return success."""
    trajectories, points, size = out.shape
    h = SAMPLES_PER_STEP / (rate * parts)
    start = first / rate
    k = np.zeros((4, size))
    trial = np.zeros(size)
    for p in range(trajectories):
        y = starts[p].copy()
        mine = (model[0], model[1], model[2], model[3], pars[p])
        out[p, 0] = y
        for point in range(1, points):
            for step in range(every * parts):
                t = start + h * ((point - 1) * every * parts + step)
                for stage in range(4):
                    part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                    for j in range(size):
                        trial[j] = y[j] + (part * h * k[stage - 1, j] if stage else 0.0)
                    status = integrator.rates(
                        t + part * h, trial, k[stage], inputs, rate, locked, geometry, mine, work
                    )
                    if status != integrator.OK:
                        return False
                for j in range(size):
                    y[j] += h / 6.0 * (k[0, j] + 2.0 * (k[1, j] + k[2, j]) + k[3, j])
            out[p, point] = y
    return bool(np.isfinite(out).all())


def parts_of(terms: Sequence[Used], rate: float) -> int:
    """Return into how many steps two samples are cut, so that every hidden state is stable."""
    fastest = max((used.term.fastest(used.shape) for used in terms), default=0.0)
    return max(1, math.ceil(fastest * SAMPLES_PER_STEP / (rate * IDENTIFY.stable_step)))


@dataclass(frozen=True)
class ShootingWindow:
    """A stretch of a record: its first sample and how many points are compared."""

    first: int
    points: int


def shoot(
    ready: Compiled,
    pars: Array,
    starts: Array,
    inputs: Array,
    rate: float,
    locked: NDArray[np.bool_],
    window: ShootingWindow,
    every: int,
    parts: int = 1,
) -> Array | None:
    """Return the states (P, points, size) from `starts` (P, size) with `pars` (P, parameters).

    A point every 2 x `every` samples, each two samples in `parts` steps. None where a state ceased
    to exist.
    """
    N = len(locked)
    work = (
        np.zeros(4), np.zeros((X_ROWS, N)), np.zeros((OUT_ROWS, N)), np.zeros((N, N)), np.zeros(N),
    )  # fmt: skip
    out = np.zeros((len(starts), window.points, starts.shape[1]))
    model = (ready.addresses, ready.ends, ready.hidden_ends, ready.prepares)
    good = _shoot(
        model, pars, starts, inputs, rate, locked, ready.geometry, window.first, every, parts, out,
        work,
    )  # fmt: skip
    return out if good else None
