"""Rig files: shipped ones by name, others by path."""

from __future__ import annotations

import os
import re
from pathlib import Path

from rig.model.parse import InputError, parse_model, shipped_files
from rig.model.rig import Rig
from rig.runs.files import read_text
from rig.runs.store import parse_header

_WHAT = "a rig file (YAML)"
_RESOLVED = re.compile(r"^format:", re.MULTILINE)  # key of a run.yaml that no rig file has


def shipped_rigs() -> tuple[str, ...]:
    """Return the names of the shipped rigs."""
    return tuple(shipped_files("rig", "shipped"))


def rig_text(name_or_path: str | Path, relative_to: Path | None = None) -> tuple[str, str]:
    """Return (text, source) of a rig; a shipped name has priority over a file of that name.

    `relative_to` is the folder that a relative path starts from (default: the current one).
    Raises InputError.
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError(f"expected the name or the file of a rig, found {name_or_path!r:.60}")
    text = os.fspath(name_or_path)
    shipped = shipped_files("rig", "shipped")
    if text in shipped:
        return shipped[text].read_text(encoding="utf-8"), f"{text}.yaml (shipped)"
    path = Path(text).expanduser()
    if relative_to is not None:
        path = relative_to / path
    try:
        return read_text(path, _WHAT), str(path)
    except InputError as error:
        raise InputError(f"{error}, or the name of a shipped rig: {', '.join(shipped)}") from error


def load_bench(name: str | Path) -> Rig:
    """Load a rig that can be driven; raises InputError, also for an electric rig."""
    rig = load_rig(name)
    if rig.electric:
        raise InputError(
            f"rig {rig.name!r} is electric: its records can be imported, identified and "
            "validated, but only hydraulic benches are driven and simulated over a wire"
        )
    return rig


def load_rig(name_or_path: str | Path, relative_to: Path | None = None) -> Rig:
    """Load a rig by shipped name, rig file, or a run.yaml recorded on it.

    Raises InputError naming file, line and expected value.
    """
    text, source = rig_text(name_or_path, relative_to)
    if _RESOLVED.search(text):
        return parse_header(text, source).rig
    return parse_model(Rig, text, source)
