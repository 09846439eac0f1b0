"""An effect smaller than the first point of its shape's grid is found beside a loud leak."""

from __future__ import annotations

import pytest

from analysis.trace.search.exact_trials import improved_by_exact_trials
from rig.model.rig import Rig
from tests.analysis.trace.gate_cases import LEAK, searched
from tests.analysis.trace.hidden import pair_of_runs


@pytest.mark.parametrize("null", [8e-4, pytest.param(-1e-3, marks=pytest.mark.slow)])
def test_a_null_of_a_millivolt_is_found_beside_a_leak(rig: Rig, null: float) -> None:
    runs = pair_of_runs(rig, c_internal=LEAK, u_null=null)
    s = searched(rig, *runs, "internal_leakage", "spool_offset", "sensor_lag")
    sizes = {u.term.name: u.shape for u in s.winner.effects}
    assert set(sizes) == {"internal_leakage", "spool_offset"}
    assert sizes["spool_offset"][0] == pytest.approx(null, rel=0.05)
    assert s.vetoes(s.winner) == ""


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1.002, 1.005, 0.998])
def test_a_gain_wrong_by_parts_in_a_thousand_is_not_called_crosstalk_of_the_other_chamber(
    rig: Rig, gain: float
) -> None:
    """With one joint the same chamber's cross-talk cannot be told from it, the other's can."""
    runs = pair_of_runs(rig, c_internal=LEAK, gain_cap_pressure=gain)
    s = searched(rig, *runs, "internal_leakage", "sensor_gain", "sensor_crosstalk")
    sizes = {u.term.key: u.shape for u in s.winner.effects}
    assert set(sizes) == {("internal_leakage", "joint 2"), ("sensor_gain", "joint 2 cap")}
    assert sizes["sensor_gain", "joint 2 cap"][0] == pytest.approx(gain, abs=3e-4)
    assert s.vetoes(s.winner) == ""


@pytest.mark.slow
def test_a_spring_is_found_beside_a_gain_that_took_part_of_it(rig: Rig) -> None:
    """Alone the gain comes out as 1.078: the spring earns its place once the gain may move too."""
    runs = pair_of_runs(rig, gain_cap_pressure=1.05, k_spring=20.0)
    s = searched(rig, *runs, "sensor_gain", "sensor_offset", "torque_offset", "joint_spring")
    assert s.winner.keys == {("sensor_gain", "joint 2 cap"), ("joint_spring", "joint 2")}
    gain = next(u.shape[0] for u in s.winner.effects if u.term.name == "sensor_gain")
    assert gain == pytest.approx(1.05, abs=1e-3)
    assert s.winner.fit.beta["k_spring_2"] == pytest.approx(20.0, rel=0.03)
    assert s.vetoes(s.winner) == ""


@pytest.mark.slow
def test_what_a_dead_band_leaves_above_the_noise_is_an_offset_and_not_an_error_of_its_form(
    rig: Rig,
) -> None:
    """The remainder is within the tolerance for forms; friction and a spring would fit it too."""
    runs = pair_of_runs(rig, w_ahead=8e-3, w_astern=8e-3, offset_cap_pressure=2.1e3)
    others = "joint_spring", "asymmetric_friction", "coulomb_friction", "stribeck_friction"
    sets = (s := searched(rig, *runs, "valve_deadband", "sensor_offset", *others)).hypotheses
    alone = s.set_of("valve_deadband")
    assert sets.within_form_tolerance(alone)
    assert not sets.within_noise(alone)
    improved = improved_by_exact_trials(sets, alone)
    assert {name for name, _ in improved.keys} == {"valve_deadband", "sensor_offset"}
    assert sets.within_noise(improved)
