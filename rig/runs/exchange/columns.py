"""Columns of foreign files: CSV with a header row, MAT files of vectors; errors name their cell.

Rows and columns are counted from 1 as an editor shows them: the header is row 1.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.model.parse import InputError
from rig.runs.exchange.settings import EXCHANGE
from rig.runs.files import read_text

Array = NDArray[np.float64]

_DELIMITERS = (",", ";", "\t")


def read_table(path: Path, wanted: Iterable[str], needed: Iterable[str]) -> dict[str, Array]:
    """Return those columns of `wanted` that the file has, each (n,), finite, without conversion.

    Raises InputError naming file, column and row; also if a column of `needed` is missing.
    """
    if path.suffix.lower() == ".mat":
        table = _read_mat(path, list(wanted))
    else:
        table = _read_csv(path, list(wanted), list(needed))
    for name in needed:
        if name not in table:
            raise _missing(path, name, table)
    _same_length(path, table)
    return table


def _missing(path: Path, name: str, has: Iterable[str]) -> InputError:
    names = ", ".join(sorted(has)) or "none"
    return InputError(
        f"{path}: has no column {name!r}; found: {names} (name it under 'columns' in the manifest "
        "if it is called differently)"
    )


# CSV


def _read_csv(path: Path, wanted: list[str], needed: list[str]) -> dict[str, Array]:
    text = read_text(path, "a CSV file with a header row", limit=EXCHANGE.file_bytes)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    head = next((i for i, line in enumerate(lines) if line.strip()), None)
    if head is None:
        raise InputError(f"{path}: the file is empty; expected a header row and numbers")
    delimiter = max(_DELIMITERS, key=lambda d: len(_split(lines[head], d)))
    names = [cell.strip() for cell in _split(lines[head], delimiter)]
    chosen = [name for name in wanted if name in names]
    for name in needed:
        if name not in names:
            raise _missing(path, name, names)
    for name in chosen:
        if names.count(name) > 1:
            raise InputError(
                f"{path}:{head + 1}: column {name!r} occurs twice; expected distinct names"
            )
    rows = [i for i in range(head + 1, len(lines)) if lines[i].strip()]
    if not rows:
        raise InputError(f"{path}: has a header row but no numbers under it")
    body = [lines[i] for i in rows]
    if delimiter != "," and not any("." in line for line in body[:50]):
        body = [line.replace(",", ".") for line in body]  # the file has decimal commas
    values = _CsvTable(path, names, delimiter, body, rows).numbers(chosen)
    return {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(chosen)}


def _split(line: str, delimiter: str) -> list[str]:
    return next(csv.reader(io.StringIO(line), delimiter=delimiter, skipinitialspace=True), [])


@dataclass(frozen=True)
class _CsvTable:
    """The lines with numbers of a CSV file; `rows` are their numbers in the file, from 0."""

    path: Path
    names: Sequence[str]
    delimiter: str
    body: Sequence[str]
    rows: Sequence[int]

    def numbers(self, chosen: Sequence[str]) -> Array:
        """Return the chosen columns, shape (lines, columns)."""
        self._refuse_ragged()
        columns = [self.names.index(name) for name in chosen]
        try:
            values = np.loadtxt(
                self.body,
                delimiter=self.delimiter,
                usecols=columns,
                ndmin=2,
                comments=None,
                quotechar='"',
            )
        except ValueError as error:
            raise self._bad_cell(columns, str(error)) from error
        if not np.isfinite(values).all():
            k, column = (int(at) for at in np.argwhere(~np.isfinite(values))[0])
            found = f"found {values[k, column]}, expected a finite number"
            raise self._error_in(self.rows[k], chosen[column], found)
        return np.asarray(values, dtype=np.float64)

    def _refuse_ragged(self) -> None:
        for line, row in zip(self.body, self.rows, strict=True):
            if line.count(self.delimiter) + 1 == len(self.names):
                continue
            cells = len(_split(line, self.delimiter))
            if cells != len(self.names):
                raise InputError(
                    f"{self.path}:{row + 1}: row {row + 1} has {cells} cells, "
                    f"the header has {len(self.names)}"
                )

    def _bad_cell(self, columns: Sequence[int], reason: str) -> InputError:
        """Return the error of the first cell that is not a number; slow, for invalid files only."""
        for line, row in zip(self.body, self.rows, strict=True):
            cells = _split(line, self.delimiter)
            for column in columns:
                cell = cells[column].strip()
                try:
                    float(cell)
                except ValueError:
                    found = f"found {cell[:40]!r}" if cell else "the cell is empty"
                    return self._error_in(row, self.names[column], f"{found}, expected a number")
        return InputError(f"{self.path}: cannot be read as numbers: {reason}")

    def _error_in(self, row: int, column: str, text: str) -> InputError:
        return InputError(f"{self.path}:{row + 1}: column {column!r}, row {row + 1}: {text}")


# MAT
# MAT


def _read_mat(path: Path, wanted: list[str]) -> dict[str, Array]:
    from scipy.io import loadmat  # noqa: PLC0415 - loads slowly
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a MAT file of vectors")
    try:
        content: Mapping[str, Any] = loadmat(path)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: a MAT file of version 7.3; save it with the option '-v7' (version 5 format)"
        ) from error
    except (MatReadError, OSError, ValueError, TypeError, KeyError, EOFError) as error:
        raise InputError(f"{path}: not a readable MAT file: {error}") from error
    except Exception as error:  # zlib and struct errors of a damaged file have no common base
        raise InputError(f"{path}: a damaged MAT file: {error}") from error
    names = [name for name in content if not name.startswith("__")]
    if not names:
        raise InputError(f"{path}: the file is empty; expected vectors named like the channels")
    return {name: _vector(path, name, content[name]) for name in wanted if name in names}


def _vector(path: Path, name: str, value: Any) -> Array:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        kind = getattr(value, "dtype", type(value).__name__)
        raise InputError(f"{path}: variable {name!r} holds {kind}, expected real numbers")
    if value.size == 0 or value.size != max(value.shape, default=1):
        raise InputError(
            f"{path}: variable {name!r} has shape {value.shape}, expected a row or a column"
        )
    vector = np.ascontiguousarray(value.ravel(), dtype=np.float64)
    invalid = np.flatnonzero(~np.isfinite(vector))
    if len(invalid):
        row = int(invalid[0])
        raise InputError(
            f"{path}: column {name!r}, row {row + 1}: found {vector[row]}, expected a finite number"
        )
    return vector


def _same_length(path: Path, table: Mapping[str, Array]) -> None:
    lengths = {name: len(values) for name, values in table.items()}
    if len(set(lengths.values())) > 1:
        first, *others = lengths
        other = next(name for name in others if lengths[name] != lengths[first])
        raise InputError(
            f"{path}: column {first!r} has {lengths[first]} rows, column {other!r} "
            f"{lengths[other]}; expected the same number"
        )
