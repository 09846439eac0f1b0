"""The linear search sees a coefficient's column where only a small part of it is its own."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.effects.mechanics import TorqueOffset
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import Variant
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import VariantColumns, regression_data
from analysis.trace.search.linear_fit import gains, project
from rig.model.rig import Rig
from tests.analysis.trace.foreign_bench import RMS, Hidden, experiment


@pytest.mark.parametrize(
    ("name", "length", "shows"),
    [("T_offset_2", 0.01, True), ("T_offset_2", 0.001, False), ("", 0.1, True), ("", 0.01, False)],
)
def test_how_much_of_a_column_must_be_its_own(
    rig: Rig, name: str, length: float, shows: bool
) -> None:
    """The column of a change of signals, named '', is right to first order only."""
    run = experiment(rig, Hidden(), repeats=1, seed=1, rms=RMS)
    data = regression_data(
        rig, [Used(term) for term in baseline_of(rig)], conditioned_records(rig, [run])
    )
    x = data.base @ np.linalg.lstsq(data.base, np.ones(len(data.base)), rcond=None)[0]
    own = np.random.default_rng(0).normal(size=len(x))
    own -= data.base @ np.linalg.lstsq(data.base, own, rcond=None)[0]
    column = x / np.linalg.norm(x) + length * own / np.linalg.norm(own)
    entry = VariantColumns(
        Variant(TorqueOffset("joint 2"), ()), (name,), column[:, None], frozenset({"torque_2"})
    )
    candidates = project(data, [entry], lambda _: 1, lambda *_: True)
    gained = gains(candidates.K, candidates.columns.T @ own, candidates.groups, candidates.least)
    assert gained[0] == pytest.approx(float(own @ own) if shows else 0.0)
