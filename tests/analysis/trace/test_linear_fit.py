"""The linear search sees a coefficient's column where only a small part of it is its own."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.effects.base import Effect
from analysis.effects.friction import CoulombFriction
from analysis.effects.mechanics import TorqueOffset
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import VariantColumns, regression_data
from analysis.trace.search.linear_fit import (
    CandidateColumns,
    LinearFit,
    gains,
    pairs_of_chambers,
    project,
    sets_with_one_more,
)
from rig.model.rig import Rig
from tests.analysis.trace.foreign_bench import RMS, Hidden, experiment, pair_of_runs
from tests.analysis.trace.gate_cases import searched


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
        Used(TorqueOffset("joint 2"), ()), (name,), column[:, None], frozenset({"torque_2"})
    )
    candidates = project(data, [entry], lambda _: 1, lambda *_: True)
    gained = gains(
        candidates.K, candidates.columns.T @ own, candidates.groups, candidates.visibility_limit
    )
    assert gained[0] == pytest.approx(float(own @ own) if shows else 0.0)


def test_an_effect_that_fits_with_an_impossible_number_leaves_room_for_others(rig: Rig) -> None:
    """Fifty shapes of it would be the only ones that are fitted together with the set."""
    run = experiment(rig, Hidden(), repeats=1, seed=1, rms=RMS)
    data = regression_data(
        rig, [Used(term) for term in baseline_of(rig)], conditioned_records(rig, [run])
    )
    rng, torque = np.random.default_rng(0), np.zeros(len(data.base))
    for s in data.segments:
        if s.equation == "torque_2":
            torque[s.where] = 5.0 * rng.normal(size=s.where.stop - s.where.start)
    r = torque - data.base @ np.linalg.lstsq(data.base, torque, rcond=None)[0]

    def entry(effect: Effect, shape: tuple[float, ...], share: float) -> VariantColumns:
        other = rng.normal(size=len(r)) * (torque != 0.0)
        column = share * r + (1.0 - share) * other
        where = frozenset({"torque_2"})
        return VariantColumns(Used(effect, shape), ("size",), column[:, None], where)

    friction, offset = CoulombFriction("joint 2"), TorqueOffset("joint 2")
    entries = [entry(friction, (1e-5 * k,), 0.99) for k in range(1, 51)]
    entries.append(entry(offset, (), 0.7))
    candidates = project(data, entries, lambda _: 1, lambda e, _: e.used.term is offset)
    found = sets_with_one_more(candidates, (), r)
    assert [candidates.entries[m].used.term for m in found[0].members] == [offset]


def test_longer_pipes_at_both_chambers_are_tried_together(rig: Rig) -> None:
    """Hoses on both, which stiffen under pressure: half of each volume is in either alone."""
    runs = pair_of_runs(rig, Hidden(hoses=1e-4))
    s = searched(rig, *runs, "dead_volume", "sensor_offset", "sensor_gain")
    candidates, r = s.hypotheses.candidates, s.hypotheses.train_data.mean_residual
    r = r - candidates.basis @ (candidates.basis.T @ r)
    best, *others = pairs_of_chambers(candidates, r)
    assert keys(candidates, best) == {("dead_volume", f"joint 2 {side}") for side in ("cap", "rod")}
    assert best.total <= min(pair.total for pair in others)
    (left, *_) = pairs_of_chambers(candidates, r, [("dead_volume", "joint 2 cap")])
    assert not keys(candidates, left) & keys(candidates, best)
    assert s.winner.keys == keys(candidates, best)


def keys(candidates: CandidateColumns, pair: LinearFit) -> frozenset[tuple[str, str]]:
    return frozenset(candidates.entries[m].used.term.key for m in pair.members)
