"""Refuse runs that are given twice: as a folder, as its copy, or as an export imported again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rig.model.records import repeated_run, samples_digest
from rig.runs.store import ARCHIVE
from rig.runs.stream import open_record, read_run_head

FIRST: Final = 1000  # samples that are compared first: noise makes those of other records differ
STRETCH: Final = 100_000  # samples of a record in memory at a time

_Place = tuple[Path, str]  # folder of a run, and the name of a record in it


def refuse_repeated(folders: Sequence[str | Path]) -> None:
    """Raise InputError if two folders are the same run, or have a record with the same samples.

    Records are read in full only where they begin alike. Folders that do not exist here (a cluster
    may read them elsewhere) are compared by name only. Raises InputError as `load_run` does.
    """
    known: dict[Path, Path] = {}
    for folder in map(Path, folders):
        if folder.resolve() in known:
            raise repeated_run(str(folder), str(known[folder.resolve()]))
        known[folder.resolve()] = folder
    if len(known) > 1:
        _refuse_shared_records(
            [folder for folder in known.values() if (folder / ARCHIVE).is_file()]
        )


def _refuse_shared_records(folders: Sequence[Path]) -> None:
    begun: dict[str, list[_Place]] = {}
    for folder in folders:
        for head in read_run_head(folder).records:
            with open_record(folder, head.name) as reader:
                alike = begun.setdefault(samples_digest(reader.read(0, FIRST)), [])
            for other, name in alike:
                if other != folder and _same_samples((folder, head.name), (other, name)):
                    raise repeated_run(str(folder), str(other), (head.name, name))
            alike.append((folder, head.name))


def _same_samples(one: _Place, other: _Place) -> bool:
    with open_record(*one) as first, open_record(*other) as second:
        return first.head.samples == second.head.samples and all(
            samples_digest(first.read(k, k + STRETCH))
            == samples_digest(second.read(k, k + STRETCH))
            for k in range(0, first.head.samples, STRETCH)
        )
