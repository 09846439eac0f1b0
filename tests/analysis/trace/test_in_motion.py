"""Joints that stick: what their rests hide is found in the samples in motion."""

from __future__ import annotations

from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from tests.studies.foreign.bench import runs_of
from tests.studies.foreign.cases import case_of

FRICTION = ("coulomb_friction", "stribeck_friction", "pressure_dependent_friction")


def test_friction_of_two_joints_that_stick_is_found_where_both_move() -> None:
    """While rows at rest of either joint count, one level of joint 1 leaves 8 noise floors."""
    case = case_of(110031, kind="pair")
    train, held_out = runs_of(case.bench, case.seed)
    found = trace(
        [train], held_out, effects=catalogue(case.bench.rig, FRICTION), look_ahead=False,
        free_forms=False, families=("mechanical",),
    )  # fmt: skip
    assert found.verdict == "explained"
    assert {(e.name, e.at) for e in found.effects} == {
        ("coulomb_friction", "joint 1"),
        ("stribeck_friction", "joint 1"),
        ("pressure_dependent_friction", "joint 2"),
    }
    assert found.worst(found.after) < 1.3
    for joint in (1, 2):
        note = f"torque_{joint}: judged without the samples at which the joint rests"
        assert any(n.startswith(note) for n in found.notes)
