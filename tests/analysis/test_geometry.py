"""A person states how well areas, volumes and pins are known; intervals hold what that costs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.physical import physical, with_physics
from analysis.identify.result import PLAIN, Identification, to_json
from analysis.identify.streams.out_of_core import identify_folders
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import with_effects
from analysis.terms.base import Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from rig.model.records import Run
from rig.model.rig import Rig
from rig.model.tolerances import Tolerances
from rig.runs.archive import write_run
from rig.runs.rigs import load_rig
from tests.analysis.test_accumulate import assert_same
from tests.analysis.trace.hidden import pair_of_runs
from tests.variants import every_second

EVERY = Tolerances(area=0.003, volume=0.05, pin=2e-4, mid_length=5e-4)
QUANTILE = 1.96


def stating(run: Run, tolerances: Tolerances | None) -> Run:
    return replace(run, rig=run.rig.model_copy(update={"tolerances": tolerances}))


def shifts(result: Identification) -> dict[str, np.ndarray]:
    """Return the shifts of each parameter by the uncertain numbers."""
    assert result.geometry is not None
    S = result.geometry.of_parameters(result.estimates)
    return dict(zip(result.estimates, S, strict=True))


def relative(result: Identification) -> dict[str, np.ndarray]:
    return {n: s / result.estimates[n].value for n, s in shifts(result).items()}


def check_of(result: Identification) -> str:
    (check,) = [c for c in result.checks if c.name == "geometry"]
    return check.detail


@pytest.fixture(scope="module")
def exact(multisine_run: Run) -> Identification:
    return identify([multisine_run])


@pytest.fixture(scope="module")
def stated(multisine_run: Run) -> Identification:
    return identify([stating(multisine_run, EVERY)])


def test_a_rig_without_tolerances_has_the_intervals_it_had(
    exact: Identification, multisine_run: Run
) -> None:
    nothing = identify([stating(multisine_run, Tolerances())])
    assert nothing.estimates == exact.estimates
    assert np.array_equal(nothing.model.covariance, exact.model.covariance)
    assert [c.name for c in nothing.checks] == [c.name for c in exact.checks]
    assert exact.geometry is None
    assert "geometry" not in to_json(exact)
    (check,) = [c for c in exact.checks if c.name == "geometry"]
    assert check.ok
    assert "taken as exact" in check.detail


def test_the_values_stay_and_the_intervals_grow_in_quadrature(
    exact: Identification, stated: Identification
) -> None:
    moved = shifts(stated)
    for name, old in exact.estimates.items():
        new, more = stated.estimates[name], float(np.linalg.norm(moved[name]))
        assert new.value == old.value
        assert new.std == pytest.approx(np.hypot(old.std, more))
        assert new.value - new.ci95[0] == pytest.approx(
            np.hypot(old.value - old.ci95[0], QUANTILE * more)
        )
        assert new.ci95[1] - new.value == pytest.approx(
            np.hypot(old.ci95[1] - old.value, QUANTILE * more)
        )


def test_with_an_unknown_slope_weights_and_slope_move_as_on_the_changed_rig(
    multisine_run: Run,
) -> None:
    """2 N columns of gravity have N weights and one slope; each pin of joint 2 is moved."""
    pins = stating(multisine_run, Tolerances(pin=2e-4))
    terms = [Used(term) for term in with_effects(pins.rig, ["base_inclination"])]
    found = identify([pins], terms=terms, estimator=PLAIN)
    moved = shifts(found)
    for k, number in enumerate(pins.rig.uncertain_numbers[-2:], start=-2):
        other = replace(multisine_run, rig=pins.rig.with_moved(number))
        changed = identify([other], terms=terms, estimator=PLAIN)
        for name in ("M1", "W1", "W2", "base_inclination"):
            expected = changed.estimates[name].value - found.estimates[name].value
            assert moved[name][k] == pytest.approx(expected, rel=0.01), name


def test_a_number_that_all_share_moves_all_together(
    exact: Identification, stated: Identification
) -> None:
    S = np.array(list(shifts(stated).values()))
    covariance = stated.model.covariance
    assert covariance == pytest.approx(exact.model.covariance + S @ S.T, rel=1e-9, abs=0)
    std = [e.std for e in stated.estimates.values()]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(std)
    # The areas of a cylinder are in its torque and in its flows: M1 and C_pp_1 go together.
    names = list(stated.estimates)
    M1, C = names.index("M1"), names.index("C_pp_1")
    assert exact.model.covariance[M1, C] == 0.0
    assert covariance[M1, C] > 0.1 * std[M1] * std[C]


@pytest.mark.slow
def test_areas_and_volumes_of_one_scale_move_gains_and_inertia_in_proportion(
    multisine_run: Run,
) -> None:
    """With A and V0 all larger by e every flow row is, but its gains' columns: C is, b is not.

    And so is the torque G F, and with it M, R, Fv and W.
    """
    e = 0.003
    result = identify([stating(multisine_run, Tolerances(area=e, volume=e))])
    for name, each in relative(result).items():
        assert each.sum() == pytest.approx(0.0 if name == "b" else e, abs=1e-3 * e)


def test_the_cap_area_moves_the_gains_of_the_cap_edges(multisine_run: Run) -> None:
    """A stiff supply of small dead volumes would have sigma_C / C = e; compression adds to it."""
    e = 0.002
    result = identify([stating(multisine_run, Tolerances(area=e))])
    assert result.geometry is not None
    number = [n.name for n in result.geometry.numbers].index("cap_area of joint 2")
    each = {name: float(s[number]) / e for name, s in relative(result).items()}
    assert 1.0 < each["C_pp_2"] < 1.2
    assert 1.0 < each["C_pm_2"] < 1.2
    assert max(abs(each["C_mp_2"]), abs(each["C_mm_2"]), abs(each["C_pp_1"])) < 0.01


@pytest.mark.parametrize("key", every_second(["base_pin", "arm_pin", "mid_length", "cap_area"]))
def test_the_shifts_are_those_of_whole_records_with_another_rig_file(
    stated: Identification, multisine_run: Run, key: str
) -> None:
    assert stated.geometry is not None
    numbers = list(stated.geometry.numbers)
    j = next(k for k, n in enumerate(numbers) if n.key == key and n.joint == 1)
    joint = multisine_run.rig.joints[1].model_dump()
    part = "cylinder" if key == "cap_area" else "linkage"
    joint[part][key] += 0.003 * joint[part][key] if part == "cylinder" else numbers[j].sigma
    other = type(multisine_run.rig.joints[1]).model_validate(joint)
    rig = multisine_run.rig.model_copy(update={"joints": (multisine_run.rig.joints[0], other)})
    before = identify([multisine_run], estimator=PLAIN).estimates
    after = identify([replace(multisine_run, rig=rig)], estimator=PLAIN).estimates
    for name, moved in shifts(stated).items():
        difference = after[name].value - before[name].value
        size = 1e-3 * abs(difference) + 1e-5 * abs(before[name].value)  # b: to first order
        assert moved[j] == pytest.approx(difference, abs=size), name
    if part == "linkage":  # a pin is in the torque and the angle, not in a flow
        assert all(abs(moved[j]) < 1e-12 for n, moved in shifts(stated).items() if n[0] == "C")


def test_the_check_and_the_json_name_the_numbers(stated: Identification) -> None:
    detail = check_of(stated)
    assert "rod_area of joint 2 (0.3 %) moves W2 by +1.5 %" in detail
    assert "cap_pipe_volume of joint 1 (5 %) moves b by +2 %" in detail
    assert "(0.2 mm) moves" in detail
    assert "(0.5 mm) moves" in detail
    data = json.loads(json.dumps(to_json(stated), allow_nan=False))["geometry"]
    assert len(data) == 14
    W2 = stated.estimates["W2"].value
    area = data["rod_area of joint 2"]
    assert area["sigma"] == pytest.approx(0.003 * 5.4e-4)
    assert area["shifts"]["W2"] == pytest.approx(0.0149 * W2, rel=0.02)


@pytest.mark.slow
def test_runs_that_state_different_tolerances_count_with_the_largest(multisine_run: Run) -> None:
    halves = [
        replace(multisine_run, records=tuple(r for r in multisine_run.records if r.repeat in part))
        for part in ((1, 2), (3, 4))
    ]
    small, large = Tolerances(area=0.001), Tolerances(area=0.003)
    one = identify([stating(halves[0], small), stating(halves[1], large)])
    two = identify([stating(halves[0], large), stating(halves[1], None)])
    assert one.estimates == two.estimates
    assert "(0.3 %)" in check_of(one)


@pytest.mark.slow
def test_streamed_folders_have_the_same_intervals(tmp_path: Path, multisine_run: Run) -> None:
    first = tuple(r for r in multisine_run.records if r.repeat == 1)
    run = stating(replace(multisine_run, records=first), EVERY)
    folder = write_run(tmp_path / "monday", run)
    shares: list[float] = []
    streamed = identify_folders([str(folder)], progress=shares.append)
    assert_same(streamed, identify([run], estimator=PLAIN))
    assert shares[-1] == 1.0
    assert "moves W2" in check_of(streamed)


def test_consistent_parameters_keep_the_tolerances(
    exact: Identification, stated: Identification
) -> None:
    free = with_physics(exact, physical(exact)).estimates
    given = with_physics(stated, physical(stated))
    moved = shifts(stated)
    for name, estimate in given.estimates.items():
        more = float(np.linalg.norm(moved[name]))
        assert estimate.std == pytest.approx(np.hypot(free[name].std, more))
        assert np.linalg.norm(shifts(given)[name]) == pytest.approx(more)
    # What rigid bodies hold, R12 = l1 W2, no number of the rig file moves apart.
    rigid = physical(stated).levels[1]
    assert rigid.geometry is not None
    S = rigid.geometry.of_parameters(rigid.estimates)
    by_name = dict(zip(rigid.estimates, S, strict=True))
    length = stated.model.rig.joints[0].link_length
    assert by_name["R12"] == pytest.approx(length * by_name["W2"], rel=1e-6)
    assert np.linalg.norm(by_name["W2"]) > 0.0
    # The paper's link length is rejected still, by fewer standard errors.
    levels = [physical(result).levels[1].costs["mechanical"] for result in (exact, stated)]
    assert levels[0].p < levels[1].p < 0.01


def test_a_method_without_tolerances_says_so(multisine_run: Run) -> None:
    result = identify([stating(multisine_run, EVERY)], method="sequential")
    (check,) = [c for c in result.checks if c.name == "geometry"]
    assert not check.ok
    assert "--method coupled includes" in check.detail
    assert "geometry" in result.model.provenance["checks_failed"]


@pytest.fixture(scope="module")
def wrong_area() -> Run:
    """Records of a boom whose cap area is 0.5 % above the one of its rig file."""
    rig = load_rig("boom-1dof")
    joint = rig.joints[0]
    cylinder = joint.cylinder.model_copy(update={"cap_area": 1.005 * joint.cylinder.cap_area})
    true = rig.model_copy(update={"joints": (joint.model_copy(update={"cylinder": cylinder}),)})
    rng = np.random.default_rng(3)
    wave = multisine(rng, rig.sample_rate, 10.0, 8.0)
    run = synthetic_run(true, rng, wave, rms=0.03, repeats=4)
    return replace(run, rig=rig.model_copy(update={"sensors": run.rig.sensors}))


def held(result: Identification, truth: dict[str, float]) -> dict[str, bool]:
    ends = {name: estimate.ci95 for name, estimate in result.estimates.items()}
    return {name: bool(low <= truth[name] <= high) for name, (low, high) in ends.items()}


def test_a_bench_whose_area_is_off_is_covered_with_its_tolerance_only(wrong_area: Run) -> None:
    truth = wrong_area.rig.nominal
    without = held(identify([wrong_area]), truth)
    assert not any(without[name] for name in ("M1", "W1", "b", "C_pp_1", "C_pm_1"))
    assert all(held(identify([stating(wrong_area, Tolerances(area=0.003))]), truth).values())


@pytest.mark.slow
def test_a_trace_includes_them_once_before_and_after(rig: Rig) -> None:
    train, held_out = pair_of_runs(rig, c_internal=2e-12)
    leaks = catalogue(rig, ("internal_leakage",))
    results = [
        trace([stating(train, t)], [stating(held_out, t)], leaks, look_ahead=False)
        for t in (None, EVERY)
    ]
    assert [result.verdict for result in results] == ["explained", "explained"]
    assert not any("tolerances" in note for note in results[0].notes)
    assert sum("tolerances of the rig file" in note for note in results[1].notes) == 1
    exact, wide = (result.effects[0].parameters["c_internal_2"] for result in results)
    leak = shifts(identify([stating(train, EVERY)], terms=results[0].model_after.terms))
    more = np.linalg.norm(leak["c_internal_2"])
    assert more > 0.0
    assert wide.std == pytest.approx(np.hypot(exact.std, more), rel=1e-3)
    for model in ("model_before", "model_after"):
        plain, wide = (getattr(result, model) for result in results)
        moved = shifts(identify([stating(train, EVERY)], terms=plain.terms))
        for name, old in plain.parameters.items():
            new = wide.parameters[name]
            if not old.identified:
                continue
            more = np.linalg.norm(moved[name])
            assert new.std**2 - old.std**2 == pytest.approx(more**2, rel=0.02)
