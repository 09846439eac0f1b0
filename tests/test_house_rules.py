"""Rules of CONTRIBUTING.md that no linter checks: effects in two files, class names, folders."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

from analysis.effects.base import Effect
from analysis.terms import known
from hil_sim.effects import CLASSES

ROOT = Path(__file__).parents[1]
PACKAGES = ("rig", "protocols", "drivers", "analysis", "hil_sim")
EFFECTS = {name: kind for name, kind in known().items() if issubclass(kind, Effect)}
# What has a name has a form of the plant; a mechanism whose curve the data draw has none.
CATALOGUE = {name: kind for name, kind in EFFECTS.items() if not kind.free}
PLANT = {kind.effect_name() for kind in CLASSES}
# Words that also name a quantity: of an electric rig file, of gravity, a state of the plant.
ELSEWHERE = {"base_inclination", "torque_offset", "tank_pressure"}


def test_the_catalogue_and_the_plant_have_the_same_effects() -> None:
    assert set(CATALOGUE) == PLANT


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - ELSEWHERE))
def test_no_other_file_of_the_product_knows_an_effect_by_name(name: str) -> None:
    homes = (ROOT / "analysis" / "effects", ROOT / "hil_sim" / "effects")
    users = [
        str(path.relative_to(ROOT))
        for path in _modules()
        if not any(home in path.parents for home in homes)
        and f'"{name}"' in path.read_text(encoding="utf-8")
    ]
    assert users == []


@pytest.mark.parametrize("kind", CATALOGUE.values(), ids=lambda kind: kind.name)
def test_an_effect_carries_the_smallest_size_of_interest(kind: type[Effect]) -> None:
    if kind.name in ("payload", "sensor_offset"):  # cannot show alone; differs by channel
        return
    assert kind.smallest_coefficients or kind.smallest_shape


def test_no_two_public_classes_share_a_name() -> None:
    """An effect's class in the catalogue and its plant form are the one exception."""
    homes: dict[str, list[str]] = defaultdict(list)
    for path in _modules():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(path.relative_to(ROOT).as_posix())
    pair = ["analysis/effects", "hil_sim/effects"]
    shared = {
        name: places
        for name, places in homes.items()
        if len(places) > 1 and sorted(str(Path(place).parent) for place in places) != pair
    }
    assert shared == {}


def test_a_file_of_a_user_is_written_whole_or_not_at_all() -> None:
    """What is written directly lies in a folder that appears whole, or in one of this process."""
    direct = {
        path.relative_to(ROOT).as_posix()
        for path in _modules()
        if ".write_text(" in path.read_text(encoding="utf-8")
    }
    assert direct == {
        "analysis/simulation/compiled_sources.py",
        "analysis/simulation/fmu/archive.py",
        "rig/runs/exchange/export.py",
        "rig/runs/exchange/ro_crate.py",
    }


def _modules() -> list[Path]:
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
