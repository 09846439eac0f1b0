"""Held-out records, not the energy left, say whether dry friction has a level by direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.effects.friction import CoulombFriction, StribeckFriction
from analysis.signals.conditioning import condition
from analysis.terms.base import Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from analysis.trace.judge import readings
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.settings import TRACE
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.trace.foreign_bench import Hidden, pair_of_runs
from tests.analysis.trace.gate_cases import searched
from tests.studies.foreign.bench import runs_of
from tests.studies.foreign.cases import case_of
from tests.variants import kept


def test_two_levels_that_energy_takes_for_one_are_asymmetric_friction(rig: Rig) -> None:
    """21 and 38 N, one repeat, eight times the noise: both laws leave about equally little."""
    runs = pair_of_runs(rig, Hidden(21.0, 38.0), repeats=1, noise=8.0)
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction")
    assert [u.term.name for u in s.winner.effects] == ["coulomb_friction"]
    settled = readings.best_readings(s.hypotheses, s.winner, s.holdout_data)
    assert [u.term.name for u in settled.effects] == ["asymmetric_friction"]
    assert settled.fit.beta["F_ext_2"] == pytest.approx(21.0, rel=0.2)
    assert settled.fit.beta["F_ret_2"] == pytest.approx(38.0, rel=0.2)


def test_one_level_in_the_same_noise_stays_coulomb_friction(rig: Rig) -> None:
    runs = pair_of_runs(rig, Hidden(30.0, 30.0), repeats=1, noise=8.0)
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction")
    settled = readings.best_readings(s.hypotheses, s.winner, s.holdout_data)
    assert [u.term.name for u in settled.effects] == ["coulomb_friction"]


@pytest.mark.slow
def test_levels_are_found_where_a_change_of_gravity_makes_most_of_their_difference() -> None:
    """Levels of 21 and 72 N remove only 12 % of what one level leaves: W1 takes their mean."""
    case = case_of(72044, kind="pair")
    names = ("coulomb_friction", "asymmetric_friction", "torque_offset")
    train, held_out = runs_of(case.bench, case.seed)
    found = trace(
        [train], held_out, effects=catalogue(case.bench.rig, names), look_ahead=False,
        free_forms=False, families=("mechanical",),
    )  # fmt: skip
    levels = next(e for e in found.effects if e.name == "asymmetric_friction")
    assert (levels.where, found.verdict) == ("joint 1", "explained")
    for name, size in (("F_ext_1", 21.0), ("F_ret_1", 72.0)):
        low, high = levels.parameters[name].ci95
        assert low < size < high


@pytest.mark.parametrize(("breakaway", "determined"), kept([(0.0, False), (16.0, True)], (1,)))
def test_a_breakaway_is_added_only_where_records_determine_all_its_numbers(
    rig: Rig, breakaway: float, determined: bool
) -> None:
    runs = pair_of_runs(rig, Hidden(40.0, 40.0, breakaway=breakaway), noise=2.0)
    s = searched(rig, *runs, "coulomb_friction", "stribeck_friction")
    both = s.set_of("coulomb_friction", "stribeck_friction")
    (stribeck,) = (u for u in both.effects if u.term.name == "stribeck_friction")
    assert readings._is_determined(s.hypotheses, both, stribeck) is determined
    settled = readings.best_readings(s.hypotheses, s.winner, s.holdout_data)
    assert ("stribeck_friction" in {u.term.name for u in settled.effects}) is determined


@pytest.mark.slow
@pytest.mark.parametrize(("breakaway", "falls"), [(0.0, False), (60.0, True)])
def test_a_breakaway_that_does_not_fall_is_a_second_contact_of_the_level(
    rig: Rig, breakaway: float, falls: bool
) -> None:
    """One contact with memory and one without fit a reversal that neither fits alone."""
    runs = pair_of_runs(rig, Hidden(40.0, 40.0, 3e-3, breakaway=breakaway))
    s = searched(rig, *runs, "coulomb_friction", "stribeck_friction")
    part = Used(StribeckFriction("joint 2"), (0.02, 1e-5))
    effects = Used(CoulombFriction("joint 2"), (0.0, 0.0, 3e-3)), part
    data, empty = s.hypotheses.train_data, s.hypotheses.empty
    fit = fit_coefficients(data, (*empty.fit.terms, *effects))
    pair = replace(empty, effects=effects, fit=fit)
    assert readings._falls(s.hypotheses, pair, part, s.holdout_data) is falls


def test_a_breakaway_without_its_fall_is_a_level(rig: Rig, multisine_run: Run) -> None:
    signals = condition(rig, multisine_run.records[0])
    breakaway, level = StribeckFriction("joint 1"), CoulombFriction("joint 1")
    shape = breakaway.without_fall(rig, (0.01, 3e-5))
    (one,) = breakaway.columns(rig, signals, shape)["torque_1"].values()
    (other,) = level.columns(rig, signals, shape[1:])["torque_1"].values()
    assert one == pytest.approx(other, abs=1e-4 * np.abs(other).max())


def test_one_level_with_an_offset_torque_is_said_to_fit_as_well_as_levels_by_direction(
    rig: Rig,
) -> None:
    """About one place of the stroke the lever arm hardly changes, and both are one torque."""
    runs = pair_of_runs(rig, Hidden(21.0, 38.0))
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction", "torque_offset")
    (effect,) = s.judged("asymmetric_friction")
    (gate,) = (g for g in effect.gates if g.name == "no rival")
    assert gate.ok
    assert "coulomb_friction and torque_offset together would leave" in gate.detail


@pytest.mark.parametrize(
    ("truth", "needed"), [(0.0, False), (0.4, False), (0.6, True), (1.0, True)]
)
def test_a_richer_name_must_leave_less_in_held_out_records(truth: float, needed: bool) -> None:
    """The richer model subtracts a curve; the held-out rows hold a share of it."""
    rng = np.random.default_rng(3)
    curve = np.sin(np.linspace(0.0, 40.0, 4000))
    rows = rng.standard_normal(len(curve)) + truth * curve
    richer = rows - curve
    if 0.0 < truth < 1.0:
        assert readings.loss_in_deviations(rows, richer) > TRACE.standard_errors
        assert readings.loss_in_deviations(richer, rows) > TRACE.standard_errors
    assert readings.loses_by_restriction(rows, richer) is needed
