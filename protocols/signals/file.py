"""A command from a table of numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from protocols.language.signal import SignalKind
from protocols.language.waveforms import Array, Waveform, shaped
from rig.model.quantity import Frequency, Ratio

LARGEST = 2_000_000  # samples of one period


class FileSignal(SignalKind):
    """One period of a command from a CSV file: a column of volts, or `time` [s] and volts.

    A file with times is resampled to the bench's rate; without, its rows are the bench's samples.
    Its mean is removed: the bias that keeps the piston centred is found on the bench. Lines above
    `f_max` are removed.
    """

    kind: Literal["file"]
    file: str = Field(min_length=1, description="path, relative to the protocol file")
    scale: Ratio = Field(default=1.0, gt=0, description="multiplies the column")
    f_max: Frequency = Field(default=50.0, gt=0, description="nothing above is kept")
    volts: tuple[float, ...] = Field(default=(), description="the column, as it was read")
    times: tuple[float, ...] = Field(default=(), description="the times, as they were read")

    @field_validator("file")
    @classmethod
    def _beside_the_protocol(cls, value: str, info: ValidationInfo) -> str:
        folder = (info.context or {}).get("folder")
        return value if folder is None else str(Path(folder) / value)

    @model_validator(mode="after")
    def _read(self) -> Self:
        if self.volts:
            return self
        times, volts = _columns(Path(self.file))
        object.__setattr__(self, "volts", tuple(volts.tolist()))
        object.__setattr__(self, "times", tuple(times.tolist()))
        return self

    def scaled(self, factor: float) -> Self:
        """Return the signal with its scale multiplied."""
        return self.model_copy(update={"scale": factor * self.scale})

    def waveform(self, sample_rate: float) -> Waveform:
        """Return the file's period at `sample_rate`; raises ValueError for an unsuitable one."""
        volts = self.scale * np.array(self.volts)
        if self.times:
            times = np.array(self.times)
            step = (times[-1] - times[0]) / (len(times) - 1)
            n = round((times[-1] - times[0] + step) * sample_rate)
            if n > LARGEST:
                raise ValueError(f"{self.file}: {n} samples; expected at most {LARGEST}")
            grid = times[0] + np.arange(n) / sample_rate
            volts = np.interp(grid, times, volts)
        try:
            return shaped(volts, self.f_max, sample_rate)
        except ValueError as error:
            raise ValueError(f"{self.file}: {error}") from error


def _columns(path: Path) -> tuple[Array, Array]:
    """Return (times [s] or empty, volts) of a CSV file; raises ValueError naming the error."""
    try:
        lines = path.read_text("utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file in UTF-8"
        raise ValueError(f"{path}: cannot be read ({reason})") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(cell) for cell in line.split(",")]
        except ValueError:
            if not rows:
                continue  # the header
            raise ValueError(f"{path}:{number}: {line.strip()!r} is no row of numbers") from None
        if len(row) not in (1, 2) or (rows and len(row) != len(rows[0])):
            raise ValueError(
                f"{path}:{number}: {len(row)} columns; expected volts, or time and volts, as above"
            )
        rows.append(row)
    if not 4 <= len(rows) <= LARGEST:
        raise ValueError(f"{path}: {len(rows)} rows of numbers; expected 4 to {LARGEST}")
    table = np.array(rows)
    if not np.isfinite(table).all():
        raise ValueError(f"{path}: a number is not finite")
    if table.shape[1] == 1:
        return np.empty(0), table[:, 0]
    if np.any(np.diff(table[:, 0]) <= 0.0):
        raise ValueError(f"{path}: its first column, the time, does not rise from row to row")
    return table[:, 0], table[:, 1]
