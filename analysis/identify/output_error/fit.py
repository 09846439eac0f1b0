"""Fit the model, simulated from free window starts, to the measured outputs (output error).

Multiple shooting: each record is cut into windows, the state at each window's start is unknown
too, and sum |measured - simulated|^2 / sigma^2 over piston and chamber pressures of the excited
joints is minimised. Noise in the outputs causes no bias, because no measured output is in a
regressor. Continuity between windows is not required: it would add little information and turn slow
model errors into bias. Gauss-Newton with step halving, the windows' states eliminated (Schur's
complement) each time. Intervals: as for the other estimators, with the windows as parts. Source:
Bock (1981) and Schloeder; Ljung, System Identification (1999), section 3.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.estimators import nuisance as nu
from analysis.identify.estimators.covariance import CovarianceParts, spread
from analysis.identify.estimators.equations import Pieces
from analysis.identify.output_error.windows import ReducedWindow, Windows
from analysis.identify.settings import IDENTIFY
from analysis.regression.least_squares import scaled_inverse
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutputErrorFit:
    """Rows' coefficients (k,) by name with their spread, and the check on convergence."""

    names: tuple[str, ...]
    value: Array
    spread: CovarianceParts
    check: Check


def output_error(
    rig: Rig, runs: Sequence[Run], terms: Sequence[Used], start: Mapping[str, float]
) -> OutputErrorFit:
    """Fit all parameters, beginning at `start` (rows' coefficients by name, 1/b for b).

    Raises InputError for a start that is incomplete or that cannot be simulated at all.
    """
    names = [c.parameter for used in terms for c in used.term.coefficients(rig)]
    refuse_undetermined([n for n in names if not np.isfinite(start.get(n, np.nan))])
    search = Search(Windows(rig, runs, terms))
    return search.run(np.array([*(start[n] for n in names), start.get(nu.KAPPA, 0.0)]))


def refuse_undetermined(missing: Sequence[str]) -> None:
    """Raise InputError if least squares left any parameter of the model without a value."""
    if missing:
        raise InputError(
            f"--estimator output-error simulates the whole model, but least squares does not "
            f"determine {' '.join(missing)}: add records that excite them, or use another estimator"
        )


class Search:
    """Gauss-Newton iterations of one fit; `low` and `high` (k,) bound the parameters if given."""

    def __init__(
        self, windows: Windows, low: Array | None = None, high: Array | None = None
    ) -> None:
        self.windows, self.low, self.high = windows, low, high
        self.names, self.placed = windows.names, windows.placed

    def run(self, theta: Array) -> OutputErrorFit:
        """Search from theta (k,); parameters that no window depends on keep their values."""
        theta = theta[: len(self.names)]
        starts = [self.windows.measured_start(s) for s in self.placed]
        sigma = self.windows.sigma()
        reduced = self.windows.linearised(theta, starts, sigma)
        rounds, moved = 0, np.inf
        for rounds in range(1, IDENTIFY.fit_rounds + 1):
            if rounds == 2:
                sigma = self._refined(reduced, sigma)
                reduced = self.windows.linearised(theta, starts, sigma)
            step, inverse = self._step(theta, reduced)
            std = np.sqrt(np.diag(inverse))
            moved = float(np.max(np.abs(step[std > 0]) / std[std > 0], initial=0.0))
            theta, starts, reduced, accepted = self._try(theta, starts, sigma, reduced, step)
            if not accepted or (moved < IDENTIFY.fit_settled and rounds >= 2):
                break
        return self._result(theta, reduced, rounds, moved)

    def _try(
        self,
        theta: Array,
        starts: list[Array],
        sigma: dict[int, Array],
        reduced: list[ReducedWindow | None],
        step: Array,
    ) -> tuple[Array, list[Array], list[ReducedWindow | None], bool]:
        """Return parameters, starts, windows, True after the step, halved until the cost falls."""
        before = sum(r.cost for r in reduced if r is not None)
        for halving in range(IDENTIFY.fit_halvings):
            size = 0.5**halving
            new_theta = np.clip(theta + size * step, self.low, self.high)
            dtheta = new_theta - theta
            new_starts = [
                s if r is None else self.windows.moved(window, s, size * r.offset - r.back @ dtheta)
                for window, s, r in zip(self.placed, starts, reduced, strict=True)
            ]
            new = self.windows.linearised(new_theta, new_starts, sigma)
            lost = sum(a is None and b is not None for a, b in zip(new, reduced, strict=True))
            after = sum(r.cost for r in new if r is not None)
            if not lost and after <= before * (1 + 1e-9):
                return new_theta, new_starts, new, True
        return theta, starts, reduced, False

    def _step(self, theta: Array, reduced: Sequence[ReducedWindow | None]) -> tuple[Array, Array]:
        good = [r for r in reduced if r is not None]
        if not good:
            raise InputError(
                "--estimator output-error: the model of least squares could not be simulated over "
                "any window; its parameters are too far off (see the checks with --estimator ls)"
            )
        A = np.sum([r.information for r in good], axis=0)
        g = np.sum([r.score for r in good], axis=0)
        # Each prior is one more observation in units of its sigma, as the outputs are.
        for prior in nu.priors(self.names, theta):
            A = A + np.outer(prior.h, prior.h) / prior.std**2
            g = g - prior.h * float(prior.h @ theta) / prior.std**2
        inverse = scaled_inverse(A)
        return inverse @ g, inverse

    def _refined(
        self, reduced: Sequence[ReducedWindow | None], sigma: dict[int, Array]
    ) -> dict[int, Array]:
        """Return the outputs' sigma (3 F,) by step from the residuals so far."""
        out = {}
        for stratum, old in sigma.items():
            residuals = [
                r.residual for s, r in zip(self.placed, reduced, strict=True)
                if r is not None and s.stratum == stratum
            ]  # fmt: skip
            out[stratum] = (
                old * np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0)) if residuals else old
            )
        return out

    def _result(
        self, theta: Array, reduced: Sequence[ReducedWindow | None], rounds: int, moved: float
    ) -> OutputErrorFit:
        _, inverse = self._step(theta, reduced)
        pairs = [(s, r) for s, r in zip(self.placed, reduced, strict=True) if r is not None]
        pieces = Pieces(
            np.array([s.stratum for s, _ in pairs]),
            np.array([s.repeat for s, _ in pairs]),
            np.array([s.part for s, _ in pairs]),
            np.array([r.score for _, r in pairs]),
            np.array([r.information for _, r in pairs]),
        )
        error = spread([pieces], inverse)
        covariance = error.covariance
        for prior in nu.priors(self.names, theta):
            moves = inverse @ prior.h / prior.std
            covariance = covariance + np.outer(moves, moves)
        grown = np.diag(covariance) / np.maximum(np.diag(error.covariance), 1e-300)
        error = CovarianceParts(
            covariance, error.dof * np.minimum(grown, 1e6) ** 2, error.systematic
        )
        failed = len(self.placed) - len(pairs)
        settled = moved < 1.0
        last_step = (
            f"the last moved no parameter by more than {moved:.2g} of its standard error"
            if settled
            else f"not settled: the last still moved a parameter by {moved:.2g} of its standard "
            "error, and the intervals do not hold; take --estimator iv or ls"
        )
        detail = (
            f"{len(pairs)} windows of {IDENTIFY.window:g} s, {rounds} rounds from least squares, "
            f"{last_step}"
        )
        if failed:
            detail += f"; {failed} windows could not be simulated and were left out"
        return OutputErrorFit(
            self.names, theta, error, Check("output error", settled and not failed, detail)
        )
