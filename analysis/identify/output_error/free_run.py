"""Fit an electric robot's parameters to free runs of whole records (output error).

Minimises the sum over records and joints of |measured - simulated position|^2, the model driven by
the measured drive alone from each record's measured first state, as in `validate`. A position
sensor's noise is far below the error of a free run, so the first state is not fitted (it would be
correlated with the constant torque). That error comes from friction that varies; a free run weighs
it by its effect on the position, the rows weigh every instant equally, reversals included.

Where dry friction holds a joint the simulated position has kinks, so derivatives are taken over
steps of one per cent; shorter steps resolve the kink, and the search stops too early. Source:
Ljung, System Identification (1999), section 3.6; Janot, Vandanjon and Gautier (2014), DIDIM, for
robots.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from analysis.identify.checks import Check
from analysis.identify.estimators.covariance import spread
from analysis.identify.estimators.equations import Pieces
from analysis.identify.output_error.fit import refuse_undetermined
from analysis.identify.settings import IDENTIFY
from analysis.regression.conditioned import ConditionedRecord, condition_runs
from analysis.regression.least_squares import scaled_inverse
from analysis.regression.solve import Solution
from analysis.signals.conditioning import Mask, aligned_channels
from analysis.simulation.model import Model, as_loaded, model_of
from analysis.simulation.simulate import DrivingInput, Effort, State, compiled, drive_of, simulate
from analysis.simulation.validate import arrived, compared, first_state
from analysis.terms.base import Used
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


class _Record:
    """One record ready to run: drive, first state, measured positions (n, F) that arrived."""

    def __init__(self, rig: Rig, conditioned: ConditionedRecord) -> None:
        record, signals = conditioned.record, conditioned.signals
        channels = aligned_channels(rig, record)
        self.key, self.repeat = conditioned.group, record.repeat
        self.drive: DrivingInput = drive_of(signals)
        self.start: State = first_state(rig, record, signals, channels)
        measured = compared(rig, channels, signals)
        self.names = tuple(measured)
        self.loaded = record.loaded
        self.present: Mask = arrived(rig, record)
        self.measured: Array = np.column_stack(list(measured.values()))[self.present]

    def residual(self, model: Model) -> Array:
        """Return measured less simulated positions (n, F)."""
        ready = compiled(as_loaded(model, self.loaded), Effort.FIT)
        result = simulate(ready, self.drive, self.start)
        if result.failure:
            return np.full(self.measured.shape, IDENTIFY.failed_state)
        simulated = result.channels()
        return self.measured - np.column_stack([simulated[n] for n in self.names])[self.present]


def free_run_fit(
    rig: Rig, runs: Sequence[Run], terms: Sequence[Used], solutions: Mapping[str, Solution]
) -> tuple[dict[str, Solution], Check]:
    """Return the solutions with the values of least free-run error, the search starting at theirs.

    Intervals are from repeats, or for a step with one repeat from ten parts of the record. Raises
    InputError where least squares left a parameter undetermined or terms keep parameters that are
    not linear in the rows.
    """
    (solution,) = solutions.values()
    refuse_undetermined(list(solution.unidentifiable))
    records = [_Record(rig, record) for record in condition_runs(rig, runs)]
    scale = np.abs(solution.value)

    def residuals(share: Array) -> Array:
        values = dict(zip(solution.names, map(float, share * scale), strict=True))
        model = model_of(rig, terms, values)
        return np.concatenate([record.residual(model).ravel() for record in records])

    x0 = solution.value / scale
    optimum = least_squares(
        residuals, x0, diff_step=IDENTIFY.free_run_step, max_nfev=IDENTIFY.free_run_simulations
    )
    before = float(np.sqrt(np.mean(residuals(x0) ** 2)))
    after = float(np.sqrt(np.mean(optimum.fun**2)))
    jacobian = optimum.jac / scale
    inverse = scaled_inverse(jacobian.T @ jacobian)
    error = spread([_pieces(records, optimum, jacobian)], inverse)
    unit = rig.unit_of(records[0].names[0])
    check = Check(
        "output error",
        bool(optimum.success),
        f"free runs of {len(records)} whole record(s) from their measured first state: "
        f"{before:.3g} {unit} rms with least squares, {after:.3g} {unit} with these parameters"
        + ("" if optimum.success else f"; not settled after {optimum.nfev} steps"),
    )
    updated = replace(solution, value=optimum.x * scale, covariance=error.covariance, dof=error.dof)
    return dict.fromkeys(solutions, updated), check


def _pieces(records: Sequence[_Record], result: OptimizeResult, jacobian: Array) -> Pieces:
    """Return scores and information of `period_segments` parts of every record."""
    strata = {key: k for k, key in enumerate(dict.fromkeys(r.key for r in records))}
    stratum, repeat, part, score, information = [], [], [], [], []
    start = 0
    for record in records:
        stop = start + record.measured.size
        edges = np.linspace(start, stop, IDENTIFY.period_segments + 1).astype(int)
        for k, (low, high) in enumerate(itertools.pairwise(edges)):
            J, r = jacobian[low:high], result.fun[low:high]
            stratum.append(strata[record.key])
            repeat.append(record.repeat)
            part.append(k)
            score.append(J.T @ r)
            information.append(J.T @ J)
        start = stop
    return Pieces(
        np.array(stratum), np.array(repeat), np.array(part), np.array(score), np.array(information)
    )
