"""The path of spools and drives between samples under a held command, fitted but never named.

The rows take the spool for linear between its samples. Under a held command a first-order spool of
time constant tau runs along an exponential there, which in the flows acts as a lead of dt^2/(12
tau): one column a joint, C T du/dt sqrt(dp) (`analysis.identify.estimators.nuisance.SpoolPath`).
Without it a quick spool looks like a sensor that is late by some tens of microseconds. The current
of an electric drive does the same to its joint's torque (`DrivePath`).
"""

from __future__ import annotations

import numpy as np

from analysis.effects.base import BETWEEN_SAMPLES
from analysis.identify.estimators.nuisance import sample_paths
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import model_rows
from analysis.trace.data.regression_data import RegressionData, least_squares


def path_terms(data: RegressionData) -> tuple[Used, ...]:
    """Return the path terms to add to the data's own: one for each joint that moves.

    A path whose fitted lead exceeds `BETWEEN_SAMPLES` of a sample is left out: another delay acts.
    """
    rig, kind = data.rig, "torque" if data.rig.electric else "flow"
    moved = [s.equation for s in data.segments if s.equation.startswith(kind)]
    joints = sorted({int(equation.rsplit("_", 1)[1]) - 1 for equation in moved})
    paths = sample_paths(rig, joints, {name: float(v) for name, v in data.beta.items()})
    if not paths:
        return ()
    rows = [model_rows(rig, (*data.terms, *paths), record) for record in data.records]
    lead = least_squares(rig, rows)

    def in_range(used: Used) -> bool:
        (own,) = used.term.coefficients(rig)
        return abs(lead.get(own.parameter, np.inf)) <= BETWEEN_SAMPLES

    return tuple(filter(in_range, paths))
