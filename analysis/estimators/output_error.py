"""Output error: the model simulated from free window starts is fitted to what was measured.

Multiple shooting: each record is cut into windows, the state at each window's start is unknown
too, and sum |measured - simulated|^2 / sigma^2 over piston and chamber pressures of the excited
joints is least. Noise in the outputs then biases nothing, for no measured output is in a
regressor. Windows are not tied to each other: what a tie would tell of the parameters is little,
and it would turn what the model gets slowly wrong into bias.
Gauss and Newton with halved steps, the windows' states eliminated (Schur's complement) each time.
Intervals: as for the other estimators, with the windows as parts. Source: Bock (1981) and
Schloeder; Ljung, System Identification (1999), section 3.6.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.checks import Check
from analysis.estimators import nuisance as nu
from analysis.estimators.covariance import Spread, spread
from analysis.estimators.equations import Pieces
from analysis.estimators.shooting import SAMPLES_PER_STEP, Window, shoot
from analysis.model import Estimate, Model
from analysis.rows import default_filtering
from analysis.signals import Signals, condition
from analysis.simulate import Compiled, compiled, drive_of
from analysis.solve import Solution
from analysis.terms.base import Used
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

# The measured spool drives the simulation, and its noise is integrated: after a second it moves the
# piston by as much as its sensor's noise. Tried were 3, 1 and 0.5 s; shorter was the more exact.
WINDOW = 0.5  # [s]
MOST_SECONDS = 150.0  # with more data, fewer windows of each record, evenly spread
POINT_RATE = 250.0  # [Hz] at which outputs are compared; the channels are filtered to 80 Hz
ROUNDS = 8
HALVINGS = 5
SETTLED = 0.1  # of its standard error, that a parameter still moves
NUDGE = 1e-5  # relative change of a parameter for its sensitivity
NUDGES = (1e-6, 1e-5, 20.0, 20.0)  # [rad, rad/s, Pa, Pa] of a window's first state


@dataclass(frozen=True)
class _Stretch:
    """One window ready to shoot: inputs, measured outputs (points, 3 F), its place in the data."""

    record: int
    stratum: int
    repeat: int
    part: int
    window: Window
    measured: Array


@dataclass(frozen=True)
class _Source:
    """One record: signals and inputs of the integrator, oil temperature less nominal [K]."""

    signals: Signals
    inputs: Array
    locked: NDArray[np.bool_]
    kelvin: float


@dataclass(frozen=True)
class _Reduced:
    """A window after its start was eliminated: score, information, cost, and how to get back."""

    score: Array
    information: Array
    cost: float
    back: Array
    offset: Array
    residual: Array


@dataclass(frozen=True)
class OutputErrorFit:
    """Rows' coefficients (k,) by name with their spread, and how the search ended."""

    names: tuple[str, ...]
    value: Array
    spread: Spread
    check: Check

    def solution(self, family: str, solution: Solution) -> Solution:
        """Return the family's solution with these values, covariance and dof."""
        place = [self.names.index(n) for n in solution.names]
        return replace(
            solution,
            value=self.value[place],
            covariance=self.spread.covariance[np.ix_(place, place)],
            dof=self.spread.dof[place],
        )


def output_error(
    rig: Rig, runs: Sequence[Run], terms: Sequence[Used], start: Mapping[str, float]
) -> OutputErrorFit:
    """Fit all parameters, beginning at `start` (rows' coefficients by name, 1/b for b).

    Raises InputError for a start that is incomplete or that cannot be simulated at all.
    """
    names = tuple(c.parameter for used in terms for c in used.term.coefficients(rig))
    missing = [n for n in names if not np.isfinite(start.get(n, np.nan))]
    if missing:
        raise InputError(
            f"--estimator output-error simulates the whole model, but least squares does not "
            f"determine {' '.join(missing)}: add records that excite them, or use another estimator"
        )
    search = _Search(rig, runs, tuple(terms), names)
    return search.run(np.array([*(start[n] for n in names), start.get(nu.KAPPA, 0.0)]))


class _Search:
    """The data of one fit and the steps of its search."""

    def __init__(
        self, rig: Rig, runs: Sequence[Run], terms: tuple[Used, ...], names: tuple[str, ...]
    ) -> None:
        self.rig, self.terms = rig, terms
        self.reciprocal = {
            c.parameter for used in terms for c in used.term.coefficients(rig) if c.reciprocal
        }
        self.warm = "b" in names and all(
            ch.TEMPERATURE in r.channels for run in runs for r in run.records
        )
        self.names = (*names, nu.KAPPA) if self.warm else names
        self.sources: list[_Source] = []
        self.stretches: list[_Stretch] = []
        self._idle: dict[int, set[int]] = {}
        self._cut(runs)

    def _cut(self, runs: Sequence[Run]) -> None:
        records = [(i, r) for i, run in enumerate(runs) for r in run.records]
        strata = {s: k for k, s in enumerate(sorted({(i, r.step) for i, r in records}))}
        most = max(1, round(MOST_SECONDS / WINDOW) // len(records))
        for i, record in records:
            signals = condition(self.rig, record, default_filtering(record).channels)
            drive = drive_of(signals)
            inputs = np.column_stack(
                (drive.p_s, drive.temperature, drive.u, drive.q, drive.qd, drive.qdd)
            )
            kelvin = float(np.mean(signals.temperature)) - self.rig.oil.temperature
            self.sources.append(
                _Source(signals, np.ascontiguousarray(inputs), drive.locked, kelvin)
            )
            free = ~drive.locked
            every = self.every
            points = round(WINDOW * record.sample_rate) // (SAMPLES_PER_STEP * every)
            length = points * SAMPLES_PER_STEP * every
            good = signals.valid[:, free].all(axis=1)
            firsts = self._fitting(good, length)
            chosen = firsts[:: max(1, -(-len(firsts) // most))][:most]
            measured = np.column_stack(
                (signals.s[:, free], signals.p_cap[:, free], signals.p_rod[:, free])
            )
            for part, first in enumerate(chosen):
                at = first + SAMPLES_PER_STEP * every * np.arange(points)
                self.stretches.append(
                    _Stretch(len(self.sources) - 1, strata[i, record.step], record.repeat, part,
                             Window(first, points), measured[at])
                )  # fmt: skip
        if not self.stretches:
            raise InputError(
                f"no record holds {WINDOW:g} s without a clipped sensor: output error has nothing "
                "to simulate; use --estimator ls"
            )

    @staticmethod
    def _fitting(good: NDArray[np.bool_], length: int) -> list[int]:
        """Return the first samples of windows that lie end to end within good samples."""
        found, first = [], 0
        bad = np.flatnonzero(~good)
        for stop in (*bad.tolist(), len(good)):
            while first + length < stop:
                found.append(first)
                first += length
            first = max(first, stop + 1)
        return found

    @property
    def every(self) -> int:
        """Steps between two points compared."""
        return max(1, round(self.rig.sample_rate / POINT_RATE / SAMPLES_PER_STEP))

    # The search

    def run(self, theta: Array) -> OutputErrorFit:
        theta = theta[: len(self.names)]
        starts = [self._measured_start(s) for s in self.stretches]
        sigma = self._sigma()
        reduced = self._linearised(theta, starts, sigma)
        rounds, moved = 0, np.inf
        for rounds in range(1, ROUNDS + 1):
            if rounds == 2:
                sigma = self._refined(reduced, sigma)
                reduced = self._linearised(theta, starts, sigma)
            step, inverse = self._step(theta, reduced)
            moved = float(np.max(np.abs(step) / np.sqrt(np.diag(inverse))))
            theta, starts, reduced, better = self._try(theta, starts, sigma, reduced, step)
            if not better or (moved < SETTLED and rounds >= 2):
                break
        return self._result(theta, reduced, rounds, moved)

    def _try(
        self,
        theta: Array,
        starts: list[Array],
        sigma: dict[int, Array],
        reduced: list[_Reduced | None],
        step: Array,
    ) -> tuple[Array, list[Array], list[_Reduced | None], bool]:
        """Take the step, halved until the cost falls."""
        before = sum(r.cost for r in reduced if r is not None)
        for halving in range(HALVINGS):
            size = 0.5**halving
            new_theta = theta + size * step
            new_starts = [
                s if r is None else self._moved(stretch, s, size * (r.offset - r.back @ step))
                for stretch, s, r in zip(self.stretches, starts, reduced, strict=True)
            ]
            new = self._linearised(new_theta, new_starts, sigma)
            lost = sum(a is None and b is not None for a, b in zip(new, reduced, strict=True))
            after = sum(r.cost for r in new if r is not None)
            if not lost and after <= before * (1 + 1e-9):
                return new_theta, new_starts, new, True
        return theta, starts, reduced, False

    def _step(self, theta: Array, reduced: Sequence[_Reduced | None]) -> tuple[Array, Array]:
        good = [r for r in reduced if r is not None]
        if not good:
            raise InputError(
                "--estimator output-error: the model of least squares could not be simulated over "
                "any window; its parameters are too far off (see the checks with --estimator ls)"
            )
        A = np.sum([r.information for r in good], axis=0)
        g = np.sum([r.score for r in good], axis=0)
        # What is known beforehand is one more observation each, in the same units of one sigma.
        for belief in nu.beliefs(self.names, theta):
            A = A + np.outer(belief.h, belief.h) / belief.std**2
            g = g - belief.h * float(belief.h @ theta) / belief.std**2
        scale = np.sqrt(np.diag(A))
        inverse = np.linalg.inv(A / np.outer(scale, scale)) / np.outer(scale, scale)
        return inverse @ g, inverse

    def _sigma(self) -> dict[int, Array]:
        sensors = self.rig.sensors
        taps = default_noise(self.rig)
        base = np.array([sensors.piston.noise, *[sensors.chamber_pressure.noise] * 2]) * taps
        steps = [(r[1] - r[0]) / (1 << bits) for r, bits in (
            (sensors.piston.range, sensors.piston.bits),
            (sensors.chamber_pressure.range, sensors.chamber_pressure.bits))]  # fmt: skip
        floor = np.array([steps[0], steps[1], steps[1]]) / np.sqrt(12)
        out = {}
        for s in self.stretches:
            free = int((~self.sources[s.record].locked).sum())
            out[s.stratum] = np.repeat(np.maximum(base, floor), free)
        return out

    def _refined(
        self, reduced: Sequence[_Reduced | None], sigma: dict[int, Array]
    ) -> dict[int, Array]:
        """Return each step's scatter of the outputs as the first fit left it."""
        out = {}
        for stratum, old in sigma.items():
            left = [
                r.residual for s, r in zip(self.stretches, reduced, strict=True)
                if r is not None and s.stratum == stratum
            ]  # fmt: skip
            out[stratum] = (
                old * np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0)) if left else old
            )
        return out

    # One window

    def _measured_start(self, stretch: _Stretch) -> Array:
        source = self.sources[stretch.record]
        s, k = source.signals, stretch.window.first
        return np.concatenate((s.q[k], s.qd[k], s.p_cap[k], s.p_rod[k]))

    def _state_places(self, stretch: _Stretch) -> NDArray[np.int64]:
        locked = self.sources[stretch.record].locked
        free = np.flatnonzero(~locked)
        return np.concatenate([kind * len(locked) + free for kind in range(4)])

    def _moved(self, stretch: _Stretch, start: Array, change: Array) -> Array:
        moved = start.copy()
        moved[self._state_places(stretch)] += change
        return moved

    def _pars(self, theta: Array, kelvin: float) -> tuple[Compiled, Array, Array]:
        """Return the compiled model, (1 + k, parameters) of it nudged, and the nudges (k,)."""
        nudges = NUDGE * np.abs(theta)
        if self.warm:
            b = abs(theta[self.names.index("b")])
            nudges[-1] = NUDGE * b
        rows = [theta, *(theta + n * e for n, e in zip(nudges, np.eye(len(theta)), strict=True))]
        ready = [self._compiled(row, kelvin) for row in rows]
        return ready[0], np.array([r.par for r in ready]), nudges

    def _compiled(self, theta: Array, kelvin: float) -> Compiled:
        values = dict(zip(self.names, theta.tolist(), strict=True))
        if self.warm:
            values["b"] += kelvin * values.pop(nu.KAPPA)
        nan = (np.nan, np.nan)
        estimates = {
            n: Estimate(1.0 / v if n in self.reciprocal else v, "", np.nan, nan)
            for n, v in values.items()
        }
        k = len(estimates)
        return compiled(Model(self.rig, self.terms, estimates, np.full((k, k), np.nan)))

    def _linearised(
        self, theta: Array, starts: Sequence[Array], sigma: Mapping[int, Array]
    ) -> list[_Reduced | None]:
        ready = [self._pars(theta, source.kelvin) for source in self.sources]
        return [
            self._window(stretch, start, sigma[stretch.stratum], *ready[stretch.record])
            for stretch, start in zip(self.stretches, starts, strict=True)
        ]

    def _window(
        self, stretch: _Stretch, start: Array, sigma: Array, ready: Compiled, pars: Array,
        nudges: Array,
    ) -> _Reduced | None:  # fmt: skip
        """Shoot one window with every nudge and eliminate its start."""
        source = self.sources[stretch.record]
        places = self._state_places(stretch)
        free = len(places) // 4
        state_nudges = np.repeat(NUDGES, free)
        active = self._active(stretch.record)
        y0 = np.zeros((1 + len(places) + len(active), len(start) + int(ready.hidden_ends[-1])))
        y0[:, : len(start)] = start
        for row, (place, nudge) in enumerate(zip(places, state_nudges, strict=True), start=1):
            y0[row, place] += nudge
        chosen = np.concatenate((np.zeros(1 + len(places), dtype=np.int64), 1 + active))
        states = shoot(
            ready, np.ascontiguousarray(pars[chosen]), y0, source.inputs, source.signals.rate,
            source.locked, stretch.window, self.every,
        )  # fmt: skip
        if states is None:
            return None
        outputs = self._outputs(states, source.locked) / sigma
        residual = stretch.measured / sigma - outputs[0]
        change = (outputs[1:] - outputs[0]).reshape(len(outputs) - 1, -1)
        Js = (change[: len(places)] / state_nudges[:, None]).T
        J = np.zeros((Js.shape[0], len(nudges)))
        J[:, active] = (change[len(places) :] / nudges[active, None]).T
        if stretch.record not in self._idle:
            self._idle[stretch.record] = {int(k) for k in active if not J[:, k].any()}
        r = residual.ravel()
        # Project the window's start out by QR of its sensitivities.
        Q, R = np.linalg.qr(Js)
        inner, outer = Q.T @ J, Q.T @ r
        left_J, left_r = J - Q @ inner, r - Q @ outer
        return _Reduced(
            left_J.T @ left_r, left_J.T @ left_J, float(r @ r),
            np.linalg.solve(R, inner), np.linalg.solve(R, outer), residual,
        )  # fmt: skip

    def _active(self, record: int) -> NDArray[np.int64]:
        """Return the parameters that move anything in a record (what a first window showed)."""
        locked = {str(i + 1) for i in np.flatnonzero(self.sources[record].locked)}
        idle = self._idle.get(record, set())
        return np.array(
            [
                k for k, name in enumerate(self.names)
                if k not in idle and not (name.startswith(("C_", "Fv")) and name[-1] in locked)
            ],
            dtype=np.int64,
        )  # fmt: skip

    def _outputs(self, states: Array, locked: NDArray[np.bool_]) -> Array:
        N = len(locked)
        free = np.flatnonzero(~locked)
        piston = [self.rig.joints[i].linkage.piston(states[..., i]) for i in map(int, free)]
        return np.concatenate(
            (np.stack(piston, axis=-1), states[..., 2 * N + free], states[..., 3 * N + free]),
            axis=-1,
        )

    # The result

    def _result(
        self, theta: Array, reduced: Sequence[_Reduced | None], rounds: int, moved: float
    ) -> OutputErrorFit:
        _, inverse = self._step(theta, reduced)
        pairs = [(s, r) for s, r in zip(self.stretches, reduced, strict=True) if r is not None]
        pieces = Pieces(
            np.array([s.stratum for s, _ in pairs]),
            np.array([s.repeat for s, _ in pairs]),
            np.array([s.part for s, _ in pairs]),
            np.array([r.score for _, r in pairs]),
            np.array([r.information for _, r in pairs]),
        )
        error = spread([pieces], inverse)
        covariance = error.covariance
        for belief in nu.beliefs(self.names, theta):
            moves = inverse @ belief.h / belief.std
            covariance = covariance + np.outer(moves, moves)
        grown = np.diag(covariance) / np.maximum(np.diag(error.covariance), 1e-300)
        error = Spread(covariance, error.dof * np.minimum(grown, 1e6) ** 2, error.systematic)
        failed = len(self.stretches) - len(pairs)
        settled = moved < 1.0
        detail = (
            f"{len(pairs)} windows of {WINDOW:g} s, {rounds} rounds from least squares, the last "
            f"moved no parameter by more than {moved:.2g} of its standard error"
        )
        if failed:
            detail += f"; {failed} windows could not be simulated and were left out"
        return OutputErrorFit(
            self.names, theta, error, Check("output error", settled and not failed, detail)
        )


def default_noise(rig: Rig) -> float:
    """Return what the channels' filter leaves of white noise, as a share of its amplitude."""
    from analysis.differentiate import channel_filter  # noqa: PLC0415 - one call

    return float(np.linalg.norm(channel_filter(rig.sample_rate).taps[0]))
