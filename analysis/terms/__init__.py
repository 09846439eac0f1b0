"""Terms by name, discovered in every module of this package that lists classes in `TERMS`."""

from __future__ import annotations

import difflib
import functools
import importlib
import pkgutil
import re
from collections.abc import Sequence
from typing import Final

from analysis.terms.base import Term
from rig.model.electric import UNKNOWN
from rig.model.parse import InputError
from rig.model.rig import ElectricRig, Rig

PACKAGES: Final = ("analysis.terms", "analysis.effects")
ELECTRIC: Final = ("inertia", "viscous_friction")
INCLINED: Final = "inclined_gravity"  # gravity with the base's angle as a further unknown
BASELINE: Final = ("inertia", "viscous_friction", "gravity", "compressibility", "orifice")


@functools.cache
def known() -> dict[str, type[Term]]:
    """Return every term class by its name, from all modules of `PACKAGES`."""
    terms: dict[str, type[Term]] = {}
    for package_name in PACKAGES:
        package = importlib.import_module(package_name)
        for info in pkgutil.iter_modules(package.__path__):
            module = importlib.import_module(f"{package_name}.{info.name}")
            terms.update({term.name: term for term in getattr(module, "TERMS", ())})
    return terms


def make(name: str, where: str = "bench") -> Term:
    """Return the term `name` at `where`; raises InputError for an unknown one."""
    try:
        return known()[name](where)
    except KeyError:
        similar = difflib.get_close_matches(name.replace(" ", "_"), known(), 1)
        suggestion = f"did you mean {similar[0]!r}? " if similar else ""
        raise InputError(
            f"unknown term {name!r}; {suggestion}this version knows: {' '.join(sorted(known()))}"
        ) from None


def baseline_of(rig: Rig) -> tuple[Term, ...]:
    """Return the terms that every model of the rig has; without gravity in a horizontal plane."""
    if not isinstance(rig, ElectricRig):
        return tuple(term for term in baseline() if term.name != "gravity" or rig.gravity > 0)
    weight = INCLINED if rig.inclination == UNKNOWN else "gravity"
    has_weight = not rig.prismatic and rig.gravity > 0
    return tuple(make(name) for name in (*ELECTRIC, *((weight,) if has_weight else ())))


def with_effects(rig: Rig, effects: Sequence[str]) -> tuple[Term, ...]:
    """Return the baseline with effects added: `name` (at every joint) or `name@joint 1`.

    Raises InputError for an unknown name or place. With `base_inclination` the angle is found by
    least squares: `inclined_gravity` replaces gravity.
    """
    terms = list(baseline_of(rig))
    for effect in effects:
        name, _, where = (part.strip() for part in effect.partition("@"))
        for place in _places(rig, name, where):
            term = make(INCLINED if name == "base_inclination" else name, place)
            if term in terms:
                raise InputError(f"effect {name!r} at {place} is in the model already")
            if name == "base_inclination":
                terms = [t for t in terms if t.name != "gravity"]
            terms.append(term)
    return tuple(terms)


def _places(rig: Rig, name: str, where: str) -> list[str]:
    """Return the stated place `where`, or, where it is empty, the bench or every joint.

    Raises InputError where the rig has no such place for the effect, or where the effect acts on
    single channels or chambers, so that the place must be stated.
    """
    places = make(name).places(rig)
    chosen = [where] if where else [p for p in places if re.fullmatch(r"bench|joint \d+", p)]
    if chosen and set(chosen) <= set(places):
        return chosen
    if not places:
        raise InputError(f"effect {name!r} does not act on rig {rig.name!r}")
    options = ", ".join(f"'{name}@{place}'" for place in places)
    problem = f"has no place {where!r}" if where else "needs its place"
    raise InputError(f"effect {name!r} {problem} on rig {rig.name!r}: write one of {options}")


def baseline() -> tuple[Term, ...]:
    """Return the terms of the paper's model."""
    return tuple(make(name) for name in BASELINE)
