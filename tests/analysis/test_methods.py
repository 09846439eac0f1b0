"""The other ways to identify: what they give, what they cannot, and that they say so."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.methods.search import (
    COMPLEX,
    DIVERGED,
    SearchOptions,
    SearchTask,
    make_task,
    score,
    searched_names,
    single_joint_record,
)
from analysis.identify.result import Identification, to_json
from analysis.identify.settings import IDENTIFY
from analysis.regression.rows import default_filtering
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis import small_bench as bench
from tests.analysis.small_bench import TRUTH
from tests.studies.reproduction.numbers import (
    experiments,
    oil_temperatures,
    payload_changes,
    payload_response,
    spread,
)

WARM = {**TRUTH, "b": 260e6}
STEP1 = ("M2", "Fv2", "W2", "b", "C_pp_2", "C_pm_2", "C_mp_2", "C_mm_2")
SMALL = SearchOptions(evaluations=60, population=12, windows=1, seconds=1.0)


def steps(run: Run, *names: str) -> Run:
    return replace(run, records=tuple(r for r in run.records if r.step in names))


def check(result: Identification, name: str) -> tuple[bool, str]:
    found = next(c for c in result.checks if c.name == name)
    return found.ok, found.detail


@pytest.fixture(scope="module")
def drifting_run(rig: Rig) -> Run:
    """STEP1 with cold oil, STEP2 and STEP3 with warm: b is not the same in every step."""
    wave = bench.default_excitations(5, 0.025)
    cold = bench.experiment(rig, wave, repeats=3, seed=21, steps=bench.STEPS[:1], seconds=5.0)
    warm = bench.experiment(
        rig, wave, repeats=3, seed=22, steps=bench.STEPS[1:], seconds=5.0, truth=WARM
    )
    return replace(cold, records=cold.records + warm.records)


def test_the_sequential_method_gives_several_values_for_b_and_says_so(drifting_run: Run) -> None:
    result = identify([drifting_run], "sequential")
    data = result.extra["sequential"]
    values = [entry["value"] for entry in data["per_step"]["b"]]
    assert [entry["step"] for entry in data["per_step"]["b"]] == ["step1", "step2", "step3"]
    assert values[0] == pytest.approx(233e6, rel=0.02)
    assert values[1:] == pytest.approx([260e6, 260e6], rel=0.02)
    # Ten per cent apart, each known to a fraction of one: no chance.
    assert data["disagreement"]["b"] > 3
    ok, detail = check(result, "one value each")
    assert not ok
    assert "b: step1" in detail
    # E1 is the first step's whatever came later, E2 is the mean of 1/b, coupled is one value.
    assert data["E1"]["b"]["step"] == "step1"
    assert result.estimates["b"].value == pytest.approx(values[0])
    assert 1 / data["E2"]["b"]["value"] == pytest.approx(np.mean([1 / v for v in values]))
    coupled = identify([drifting_run]).estimates["b"].value
    assert min(values) < coupled < max(values)


def test_each_steps_own_values_are_what_identifying_that_step_alone_gives(
    drifting_run: Run,
) -> None:
    data = identify([drifting_run], "sequential").extra["sequential"]
    for step in ("step1", "step2", "step3"):
        alone = identify([steps(drifting_run, step)], estimator="plain").estimates
        for name, found in data["per_step"].items():
            for entry in found:
                if entry["step"] == step:
                    assert entry["value"] == pytest.approx(alone[name].value, rel=1e-6)


@pytest.mark.slow
def test_without_drift_all_ways_end_near_the_truth(multisine_run: Run) -> None:
    result = identify([multisine_run], "sequential")
    for name, entry in result.extra["sequential"]["E2"].items():
        assert entry["value"] == pytest.approx(TRUTH[name], rel=0.02)
    for name, estimate in result.estimates.items():
        assert estimate.value == pytest.approx(TRUTH[name], rel=0.02)
    # M1 and R12 are a sum in STEP2: they wait for STEP3, and no step has them alone.
    assert result.extra["sequential"]["per_step"]["M1"] == []
    residual = [
        identify([multisine_run], method).solutions["mechanical"].residual_rms
        for method in ("sequential", "coupled")
    ]
    assert residual[0] >= residual[1]


def test_sequential_on_one_step_leaves_the_rest_null(multisine_run: Run) -> None:
    result = identify([steps(multisine_run, "step1")], "sequential")
    data = json.loads(json.dumps(to_json(result), allow_nan=False))
    assert data["method"] == "sequential"
    assert data["parameters"]["Fv1"]["value"] is None
    assert data["parameters"]["M2"]["value"] == pytest.approx(TRUTH["M2"], rel=0.01)
    assert check(result, "one value each") == (
        True,
        "no parameter is identified by more than one step",
    )


def test_simultaneous_uses_records_that_move_every_joint_and_no_other(
    multisine_run: Run, both_run: Run
) -> None:
    result = identify([multisine_run, both_run], "simultaneous")
    assert result.method == result.model.provenance["method"] == "simultaneous"
    assert result.model.provenance["records"] == ["both_r1"]
    ok, detail = check(result, "records used")
    assert not ok
    assert "1 of 13 records" in detail
    assert check(result, "gravity order")[0]
    lock = identify([multisine_run])
    worse = result.solutions["mechanical"].condition_number
    assert worse > lock.solutions["mechanical"].condition_number


def test_simultaneous_without_such_records_says_what_is_needed(multisine_run: Run) -> None:
    with pytest.raises(InputError, match="excite all 2 joints at once; in the steps step1 step2"):
        identify([multisine_run], "simultaneous")


@pytest.fixture(scope="module")
def task(rig: Rig, sine_run: Run) -> SearchTask:
    record = single_joint_record([sine_run])
    terms = tuple(Used(term) for term in baseline())
    return make_task(rig, record, terms, default_filtering(record), SMALL)


def test_the_truth_scores_well_and_a_wrong_machine_badly_or_not_at_all(task: SearchTask) -> None:
    truth = {name: TRUTH[name] for name in STEP1}
    assert task.record == "step1_r1"
    assert score(task, truth).failure == ""
    assert score(task, truth).error < 2e-3
    weak = {**truth, **{name: 0.7 * v for name, v in truth.items() if name.startswith("C_")}}
    assert score(task, weak).error > 10 * score(task, truth).error
    # Eight times too much cap flow one way: the rod chamber is driven beyond the supply.
    torn = score(task, {**truth, "C_pp_2": 8 * truth["C_pp_2"]})
    assert torn.failure in {COMPLEX, DIVERGED}
    assert torn.error >= IDENTIFY.failed_error


@pytest.mark.parametrize("method", ["pso", "ga"])
def test_a_search_loses_candidates_counts_them_and_gets_better(sine_run: Run, method: str) -> None:
    result = identify([sine_run], method, rng=np.random.default_rng(3), search=SMALL)
    found = result.extra["search"]
    assert found["evaluations"] == sum(found["generation_sizes"]) <= SMALL.evaluations
    assert found["generation_sizes"] == [12] * 5
    lost = sum(found["lost"].values())
    assert lost == sum(found["lost_by_generation"]) > 0
    assert found["lost_by_generation"][0] == found["lost_first_generation"] > 0
    ok, detail = check(result, "state exists")
    assert not ok
    assert f"{lost} of 60 candidates" in detail
    # None: not one of the generation lived.
    best = [np.inf if e is None else e for e in found["error_by_generation"]]
    assert best[0] == (found["error_first_generation"] or np.inf)
    assert found["error"] < best[0]
    assert best == sorted(best, reverse=True)
    assert best[-1] == found["error"]


def test_a_search_gives_step_ones_eight_parameters_and_null_for_the_rest(sine_run: Run) -> None:
    result = identify([sine_run], "pso", rng=np.random.default_rng(3), search=SMALL)
    data = json.loads(json.dumps(to_json(result), allow_nan=False))
    given = {name for name, p in data["parameters"].items() if p["value"] is not None}
    assert given == set(STEP1) == set(searched_names(sine_run.rig))
    assert all(p["ci95"] == [None, None] for p in data["parameters"].values())
    assert data["condition_number"] == {"mechanical": None, "fluid": None}
    for name in STEP1:
        low, high = data["search"]["bounds"][name]
        assert low <= data["parameters"][name]["value"] <= high
        assert high / low == pytest.approx(100.0)
    assert "8 of 16" in check(result, "all parameters")[1]


def test_the_same_seed_searches_the_same_way_and_another_does_not(sine_run: Run) -> None:
    tiny = replace(SMALL, evaluations=24)
    first, again, other = (
        identify([sine_run], "ga", rng=np.random.default_rng(seed), search=tiny).model.values["b"]
        for seed in (1, 1, 2)
    )
    assert first == again != other


def test_a_search_that_cannot_start_says_why(sine_run: Run, rig: Rig) -> None:
    with pytest.raises(InputError, match="excites the last joint alone"):
        identify([steps(sine_run, "step2")], "pso", search=SMALL)
    with pytest.raises(InputError, match="at least 4 of each"):
        SearchOptions(evaluations=1)
    unknown = rig.model_copy(update={"nominal": {k: v for k, v in rig.nominal.items() if k != "b"}})
    with pytest.raises(InputError, match="no positive nominal b"):
        identify([replace(sine_run, rig=unknown)], "ga", search=SMALL)
    with pytest.raises(InputError, match="too short"):
        identify([sine_run], "ga", search=replace(SMALL, seconds=60.0))


@pytest.mark.slow
def test_every_experiment_by_itself_scatters_about_all_of_them_together(sine_run: Run) -> None:
    each = experiments(sine_run)
    together = identify([sine_run], estimator="plain").estimates
    assert each.count == 4
    for name, found in each.spreads.items():
        assert found.low <= found.mean <= found.high
        assert found.mean == pytest.approx(together[name].value, rel=0.003)
    alone = [
        identify([replace(sine_run, records=records)], estimator="plain").estimates["b"].value
        for k in (1, 2, 3, 4)
        for records in (tuple(r for r in sine_run.records if r.repeat == k),)
    ]
    scatter = 100 * np.std(alone, ddof=1) / np.mean(alone)
    assert each.spreads["b"].rsd == pytest.approx(scatter)
    # Columns of unit length are the best scaling one can do cheaply: plain SI is worse.
    for family in each.conditions.values():
        assert family.plain[0] > family.scaled[1] >= 1.0


def test_scatter_of_three_numbers() -> None:
    found = spread([9.0, 10.0, 11.0])
    assert (found.low, found.mean, found.high, found.rsd) == (9.0, 10.0, 11.0, 10.0)
    assert np.isnan(spread([1.0]).rsd)


def test_a_payload_moves_what_rigid_bodies_say_and_nothing_else(rig: Rig) -> None:
    # 6.5 kg at 0.5 m on 0.5 m: m l^2 = 1.625, m l = 3.25.
    expected = {"M1": 3.25, "M2": 1.625, "R12": 1.625, "W1": 3.25, "W2": 3.25}
    assert payload_changes(rig, 6.5) == pytest.approx(expected)
    wave = bench.default_excitations(9, 0.02)
    loaded = {**TRUTH, **{name: TRUTH[name] + more for name, more in expected.items()}}
    bare, heavy = (
        identify([bench.experiment(rig, wave, repeats=2, seed=s, seconds=5.0, truth=truth)])
        for s, truth in ((31, TRUTH), (32, loaded))
    )
    found = payload_response(rig, 6.5, bare, heavy)
    assert {name for name, r in found.items() if r.responds} == set(expected)
    assert all(r.as_expected for r in found.values())
    for name, more in expected.items():
        assert found[name].change == pytest.approx(more, rel=0.02)


def test_the_oil_of_every_step_is_averaged_and_an_unmeasured_one_left_out(sine_run: Run) -> None:
    found = oil_temperatures(sine_run)
    assert set(found) == {"step1", "step2", "step3"}
    assert found["step2"] == pytest.approx(40.0, abs=0.01)
    channels = {k: v for k, v in sine_run.records[0].channels.items() if k != "oil_temperature"}
    blind = replace(sine_run, records=(replace(sine_run.records[0], channels=channels),))
    assert oil_temperatures(blind) == {}
