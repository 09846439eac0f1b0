"""What was chosen early in a search is asked again once the set is whole."""

from __future__ import annotations

import pytest

from rig.model.rig import Rig
from tests.analysis.trace.gate_cases import LEAK, searched
from tests.analysis.trace.hidden import pair_of_runs


def names(keys: frozenset[tuple[str, str]]) -> set[str]:
    return {name for name, _ in keys}


def test_a_level_taken_for_friction_by_pressure_is_put_right_beside_a_leak(rig: Rig) -> None:
    runs = pair_of_runs(rig, Fc=60.0, c_internal=LEAK)
    s = searched(rig, *runs, "coulomb_friction", "pressure_dependent_friction", "internal_leakage")
    wrong = s.set_of("pressure_dependent_friction", "internal_leakage")
    again = s.hypotheses.reread(wrong)
    assert names(again.keys) == {"coulomb_friction", "internal_leakage"}
    assert again.fit.beta["Fc2"] == pytest.approx(60.0, rel=0.1)


def test_two_levels_give_way_to_one_level_and_an_offset(rig: Rig) -> None:
    """Breakaway, level and offset: two levels with a breakaway need more and leave as much."""
    runs = pair_of_runs(rig, Fc=40.0, Fs=40.0, T_offset=2.0)
    four = ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "torque_offset")
    s = searched(rig, *runs, *four)
    wrong = s.set_of("asymmetric_friction", "stribeck_friction")
    s.set_of("stribeck_friction", "torque_offset")
    again = s.hypotheses.rerouted(wrong)
    assert names(again.keys) == {"coulomb_friction", "stribeck_friction", "torque_offset"}
    assert again.size[1] < wrong.size[1]
    assert again.fit.beta["T_offset_2"] == pytest.approx(2.0, rel=0.1)
