"""A clean verdict on small motions: the trace lists what could still hide, and what it would do."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.terms import make
from analysis.trace.engine import trace
from analysis.trace.next_experiment.detection_limits import detection_limit_notes, is_possible
from analysis.trace.next_experiment.discrimination import smallest_effect
from analysis.trace.result import DetectionLimit, Trace, to_json
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace import gate_cases
from tests.analysis.trace.hidden import experiment, pair_of_runs
from tests.variants import kept

SMALL = 0.004  # [V] of the spool, rms: the friction of such a motion is near the noise


def traced(rig: Rig, rms: float, **hidden: float) -> Trace:
    train = experiment(rig, rms=rms, **hidden)
    held_out = experiment(rig, repeats=2, seed=2, rms=0.7 * rms, **hidden)
    return trace([train], [held_out], look_ahead=False)


@pytest.fixture(scope="module")
def small(rig: Rig) -> Trace:
    return traced(rig, SMALL)


def limit(result: Trace, name: str) -> DetectionLimit:
    return next(d for d in result.detection_limits if d.name == name)


@pytest.mark.slow
def test_large_motions_leave_nothing_to_hide(rig: Rig) -> None:
    result = traced(rig, 0.03)
    assert result.verdict == "clean"
    assert result.detection_limits == ()


@pytest.mark.parametrize(
    ("name", "at", "parameter", "hidden"),
    kept(
        [
            ("coulomb_friction", "joint 2", "Fv2", "Fc"),
            ("tank_pressure", "bench", "C_pm_2", "p_tank"),
        ],
        (0,),
    ),
)
def test_an_effect_at_its_limit_stays_hidden_and_changes_the_parameter_as_stated(
    rig: Rig, small: Trace, name: str, at: str, parameter: str, hidden: str
) -> None:
    found = limit(small, name)
    assert (found.at, found.parameter) == (at, parameter)
    biased = traced(rig, SMALL, **{hidden: found.size})
    assert biased.verdict == "clean"
    right = small.model_after.parameters[parameter]
    change = biased.model_after.parameters[parameter].value / right.value - 1
    # Both benches have the same noise: the change is the effect's alone.
    assert abs(change) == pytest.approx(found.shift, rel=0.1)


def test_the_largest_change_of_each_parameter_is_noted_and_all_are_in_the_result(
    small: Trace,
) -> None:
    noted = [note for note in small.notes if note.startswith("not excluded by these records")]
    assert len(noted) == 3
    largest = {d.parameter: d for d in reversed(small.detection_limits)}
    stated = sorted(largest.values(), key=lambda d: -d.shift)
    assert len(stated) >= 3
    assert all(
        d.name in note and d.parameter in note for d, note in zip(stated, noted, strict=False)
    )
    shifts = [d["shift"] for d in to_json(small)["detection_limits"]]
    assert shifts == sorted(shifts, reverse=True)
    assert shifts[-1] >= 0.01


@pytest.mark.slow
def test_a_special_case_of_a_named_effect_is_none_that_could_hide_beside_it(rig: Rig) -> None:
    """Friction of one level is part of that of two, and would change both without limit.

    What a breakaway beside them would change lies within the intervals.
    """
    names = ("asymmetric_friction", "coulomb_friction", "stribeck_friction")
    result = gate_cases.traced(rig, pair_of_runs(rig, F_ext=70.0, F_ret=40.0), *names)
    assert [e.name for e in result.effects] == ["asymmetric_friction"]
    assert result.detection_limits == ()


def test_a_limit_is_that_of_both_chambers_where_they_hide_more_than_one(rig: Rig) -> None:
    """Both pipes hold twice the oil that the rig file states: the bulk modulus takes it up."""
    cylinder = rig.joints[1].cylinder
    half = {name: 0.5 * getattr(cylinder, name) for name in ("cap_pipe_volume", "rod_pipe_volume")}
    second = rig.joints[1].model_copy(update={"cylinder": cylinder.model_copy(update=half)})
    stated = rig.model_copy(update={"joints": (rig.joints[0], second)})
    train, held_out = (
        replace(experiment(rig, repeats=n, seed=n, rms=rms), rig=stated)
        for n, rms in ((2, SMALL), (2, 0.7 * SMALL))
    )
    candidates = gate_cases.at_joint_2(stated, "dead_volume")
    result = trace([train], [held_out], candidates, look_ahead=False, free_forms=False)
    hidden = limit(result, "dead_volume")
    assert (result.verdict, hidden.at, hidden.parameter) == ("clean", "joint 2 both chambers", "b")
    assert hidden.size == pytest.approx(half["cap_pipe_volume"], rel=0.3)
    wrong = abs(result.model_after.parameters["b"].value / TRUTH["b"] - 1.0)
    assert hidden.shift == pytest.approx(wrong, rel=0.3)
    (note,) = (n for n in result.notes if "dead_volume" in n)
    assert "dead_volume at joint 2, both chambers up to" in note


def test_a_limit_is_stated_as_the_number_that_a_reader_knows(rig: Rig) -> None:
    """A gain is near 1; a size that no machine has excludes nothing."""
    gain = ("sensor_gain", "joint 1", "joint 1 rod", "gain_rod_pressure_1", 0.02, "", 1.0)
    torque = ("torque_offset", "joint 1", "joint 1", "T_offset_1", 2.4e5, "N*m", 0.0)
    notes = detection_limit_notes(
        [DetectionLimit(*gain, "W1", 0.03, True), DetectionLimit(*torque, "W1", 5.3, False)]
    )
    begin, end = "not excluded by these records: ", " without a residual above the noise"
    assert notes == [
        f"{begin}sensor_gain at joint 1, rod up to gain_rod_pressure_1 = 1 ± 0.02, which would "
        f"change W1 by 3 %{end}",
        f"{begin}torque_offset at joint 1 of any possible size, which would change W1{end}",
    ]


def test_the_largest_limit_of_every_parameter_is_stated_first() -> None:
    def of(name: str, parameter: str, shift: float) -> DetectionLimit:
        return DetectionLimit(
            name, "bench", "bench", "size", 1.0, "Pa", 0.0, parameter, shift, True
        )

    weight = ("sensor_gain", 0.9), ("sensor_offset", 0.8), ("torque_offset", 0.7)
    limits = [*(of(name, "W1", shift) for name, shift in weight), of("entrained_air", "b", 0.02)]
    notes = detection_limit_notes(limits)
    assert [note.split()[5] for note in notes] == ["sensor_gain", "entrained_air", "sensor_offset"]


def test_no_limit_above_the_sizes_that_are_physical_is_called_possible(small: Trace) -> None:
    """Half of the drive's torque is the most that an offset may have."""
    effects = {f"{d.name} {d.at}": d for d in small.detection_limits}
    assert all(d.possible for d in effects.values() if d.shift < 0.5)
    offset = make("torque_offset", "joint 1")
    (parameter,) = (c.parameter for c in offset.coefficients(small.model_after.rig))
    explanation = smallest_effect(offset, small.model_after.rig)
    assert explanation is not None
    for times, possible in ((1.0, True), (1e6, False)):
        assert parameter in explanation.beta
        assert is_possible(small.model_after.rig, small.model_after, explanation, times) == possible
