"""Every gate and statistic of the trace, broken one at a time, is noticed by a bench that needs it.

A story holds with all rules; each rule and each fault beside it (`tests.studies.trace.rules`) must
make it fail (`rule_stories`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace import judging
from analysis.trace.data.candidates import at_start
from analysis.trace.finding import Finding, remainders
from analysis.trace.judge import gates, held_out
from analysis.trace.judge.gates import judged_beside_unknown_cause
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.settings import SEARCH
from rig.model.rig import Rig
from tests.analysis.trace import foreign_bench, gate_cases
from tests.analysis.trace.foreign_bench import Hidden
from tests.analysis.trace.gate_cases import LEAK
from tests.analysis.trace.hidden import pair_of_runs
from tests.analysis.trace.rule_stories import NO_BENCH, SLOW, STORIES, Benches, Story
from tests.studies.trace.rules import FAULTS, RULES, by_name, switched_off
from tests.variants import kept


@pytest.fixture(scope="module")
def benches(rig: Rig) -> Benches:
    return Benches(rig)


@pytest.mark.parametrize(
    ("story", "broken"),
    kept(STORIES, [k for k, (story, _) in enumerate(STORIES) if story not in SLOW]),
    ids=[s.__name__ for s, _ in STORIES],
)
def test_what_a_gate_is_for_holds_and_is_lost_without_it(
    benches: Benches, story: Story, broken: tuple[str, ...]
) -> None:
    story(benches)
    known = by_name(RULES + FAULTS)
    for name in broken:
        with switched_off(known[name]):
            try:
                story(benches)
            except AssertionError:
                continue
        pytest.fail(f"nobody notices: {known[name].off}")


def test_every_rule_and_fault_has_a_story() -> None:
    told = {name for _, broken in STORIES for name in broken}
    assert set(by_name(RULES + FAULTS)) - told == NO_BENCH


def test_an_edge_cannot_overlap_and_be_open_at_the_null(rig: Rig) -> None:
    """Together the two names would only bend the edge's form."""
    names = ("valve_deadband", "underlap_leakage")
    s = gate_cases.searched(rig, *pair_of_runs(rig, c_internal=LEAK), *names)
    assert "exclude each other" in s.hypotheses.physical_problem(s.set_of(*names))
    for name in names:
        assert "exclude" not in s.hypotheses.physical_problem(s.set_of(name))


def test_an_effect_that_removes_nothing_is_compared_with_no_other(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it the other effects leave as little: no equation shows what a rival would do."""
    names = ("internal_leakage", "sensor_offset")
    s = gate_cases.searched(rig, *pair_of_runs(rig, c_internal=LEAK), *names)
    leak = s.set_of("internal_leakage")
    s.set_of("sensor_offset")
    monkeypatch.setattr(gates, "_set_without", lambda *_: leak)
    (judged,) = gates.judge_effects(s.hypotheses, leak, s.holdout_data, np.random.default_rng(0))
    words = {gate.name: gate.detail for gate in judged.gates}
    assert judged.rivals == ()
    assert not gates.passes_gates(judged)
    assert "it removes nothing" in words[gates.NO_RIVAL]
    assert not any("nan" in text for text in words.values())


def test_the_lag_of_all_spools_is_compared_with_one_delay_of_all_pistons(rig: Rig) -> None:
    """Commands in place of two spools: one number for the pistons was named, without this rival."""
    s = gate_cases.searched(rig, *pair_of_runs(rig), "channel_delay")
    data = s.hypotheses.train_data
    delay = replace(at_start(rig, make("channel_delay", "bench piston")), shape=(2e-3,))
    late = replace(s.hypotheses.refined([delay]), excess_energy=s.hypotheses.empty.excess_energy)
    early = {e: v + 1e3 for e, v in late.excess_energy.items()}
    s.hypotheses.empty = replace(s.hypotheses.empty, excess_energy=early)
    gates.judge_effects(s.hypotheses, late, s.holdout_data, np.random.default_rng(0))
    pair = make("channel_delay", "bench piston").alike_together(data.rig)
    assert pair == (("spool_lag", "joint 1"), ("spool_lag", "joint 2"))
    assert frozenset(pair) in s.hypotheses.fitted
    assert make("channel_delay", "joint 1 piston").alike_together(data.rig) == ()


def test_equal_delays_of_pistons_and_pressures_are_not_separated_from_lags_of_the_spools(
    rig: Rig,
) -> None:
    """Commands in place of the spools, once more: everything else is late by the same time."""
    pistons, pressures = (make("channel_delay", f"bench {k}") for k in ("piston", "pressure"))
    lags = (("spool_lag", "joint 1"), ("spool_lag", "joint 2"))
    for one, other in ((pistons, pressures), (pressures, pistons)):
        alike, unlike = (Used(other, (time,)) for time in (5.2e-3, 9e-3))
        assert one.inseparable_beside(rig, (5e-3,), [alike]) == lags
        assert one.inseparable_beside(rig, (5e-3,), [unlike]) == ()
        assert one.inseparable_beside(rig, (5e-3,), [Used(one, (5e-3,))]) == ()
    single = make("channel_delay", "joint 1 piston")
    assert single.inseparable_beside(rig, (5e-3,), [Used(pressures, (5e-3,))]) == ()


def test_what_held_out_records_lose_in_another_equation_counts_against_an_effect(rig: Rig) -> None:
    """Three times the noise in one equation: by the effect, there before, or without it too."""
    s = gate_cases.searched(rig, *pair_of_runs(rig, c_internal=LEAK), "internal_leakage")
    rows = s.holdout_data
    good = np.random.default_rng(0).standard_normal(len(rows.mean_residual))
    bad = good.copy()
    for segment in rows.segments:
        if segment.equation == "torque_2":
            bad[segment.where] *= 3.0
    assert held_out.disturbed_in_held_out(rows, good, good, bad) == ["torque_2"]
    assert held_out.disturbed_in_held_out(rows, bad, good, bad) == []
    assert held_out.disturbed_in_held_out(rows, good, bad, bad) == []
    assert held_out.disturbed_in_held_out(rows, good, good, good) == []


@pytest.mark.parametrize(
    ("size", "removed", "in_noise"),
    [(3.0, 1.0, False), (0.8, 1.0, True), (0.02, 0.0, False)],
    ids=["above the noise", "below it, seen along the change", "not seen at all"],
)
def test_an_effect_that_held_out_rows_hardly_show_is_judged_by_its_change_of_them(
    rig: Rig, size: float, removed: float, in_noise: bool
) -> None:
    """A sine in noise, and noise alone, each with an effect that is that sine.

    In each equation the noise has the energy of its rows and none along the sine.
    """
    s = gate_cases.searched(rig, *pair_of_runs(rig, c_internal=LEAK), "internal_leakage")
    rows = s.holdout_data
    noise = np.random.default_rng(8).normal(size=len(rows.mean_residual))
    cause = size * np.sin(np.arange(len(noise)) / 7.0)
    for where in (segment.where for segment in rows.segments):
        sine = cause[where]
        apart = noise[where] - sine * (noise[where] @ sine) / (sine @ sine)
        noise[where] = apart * np.sqrt(len(apart) / (apart @ apart))
    changes = {s.equation: 100.0 for s in rows.segments}
    right = held_out.removal_of(rows, changes, noise + cause, noise)
    assert right.share == pytest.approx(removed)
    assert right.in_noise is in_noise
    nothing = held_out.removal_of(rows, changes, noise, noise - cause)
    assert nothing.share == pytest.approx(0.0)


def test_a_further_effect_that_takes_all_that_is_left_is_named_although_it_ties(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dead volume beside a leak, in equations that held-out records allow to keep it."""
    runs = pair_of_runs(rig, c_internal=LEAK, V_cap=3e-5)
    s = gate_cases.searched(rig, *runs, "internal_leakage", "dead_volume")
    leak = s.set_of("internal_leakage")
    left = tuple(r._replace(veto=False) for r in remainders(s.hypotheses, leak, s.holdout_data))
    assert left
    monkeypatch.setattr(judging, "has_tied_rival", lambda effects: len(effects) > 1)
    for share, names in (
        (SEARCH.further_share, {"internal_leakage", "dead_volume"}),
        (-1.0, {"internal_leakage"}),
    ):
        monkeypatch.setattr(judging, "SEARCH", replace(SEARCH, further_share=share))
        judge, effects = s.judge(np.random.default_rng(0)), tuple(s.judged("internal_leakage"))
        found = Finding(judge.rows, s.hypotheses, leak, "", effects, left)
        assert {e.name for e in judge._extended(found).effects} == names


def test_both_parts_of_a_law_are_judged_where_one_does_not_explain(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Friction with a large breakaway: its level alone varies with speed."""
    runs = foreign_bench.pair_of_runs(rig, Hidden(60.0, 60.0, breakaway=120.0))
    names = ("coulomb_friction", "stribeck_friction")
    s = gate_cases.searched(rig, *runs, *names)
    level, both = s.set_of("coulomb_friction"), s.set_of(*names)
    monkeypatch.setattr(judging.readings, "best_readings", lambda *_: level)

    def judged(found: Hypothesis) -> Finding:
        return s.judge(np.random.default_rng(0)).best_finding(found)

    for found in (level, both):
        assert {e.name for e in judged(found).effects} == set(names)
    monkeypatch.setattr(judging.Judge, "_under_other_names", lambda *_: None)
    assert judged(level).verdict == "unexplained"


def test_a_size_that_may_be_nothing_is_no_name_beside_an_unknown_cause(benches: Benches) -> None:
    """What an unknown cause leaves may widen the interval of a leak beyond zero."""
    runs = benches.runs(c_internal=LEAK)
    sets = benches.searched(runs, "internal_leakage")
    winner = sets.set_of("internal_leakage")
    (leak,) = benches.traced(runs, "internal_leakage").effects
    ((name, size),) = leak.parameters.items()
    known = replace(leak, parameters={name: replace(size, ci95=(0.1 * LEAK, 3.0 * LEAK))})
    open_size = replace(leak, parameters={name: replace(size, ci95=(-LEAK, 3.0 * LEAK))})
    passed, refused = judged_beside_unknown_cause(sets.hypotheses, winner, (known, open_size), ())
    assert all(gate.ok for gate in passed.gates)
    assert [g.detail for g in refused.gates if not g.ok] == [
        f"{name} may be nothing within the interval beside a cause that is not known"
    ]
