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
from analysis.identify.estimators.nuisance import BETWEEN, DRIVE_BETWEEN, DrivePath, SpoolPath
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import model_rows
from analysis.trace.data.regression_data import RegressionData, least_squares
from rig.model.parameters import gain_names


def path_terms(data: RegressionData) -> tuple[Used, ...]:
    """Return the path terms to add to the data's own: one for each joint that moves.

    A path whose fitted lead exceeds `BETWEEN_SAMPLES` of a sample is left out: another delay acts.
    """
    moved, electric = ("torque", True) if data.rig.electric else ("flow", False)
    kinds = [s.equation.rsplit("_", 1) for s in data.segments]
    joints = sorted({int(number) - 1 for kind, number in kinds if kind.startswith(moved)})
    names = [name for i in joints for name in gain_names(i + 1)] if not electric else []
    gains = tuple((n, float(data.beta[n])) for n in names if np.isfinite(data.beta[n]))
    if not (gains or electric):
        return ()
    paths = [
        Used(DrivePath(joint=i) if electric else SpoolPath(gains=gains, joint=i)) for i in joints
    ]
    rows = [model_rows(data.rig, (*data.terms, *paths), record) for record in data.records]
    lead, name = least_squares(data.rig, rows), DRIVE_BETWEEN if electric else BETWEEN
    return tuple(
        used
        for used, i in zip(paths, joints, strict=True)
        if abs(lead.get(f"{name}{i + 1}", np.inf)) <= BETWEEN_SAMPLES
    )
