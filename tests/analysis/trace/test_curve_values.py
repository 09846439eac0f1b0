"""A curve one of whose values is mostly noise is simulated with what the trace found for it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from analysis.simulation.model import Estimate, nominal_model
from analysis.simulation.simulate import compiled
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from analysis.trace.data.candidates import free_mechanisms
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, evidence, regression_data
from analysis.trace.fitted_model import with_effect_values
from analysis.trace.judge.curves import CurveRange
from analysis.trace.judge.gates import held_out_above_band
from analysis.trace.result import JudgedEffect
from analysis.trace.search.exact_fit import ExactFit, fit_coefficients
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.stages.conclusion import judging_rows_above_band
from rig.model.parse import InputError
from rig.model.rig import Rig
from tests.analysis.trace.foreign_bench import RMS, Hidden, experiment

KNOTS = (0.0, 0.02, 0.06, 0.12, 2e-5)  # [m/s] of |s'|, then the presliding distance [m]


def sprung(rig: Rig, reach: float) -> tuple[RegressionData, Used, ExactFit]:
    """Return rows of a joint with a spring, a curve over `reach` of its travel, and the fit."""
    run = experiment(rig, Hidden(spring=20.0), repeats=1, seed=1, rms=RMS)
    terms = [Used(term) for term in baseline_of(rig)]
    data = regression_data(rig, terms, conditioned_records(rig, [run]))
    s = data.records[0].signals.s[:, 1]
    middle, half = 0.5 * (s.min() + s.max()), 0.5 * reach * np.ptp(s)
    knots = np.linspace(middle - half, middle + half, 9)
    curve = Used(make("position_force", "joint 2"), (*knots, *np.eye(9)[0]))
    return data, curve, fit_coefficients(data, (*terms, curve))


def test_a_model_with_an_undetermined_value_of_a_curve_can_be_simulated(rig: Rig) -> None:
    curve = Used(make("friction_curve", "joint 2"), KNOTS)
    lost = "friction_2_extending_1"
    nothing = Estimate(math.nan, "N", math.nan, (math.nan, math.nan))
    values = {
        c.parameter: Estimate(8.0, "N", 1.0, (6.0, 10.0)) for c in curve.term.coefficients(rig)
    }
    model = nominal_model(rig, [Used(term) for term in baseline_of(rig)])
    model = replace(
        model,
        terms=(*model.terms, curve),
        parameters={**model.parameters, **values, lost: nothing, "Fv1": nothing},
    )
    found = JudgedEffect("friction_curve", "joint 2", values, 0.005, 0.9, (), (), free=True)
    with pytest.raises(InputError, match="Fv1 friction_2_extending_1 not identified"):
        compiled(model)
    # A parameter that belongs to no curve stays undetermined.
    with pytest.raises(InputError, match="cannot be simulated: Fv1 not identified"):
        compiled(with_effect_values(model, (found,)))
    known = replace(model, parameters={**model.parameters, "Fv1": values[lost]})
    compiled(with_effect_values(known, (found,)))


@pytest.mark.parametrize(
    ("reach", "says"), [(0.9, "they cannot judge it"), (0.01, "only the rows that choose")]
)
def test_rows_beyond_a_curve_are_stated_whether_they_judge_or_not(
    rig: Rig, reach: float, says: str
) -> None:
    """The knots span `reach` of the piston's travel; too few rows within them cannot judge."""
    data, _, fit = sprung(rig, reach)
    notes = CurveRange(data, fit).notes
    assert [note.partition(":")[0] for note in notes] == ["torque_2"]
    assert says in notes[0]
    known = CurveRange(data, fit).rows.row_counts
    assert (known["torque_2"] < data.row_counts["torque_2"]) is (reach > 0.1)
    assert known["flow_cap_2"] == data.row_counts["flow_cap_2"]


@pytest.mark.parametrize("reach", [0.9, 0.01])
def test_an_extrapolated_curve_does_not_change_the_verdict(rig: Rig, reach: float) -> None:
    """A spring that is too soft speaks against the set only within the range of its curve."""
    data, curve, fit = sprung(rig, reach)
    empty = HypothesisSet(data, []).empty
    wrong = {n: 0.3 * v if n.startswith("F_position") else v for n, v in fit.beta.items()}
    after = replace(empty, effects=(curve,), fit=replace(fit, beta=wrong))
    assert [e for e, _ in held_out_above_band(data, empty.fit, after.fit)] == ["torque_2"]
    against, words = judging_rows_above_band(data, empty, after)
    assert against == ({"torque_2"} if reach > 0.1 else set())
    assert any("beyond the range of the fitted curve" in said for said in words)


def test_knots_of_a_curve_lie_where_rows_can_determine_it(rig: Rig) -> None:
    """Motion at a record's ends, which the filters reach beyond, has no rows: it places no knot."""
    data, _, _ = sprung(rig, 0.9)
    record = data.records[0]
    times = np.concatenate([rows.time for rows in data.rows[0].values()])
    first, last = record.samples_at(np.array([times.min(), times.max()]))
    at = np.arange(len(record.signals.t))[:, None]
    ends = (at < first) | (at > last)
    x = record.signals
    larger = replace(
        x,
        **{k: np.where(ends, 3.0 * v, v) for k, v in vars(x).items() if k in ("u", "s", "sd", "G")},
        **{k: np.where(ends, 0.3 * v, v) for k, v in vars(x).items() if k in ("p_cap", "p_rod")},
    )
    unlike = replace(data, records=(replace(record, signals=larger), *data.records[1:]))
    curves = [e for e in free_mechanisms(rig) if e.where != "joint 1"]
    for curve in curves:
        known = curve.points(rig, evidence(data, data.mean_residual))
        assert known == curve.points(rig, evidence(unlike, data.mean_residual)), curve.name
    assert {"leakage_along_stroke", "supply_curve"} <= {curve.name for curve in curves}
