"""Find the rig and the driver of a verb; print the places under pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rig.cli.text.output import progress

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from drivers.base import Driver
    from rig.bench.probe import Reading
    from rig.cli.text.output import Say
    from rig.model.rig import Rig


def reached_at(rig: Rig, endpoint: str | None) -> Rig:
    """Return the rig with the wire of `endpoint`; unchanged without one."""
    from drivers import wire_at

    if endpoint is None:
        return rig
    return rig.model_copy(update={"wire": wire_at(endpoint, rig.wire)})


def bench_at(name: str, endpoint: str | None, *, on_twin: bool = False) -> Rig:
    """Return a rig that can be driven, with the wire of `endpoint` if given.

    Raises InputError, with the rig file's line where its own wire is meant, for one with which no
    session could begin; a package that the wire needs may be missing where the bench is not driven
    (`on_twin`).
    """
    from drivers.base import PackageMissing
    from drivers.registry import require_setup
    from rig.model.parse import InputError
    from rig.runs.rigs import load_bench

    own = load_bench(name)
    bench = reached_at(own, endpoint)
    if endpoint is None and not own.wire.settings:  # --endpoint states them
        return bench
    try:
        require_setup(bench.wire, bench)
    except InputError as error:
        if on_twin and isinstance(error, PackageMissing):
            return bench
        in_file = bench.wire == own.wire
        where = _place_of(name, str(error)) if in_file else f"rig {bench.name!r}"
        raise InputError(f"{where}: {error}") from error
    return bench


def warn_of_limits(rig: Rig, say: Say = progress) -> None:
    """State each limit that no reading can pass, before anything moves."""
    from rig.bench.checks.unreachable import unreachable_limits

    for sentence in unreachable_limits(rig):
        say(f"WARNING: {sentence}")


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


def _place_of(name: str, problem: str) -> str:
    """Return file and line of the key below `wire` with which a problem's text begins."""
    from rig.model.parse import load_yaml
    from rig.runs.rigs import rig_text

    text, source = rig_text(name)
    lines = {tuple(map(str, path)): line for path, line in load_yaml(text, source)[1].items()}
    keys = ["wire", *problem.removeprefix("wire: ").partition(":")[0].split(".")]
    known = (lines.get(tuple(keys[:end])) for end in range(len(keys), 0, -1))
    return f"{source}:{next((line for line in known if line is not None), 1)}"


def pressure_text(readings: Sequence[Reading], bench: str = "") -> str:
    """Return where pressure is left, and where it is not known, as text; '' for nowhere.

    `bench` is named where several may be meant.
    """
    from rig.bench.probe import pressurised, unknown_pressures

    lists = {
        "still under pressure": pressurised(readings),
        "pressure not known": unknown_pressures(readings),
    }
    where = f", {bench}" if bench else ""
    return "; ".join(
        f"{what}{where}: {', '.join(places)}" for what, places in lists.items() if places
    )
