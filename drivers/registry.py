"""Drivers by the kind of their wire: classes found by the entry point group ``bramah.drivers``."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoints, entry_points
from typing import Final
from urllib.parse import urlsplit

from drivers.base import Driver, KnowsSetup
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig

GROUP: Final = "bramah.drivers"


@cache
def _installed() -> EntryPoints:
    """Return the installed drivers; a look-up reads the list of every installed package."""
    return entry_points(group=GROUP)


def wire_kinds() -> tuple[str, ...]:
    """Return the kinds of wire for which a driver is installed."""
    return tuple(sorted({entry.name for entry in _installed()}))


def driver_class(kind: str) -> type[Driver]:
    """Return the driver of a kind of wire; raises InputError for an unknown kind."""
    entries = list(_installed().select(name=kind))
    if not entries:
        raise InputError(f"wire: kind: {kind!r} has no driver; installed: {' '.join(wire_kinds())}")
    loaded: type[Driver] = entries[0].load()
    return loaded


def make_driver(wire: Wire, rig: Rig) -> Driver:
    """Return the unconnected driver of a wire; raises InputError for settings it cannot read."""
    try:
        return driver_class(wire.kind)(wire, rig)
    except InputError as error:
        raise InputError(f"rig {rig.name!r}: {error}") from error


def require_setup(wire: Wire, rig: Rig) -> None:
    """Raise InputError naming the key of a wire with which no session could begin.

    Contacts no device. Raises PackageMissing for a package that is not installed.
    """
    driver = driver_class(wire.kind)(wire, rig)
    problem = driver.setup_problem() if isinstance(driver, KnowsSetup) else None
    if problem is not None:
        raise InputError(problem)


def wire_at(endpoint: str, wire: Wire) -> Wire:
    """Return the wire to an endpoint such as ``modbus-tcp://127.0.0.1:5020``; times as in `wire`.

    An endpoint has no form for tables and lists: `wire` itself is returned where it has this
    endpoint, and its tables and lists are kept where it is of this kind. Raises InputError for
    another form, naming the expected one.
    """
    if endpoint == wire.endpoint:
        return wire
    kinds = wire_kinds()
    url = urlsplit(endpoint)
    if url.scheme not in kinds:
        raise InputError(
            f"--endpoint {endpoint}: expected KIND://..., the kind one of: {' '.join(kinds)}"
        )
    settings = driver_class(url.scheme).settings
    own = wire.settings.items() if url.scheme == wire.kind else ()
    without_form = {key: value for key, value in own if isinstance(value, dict | list)}
    try:
        return wire.reached_by(url.scheme, {**without_form, **settings.of_endpoint(url)})
    except (ValueError, TypeError) as error:  # TypeError: a key of every wire, such as timeout
        expected = f"the settings of {url.scheme} in the rig file's section `wire`"
        if settings.example:
            expected = f"one like {settings.example}"
        raise InputError(f"--endpoint {endpoint}: expected {expected}") from error
