"""What an experiment is worth before it is run: told from the rows alone, and checked by hand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from analysis.terms import baseline_of, known
from analysis.terms.base import Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.next_experiment import proposal
from analysis.trace.next_experiment.discrimination import (
    ComparisonRows,
    Explanation,
    OpenQuestion,
    largest_rms,
    measurement_view,
    noise_ratios,
    present_separation,
    separation,
    smallest_effect,
)
from analysis.trace.next_experiment.excitations import (
    FAMILIES,
    JointSetting,
    excitation,
    joint_settings,
    protocol,
)
from hil_sim.scenario.file import Scenario
from protocols.files.plan import Overrides
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.studies.direct_bench import simulated_run

FAST = next(f for f in FAMILIES if f.name == "fast")
AIR = Explanation((Used(known()["entrained_air"]("bench")),), {"alpha_air": 3e-3})
LEAK = Explanation((Used(known()["internal_leakage"]("joint 2")),), {"c_internal_2": 1e-12})


@cache
def sine() -> tuple[Rig, RegressionData]:
    """Three records of the paper's first step on a bench with nothing wrong, laid out."""
    rig = load_rig("shinshu-2dof")
    change = Overrides(repeats=3, duration=5.0, steps=("step1",))
    run, _ = simulated_run(rig, "lock-and-excite", 5, Scenario(), change)
    return rig, regression_data(
        rig, tuple(map(Used, baseline_of(rig))), conditioned_records(rig, [run])
    )


@cache
def rows_of_both(family: str = "fast") -> tuple[ComparisonRows, ComparisonRows]:
    rig, train_data = sine()
    chosen = next(f for f in FAMILIES if f.name == family)
    found = excitation(
        rig, joint_settings(rig, train_data.records)[0], chosen, np.random.default_rng(1)
    )
    assert found is not None
    old = ComparisonRows(train_data)
    return old, ComparisonRows(
        train_data, measurement_view(train_data, found, noise_ratios(train_data)), old
    )


def test_how_the_joints_stood_is_read_from_the_records() -> None:
    rig, train_data = sine()
    assert joint_settings(rig, train_data.records) == [
        JointSetting({0: 0.0}, {}),
        JointSetting({}, {}),
    ]


def test_what_an_explanation_can_imitate_is_no_separation() -> None:
    old, new = rows_of_both()
    half = Explanation(LEAK.effects, {"c_internal_2": 5e-13})
    assert separation(OpenQuestion(LEAK, half), old, new)[0] < 1e-3
    # Against the baseline alone the same leak stands out far above the noise.
    assert separation(OpenQuestion(LEAK, Explanation(), False), old, new)[0] > 3.0


def test_the_separation_is_the_rms_that_stands_out_of_the_new_rows() -> None:
    """By hand: whiten, project with a QR of one's own, count energy per row and repeat."""
    old, new = rows_of_both()
    question = OpenQuestion(AIR, LEAK, False)
    assert new.view is not None
    energy = []
    for ground in (old, new):
        X = np.column_stack([ground.base, *ground.columns(LEAK.effects[0]).values()])
        X = X[:, np.linalg.norm(X, axis=0) > 0]
        y = ground.columns(AIR.effects[0])["alpha_air"] * 3e-3
        Q, _ = np.linalg.qr(X / np.linalg.norm(X, axis=0))
        r = y - Q @ (Q.T @ y)
        energy.append({e: float(np.sum(r[ground.equation == e] ** 2)) for e in new.view.rows})
    expected = {
        e: np.sqrt(max(0.0, energy[1][e] - energy[0][e]) / (4 * len(rows.rhs)))
        for e, rows in new.view.rows.items()
    }
    figure, equation = separation(question, old, new)
    assert figure == pytest.approx(max(expected.values()), rel=0.02)
    assert equation == max(expected, key=lambda e: expected[e])


def test_air_hardly_shows_on_the_sine_and_shows_on_fast_lines() -> None:
    old, new = rows_of_both()
    question = OpenQuestion(AIR, Explanation(), False)
    assert present_separation(question, old) < 0.5
    assert separation(question, old, new)[0] > 2 * present_separation(question, old)
    _, small = rows_of_both("small")
    assert separation(question, old, small)[0] < separation(question, old, new)[0]


def test_faster_lines_are_noisier_than_the_sine_and_it_is_foreseen() -> None:
    old, new = rows_of_both()
    assert new.view is not None
    floor = {f.equation: f.noise for f in old.train_data.floors}
    assert all(new.view.noise[e] > 1.5 * floor[e] for e in new.view.rows)


def test_an_excitation_fills_its_share_of_the_limits_and_is_a_protocol() -> None:
    rig, train_data = sine()
    one = excitation(
        rig, joint_settings(rig, train_data.records)[0], FAST, np.random.default_rng(2)
    )
    assert one is not None
    piston = one.played.motion["piston"][:, 1]
    low, high = rig.joints[1].limits.piston
    assert low < piston.min() < piston.max() < high
    made = protocol(rig, [one], "next")
    (step,) = made["steps"]
    assert step["lock"] == [{"joint": 1, "at": "closed", "piston": "0 mm", "tolerance": "5 mm"}]
    amplitudes = [float(a.split()[0]) for a in step["excite"][0]["signal"]["amplitudes"]]
    rms = np.sqrt(np.sum(np.square(amplitudes)) / 2)
    assert rms == pytest.approx(np.sqrt(np.mean(one.step.waves[1] ** 2)), rel=1e-3)


def test_a_rig_without_a_twin_offers_nothing() -> None:
    rig, train_data = sine()
    blind = rig.model_copy(update={"nominal": {}})
    where = joint_settings(rig, train_data.records)[0]
    assert excitation(blind, where, FAST, np.random.default_rng(0)) is None


def test_a_rig_without_nominal_values_has_those_of_the_records() -> None:
    """The twin of an imported machine needs every one; joint 1 never moved."""
    rig, train_data = sine()
    blind = replace(train_data, rig=rig.model_copy(update={"nominal": {}}))
    likely = proposal.rig_with_estimates(blind).nominal
    assert likely["b"] == pytest.approx(rig.nominal["b"], rel=0.1)
    assert likely["C_pp_2"] == pytest.approx(rig.nominal["C_pp_2"], rel=0.1)
    assert "M2" in likely
    assert "M1" not in likely


def test_every_effect_that_can_show_has_a_size_worth_knowing() -> None:
    rig, train_data = sine()
    without = [e for e in catalogue(rig) if smallest_effect(e, rig) is None]
    assert "payload" in {e.name for e in without}
    assert all(e.absorbed(rig) for e in without)
    assert largest_rms(train_data, np.zeros(train_data.base.shape[0])) == 0.0


def test_only_effects_that_one_answer_lacks_are_separated() -> None:
    """A metering curve that both answers hold is no part of the question."""
    rig = load_rig("shinshu-2dof")
    at = {(e.name, e.where): Used(e, e.shape_of(rig, ())) for e in catalogue(rig)}
    shared = at["internal_leakage", "joint 1"]
    lag, delay = at["sensor_lag", "joint 1 rod"], at["channel_delay", "joint 1 rod"]
    question = OpenQuestion(Explanation((shared, lag)), Explanation((shared, delay)))
    assert proposal._separated_effects([proposal.PredictedAnswer(question, 0.0)]) == [
        {"name": "sensor_lag", "where": "joint 1 rod"},
        {"name": "channel_delay", "where": "joint 1 rod"},
    ]
