"""A curve one of whose values is mostly noise is simulated with what the trace found for it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from analysis.simulation.model import Estimate, nominal_model
from analysis.simulation.simulate import compiled
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from analysis.trace.engine import with_curve_values
from analysis.trace.result import JudgedEffect
from rig.model.parse import InputError
from rig.model.rig import Rig

KNOTS = (0.0, 0.02, 0.06, 0.12, 2e-5)  # [m/s] of |s'|, then the presliding distance [m]


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
        compiled(with_curve_values(model, (found,)))
    known = replace(model, parameters={**model.parameters, "Fv1": values[lost]})
    compiled(with_curve_values(known, (found,)))
    with pytest.raises(InputError, match=lost):
        compiled(with_curve_values(known, (replace(found, free=False),)))
