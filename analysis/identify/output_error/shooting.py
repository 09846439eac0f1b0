"""Simulate many trajectories of one window, all with the same fixed steps (RK4), compiled.

Sensitivities are differences of neighbouring trajectories. An adaptive integrator would choose
different steps for each, and the resulting noise would spoil the small differences; with one grid
for all the differences are smooth ("internal numerical differentiation", Bock 1981). A step spans
two samples of the inputs, so that its midpoint is a sample and nothing is interpolated; it is cut
into parts where a term's hidden state (a contact's deflection, a lagging spool) relaxes faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.simulation.equations import OK, evaluate
from analysis.simulation.simulate import Compiled
from analysis.terms.base import Used

Array = NDArray[np.float64]

SAMPLES_PER_STEP = 2


@njit(cache=True, error_model="numpy", nogil=True)
def _shoot(  # type: ignore[no-untyped-def]
    address, context, pars, geometry, work, starts, inputs, rate, locked, first, every, parts, out
):
    """Fill out (P, points, size), a point every `every` steps of `parts` each; return success."""
    trajectories, points, size = out.shape
    h = SAMPLES_PER_STEP / (rate * parts)
    start = first / rate
    k1, k2, k3, k4 = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    trial = np.zeros(size)
    for p in range(trajectories):
        y = starts[p].copy()
        par = pars[p]
        out[p, 0] = y
        for point in range(1, points):
            for step in range(every * parts):
                t = start + h * ((point - 1) * every * parts + step)
                status = evaluate(
                    address, t, y, k1, inputs, rate, locked, geometry, par, context, work
                )
                for j in range(size):
                    trial[j] = y[j] + 0.5 * h * k1[j]
                status += evaluate(
                    address, t + 0.5 * h, trial, k2, inputs, rate, locked, geometry, par, context,
                    work,
                )  # fmt: skip
                for j in range(size):
                    trial[j] = y[j] + 0.5 * h * k2[j]
                status += evaluate(
                    address, t + 0.5 * h, trial, k3, inputs, rate, locked, geometry, par, context,
                    work,
                )  # fmt: skip
                for j in range(size):
                    trial[j] = y[j] + h * k3[j]
                status += evaluate(
                    address, t + h, trial, k4, inputs, rate, locked, geometry, par, context, work
                )
                if status != OK:
                    return False
                for j in range(size):
                    y[j] += h / 6.0 * (k1[j] + 2.0 * (k2[j] + k3[j]) + k4[j])
            out[p, point] = y
    return bool(np.isfinite(out).all())


def parts_of(terms: Sequence[Used], rate: float) -> int:
    """Return the number of steps in two samples that keeps every hidden state stable."""
    fastest = max((used.term.fastest(used.shape) for used in terms), default=0.0)
    return max(1, math.ceil(fastest * SAMPLES_PER_STEP / (rate * IDENTIFY.stable_step)))


def shoot(
    ready: Compiled,
    pars: Array,
    starts: Array,
    inputs: Array,
    rate: float,
    locked: NDArray[np.bool_],
    first: int,
    points: int,
    every: int,
    parts: int,
) -> Array | None:
    """Return the states (P, points, size) from `starts` (P, size) with `pars` (P, parameters).

    There is a point every 2 x `every` samples from the sample `first` on; two samples take `parts`
    steps. None where a simulation failed.
    """
    out = np.zeros((len(starts), points, starts.shape[1]))
    succeeded = _shoot(
        ready.address, ready.context, pars, ready.geometry, ready.work(), starts, inputs, rate,
        locked, first, every, parts, out,
    )  # fmt: skip
    return out if succeeded else None
