"""The spool's path between samples under a held command: known physics, fitted but never named.

The rows take the spool for linear between its samples. Under a held command a first-order spool of
time constant tau runs along an exponential there, which in the flows acts as a lead of dt^2/(12
tau): one column a joint, C T du/dt sqrt(dp) (`analysis.identify.estimators.nuisance.SpoolPath`).
Without it a quick spool looks like a sensor that is late by some tens of microseconds.
"""

from __future__ import annotations

import numpy as np

from analysis.effects.base import BETWEEN_SAMPLES
from analysis.identify.estimators.nuisance import BETWEEN, SpoolPath
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import model_rows
from analysis.trace.data.regression_data import RegressionData, least_squares
from rig.model.parameters import gain_names


def path_terms(data: RegressionData) -> tuple[Used, ...]:
    """Return the spool-path terms to add to the data's own: one for each joint that moves.

    A path whose fitted lead exceeds `BETWEEN_SAMPLES` of a sample is left out: another delay acts.
    """
    kinds = [s.equation.rsplit("_", 1) for s in data.segments]
    joints = sorted({int(number) - 1 for kind, number in kinds if kind.startswith("flow")})
    names = [name for i in joints for name in gain_names(i + 1)]
    gains = tuple((n, float(data.beta[n])) for n in names if np.isfinite(data.beta[n]))
    if not gains:
        return ()
    paths = [Used(SpoolPath(gains=gains, joint=i)) for i in joints]
    rows = [model_rows(data.rig, (*data.terms, *paths), record) for record in data.records]
    lead = least_squares(data.rig, rows)
    return tuple(
        used
        for used, i in zip(paths, joints, strict=True)
        if abs(lead.get(f"{BETWEEN}{i + 1}", np.inf)) <= BETWEEN_SAMPLES
    )
