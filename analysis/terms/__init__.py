"""Terms by name: every module of this package that names classes in `TERMS` is found by itself."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from typing import Final

from analysis.terms.base import Term
from rig.model.parse import InputError

PACKAGES: Final = ("analysis.terms", "analysis.effects")
BASELINE: Final = ("inertia", "viscous_friction", "gravity", "compressibility", "orifice")


@functools.cache
def known() -> dict[str, type[Term]]:
    """Return every term class by its name, from all modules of `PACKAGES`."""
    found: dict[str, type[Term]] = {}
    for package_name in PACKAGES:
        package = importlib.import_module(package_name)
        for info in pkgutil.iter_modules(package.__path__):
            module = importlib.import_module(f"{package_name}.{info.name}")
            found.update({term.name: term for term in getattr(module, "TERMS", ())})
    return found


def make(name: str, where: str = "bench") -> Term:
    """Return the term `name` at `where`; raises InputError for one that this version lacks."""
    try:
        return known()[name](where)
    except KeyError:
        raise InputError(
            f"unknown term {name!r}; this version knows: {' '.join(sorted(known()))}"
        ) from None


def baseline() -> tuple[Term, ...]:
    """Return the terms of the paper's model."""
    return tuple(make(name) for name in BASELINE)
