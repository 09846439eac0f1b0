"""Output error of an electric joint: the parameters whose free run stays nearest."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.simulation.validate import validate
from analysis.terms import with_effects
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Run
from rig.runs.rigs import load_rig
from tests.analysis.carriage import Carriage, moves, record

EFFECTS = ("coulomb_friction", "torque_offset")


@pytest.fixture(scope="module")
def runs() -> tuple[Run, Run]:
    rig, rng = load_rig("emps"), np.random.default_rng(3)
    falling = Carriage(breakaway=6.0)
    train = record(rig, falling, moves(1000.0, 10.0, 0.05, 0.2), rng, "train")
    judge = record(rig, falling, moves(1000.0, 10.0, 0.07, 0.15), rng, "judge")
    return Run(rig, (train,)), Run(rig, (judge,))


def fitted(run: Run, estimator: str, bootstrap: int = 0) -> Identification:
    terms = [Used(term) for term in with_effects(run.rig, EFFECTS)]
    return identify([run], terms=terms, estimator=estimator, bootstrap=bootstrap)


def off(found: Identification, run: Run) -> float:
    (result,) = validate(found.model, [run])
    return result.rmse["position_1"]


def test_it_runs_nearer_than_least_squares_where_the_model_lacks_something(
    runs: tuple[Run, Run],
) -> None:
    train, judge = runs
    rows, free = fitted(train, "ls"), fitted(train, "output-error")
    assert off(free, train) < 0.8 * off(rows, train)
    assert off(free, judge) < 1.1 * off(rows, judge)
    said = next(c for c in free.checks if c.name == "output error")
    assert said.ok
    assert "1 whole record(s)" in said.detail
    assert free.model.provenance["estimator"] == "output-error"


def test_it_finds_the_truth_where_only_the_reversals_are_finer_than_the_model() -> None:
    rig, rng = load_rig("emps"), np.random.default_rng(4)
    truth = {"M1": 95.0, "Fv1": 200.0, "Fc1": 20.0, "offset1": -3.0}
    records = tuple(
        record(rig, Carriage(), moves(1000.0, 6.0, 0.05, 0.25), rng, "train", repeat)
        for repeat in (1, 2)
    )
    found = fitted(Run(rig, records), "output-error")
    for name, value in truth.items():
        assert found.estimates[name].value == pytest.approx(value, rel=0.04), name
        assert found.estimates[name].std > 0


def test_what_cannot_be_simulated_is_refused_in_words(runs: tuple[Run, Run]) -> None:
    train, _ = runs
    one_way = 0.03 + 0.03 * np.arange(5000) / 1000.0
    away = record(train.rig, Carriage(), one_way, np.random.default_rng(5), "away")
    with pytest.raises(InputError, match=r"does not determine .*offset1"):
        fitted(Run(train.rig, (away,)), "output-error")
    with pytest.raises(InputError, match="does not go with --estimator output-error"):
        fitted(train, "output-error", bootstrap=200)
