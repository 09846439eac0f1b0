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


def refuse_repeated(folders: Sequence[str | Path], partly: bool = True) -> None:
    """Raise InputError if two folders are the same run or, if `partly`, have a record in common.

    Records are read in full only where they begin alike. Folders that do not exist here (a cluster
    may read them elsewhere) are compared by name only. Raises InputError as `load_run` does.
    """
    known: dict[Path, Path] = {}
    for folder in map(Path, folders):
        if folder.resolve() in known:
            raise repeated_run(str(folder), str(known[folder.resolve()]))
        known[folder.resolve()] = folder
    if len(known) > 1:
        stored = [folder for folder in known.values() if (folder / ARCHIVE).is_file()]
        _refuse_shared_records(stored, partly)


def _refuse_shared_records(folders: Sequence[Path], partly: bool) -> None:
    begun: dict[str, list[_Place]] = {}
    counts: dict[Path, int] = {}
    for folder in folders:
        heads = read_run_head(folder).records
        counts[folder] = len(heads)
        shared: dict[Path, list[tuple[str, str]]] = {}
        for head in heads:
            with open_record(folder, head.name) as reader:
                alike = begun.setdefault(samples_digest(reader.read(0, FIRST)), [])
            for other, name in alike:
                if other != folder and _same_samples((folder, head.name), (other, name)):
                    shared.setdefault(other, []).append((head.name, name))
            alike.append((folder, head.name))
        for other, pairs in shared.items():
            if partly or len(pairs) == len(heads) == counts[other]:
                raise repeated_run(str(folder), str(other), pairs[0])


def _same_samples(one: _Place, other: _Place) -> bool:
    with open_record(*one) as first, open_record(*other) as second:
        return first.head.samples == second.head.samples and all(
            samples_digest(first.read(k, k + STRETCH))
            == samples_digest(second.read(k, k + STRETCH))
            for k in range(0, first.head.samples, STRETCH)
        )
