"""The search for shapes ends where the effect is, from whichever side it begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.effects.friction import StribeckFriction
from analysis.terms import baseline, make
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.judge.scatter import form_shift
from analysis.trace.search import exact_fit, refinement
from analysis.trace.search.hypothesis import energy_above_noise
from analysis.trace.settings import SEARCH
from rig.model.rig import Rig
from tests.analysis.effects import one_joint as bench
from tests.analysis.trace import foreign_bench
from tests.analysis.trace.gate_cases import searched
from tests.analysis.trace.hidden import pair_of_runs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FewRows:
    """What a search asks of its data where the fit is given."""

    rig: Rig
    terms: tuple[Used, ...] = ()
    relative: bool = False


@pytest.mark.parametrize("start", [0.9, 0.98, 1.02, 1.1])
def test_a_gain_is_found_from_the_wrong_side_of_one_too(
    rig: Rig, start: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Below one the residual falls towards the bound, as it did on a bench moved by a sine."""

    def fit(train_data: Any, terms: Sequence[Used]) -> exact_fit.ExactFit:
        gain = terms[-1].shape[0]
        residual = 50.0 * (gain - 1.01) if gain >= 1.0 else 9.0 / (1.6 - gain)
        left = np.array([residual, 0.1])
        return exact_fit.ExactFit(tuple(terms), {}, left, np.zeros((0, 0)))

    monkeypatch.setattr(refinement, "fit_coefficients", fit)
    train_data: Any = FewRows(rig)
    used = Used(make("sensor_gain", "joint 2 piston"), (start,))
    found = refinement.refine(train_data, (used,))
    assert found.terms[-1].shape[0] == pytest.approx(1.01, abs=1e-3)


def test_what_a_gain_leaves_is_noise_although_the_corrected_forces_are_smaller(rig: Rig) -> None:
    """The force of a piston is a difference: a few per cent of one side may double it."""
    run, _ = pair_of_runs(rig, gain_cap_pressure=1.3)
    terms = tuple(map(Used, baseline()))
    train_data = regression_data(rig, terms, conditioned_records(rig, [run]))
    used = Used(make("sensor_gain", "joint 2 cap"), (1.2,))
    found = refinement.refine(train_data, (*terms, used))
    assert found.terms[-1].shape[0] == pytest.approx(1.3, abs=1e-3)
    left = energy_above_noise(train_data, found.residual)["torque_2"]
    scaled = exact_fit.fit_coefficients(replace(train_data, relative=True), found.terms)
    rows = train_data.row_counts["torque_2"]
    assert left < 0.0  # the noise of the reading was magnified too
    assert energy_above_noise(train_data, scaled.residual)["torque_2"] - left > 0.3 * rows


@pytest.mark.parametrize("edges", [(0.0018, 0.014), (0.02, 0.001)])
def test_the_search_goes_on_until_very_different_overlaps_are_found(
    rig: Rig, edges: tuple[float, float]
) -> None:
    wrong = bench.Wrong.of(w_ahead=edges[0], w_astern=edges[1])
    records = conditioned_records(rig, [bench.run(rig, wrong, 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    band = Used(make("valve_deadband", "joint 2"), (0.0042, 0.0042, 0.0028))
    ahead, astern, *_ = refinement.refine(train_data, (*train_data.terms, band)).terms[-1].shape
    assert (ahead, astern) == pytest.approx(edges, rel=0.02)


def test_the_search_of_a_set_that_leaves_too_much_ends_where_it_leads_nowhere(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From edges beyond the spool's travel no step leads on; from others each step does."""
    wrong = bench.Wrong.of(w_ahead=5e-3, w_astern=8e-3)
    records = conditioned_records(rig, [bench.run(rig, wrong, 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    searches: list[int] = []
    whole = refinement.minimise

    def counted(*arguments: Any, max_nfev: int, **named: Any) -> Any:
        searches.append(max_nfev)
        return whole(*arguments, max_nfev=max_nfev, **named)

    def refined(
        edge: float, instead_of: exact_fit.ExactFit | None = None
    ) -> tuple[exact_fit.ExactFit, list[int]]:
        searches.clear()
        band = Used(make("valve_deadband", "joint 2"), (edge, edge, 0.0028))
        fit = refinement.refine(train_data, (*train_data.terms, band), instead_of)
        return fit, list(searches)

    monkeypatch.setattr(refinement, "minimise", counted)
    monkeypatch.setattr(refinement, "SEARCH", replace(SEARCH, unpromising_ratio=1.1))
    least, _ = refined(6e-3)
    first, most = SEARCH.first_steps, SEARCH.steps
    assert refined(0.5, least)[1] == [first, first]
    fit, steps = refined(0.02, least)
    assert fit.energy == pytest.approx(least.energy, rel=1e-3)
    assert most in steps


def test_a_crosstalk_that_leaves_no_row_has_an_energy_all_the_same(rig: Rig) -> None:
    """It puts every pressure of the chamber below zero, where no flow can be compared."""
    records = conditioned_records(rig, [bench.run(rig, bench.Wrong.of(), 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    wild = Used(make("sensor_crosstalk", "joint 2 rod"), (3.0,))
    fit = exact_fit.fit_coefficients(train_data, (*train_data.terms, wild))
    assert np.isfinite(fit.energy)


@pytest.mark.parametrize("stiffening", [0.0, 60.0])
def test_a_contact_stiffens_in_the_model_where_it_does_on_the_bench_and_else_says_nothing_of_it(
    rig: Rig, stiffening: float
) -> None:
    wrong = bench.Wrong.of(Fc=80, presliding=150e-6, stiffening=stiffening)
    records = conditioned_records(rig, [bench.run(rig, wrong, 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    friction = Used(make("coulomb_friction", "joint 2"), (40e-6,))
    distance, *more = refinement.refine(train_data, (*train_data.terms, friction)).terms[-1].shape
    assert distance == pytest.approx(150e-6, rel=0.15)
    assert more == ([pytest.approx(stiffening, rel=0.25)] if stiffening else [])


def test_an_effect_explains_nothing_by_moving_pressures_beyond_the_supplys(rig: Rig) -> None:
    records = conditioned_records(rig, [bench.run(rig, bench.Wrong.of(Fc=80), 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    outside = Used(make("sensor_offset", "joint 2 cap"), (-8e6,))
    found = exact_fit.fit_coefficients(train_data, (*train_data.terms, outside))
    (flow,) = [s.where for s in train_data.segments if s.equation == "flow_cap_2"]
    assert np.linalg.norm(found.residual[flow]) > 10 * np.linalg.norm(
        train_data.mean_residual[flow]
    )


def test_a_few_instants_at_which_an_effect_makes_the_oil_cavitate_count_like_the_others(
    rig: Rig,
) -> None:
    run = bench.run(rig, bench.Wrong.of(c_internal=1e-11), 0.03, 1)
    train_data = regression_data(rig, tuple(map(Used, baseline())), conditioned_records(rig, [run]))
    leak = Used(make("internal_leakage", "joint 2"))

    def fitted(share: float) -> tuple[Array, Array, Array]:
        """Return residuals where the oil cavitates and elsewhere, and those of the baseline there.

        The cap's sensor is said to read so high that the pressure is below zero at a `share`.
        """
        high = float(np.quantile(run.records[0].channels["cap_pressure_2"], share))
        terms = (*train_data.terms, leak, Used(make("sensor_offset", "joint 2 cap"), (high,)))
        ((kept, outside),) = exact_fit.design_matrix(train_data, terms).cavitating
        residual = exact_fit.fit_coefficients(train_data, terms).residual
        return residual[outside], residual[kept], train_data.mean_residual[outside]

    few, others, before = fitted(0.003)
    assert 0 < len(few) < 0.2 * len(others)
    assert np.abs(few).max() <= np.sqrt(np.mean(others**2)) < 0.5 * np.abs(before).max()
    many, others, before = fitted(0.02)
    assert len(many) > 0.2 * len(others)
    np.testing.assert_array_equal(many, before)


def test_a_chamber_below_the_tanks_pressure_draws_oil_from_the_tank(rig: Rig) -> None:
    """Where the tank stands at 2.4 MPa, a chamber falls below it for part of the time."""
    tank = 2.4e6
    run = bench.run(rig, bench.Wrong.of(p_tank=tank), 0.1, 1)
    below = np.mean(run.records[0].channels["rod_pressure_2"] < tank)
    assert below > 0.001
    train_data = regression_data(rig, tuple(map(Used, baseline())), conditioned_records(rig, [run]))
    start = Used(make("tank_pressure", "bench"), (0.5 * tank, 0.0))
    found = refinement.refine(train_data, (*train_data.terms, start))
    assert found.terms[-1].shape[0] == pytest.approx(tank, rel=0.01)
    assert found.energy < 2 * len(found.residual)


def test_a_detail_at_its_bound_or_one_that_leaves_the_shape_open_is_no_form(rig: Rig) -> None:
    """A contact that stiffens without limit is none, and a distance must stay known beside it."""
    records = conditioned_records(rig, [bench.run(rig, bench.Wrong.of(Fc=80), 0.03, 1)])
    train_data = regression_data(rig, tuple(map(Used, baseline())), records)
    friction = make("coulomb_friction", "joint 2")

    def shaped(*shape: float, before: float = 1e-6) -> bool:
        used = Used(friction, shape)
        fit = exact_fit.fit_coefficients(train_data, (*train_data.terms, used))
        return refinement._determines_shapes(train_data, fit, used, Used(friction, (before,)))

    assert shaped(100e-6, 30.0)
    assert not shaped(100e-6, 3e3)
    # So short a distance that no sample lies within a reversal says nothing of how it shortens.
    assert not shaped(2e-6, 30.0)
    # A distance that was no shorter without the detail is not what the detail fits.
    assert shaped(2e-6, 30.0, before=2e-6)


@pytest.mark.slow
def test_shapes_are_searched_again_from_those_of_a_larger_set(rig: Rig) -> None:
    """A search that began far away leaves more; an effect that mends this is not needed."""
    s = searched(rig, *pair_of_runs(rig, Fc=60.0), "coulomb_friction", "torque_offset")
    sets, alone = s.hypotheses, s.set_of("coulomb_friction")
    both = s.set_of("coulomb_friction", "torque_offset")
    (friction,) = alone.effects
    far = Used(friction.term, tuple(10.0 * value for value in friction.shape))
    fit = exact_fit.fit_coefficients(sets.train_data, (*sets.base, far))
    energy = energy_above_noise(sets.train_data, fit.residual)
    poor = sets.fitted[alone.keys] = replace(alone, effects=(far,), fit=fit, excess_energy=energy)
    assert poor.total > 2.0 * alone.total
    kept = sets.prune(both)
    assert kept.keys == alone.keys
    assert kept.total == pytest.approx(alone.total, rel=0.01)
    assert sets.fitted[alone.keys] is kept


@pytest.mark.parametrize("shown", [True, False])
def test_of_two_forms_the_one_that_the_records_show_is_chosen(
    rig: Rig, shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exponential fall leaves less, unless the records do not show a breakaway with it."""
    run, _ = pair_of_runs(rig, Fc=30.0, Fs=40.0, v_stribeck=0.02, fall=1.0)
    terms = tuple(map(Used, baseline()))
    data = regression_data(rig, terms, conditioned_records(rig, [run]))
    names = ("coulomb_friction", "stribeck_friction")
    starts = [at_start(rig, make(name, "joint 2")) for name in names]

    def not_shown(self: Effect, rig: Rig, values: Any, shape: Sequence[float], *_: Any) -> str:
        return "" if shown or len(shape) < 4 else "it hardly falls"

    monkeypatch.setattr(StribeckFriction, "not_shown", not_shown)
    stribeck = refinement.refine(data, (*terms, *starts)).terms[-1]
    assert (len(stribeck.shape) == 4) == shown


def test_effects_keep_their_forms_until_their_set_is_chosen(rig: Rig) -> None:
    """The lag is of second order; tried beside a leak, it stays of first order at first."""
    hidden = foreign_bench.Hidden(spool_frequency=50.0, spool_damping=0.5)
    runs = foreign_bench.pair_of_runs(rig, hidden, seed=2)
    sets = searched(rig, *runs, "spool_lag", "internal_leakage").hypotheses
    lag = Used(make("spool_lag", "joint 2"), (0.003,))
    leak = at_start(rig, make("internal_leakage", "joint 2"))
    sets.fitted.clear()
    tried = sets.refined([lag, leak], in_form=[lag])
    assert len(tried.effects[0].shape) == 1
    assert sets.refined([lag, leak]) is tried
    chosen = sets.in_best_forms(tried)
    assert len(chosen.effects[0].shape) == 2
    assert chosen.total < 0.1 * tried.total
    assert sets.fitted[tried.keys] is sets.in_best_forms(chosen) is chosen


def test_a_form_that_leaves_far_more_beside_the_others_is_searched_no_further(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A held input is half a sample of the lag: it leaves as much here."""
    hidden = foreign_bench.Hidden(spool_frequency=50.0, spool_damping=0.9)
    s = searched(rig, *foreign_bench.pair_of_runs(rig, hidden, seed=2), "spool_lag")
    data, fit = s.hypotheses.train_data, s.winner.fit
    (lag,) = s.winner.effects
    place, (other,) = fit.terms.index(lag), lag.term.other_form_starts(rig, lag.shape)
    found = refinement._in_other_form(data, fit, place, other)
    assert found is not None
    ratio = found.energy / fit.energy
    monkeypatch.setattr(refinement, "SEARCH", replace(SEARCH, unpromising_form=0.9 * ratio))
    assert refinement._in_other_form(data, fit, place, other) is None


def test_a_lag_has_no_hold_at_its_input_unless_the_records_show_one(rig: Rig) -> None:
    """Of second order, the lag with a held input, half a sample shorter, fits as well by chance."""
    hidden = foreign_bench.Hidden(spool_frequency=50.0, spool_damping=0.9)
    s = searched(rig, *foreign_bench.pair_of_runs(rig, hidden, seed=2), "spool_lag")
    (lag,) = s.winner.effects
    assert lag.shape == pytest.approx((2.0 * 0.9 / (2.0 * np.pi * 50.0), 0.9), rel=0.01)
    data = s.hypotheses.train_data
    ((_, held),) = refinement.fits_in_other_forms(data, s.winner.fit)
    assert held.energy < s.winner.fit.energy
    shift = form_shift(data, s.winner.fit)
    assert shift["tau_spool_2"] == pytest.approx(0.5 / rig.sample_rate, rel=0.05)
