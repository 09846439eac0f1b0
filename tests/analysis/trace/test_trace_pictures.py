"""The report's reader sees where an effect is on the machine, and what speaks against rivals."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

import rig as rig_package
from analysis.report.plots import place_plot, trace_plots
from analysis.report.plots.style import MODEL, ORANGE
from analysis.trace.data.candidates import catalogue, free_mechanisms
from analysis.trace.judge.gates import refused_effects
from analysis.trace.result import Gate, JudgedEffect, Rival, Trace
from rig.model.channels import place_in_words
from rig.model.parse import parse_model
from rig.model.rig import Rig

LEAK = JudgedEffect(
    "internal_leakage", "joint 2", {}, 0.005, 0.99,
    (
        Rival("spool_offset", "joint 2", 9.4, 8.0, False),
        Rival("sensor_gain", "joint 2 cap", 1.02, 1.01, True),
        Rival("external_leakage", "joint 2 rod", 1.05, 1.9, False),
    ),
    (Gate("no rival", False, "cannot be separated from sensor_gain"),),
    rms_without=27.6, rms_with=1.5,
)  # fmt: skip


def shipped(name: str) -> Rig:
    path = Path(rig_package.__file__).parent / "shipped" / f"{name}.yaml"
    return parse_model(Rig, path.read_text(), path.name)


@pytest.mark.parametrize("name", ["shinshu-2dof", "electric-2dof", "boom-1dof", "digger-3dof"])
def test_every_place_that_the_catalogue_names_is_marked_in_the_drawing(name: str) -> None:
    rig = shipped(name)
    marks = {}
    for effect in (*catalogue(rig), *free_mechanisms(rig)):
        names = [c.parameter for c in effect.coefficients(rig)]
        names += [shape.parameter for shape in effect.shapes(rig)]
        marks[effect.name, effect.where] = place_plot.marked(rig, effect.name, effect.place, names)
    assert all(marks.values())
    assert {spot for own in marks.values() for spot in own} <= set(place_plot.elements(rig))
    for (_, where), own in marks.items():
        if where.startswith("joint"):
            assert {spot.split()[-1] for spot in own} == {where.split()[1]}
    shown = [key for key in marks if key[0] in ("entrained_air", "sensor_gain", "joint_spring")]
    lines = [(effect_name, place, (), MODEL) for effect_name, place in shown]
    drawn = str(place_plot.drawn(rig, lines))
    for k, (effect_name, place) in enumerate(shown, start=1):
        found = re.findall(rf'id="places-mark-{k}-([^"]*)"', drawn)
        wanted = place_plot.marked(rig, effect_name, place)
        assert sorted(found) == sorted(spot.replace(" ", "-") for spot in wanted)
        assert f"{k} {effect_name.replace('_', ' ')} at {place_in_words(place)}" in " ".join(
            drawn.split()
        )


@pytest.mark.parametrize("name", ["shinshu-2dof", "electric-2dof", "emps"])
def test_every_residual_is_plotted_over_a_quantity_with_a_practical_unit(name: str) -> None:
    rig = shipped(name)
    effects = (*catalogue(rig), *free_mechanisms(rig))
    axes = {(e.name, e.where): trace_plots.axis(rig, e.plotted()) for e in effects}
    way = rig.unit_of(f"{rig.position_kind}_1")
    words, factor = {"rad": ("°/s", 180 / math.pi), "m": ("mm/s", 1e3)}[way]
    label, scale = axes["coulomb_friction", "joint 1"]
    assert (label, round(scale, 6)) == (f"velocity [{words}]", round(factor, 6))
    if not rig.electric:
        assert axes["internal_leakage", "joint 1"] == ("pressure difference [MPa]", 1e-6)
        assert axes["sensor_lag", "joint 1 spool"] == ("spool rate [V/s]", 1.0)
        assert trace_plots.axis(rig, "cap_pressure_1") == ("cap_pressure_1 [MPa]", 1e-6)


@pytest.mark.parametrize(
    ("effect", "where", "parameters", "spots"),
    [
        ("internal_leakage", "joint 2", ["c_internal_2"], ("piston 2",)),
        ("external_leakage", "joint 2 cap", ["c_external_cap_2"], ("cap 2",)),
        ("valve_deadband", "joint 1", ["w_ahead_1"], ("valve 1",)),
        ("entrained_air", "bench", ["alpha_air"], ("cap 1", "rod 1", "cap 2", "rod 2")),
        ("laminar_orifice", "bench", ["dp_laminar"], ("valve 1", "valve 2")),
        ("supply_sag", "bench", ["dp_supply"], ("supply",)),
        ("tank_pressure", "bench", ["p_tank"], ("tank",)),
        ("base_inclination", "bench", ["inclination"], ("base",)),
        ("payload", "bench", ["m_payload"], ("load",)),
        ("sensor_gain", "joint 1", ["gain_spool_1"], ("spool sensor 1",)),
        ("sensor_gain", "joint 1", ["gain_piston_1"], ("piston sensor 1",)),
        ("sensor_offset", "bench", ["offset_supply_pressure"], ("supply sensor",)),
        (
            "channel_delay", "bench", ["delay_pressure"],
            ("cap sensor 1", "rod sensor 1", "cap sensor 2", "rod sensor 2"),
        ),
    ],
)  # fmt: skip
def test_an_effect_is_marked_where_a_mechanic_would_look(
    rig: Rig, effect: str, where: str, parameters: list[str], spots: tuple[str, ...]
) -> None:
    assert place_plot.marked(rig, effect, where, parameters) == spots


def test_two_effects_at_one_place_are_both_marked(rig: Rig) -> None:
    lines = [
        ("internal_leakage", "joint 2", (), MODEL),
        ("coulomb_friction", "joint 2", (), ORANGE),
    ]
    drawn = str(place_plot.drawn(rig, lines))
    assert "mark-1" in drawn
    assert "mark-2" in drawn
    assert "coulomb friction at joint 2, which these records cannot separate from it" in drawn


def test_a_valve_s_null_is_drawn_beside_the_spool_s_own_sensor(rig: Rig) -> None:
    """They are one to the data; `sensor_offset at joint 2` alone would be the piston's."""
    null = JudgedEffect("spool_offset", "joint 2", {}, 0.005, 1.0, (), ())
    result = SimpleNamespace(
        model_before=SimpleNamespace(rig=rig),
        effects=(null,),
        tied_at=[("sensor_offset", "joint 2 spool")],
    )
    assert place_plot.lines_of(cast(Trace, result)) == [
        ("spool_offset", "joint 2", (), MODEL),
        ("sensor_offset", "joint 2 spool", (), ORANGE),
    ]
    assert place_plot.marked(rig, "sensor_offset", "joint 2 spool") == ("spool sensor 2",)
    assert place_plot.marked(rig, "sensor_offset", "joint 2") == ("piston sensor 2",)
    assert "mark-2" in str(place_plot.places(cast(Trace, result)))
    nothing = SimpleNamespace(model_before=result.model_before, effects=(), tied_at=[])
    assert place_plot.places(cast(Trace, nothing)) is None


def test_rivals_stand_by_what_they_leave_and_say_why_they_are_not_named() -> None:
    drawn = str(trace_plots.rival_errors(LEAK, "e0"))
    said = [re.sub(r"<[^>]+>", "", line) for line in re.findall(r"<text.*?</text>", drawn)]
    stand = [s for s in said if "joint 2" in s or s == "without the effect"]
    assert [s.partition(":")[0] for s in stand] == [
        "without the effect", "spool offset at joint 2", "external leakage at joint 2, rod",
        "sensor gain at joint 2, cap", "internal leakage at joint 2",
    ]  # fmt: skip
    assert "held-out error 9.40 times as large" in stand[1]
    assert "training error 1.90 times as large" in stand[2]
    assert "cannot be separated from it" in stand[3]
    assert "not named (no rival: cannot be separated from sensor gain)" in stand[4]
    for left in ("27.6", "14.1", "1.58", "1.53", "1.50"):
        assert f" {left}" in said


def test_a_trace_of_before_is_drawn_without_what_nobody_knows() -> None:
    assert trace_plots.rival_errors(replace(LEAK, rms_without=float("nan")), "e0") is None


def test_a_sensor_s_effect_is_told_with_its_sensor_and_stored_by_its_joint() -> None:
    lag = JudgedEffect(
        "sensor_lag", "joint 1", {}, 0.01, 0.4,
        (Rival("sensor_lag", "bench", 1.0, 1.0, True, "bench pressure"),),
        (Gate("invariant", False, ""),), at="joint 1 spool",
    )  # fmt: skip
    assert (lag.where, lag.location) == ("joint 1", "joint 1, spool")
    assert (lag.rivals[0].where, lag.rivals[0].location) == ("bench", "bench, pressure")
    assert replace(lag, at="").location == "joint 1"
    assert LEAK.rivals[1].location == "joint 2, cap"


def test_an_effect_that_several_sets_hold_is_refused_once_where_it_removes_most() -> None:
    failed = (Gate("invariant", False, ""),)
    first, second, other = (
        JudgedEffect("sensor_lag", "joint 1", {}, 0.01, removed, (), failed, at=at)
        for removed, at in ((0.1, "joint 1 spool"), (0.4, "joint 1 spool"), (0.2, "joint 1 piston"))
    )
    assert refused_effects([first, LEAK, second, other]) == (second, other)
    named = replace(first, gates=())
    assert refused_effects([named, second, other]) == (other,)
