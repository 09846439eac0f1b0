"""Find the rig and the driver of a verb; print the places under pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from pathlib import Path

    from drivers.base import Driver
    from rig.model.rig import Rig


def reached_at(rig: Rig, endpoint: str | None) -> Rig:
    """Return the rig with the wire of `endpoint`; unchanged without one."""
    from drivers import wire_at

    if endpoint is None:
        return rig
    return rig.model_copy(update={"wire": wire_at(endpoint, rig.wire)})


def bench_at(name: str, endpoint: str | None) -> Rig:
    """Return a rig that can be driven, with the wire of `endpoint` if given.

    Raises InputError, with file and line, for a wire of the rig file without driver or with wrong
    settings.
    """
    from rig.runs.rigs import load_bench

    bench = load_bench(name)
    if endpoint is None:
        _require_wire(name, bench)
    return reached_at(bench, endpoint)


def device_of(rig: str, endpoint: str | None) -> tuple[Rig, Driver]:
    """Return a rig, with the wire of `endpoint` if given, and its unconnected driver."""
    from drivers import make_driver

    bench = bench_at(rig, endpoint)
    return bench, make_driver(bench.wire, bench)


def refuse_endpoint_alone(rig: str | None, endpoint: str | None) -> None:
    """Raise InputError for `--endpoint` without `--rig`, which describes the device there."""
    from rig.model.parse import InputError

    if rig is None and endpoint is not None:
        raise InputError("--endpoint does not describe the bench there; name it: --rig RIG")


def only_bench(rigs: list[Path], none: str, state: str) -> Path:
    """Return the rig file of the only bench of this computer in a state (`tripped`, `in use`).

    Raises InputError that asks for `--rig`, with the reason `none` where there is none.
    """
    from rig.model.parse import InputError
    from rig.runs.rigs import load_rig

    if len(rigs) == 1:
        return rigs[0]
    if not rigs:
        raise InputError(f"{none}; name the bench: --rig RIG")
    benches = (load_rig(path) for path in rigs)
    places = ", ".join(f"{rig.name} at {rig.wire.endpoint}" for rig in benches)
    raise InputError(f"{len(rigs)} benches are {state}: {places}; name one: --rig RIG")


def _require_wire(name: str, rig: Rig) -> None:
    from drivers.registry import driver_class
    from rig.model.parse import InputError, load_yaml
    from rig.runs.rigs import rig_text

    try:
        driver = driver_class(rig.wire.kind)
        if rig.wire.settings:  # without any, --endpoint states them
            driver.settings.of(rig.wire)
    except InputError as error:
        text, source = rig_text(name)
        line = load_yaml(text, source)[1].get(("wire",), 1)
        raise InputError(f"{source}:{line}: {error}") from error


def print_pressure(places: list[str], *, to_stderr: bool = False) -> None:
    """Print the places still under pressure, if any; `to_stderr`: to standard error."""
    if places:
        typer.echo(f"still under pressure: {', '.join(places)}", err=to_stderr)
