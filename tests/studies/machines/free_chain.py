"""A planar chain that swings freely: no torque, so parameters are identifiable up to one scale.

Without torque the rows are X p = 0 for any multiple of p. One parameter is fixed (`Scale`) and its
column taken to the right-hand side; the rest is the same algebra of rows as everywhere: the same
terms, channels through the wide filter, whole rows through the narrow one
(`analysis.regression.rows`).

The simulation is the chain of NOTES in absolute angles, many trajectories at once:
 sum_j R_ij cos(th_i - th_j) th_j'' = - sum_j R_ij sin(th_i - th_j) th_j'^2 - W_i g sin th_i
                                     - (f_i - f_i+1),  f_i = Fv_i (th_i' - th_i-1'),
by Runge and Kutta's fourth-order rule, one step per sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.settings import REGRESSION
from analysis.signals.conditioning import Signals
from analysis.signals.filters import channel_filter, row_filter, row_step
from analysis.terms import make
from analysis.terms.base import equation
from analysis.terms.mechanics import chain_matrix
from rig.model.parameters import mechanical_names
from rig.model.rig import Rig

Array = NDArray[np.float64]

TERMS = ("inertia", "viscous_friction", "gravity")
SHOOTING_ROUNDS, HALVINGS = 6, 8
STEP_OF_PARAMETER, STEP_OF_START = 1e-5, 1e-6  # finite differences: relative; rad and rad/s


@dataclass(frozen=True)
class Swing:
    """A free motion: absolute angles (n, N) [rad], 0 hanging, at `rate` [Hz]."""

    rate: float
    theta: Array


@dataclass(frozen=True)
class Scale:
    """The parameter that is fixed, and the value it is given."""

    name: str
    value: float


def free_rows(rig: Rig, swing: Swing) -> dict[str, Array]:
    """Return the filtered rows (m, k) of every joint's torque balance, columns by name's order.

    Of `rig` only the number of joints and gravity are used.
    """
    filters, rows = channel_filter(swing.rate), row_filter(swing.rate, REGRESSION.row_cutoff)
    theta, rate, acceleration = (filters.apply(swing.theta, order) for order in range(3))
    signals = _signals(swing.rate, *(_relative(x) for x in (theta, rate, acceleration)))
    names = mechanical_names(len(rig.joints))
    out = {}
    inside = slice(filters.reach, len(theta) - filters.reach)
    for i in range(len(rig.joints)):
        matrix = np.zeros((len(theta), len(names)))
        for term in map(make, TERMS):
            for name, column in (
                term.columns(rig, signals, ()).get(equation("torque", i), {}).items()
            ):
                matrix[:, names.index(name)] += column
        out[equation("torque", i)] = rows.decimate(
            matrix[inside], row_step(swing.rate, REGRESSION.row_cutoff)
        )
    return out


def identify_free(rig: Rig, swings: Sequence[Swing], scale: Scale) -> dict[str, float]:
    """Return the mechanical parameters by least squares over all swings, one of them fixed."""
    names = mechanical_names(len(rig.joints))
    X = np.vstack([matrix for swing in swings for matrix in free_rows(rig, swing).values()])
    fixed = names.index(scale.name)
    rest = [k for k in range(len(names)) if k != fixed]
    size = np.linalg.norm(X[:, rest], axis=0)
    found = np.linalg.lstsq(X[:, rest] / size, -scale.value * X[:, fixed], rcond=None)[0] / size
    values = dict(zip([names[k] for k in rest], map(float, found), strict=True))
    return {name: values.get(name, scale.value) for name in names}


def simulate_free(rig: Rig, values: Mapping[str, float], start: Array, samples: int) -> Array:
    """Return absolute angles (samples, trajectories, N) from starts (trajectories, 2 N).

    A start holds absolute angles, then rates; a sample is 1 / rig.sample_rate.
    """
    names = mechanical_names(len(rig.joints))
    p = np.tile([values[name] for name in names], (len(start), 1))
    return _simulate(rig, p, start, samples)


def measured_starts(swing: Swing, firsts: Sequence[int]) -> Array:
    """Return states (len(firsts), 2 N) from the filtered angles at these samples."""
    filters = channel_filter(swing.rate)
    at = list(firsts)
    return np.column_stack([filters.apply(swing.theta, order)[at] for order in (0, 1)])


@dataclass(frozen=True)
class Windows:
    """Stretches of equal length: angles (samples, windows, N), first states (windows, 2 N)."""

    theta: Array
    start: Array


def windows(swings: Sequence[Swing], seconds: float) -> Windows:
    """Cut swings into windows of `seconds`, clear of the filter's edges, one after the other."""
    stretches, starts = [], []
    for swing in swings:
        length, edge = round(seconds * swing.rate), channel_filter(swing.rate).reach
        firsts = range(edge, len(swing.theta) - edge - length + 1, length)
        if firsts:
            stretches += [swing.theta[first : first + length] for first in firsts]
            starts.append(measured_starts(swing, firsts))
    return Windows(np.stack(stretches, axis=1), np.vstack(starts))


def window_error(rig: Rig, values: Mapping[str, float], cut: Windows) -> float:
    """Return the RMS [rad] of simulated less measured angles over all windows."""
    found = simulate_free(rig, values, cut.start, len(cut.theta))
    return float(np.sqrt(np.mean((found - cut.theta) ** 2)))


def refine_free(
    rig: Rig, values: Mapping[str, float], cut: Windows, scale: Scale
) -> tuple[dict[str, float], Windows]:
    """Fit parameters and every window's start by output error (Gauss and Newton, from `values`).

    A step that does not lower the error is halved until it does: a swinging chain soon forgets
    where it started, and the error's valley is narrow. Ends where no step lowers it.
    """
    names = mechanical_names(len(rig.joints))
    free = [k for k, name in enumerate(names) if name != scale.name]
    p, start = np.array([values[name] for name in names]), cut.start
    error = _squares(rig, p, start, cut.theta)
    for _ in range(SHOOTING_ROUNDS):
        dp, dstart = _step(rig, p, start, cut.theta, free)
        for share in 0.5 ** np.arange(HALVINGS):
            lower = _squares(rig, p + share * dp, start + share * dstart, cut.theta)
            if lower < error:
                p, start, error = p + share * dp, start + share * dstart, lower
                break
        else:
            break
    return dict(zip(names, map(float, p), strict=True)), Windows(cut.theta, start)


def _squares(rig: Rig, p: Array, start: Array, theta: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        found = _simulate(rig, np.tile(p, (len(start), 1)), start, len(theta))
        return float(np.sum((found - theta) ** 2))


def _step(
    rig: Rig, p: Array, start: Array, theta: Array, free: Sequence[int]
) -> tuple[Array, Array]:  # fmt: skip
    """Return Gauss and Newton's step of p (k,) and of the starts (windows, 2 N).

    A start belongs to one window: it is eliminated there, which leaves the normal equations of
    the parameters (Bock's multiple shooting, with nothing to tie the windows together).
    """
    residual, slopes = _sensitivities(rig, p, start, theta, free)
    width = start.shape[1]
    normal, side = np.zeros((len(free), len(free))), np.zeros(len(free))
    parts = []
    for w in range(len(start)):
        J, r = slopes[:, :, w].reshape(len(slopes), -1).T, residual[:, w].ravel()
        own, common = J[:, :width], J[:, width:]
        Q = np.linalg.qr(own)[0]
        left = common - Q @ (Q.T @ common)
        normal += left.T @ left
        side += left.T @ r
        parts.append((own, common, r))
    size = np.sqrt(np.diag(normal))
    step = np.linalg.solve(normal / np.outer(size, size), side / size) / size
    dp = np.zeros_like(p)
    dp[list(free)] = step
    dstart = [np.linalg.lstsq(own, r - common @ step, rcond=None)[0] for own, common, r in parts]
    return dp, np.array(dstart)


def _sensitivities(
    rig: Rig, p: Array, start: Array, theta: Array, free: Sequence[int]
) -> tuple[Array, Array]:  # fmt: skip
    """Return theta less simulated (n, windows, N), and its slopes (2 N + free, n, windows, N)."""
    count, width = start.shape
    steps = np.array([STEP_OF_START] * width + [STEP_OF_PARAMETER * p[k] for k in free])
    moves = np.zeros((1 + len(steps), len(p)))
    shifts = np.zeros((1 + len(steps), width))
    shifts[1 : 1 + width] = STEP_OF_START * np.eye(width)
    for row, k in enumerate(free, start=1 + width):
        moves[row, k] = steps[row - 1]
    every_p = np.repeat(p + moves, count, axis=0)
    every_start = (start[None] + shifts[:, None]).reshape(-1, width)
    found = _simulate(rig, every_p, every_start, len(theta))
    found = found.reshape(len(theta), len(moves), count, -1).swapaxes(0, 1)
    return theta - found[0], (found[1:] - found[0]) / steps[:, None, None, None]


def _simulate(rig: Rig, p: Array, start: Array, samples: int) -> Array:
    """Simulate trajectories (T, 2 N), each with parameters of its own (T, k)."""
    N, h = len(rig.joints), 1.0 / rig.sample_rate
    names = mechanical_names(N)
    R = np.stack([chain_matrix(dict(zip(names, row, strict=True)), N) for row in p])
    Fv = p[:, [names.index(f"Fv{i + 1}") for i in range(N)]]
    weight = rig.gravity * p[:, [names.index(f"W{i + 1}") for i in range(N)]]

    def rates(y: Array) -> Array:
        theta, rate = y[:, :N], y[:, N:]
        turn = theta[:, :, None] - theta[:, None, :]
        friction = Fv * np.diff(rate, axis=1, prepend=0.0)
        load = np.diff(friction, axis=1, append=0.0) - weight * np.sin(theta)
        load -= np.einsum("tij,tj->ti", R * np.sin(turn), rate**2)
        return np.hstack((rate, np.linalg.solve(R * np.cos(turn), load[:, :, None])[:, :, 0]))

    out = np.empty((samples, len(start), N))
    y = start
    for n in range(samples):
        out[n] = y[:, :N]
        a = rates(y)
        b = rates(y + 0.5 * h * a)
        c = rates(y + 0.5 * h * b)
        y = y + h / 6 * (a + 2 * (b + c) + rates(y + h * c))
    return out


def _relative(x: Array) -> Array:
    return np.diff(x, axis=1, prepend=0.0)


def _signals(rate: float, q: Array, qd: Array, qdd: Array) -> Signals:
    """Return signals that hold a motion and no hydraulics."""
    n, none, zero = len(q), np.zeros_like(q), np.zeros(len(q))
    return Signals(
        rate=rate, t=np.arange(n) / rate, u=none, s=none, sd=none, q=q, qd=qd, qdd=qdd,
        theta=np.cumsum(q, axis=1), G=np.ones_like(q), p_cap=none, p_rod=none, pd_cap=none,
        pd_rod=none, V_cap=none, V_rod=none, p_s=zero, p_tank=zero, temperature=zero,
        excited=np.ones(q.shape[1], dtype=bool), valid=np.ones(q.shape, dtype=bool),
        lost=np.zeros(q.shape, dtype=bool), bands=np.full(q.shape[1], np.inf),
    )  # fmt: skip
