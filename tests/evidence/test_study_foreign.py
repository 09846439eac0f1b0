"""The textbook bench is what it says, and its judge cannot flatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis import small_bench
from tests.analysis.small_bench import TRUTH
from tests.studies.foreign import bench as foreign
from tests.studies.foreign import plant
from tests.studies.foreign.cases import NONE, OUTSIDE, SINGLE, Case, Wrong, case_of
from tests.studies.foreign.study import Job, Outcome, answer_of, bounds, weakened

LEAK = ("internal_leakage", "joint 1")


@pytest.mark.slow
def test_without_anything_wrong_it_moves_as_another_integrator_says() -> None:
    """The same machine, typed in elsewhere and integrated by LSODA."""
    rig = small_bench.shinshu()
    bench = foreign.Bench(rig, TRUTH)
    machine, joints = foreign._numbers(bench)
    step = small_bench.STEPS[1]
    wave = small_bench.Excitation(4.0, (1, 3, 7), 0.02, (0.3, 1.1, 2.0))
    rows = np.array([
        (0, wave.amplitude, 2 * np.pi * n / wave.period, p)
        for n, p in zip(wave.lines, wave.phases, strict=True)
    ])  # fmt: skip
    start = np.zeros(plant.SIZE)
    start[:8] = small_bench.settle(step, {}, TRUTH)
    y, spools = plant.integrated(
        start, 25_000, 25, machine, joints, np.array([False, True]), rows, np.zeros(2), 0.3, 0
    )
    other = small_bench.simulate(
        rig, step, {0: wave}, seconds=0.5, settle_seconds=0.4, centring=0.3
    )
    time = plant.STEP * np.arange(len(y))
    k = rig.channels.index("cap_pressure_1")
    at = 0.4 + np.arange(500) / 1000 + k * rig.sensors.skew
    np.testing.assert_allclose(
        np.interp(at, time, y[:, plant.P]), other["cap_pressure_1"], rtol=2e-4
    )
    at = 0.4 + np.arange(500) / 1000 + rig.channels.index("spool_1") * rig.sensors.skew
    np.testing.assert_allclose(np.interp(at, time, spools[:, 0]), other["spool_1"], atol=1e-5)


@pytest.mark.parametrize("form", [plant.TANH, plant.DAHL, plant.LUGRE, plant.KARNOPP])
def test_every_form_of_dry_friction_slides_at_its_level_and_opposes_motion(form: int) -> None:
    joint = np.zeros(len(plant.JOINT))
    joint[[plant.AHEAD, plant.ASTERN]] = 50.0, 30.0
    joint[plant.DRY_FORM], joint[plant.WIDTH], joint[plant.STRIBECK] = form, 1e-4, 0.02
    for speed, level in ((0.05, 50.0), (-0.05, -30.0)):
        z = 0.0
        for _ in range(20_000):
            force, rate = plant.dry(speed, 0.0, z, 1e6, 1e6, 500.0, joint)
            z += 1e-6 * rate
        assert force == pytest.approx(level, rel=0.01)


def test_a_piston_that_sticks_displaces_no_oil() -> None:
    """Within Karnopp's band the position stands still, so with a closed valve no pressure moves."""
    bench = foreign.Bench(small_bench.shinshu(), TRUTH)
    machine, joints = foreign._numbers(bench)
    joints[0, [plant.AHEAD, plant.ASTERN, plant.WIDTH]] = 500.0, 500.0, 1e-3
    joints[0, plant.DRY_FORM] = plant.KARNOPP
    state, out = np.zeros(plant.SIZE), np.zeros(plant.SIZE)
    state[plant.Q] = foreign.angle(bench, 0, 0.0)
    state[plant.P : plant.P + 2] = 2e6, 2e6
    lever = plant.stroke(state[plant.Q], joints[0])[1]
    for speed, sticks in ((5e-4, True), (5e-3, False)):
        state[plant.W] = speed / lever
        plant.rates(state, 0.0, machine, joints, np.array([False, True]), np.zeros(2), out)
        assert (out[plant.Q] == 0.0) == sticks
        assert (not out[plant.P : plant.P + 2].any()) == sticks


def test_a_pair_whose_first_cause_leaves_no_sensor_for_the_second_is_drawn_anew() -> None:
    """First drawn for this seed are a delay of all pressures and the gain of one of them."""
    one, other = case_of(9120, kind="pair").hidden
    assert (one.name, other.name) == ("channel_delay", "sensor_gain")
    assert not set(one.sensors) & set(other.sensors)


def test_a_seed_draws_the_same_bench_again_and_another_seed_another() -> None:
    one, again, other = case_of(4), case_of(4), case_of(6)
    assert (one.label, dict(one.bench.truth)) == (again.label, dict(again.bench.truth))
    assert dict(one.bench.truth) != dict(other.bench.truth)
    assert case_of(4, only="supply_sag").hidden[0].name == "supply_sag"


def _case(kind: str, *hidden: Wrong) -> Case:
    return Case(kind, 0, replace(case_of(0, kind=NONE).bench), hidden)


@pytest.mark.parametrize(
    ("verdict", "named", "answer"),
    [
        ("explained", {LEAK}, "right"),
        ("confounded", {LEAK}, "right"),
        ("explained", {("internal_leakage", "joint 2")}, "wrong"),
        ("explained", {LEAK, ("tank_pressure", "bench")}, "wrong"),
        ("unexplained", {LEAK}, "abstained, truth found"),
        ("unexplained", {("tank_pressure", "bench")}, "wrong beside unexplained"),
        ("clean", set(), "quiet"),
    ],
)
def test_a_hidden_leak_is_judged_by_name_place_and_verdict(
    verdict: str, named: set[tuple[str, str]], answer: str
) -> None:
    assert answer_of(_case(SINGLE, Wrong(*LEAK, "")), verdict, named, set()) == answer


def test_what_has_no_name_must_be_refused_and_a_clean_bench_left_alone() -> None:
    worn = Wrong("worn bore", "joint 1", "", also=("leakage_curve",), kin=("internal_leakage",))
    assert answer_of(_case(OUTSIDE, worn), "explained", {LEAK}, set()) == "wrong"
    assert answer_of(_case(OUTSIDE, worn), "unexplained", {LEAK}, set()) == "refused"
    curve = {("leakage_curve", "joint 1")}
    assert answer_of(_case(OUTSIDE, worn), "explained", curve, set()) == "refused"
    assert answer_of(_case(NONE), "explained", {LEAK}, set()) == "false alarm"


def test_the_curve_of_a_leak_whose_form_has_no_name_is_right() -> None:
    turbulent = Wrong(*LEAK, "turbulent", curve="leakage_curve")
    curve = {("leakage_curve", "joint 1")}
    assert answer_of(_case(SINGLE, turbulent), "explained", curve, set()) == "right"
    assert answer_of(_case(SINGLE, Wrong(*LEAK, "laminar")), "explained", curve, set()) == (
        "right mechanism"
    )


def test_bounds_are_those_of_the_binomial() -> None:
    assert bounds(0, 59)[1] == pytest.approx(0.05, abs=0.001)  # rule of three
    assert bounds(20, 20) == (pytest.approx(0.05 ** (1 / 20)), 1.0)


def test_an_answer_that_better_data_weaken_is_listed() -> None:
    def outcome(answer: str) -> Outcome:
        return Outcome(3, SINGLE, "a leak", "", answer, "", (), (), (), 5.0, 0.0, (0, 0), (16, 16),
                       0.0, 1.0, (), 1.0)  # fmt: skip

    base, quieter, more = Job(3), Job(3, better="noise"), Job(3, better="repeats")
    answers = {base: "right", quieter: "abstained", more: "right"}
    said = weakened({job: outcome(answer) for job, answer in answers.items()})
    assert said.startswith("weaker when measured better: 1 of 2")
    assert "noise: right -> abstained" in said
