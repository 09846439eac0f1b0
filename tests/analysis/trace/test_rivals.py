"""Names that fit as well as the one given: which are listed, and what intervals they widen."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from analysis.identify.identify import identify
from analysis.simulation.model import Model
from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace.engine import trace
from analysis.trace.judge import held_out, rivals
from analysis.trace.judge.alternatives import errors_by_alternatives, shape_errors_by_alternatives
from analysis.trace.result import Rival
from analysis.trace.settings import SEARCH, TRACE
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.foreign_bench import Hidden, pair_of_runs
from tests.analysis.trace.gate_cases import at_joint_2, searched, traced
from tests.analysis.trace.hidden import RMS, experiment
from tests.variants import kept


@pytest.fixture(scope="module")
def noisy(rig: Rig) -> tuple[Run, Run]:
    """Levels of 24 and 20 N in six times the noise."""
    return pair_of_runs(rig, Hidden(24.0, 20.0), repeats=1, noise=6.0)


@pytest.mark.parametrize(
    ("more", "tied"),
    kept(
        [((), set()),
         (("pressure_dependent_friction",),
          {"asymmetric_friction", "pressure_dependent_friction"})],
        (0,),
    ),
)  # fmt: skip
def test_levels_by_direction_are_listed_where_another_law_fits_as_well_anyway(
    rig: Rig,
    noisy: tuple[Run, Run],
    more: tuple[str, ...],
    tied: set[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They change no parameter of another law by enough to be a rival of one level alone."""
    monkeypatch.setattr(rivals, "TRACE", replace(TRACE, noted_shift=0.5, open_share=0.5))
    result = traced(rig, noisy, "coulomb_friction", "asymmetric_friction", *more)
    (effect,) = result.effects
    assert effect.name == "coulomb_friction"
    assert {r.name for r in effect.rivals if r.tied} == tied


@pytest.mark.slow
def test_a_richer_name_of_a_named_law_is_not_preferred_to_it_for_less_energy(
    rig: Rig,
) -> None:
    """Of 22 and 19 N the difference fits an error of the form: it is listed as a rival only."""
    runs = pair_of_runs(rig, Hidden(22.0, 19.0), repeats=2)
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction")
    one, two = s.set_of("coulomb_friction"), s.set_of("asymmetric_friction")
    assert two.fit.energy < one.fit.energy - 5 * SEARCH.number_price
    rival = Rival("asymmetric_friction", "joint 2", 1.0, 1.0, tied=True, at="joint 2")
    (judged,) = s.judged("coulomb_friction")
    effects = [replace(judged, rivals=(rival,))]
    assert rivals.best_tied_set(s.hypotheses, one, effects, s.holdout_data) is one


@pytest.mark.slow
def test_an_interval_reaches_what_a_richer_form_of_the_named_effect_gives(
    rig: Rig, noisy: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weight takes up the difference of two levels, which these records do not show."""
    monkeypatch.setattr(rivals, "TRACE", replace(TRACE, noted_shift=0.5, open_share=0.5))
    found = {
        names: traced(rig, noisy, *names).model_after.parameters["W2"]
        for names in (("coulomb_friction",), ("coulomb_friction", "asymmetric_friction"))
    }
    alone, beside = found.values()
    assert beside.value == alone.value
    assert beside.std > 1.5 * alone.std


def test_friction_is_as_uncertain_as_a_breakaway_that_noise_hides(rig: Rig) -> None:
    """The level takes up most of the breakaway, and viscous friction the fall behind it."""
    level = 24.0
    runs = pair_of_runs(
        rig, Hidden(level, level, breakaway=6.0, stribeck=0.05), repeats=1, noise=4.0
    )
    alone, beside = (
        traced(rig, runs, *names)
        for names in (("coulomb_friction",), ("coulomb_friction", "stribeck_friction"))
    )
    viscous = [result.model_after.parameters["Fv2"] for result in (alone, beside)]
    assert viscous[0].value == viscous[1].value
    assert viscous[0].ci95[1] < TRUTH["Fv2"] < viscous[1].ci95[1]
    narrow, wide = (result.effects[0].parameters["Fc2"].ci95[0] for result in (alone, beside))
    assert wide < level < narrow


@pytest.mark.parametrize("noise", kept([1.0, 3.0], (3.0,)))
def test_noise_does_not_make_a_certain_inclination_of_a_spring(rig: Rig, noise: float) -> None:
    """Over this arc both are a straight line; with the spring the weight is open by a tenth."""
    runs = pair_of_runs(rig, Hidden(spring=2.5 if noise > 1.0 else 4.0), noise=noise)
    result = traced(rig, runs, "base_inclination", "joint_spring")
    assert result.verdict == "confounded"
    assert ("joint_spring", "joint 2") in [*result.tied, *((e.name, e.at) for e in result.effects)]
    low, high = result.model_after.parameters["W2"].ci95
    assert low < TRUTH["W2"] < high


def test_an_interval_reaches_what_another_effect_of_more_numbers_gives(rig: Rig) -> None:
    """A weak spring fits like an inclination and moves the weight by less than a rival must."""
    runs = pair_of_runs(rig, Hidden(spring=0.3), noise=0.1)
    result = traced(rig, runs, "base_inclination", "joint_spring")
    assert [(e.name, e.rivals) for e in result.effects] == [("base_inclination", ())]
    weight = result.model_after.parameters["W2"]
    assert weight.ci95[0] < TRUTH["W2"] < weight.ci95[1]
    assert weight.ci95[1] - weight.ci95[0] < 0.03 * TRUTH["W2"]


@pytest.mark.slow
def test_alternatives_widen_what_they_share_with_the_model(
    rig: Rig, noisy: tuple[Run, Run]
) -> None:
    model = traced(rig, noisy, "coulomb_friction").model_after
    own = model.parameters

    def shifted(**by: float) -> Model:
        changed = {n: replace(own[n], value=own[n].value * (1 + x)) for n, x in by.items()}
        return replace(model, parameters={**own, **changed})

    errors = errors_by_alternatives(model, [(shifted(W2=0.02, Fv2=0.1), "friction")])
    # Fv2 is of the law in which the two differ.
    assert errors == {"W2": pytest.approx(0.02 * own["W2"].value / math.sqrt(2))}
    assert errors_by_alternatives(model, [(shifted(Fv2=0.1), "")])["Fv2"] > 0.0


def test_an_unknown_cause_that_differs_between_days_widens_what_it_moves(rig: Rig) -> None:
    """Dry friction, not among the candidates, of 40 N in the training runs and of 60 N later."""
    train = experiment(rig, Fc=40.0, repeats=2)
    held_out = experiment(rig, Fc=60.0, repeats=2, seed=2, rms=0.7 * RMS)
    candidates = at_joint_2(rig, "base_inclination")
    result = trace([train], [held_out], candidates, look_ahead=False, free_forms=False)
    assert (result.verdict, result.effects) == ("unexplained", ())
    alone, intervals = identify([train]).estimates, result.model_after.parameters
    low, high = intervals["Fv2"].ci95
    assert low < TRUTH["Fv2"] < high
    assert alone["Fv2"].ci95[0] > TRUTH["Fv2"]
    for name in ("b", "C_pp_2"):  # the flows keep no more than noise
        assert intervals[name].ci95 == pytest.approx(alone[name].ci95)


def test_an_effect_may_not_pay_for_one_equation_with_another() -> None:
    """A good piston sensor got a gain of 1.1: less in the flows, and more in a quiet torque."""

    def left(torque: float, flow: float) -> Any:
        return SimpleNamespace(excess_energy={"torque_1": torque, "flow_cap_1": flow})

    rows = {"torque_1": 1600, "flow_cap_1": 1600}
    hypotheses: Any = SimpleNamespace(
        empty=left(-30.0, 2300.0), noise_band=dict.fromkeys(rows, 780.0),
        train_data=SimpleNamespace(row_counts=rows),
    )  # fmt: skip
    without = left(-30.0, 1600.0)
    assert held_out.disturbed_equations(hypotheses, left(284.0, 300.0), without) == ["torque_1"]
    # What noise makes, and what the form error of a large effect makes, refuses nothing.
    assert held_out.disturbed_equations(hypotheses, left(150.0, 300.0), without) == []
    hypotheses.empty = left(-30.0, 23000.0)
    assert held_out.disturbed_equations(hypotheses, left(284.0, 300.0), without) == []


def test_other_sets_widen_the_interval_of_a_shape_too(rig: Rig) -> None:
    """With a torque beside it, an inclination of 0.025 rad would be 0.029 rad."""

    def leaning(by: float) -> Any:
        used = Used(make("base_inclination", "bench"), (by,))
        return SimpleNamespace(fit=SimpleNamespace(terms=(used,)))

    other = leaning(0.029)
    errors = shape_errors_by_alternatives(rig, leaning(0.025), [other])
    assert errors == {"inclination": pytest.approx(0.004 / 2**0.5)}
    empty: Any = SimpleNamespace(fit=SimpleNamespace(terms=()))
    assert shape_errors_by_alternatives(rig, leaning(0.025), [empty]) == {}
