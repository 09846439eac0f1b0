"""Joints that stick: what their rests hide is found in the samples in motion."""

from __future__ import annotations

import pytest

from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from tests.analysis.small_bench import TRUTH, shinshu
from tests.analysis.trace.foreign_bench import KARNOPP, Hidden, pair_of_runs
from tests.studies.foreign import plant
from tests.studies.foreign.bench import Bench, runs_of
from tests.studies.foreign.cases import case_of

FRICTION = ("coulomb_friction", "stribeck_friction", "pressure_dependent_friction")


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_tilt_is_found_beside_friction_whose_rests_hid_it() -> None:
    """On all rows two levels of friction and a force over the position of joint 1 seem to fit."""
    sticks = {"ahead": 80.0, "astern": 80.0, "dry_form": plant.KARNOPP, "width": 5e-4}
    bench = Bench(
        shinshu(), TRUTH, {"inclination": 0.05}, ({}, sticks), noise=0.5, seconds=6.0
    )  # fmt: skip
    train, held_out = runs_of(bench, 1)
    names = ("coulomb_friction", "asymmetric_friction", "base_inclination")
    found = trace(
        [train], held_out, effects=catalogue(bench.rig, names), look_ahead=False,
        families=("mechanical",),
    )  # fmt: skip
    assert found.verdict == "explained"
    sizes = {e.name: next(iter(e.parameters.values())) for e in found.effects}
    assert set(sizes) == {"coulomb_friction", "base_inclination"}
    assert sizes["coulomb_friction"].value == pytest.approx(80.0, rel=0.02)
    assert sizes["base_inclination"].value == pytest.approx(0.05, rel=0.02)


def test_a_breakaway_that_motion_hides_is_noted_beside_the_level() -> None:
    """Friction falls from 160 N to 60 N within a fiftieth of the rms speed; the joint sticks."""
    hidden = Hidden(60.0, 60.0, 1e-3, KARNOPP, breakaway=100.0, stribeck=0.003)
    rig = shinshu()
    train, held_out = pair_of_runs(rig, hidden)
    found = trace(
        [train], [held_out], effects=catalogue(rig, ("coulomb_friction",)), look_ahead=False,
        free_forms=False, families=("mechanical",),
    )  # fmt: skip
    assert [e.name for e in found.effects] == ["coulomb_friction"]
    assert any("torque_2: near standstill friction reaches 1." in note for note in found.notes)


def test_rows_in_motion_limit_no_breakaway() -> None:
    """Of a joint that sticks they state no largest force by which it might break away."""
    rig = shinshu()
    train, held_out = pair_of_runs(rig, Hidden(30.0, 30.0, 1e-3, KARNOPP))
    found = trace(
        [train], [held_out], effects=catalogue(rig, ("coulomb_friction", "stribeck_friction")),
        free_forms=False, look_ahead=False, families=("mechanical",),
    )  # fmt: skip
    assert any("without the samples at which the joint rests" in note for note in found.notes)
    limits = {(d.name, d.at) for d in found.detection_limits}
    assert ("stribeck_friction", "joint 2") not in limits
