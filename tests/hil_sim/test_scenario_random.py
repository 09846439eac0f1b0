"""A bench that hides what nobody told it to: drawn by its seed, the same for the same seed."""

from __future__ import annotations

from collections import Counter

import pytest

from hil_sim.effects import CLASSES
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from hil_sim.scenario.random_draw import NO_FORMULA_EFFECTS, draw
from rig.model.rig import Rig
from rig.runs.rigs import load_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def test_one_seed_hides_one_thing_and_another_seed_another(rig: Rig) -> None:
    assert draw(rig, 3) == draw(rig, 3)
    assert len({draw(rig, seed).model_dump_json() for seed in range(12)}) > 6


def test_all_kinds_come_up_and_every_place_with_them(rig: Rig) -> None:
    drawn = [draw(rig, seed) for seed in range(600)]
    counts = Counter(scenario.description for scenario in drawn)
    assert {"drawn: none", "drawn: one", "drawn: two", "drawn: strange"} == set(counts)
    assert min(counts.values()) > 50
    names = {effect.name for scenario in drawn for effect in scenario.effects}
    assert names == {kind.effect_name() for kind in CLASSES if kind.drawn}
    places = {effect.place for scenario in drawn for effect in scenario.effects}
    assert {"bench", "joint 1", "joint 2", "joint 1 cap", "joint 2 rod"} <= places
    assert {"cap_pressure_1", "rod_pressure_2"} <= places


def test_sizes_stay_within_what_such_a_bench_shows(rig: Rig) -> None:
    ranges = [
        (kind.effect_name(), key, low, high)
        for kind, sizes in (*((c, c.sizes) for c in CLASSES), *NO_FORMULA_EFFECTS)
        for key, (low, high) in sizes.items()
    ]
    for seed in range(300):
        for effect in draw(rig, seed).effects:
            allowed = [r for r in ranges if r[0] == effect.name]
            keys = {key for _, key, _, _ in allowed} & effect.model_fields_set
            sizes = {key: abs(getattr(effect, key)) for key in keys}
            for key, size in sizes.items():
                spans = [(low, high) for _, k, low, high in allowed if k == key]
                assert any(low <= size <= high for low, high in spans), (effect, key)


def test_what_was_drawn_is_what_the_plant_does(rig: Rig) -> None:
    seed = next(
        s for s in range(200) if [e.name for e in draw(rig, s).effects] == ["internal_leakage"]
    )
    closed = [Law() for _ in rig.joints]
    drawn, plain = Plant(rig, draw(rig, seed), seed), Plant(rig, Scenario(), seed)
    for plant in (drawn, plain):
        plant.advance(2000, closed)
    joint = draw(rig, seed).effects[0].joint
    leaked = drawn.snapshot()["cap_pressure"] - plain.snapshot()["cap_pressure"]
    assert abs(leaked[joint]) > 1e3
