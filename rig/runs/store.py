"""Run folders: creating and loading; software versions of a run."""

from __future__ import annotations

import json
import platform
import socket
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from rig.model.parse import InputError, first_problem, load_yaml
from rig.model.records import Record, RecordHead, Run
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed
from rig.runs.files import new_folder, no_place_for, read_text, replace_text
from rig.runs.runstate import (
    EVENTS,
    HEADER,
    INTERRUPTED,
    JOURNAL,
    RUNNING,
    STREAM,
    read_owner,
    read_state,
    release_ownership,
    take_ownership,
    user_name,
    utc_now,
    write_state,
)

T = TypeVar("T", Record, RecordHead)

ARCHIVE = "records.h5"
CRATE_METADATA = "ro-crate-metadata.json"  # in the copy of a run for an archive
PROOF = "proof.json"  # the proof of the protocol on the twin
TRACKED = "tracked.json"  # the estimates at the end of a run that tracked parameters
TRIP_WINDOW = "trip.csv"  # the samples around a trip
_OWN_FILES = (HEADER, ARCHIVE, JOURNAL, EVENTS, "state", TRIP_WINDOW, PROOF, TRACKED)
_FORMAT = 1
_NOTE = "# How this run was taken. Numbers are SI: m, Pa, V, s, Hz, rad, degC.\n"


class Header(BaseModel):
    """Contents of run.yaml; keys of later versions are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: int
    created: str
    operator: str = ""
    host: str = ""
    seed: int | None = None
    source: str = ""
    device: str = ""
    virtual_time: bool = False
    versions: dict[str, str] = {}
    provenance: dict[str, Any] = {}
    rig: Rig
    protocol: dict[str, Any] | None = None


def description_of(rig: Rig) -> str:
    """Return the head of a run, as text, with a rig alone: `rig.runs.rigs.load_rig` reads it."""
    head = Header(format=_FORMAT, created=utc_now(), rig=rig)
    return yaml.safe_dump(head.model_dump(mode="json"), sort_keys=False)


def refuse_occupied(folder: Path) -> None:
    """Raise InputError unless `folder` is new or an empty folder."""
    try:
        if not folder.exists() and not folder.is_symlink():
            if reason := no_place_for(folder):
                raise InputError(f"{folder}: {reason}; name another folder for the run")
            return
        if not folder.is_dir():
            raise InputError(f"{folder}: is not a folder; name a new folder for the run")
        if any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty; name a new folder for the run")
    except OSError as error:
        raise InputError(f"{folder}: cannot be used for a run: {error.strerror}") from error


def create_run(
    folder: Path,
    rig: Rig,
    *,
    protocol: Mapping[str, Any] | None = None,
    seed: int | None = None,
    operator: str | None = None,
    source: str = "",
    device: str = "",
    virtual_time: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Create a run folder in state `running`, owned by this process.

    `protocol`: the resolved protocol as plain data, with a `name`. `provenance`: command, files
    with checksums and seeds, for repeating the run. `virtual_time`: the device is a simulator whose
    clock advances only when it is read. Raises InputError if the folder is occupied or cannot be
    created.
    """
    refuse_occupied(folder)
    head = {
        "format": _FORMAT,
        "created": utc_now(),
        "operator": user_name() if operator is None else operator,
        "host": socket.gethostname(),
        "seed": seed,
        "source": source,
        "device": device,
        "virtual_time": virtual_time,
        "versions": versions(),
        "provenance": dict(provenance or {}),
        "protocol": None if protocol is None else json.loads(json.dumps(dict(protocol))),
        "rig": rig.model_dump(mode="json"),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        take_ownership(folder)
        write_state(folder, RUNNING)
        replace_text(folder / HEADER, _NOTE + yaml.safe_dump(head, sort_keys=False))
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from error
    return folder


@contextmanager
def whole_run(out: Path, rig: Rig, source: str) -> Iterator[Path]:
    """Yield a temporary folder for a run without a bench; it becomes `out` when finished.

    `out` is complete or absent. Raises InputError if `out` is occupied, RecordingFailed if it
    cannot be written.
    """
    refuse_occupied(out)
    try:
        with new_folder(out) as folder:
            create_run(folder, rig, source=source)
            yield folder
            release_ownership(folder)
    except (OSError, RuntimeError) as error:  # h5py reports a failed flush as RuntimeError
        raise RecordingFailed(f"{out}: cannot be written: {error}") from error


def is_run(folder: Path) -> bool:
    """Return whether a folder is a run folder."""
    return (folder / HEADER).is_file()


def is_crate(folder: Path) -> bool:
    """Return whether a folder holds a copy of a run made by `bramah export --format ro-crate`."""
    return (folder / CRATE_METADATA).is_file()


def is_file_of_run(path: Path) -> bool:
    """Return whether a file holds what a run recorded or how it was taken."""
    return path.name in _OWN_FILES and is_run(path.parent)


def read_header(folder: Path) -> Header:
    """Read run.yaml; raises InputError naming file, line and key."""
    path = folder / HEADER
    if not folder.is_dir():
        raise InputError(f"{folder}: no such run folder")
    if not is_run(folder):
        raise InputError(f"{folder}: not a run folder: it has no {HEADER}")
    return parse_header(read_text(path, "the head of a run", limit=64 << 20), str(path))


def parse_header(text: str, source: str) -> Header:
    """Read the text of a run.yaml; raises InputError naming `source`, line and key."""
    data, _ = load_yaml(text, source)
    if not isinstance(data, dict):
        raise InputError(f"{source}:1: expected keys and values")
    if data.get("format") != _FORMAT:
        raise InputError(f"{source}: format {data.get('format')!r}, this version reads {_FORMAT}")
    try:
        return Header.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{source}: {first_problem(error)}") from error


def missing_samples(events: Iterable[Mapping[str, Any]]) -> str:
    """Return that a folder without samples once had some, by its events ('' if it had none)."""
    if not any(event.get("event") == STREAM for event in events):
        return ""
    return (
        f"samples were recorded, and neither {JOURNAL} nor {ARCHIVE} is here; copy the missing "
        "file from where the run was taken"
    )


def finished(folder: Path) -> tuple[Header, str]:
    """Return header and state of a finalised run; raises InputError otherwise."""
    header = read_header(folder)
    state = read_state(folder)
    if state == RUNNING:
        owner = read_owner(folder)
        who = f" (process {owner.pid})" if owner else ""
        raise InputError(f"{folder}: is still being recorded{who}; load it when it has ended")
    unfinished = state == INTERRUPTED and (folder / JOURNAL).exists()
    if unfinished or not (folder / ARCHIVE).exists():
        raise InputError(
            f"{folder}: {state}, its records were not finalised; run `bramah recover {folder}`"
        )
    return header, state


def chosen_of(folder: Path, state: str, records: Sequence[T], partial: bool) -> tuple[T, ...]:
    """Return the complete records, or all if `partial`; raises InputError if there are none."""
    chosen = tuple(r for r in records if partial or r.attributes["complete"])
    if not chosen:
        unfinished = f"; it keeps {len(records)} unfinished one(s)" if records else ""
        raise InputError(f"{folder}: {state} before any record was complete{unfinished}")
    return chosen


def load_run(path: str | Path, *, partial: bool = False) -> Run:
    """Load a run's complete records and, if `partial`, the unfinished ones.

    A sample lost on the wire is NaN in every channel (attribute `lost_samples` counts them).
    Raises InputError with a one-line message for unreadable data.
    `rig.runs.stream` reads them one by one.
    """
    folder = Path(path)
    header, state = finished(folder)
    from rig.runs.archive_reader import read_records  # noqa: PLC0415 - keeps this module light

    chosen = chosen_of(folder, state, read_records(folder / ARCHIVE), partial)
    return Run(header.rig, chosen, source=str(folder), state=state)


# Libraries that decode, store or compute data; a repeated run needs the same versions.
_LIBRARIES = ("numpy", "scipy", "numba", "h5py", "pymodbus", "pyserial", "pydantic")
_ROOT = Path(__file__).resolve().parents[2]


def _git(*words: str) -> str | None:
    try:
        result = subprocess.run(
            ["git", "-C", str(_ROOT), *words],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


def commit() -> str | None:
    """Return the commit of the source tree in use ('-dirty' if changed), None if installed."""
    if not (_ROOT / ".git").exists():
        return None
    head = _git("rev-parse", "HEAD")
    if not head:
        return None
    return f"{head}-dirty" if _git("status", "--porcelain", "--untracked-files=no") else head


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Return the software versions and the platform of this process."""
    out = {
        "bramah": _version("bramah") or "unknown",
        "python": platform.python_version(),
        "platform": platform.platform(),
        **{name: version for name in _LIBRARIES if (version := _version(name)) is not None},
    }
    source = commit()
    return out if source is None else {**out, "commit": source}
