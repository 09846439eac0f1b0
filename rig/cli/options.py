"""Options that several verbs share."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

if TYPE_CHECKING:
    from protocols.files.plan import Overrides


def _rigs(incomplete: str) -> list[str]:
    """Return the shipped rigs that complete a word; the shell completes files."""
    from rig.runs.rigs import shipped_rigs

    return [name for name in shipped_rigs() if name.startswith(incomplete)]


def _protocols(incomplete: str) -> list[str]:
    """Return the shipped protocols that complete a word."""
    from protocols.files.library import shipped_names

    return [name for name in shipped_names() if name.startswith(incomplete)]


_OUTPUT_FILES: Final = "output files"  # key of a context's notes: file to option


def writable_file(
    context: typer.Context, param: typer.CallbackParam, path: Path | None
) -> Path | None:
    """Return the file that a verb is to write; raises InputError where it cannot be written.

    Called while the options are read, before any computation.
    """
    if path is None or str(path) == "-":
        return path
    from rig.model.parse import InputError
    from rig.runs.files import no_place_for
    from rig.runs.store import is_file_of_run

    option = f"{param.opts[0]} {path}"
    if path.is_dir():
        raise InputError(f"{option}: is a folder; expected the name of a file in it")
    if path.exists() and not path.is_file():
        raise InputError(f"{option}: is no regular file; expected the name of a file to write")
    if is_file_of_run(path):
        raise InputError(f"{option}: is part of the run {path.parent}; name another file")
    if reason := no_place_for(path):
        raise InputError(f"{option}: {reason}; name a file in a folder that can be written")
    options_of_files = context.meta.setdefault(_OUTPUT_FILES, {})
    other = options_of_files.setdefault(path.absolute(), param.opts[0])
    if other != param.opts[0]:
        raise InputError(f"{option}: {other} writes that file as well; name two files")
    return path


def one_line(param: typer.CallbackParam, text: str | None) -> str | None:
    """Return a name; raises InputError for one with a line break."""
    from rig.queue.items import require_one_line

    if text is not None:
        require_one_line(text, param.opts[0])
    return text


RigOption = Annotated[
    str,
    typer.Option(
        "--rig", help="A shipped rig's name, or the path of a rig file.", autocompletion=_rigs
    ),
]
KnownRigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        help="A shipped rig's name, or the path of a rig file; by default the rig that a process "
        "of this computer drives, for `reset` the one that tripped.",
        autocompletion=_rigs,
    ),
]
ProtocolArgument = Annotated[
    str,
    typer.Argument(
        help="A shipped protocol's name, or the path of a protocol file.", autocompletion=_protocols
    ),
]
RepeatsOption = Annotated[
    int | None, typer.Option(min=1, help="Repeats per step, instead of the file's.")
]
DurationOption = Annotated[
    float | None, typer.Option(min=0.01, help="Seconds per record, instead of the file's.")
]
ScaleOption = Annotated[float, typer.Option(help="Factor on every amplitude of the file.")]
WaveSeedOption = Annotated[
    int | None, typer.Option("--wave-seed", min=0, help="Seed of the multisines' phases.")
]
StepOption = Annotated[
    list[str] | None, typer.Option("--step", help="Run only this step; repeatable.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="NAME=VALUE sets a parameter of the file; repeatable."),
]
EndpointOption = Annotated[
    str | None,
    typer.Option(help="KIND://..., such as modbus-tcp://HOST:PORT, instead of the rig's wire."),
]
JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json",
        help="Write the machine-readable result here; - is standard output.",
        callback=writable_file,
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="A model file with the twin's parameters.  "
        "[default: the last identified one of the rig]",
    ),
]
NominalOption = Annotated[
    bool, typer.Option("--nominal", help="Use the rig file's nominal values for the twin instead.")
]
ReportOption = Annotated[
    Path | None, typer.Option(help="Write an HTML report here.", callback=writable_file)
]
ProtocolFileOption = Annotated[
    Path | None, typer.Option(help="Write the protocol file here.", callback=writable_file)
]
RunsArgument = Annotated[list[Path], typer.Argument(help="Run folders.")]


def overridden(
    repeats: int | None,
    duration: float | None,
    amplitude_scale: float,
    seed: int | None,
    steps: Sequence[str] | None,
    settings: Sequence[str] | None = None,
) -> Overrides:
    """Return the changes of a protocol given on the command line."""
    from protocols.files import library
    from protocols.files.plan import Overrides

    step_names = tuple(steps) if steps else None
    values = library.parsed_values(settings or ())
    return Overrides(repeats, duration, amplitude_scale, seed, step_names, values)


def time_since(text: str | None) -> datetime | None:
    """Read a date, a time, or a duration before now (12h, 7d, 30m); raises InputError."""
    if text is None:
        return None
    units = {"h": "hours", "d": "days", "m": "minutes"}
    if text[:-1].isdigit() and text[-1] in units:
        return datetime.now(UTC) - timedelta(**{units[text[-1]]: int(text[:-1])})
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except ValueError:
        from rig.model.parse import InputError

        raise InputError(
            f"--since {text!r}: expected a date (2026-03-01), a time (2026-03-01T22:00) or a "
            "duration (12h or 7d)"
        ) from None
