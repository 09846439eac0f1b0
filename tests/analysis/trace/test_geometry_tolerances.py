"""A rig file whose areas, volumes and pin distances are wrong, within the tolerances it states.

The bench keeps its geometry; the rig file that the records are read with states other numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.engine import trace
from analysis.trace.result import Trace
from analysis.trace.search import geometry
from analysis.trace.search.exact_fit import fit_coefficients
from analysis.trace.search.geometry import Geometry, geometry_for_smaller_set, residual_changes
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import SEARCH
from analysis.trace.stages import one_bandwidth
from rig.model.records import Run
from rig.model.rig import Rig
from rig.model.tolerances import Tolerances
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.gate_cases import at_joint_2, searched
from tests.analysis.trace.hidden import STATED, misread, pair_of_runs


def traced(runs: tuple[Run, Run], tolerances: Tolerances | None = STATED) -> Trace:
    train, held_out = (misread(run, tolerances=tolerances) for run in runs)
    return trace([train], [held_out], look_ahead=False)


def test_wrong_numbers_within_their_tolerances_are_no_effect(rig: Rig) -> None:
    runs = pair_of_runs(rig)
    as_exact = traced(runs, tolerances=None)
    assert as_exact.verdict != "clean"
    assert any("state `tolerances`" in note for note in as_exact.notes)
    result = traced(runs)
    assert (result.verdict, result.effects) == ("clean", ())
    assert result.unexplained_fraction == 0.0
    (note,) = [n for n in result.notes if "are taken within the tolerances" in n]
    assert "as stated" in note
    for name in ("b", "M2", "W2", "Fv2", "C_pp_2"):
        low, high = result.model_after.parameters[name].ci95
        assert low < TRUTH[name] < high


def test_an_effect_beside_wrong_numbers_is_named_alone(rig: Rig) -> None:
    result = traced(pair_of_runs(rig, c_internal=2e-12))
    assert [(e.name, e.where) for e in result.effects] == [("internal_leakage", "joint 2")]
    low, high = result.effects[0].parameters["c_internal_2"].ci95
    assert low < 2e-12 < high


def test_a_part_of_the_set_is_tried_with_the_geometry_though_the_search_did_not_fit_it(
    rig: Rig,
) -> None:
    runs = [misread(run, tolerances=STATED) for run in pair_of_runs(rig, c_internal=2e-12)]
    s = searched(runs[0].rig, *runs, "internal_leakage", "sensor_gain", "dead_volume")
    names = {("internal_leakage", "joint 2"), ("sensor_gain", "joint 2 cap")}
    effects = [at_start(s.hypotheses.train_data.rig, make(*key)) for key in sorted(names)]
    winner = s.hypotheses.refined(effects)
    s.hypotheses.fitted = {winner.keys: winner}
    assert geometry_for_smaller_set(s.hypotheses, winner, explained=True) is not None
    assert frozenset({("internal_leakage", "joint 2")}) in s.hypotheses.fitted


def test_records_are_traced_again_only_where_the_other_geometry_leaves_little(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To first order a geometry may explain what its rows do not bear out."""
    traces: list[object] = []
    again = one_bandwidth._traced_within_tolerances
    proposed = one_bandwidth.geometry_for_smaller_set

    def counted(*arguments: Any) -> Trace | None:
        traces.append(arguments)
        return again(*arguments)

    def elsewhere(*arguments: Any, **named: Any) -> Geometry:
        geometry = proposed(*arguments, **named)
        far = runs[0].rig.with_deviations((-2.0 * geometry.deviations).tolist())
        return replace(geometry, rig=far)

    monkeypatch.setattr(one_bandwidth, "_traced_within_tolerances", counted)
    runs = [misread(run, tolerances=STATED) for run in pair_of_runs(rig)]
    candidates = at_joint_2(runs[0].rig, "sensor_gain", "dead_volume")

    def verdict() -> str:
        return trace([runs[0]], [runs[1]], candidates, look_ahead=False, free_forms=False).verdict

    assert verdict() == "clean"
    assert len(traces) == 1
    monkeypatch.setattr(one_bandwidth, "geometry_for_smaller_set", elsewhere)
    assert verdict() != "clean"
    assert len(traces) == 1


def a_leak_and(rig: Rig, name: str, where: str) -> tuple[HypothesisSet, Hypothesis, Hypothesis]:
    """Return the sets of a bench with a leak: that of the leak, and that with a second effect."""
    runs = [misread(run, tolerances=STATED) for run in pair_of_runs(rig, c_internal=2e-12)]
    s = searched(runs[0].rig, *runs, "internal_leakage", name)
    leak, second = s.set_of("internal_leakage"), at_start(runs[0].rig, make(name, where))
    return s.hypotheses, leak, s.hypotheses.refined([*leak.effects, second])


@pytest.mark.parametrize(("share", "is_smaller"), [(0.5, True), (1.5, False)])
def test_a_smaller_set_may_leave_the_price_of_the_numbers_it_saves(
    rig: Rig, share: float, is_smaller: bool
) -> None:
    """A leak was named with a gain within the area's tolerance: alone it left 1 % more."""
    sets, leak, both = a_leak_and(rig, "sensor_gain", "joint 2 cap")
    data = sets.train_data
    changes = residual_changes(data, both.fit, data.rig.uncertain_numbers)
    _, left = geometry.likeliest(data, leak, changes)
    price = SEARCH.number_price * (sum(both.size) - sum(leak.size))
    winner = replace(both, excess_energy={e: v - share * price for e, v in left.items()})
    sets.fitted = {leak.keys: leak, winner.keys: winner}
    sets.noise_band = dict.fromkeys(left, -np.inf)
    found = geometry_for_smaller_set(sets, winner, explained=True)
    assert (found is not None and found.effects == leak.effects) == is_smaller


@pytest.mark.parametrize(("left", "is_smaller"), [(0.4, True), (1.5, False)])
def test_of_sets_that_leave_noise_beside_a_geometry_the_simplest_is_taken(
    rig: Rig, left: float, is_smaller: bool
) -> None:
    """A dead volume of 1.7 tolerances was named: the shapes of a sag had adapted to the pipe."""
    sets, leak, both = a_leak_and(rig, "dead_volume", "joint 2 rod")
    band = sets.noise_band
    smaller = replace(leak, excess_energy={e: left * v for e, v in band.items()})
    larger = replace(both, excess_energy={e: 0.01 * v for e, v in band.items()})
    nowhere = np.zeros(len(sets.train_data.rig.uncertain_numbers))
    found, _ = geometry._simplest(sets, [(larger, nowhere), (smaller, nowhere)])
    assert (found is smaller) == is_smaller


def test_a_gain_far_beyond_the_tolerance_of_an_area_is_still_named(rig: Rig) -> None:
    train, held_out = pair_of_runs(rig)

    def misgauged(run: Run) -> Run:
        records = []
        for r in run.records:
            pressure = 1.06 * r.channels["cap_pressure_2"]
            records.append(replace(r, channels={**r.channels, "cap_pressure_2": pressure}))
        rig = run.rig.model_copy(update={"tolerances": STATED})
        return replace(run, rig=rig, records=tuple(records))

    result = trace([misgauged(train)], [misgauged(held_out)], look_ahead=False)
    assert "sensor_gain" in {e.name for e in result.effects}
    assert not any("tolerances" in note for note in result.notes if "are taken" in note)


def test_changes_by_one_sigma_are_those_of_records_read_with_the_other_rig(rig: Rig) -> None:
    train, _ = pair_of_runs(rig)
    stated = rig.model_copy(update={"tolerances": STATED})
    terms = tuple(map(Used, baseline_of(rig)))
    data = regression_data(stated, terms, conditioned_records(stated, [train]))
    fit = fit_coefficients(data, terms)
    numbers = [n for n in stated.uncertain_numbers if n.joint == 1]
    changes = residual_changes(data, fit, numbers)
    for number, change in zip(numbers, changes.T, strict=True):
        other = stated.with_moved(number)
        again = regression_data(other, terms, conditioned_records(other, [train]), fit.beta)
        expected = np.concatenate(
            [
                again.mean_residual[t.where] * t.noise / s.noise - data.mean_residual[s.where]
                for s, t in zip(data.segments, again.segments, strict=True)
            ]
        )
        assert np.linalg.norm(change - expected) < 0.02 * np.linalg.norm(expected), number.name


@pytest.mark.slow
def test_the_interval_of_a_dead_volume_includes_how_well_the_pipe_is_known(rig: Rig) -> None:
    result = traced(pair_of_runs(rig, V_cap=4e-5))
    assert [(e.name, e.where) for e in result.effects] == [("dead_volume", "joint 2 cap")]
    volume = result.effects[0].parameters["V_dead_2_cap"]
    low, high = volume.ci95
    assert low < 4e-5 < high
    pipe = STATED.volume * rig.joints[1].cylinder.cap_pipe_volume
    assert high - low > 2 * pipe
