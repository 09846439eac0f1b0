"""The import manifest (format: docs/runs.md) as data; errors name its line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rig.model import channels as ch
from rig.model.parse import InputError, load_yaml, validate_model
from rig.model.quantity import Frequency, Time, UnitError, unit_map
from rig.model.records import BANDWIDTH, LOADED
from rig.model.rig import Rig
from rig.runs.files import read_text
from rig.runs.recorder import RecordMeta

TIME = "time"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Column(_Part):
    """The column of a channel: value = to_SI(raw * scale + offset).

    `scale` and `offset` apply to the raw number and give a value in `unit` (default: SI). `delay`
    [s] is the lag of the column: its value at t belongs to t - delay.
    """

    column: str | None = Field(default=None, min_length=1)
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    delay: Time = Field(default=0.0, description="behind the other columns [s], taken out")

    @model_validator(mode="after")
    def _scale_is_a_scale(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale is 0, which makes the column constant; expected another number")
        return self


class ManifestRecord(_Part):
    """One record: a file, or its part from `begin` to `end`.

    `period` [samples] and `lines` describe a periodic excitation. `loaded` says whether the last
    link carries a load (of any unknown mass) that it has not in other records. `bandwidth` [Hz] is
    that of the motion; it is measured where neither it nor `lines` are stated.
    """

    file: str = Field(min_length=1)
    step: str = Field(min_length=1)
    locked: tuple[int, ...] = ()
    repeat: int = Field(default=1, ge=1)
    name: str = ""
    period: int = Field(default=0, ge=0)
    lines: tuple[int, ...] = ()
    bandwidth: Frequency | None = Field(default=None, gt=0, description="of the motion [Hz]")
    loaded: bool | None = None
    begin: Time = Field(default=0.0, ge=0, description="first sample, from the file's start [s]")
    end: Time | None = Field(default=None, gt=0, description="last sample is before this [s]")

    @model_validator(mode="after")
    def _can_be_named(self) -> Self:
        self.meta()
        if self.end is not None and self.end <= self.begin:
            raise ValueError(f"end {self.end:g} s is not after begin {self.begin:g} s")
        if any(line < 1 for line in self.lines):
            raise ValueError("lines are multiples of 1/period, 1 and up")
        return self

    def meta(self) -> RecordMeta:
        """Return the description of the record."""
        stated: dict[str, str | float | int] = {}
        if self.loaded is not None:
            stated[LOADED] = int(self.loaded)
        if self.bandwidth is not None:
            stated[BANDWIDTH] = self.bandwidth
        return RecordMeta(
            self.step, self.repeat, self.locked, self.period, self.lines, self.name, stated
        )


class Manifest(_Part):
    """A whole manifest."""

    rig: str = Field(min_length=1)
    sample_rate: Frequency | None = Field(default=None, gt=0)
    records: tuple[ManifestRecord, ...] = Field(min_length=1)
    columns: dict[str, Column] = {}


def load_manifest(path: Path) -> tuple[Manifest, dict[tuple[str | int, ...], int]]:
    """Read a manifest; returns it with the line of each key; raises InputError."""
    text = read_text(path, "an import manifest (YAML)")
    data, lines = load_yaml(text, str(path))
    manifest = validate_model(Manifest, data, lines, str(path))
    _refuse_duplicates(manifest.records, lines, path)
    return _with_every_load(manifest, lines, path), lines


def _refuse_duplicates(
    records: Sequence[ManifestRecord], lines: dict[tuple[str | int, ...], int], path: Path
) -> None:
    line_of_repeat: dict[tuple[str, int], int] = {}
    names: set[str] = set()
    for index, entry in enumerate(records):
        line = lines.get(("records", index), 1)
        key = (entry.step, entry.repeat)
        if key in line_of_repeat:
            raise InputError(
                f"{path}:{line}: records: step {entry.step!r} repeat {entry.repeat} is already in "
                f"line {line_of_repeat[key]}; expected another repeat"
            )
        name = entry.meta().name
        if name in names:
            raise InputError(
                f"{path}:{line}: records: name {name!r} occurs twice; expected distinct names"
            )
        line_of_repeat[key] = line
        names.add(name)


def _with_every_load(
    manifest: Manifest, lines: dict[tuple[str | int, ...], int], path: Path
) -> Manifest:
    """Return the manifest with a load stated of every record, where one states it: else none.

    Raises InputError for a step whose repeats differ in it: they would not have the same motion.
    """
    if all(entry.loaded is None for entry in manifest.records):
        return manifest
    records = tuple(r.model_copy(update={LOADED: bool(r.loaded)}) for r in manifest.records)
    load_of_step: dict[str, bool | None] = {}
    for index, entry in enumerate(records):
        if entry.loaded is not load_of_step.setdefault(entry.step, entry.loaded):
            line = lines.get(("records", index, LOADED), lines.get(("records", index), 1))
            raise InputError(
                f"{path}:{line}: records.{index}.loaded: found {str(entry.loaded).lower()}, "
                f"expected it as in the other repeats of step {entry.step!r}; give the records "
                "with the load a step of their own"
            )
    return manifest.model_copy(update={"records": records})


def check_against_rig(
    manifest: Manifest, lines: dict[tuple[str | int, ...], int], path: Path, rig: Rig
) -> dict[str, tuple[float, float]]:
    """Return (scale, offset) to SI of each mapped channel; raises InputError naming its line."""
    joints = len(rig.joints)
    for index, entry in enumerate(manifest.records):
        wrong = [j for j in entry.locked if not 1 <= j <= joints]
        if wrong or len(set(entry.locked)) != len(entry.locked):
            line = lines.get(("records", index, "locked"), lines.get(("records", index), 1))
            raise InputError(
                f"{path}:{line}: records.{index}.locked: found {list(entry.locked)}, expected "
                f"different joints of rig {rig.name!r}, 1 to {joints}"
            )
    maps = {}
    allowed = (TIME, *_all_channels(rig))
    for name, column in manifest.columns.items():
        line = lines.get(("columns", name), 1)
        if name not in allowed:
            raise InputError(
                f"{path}:{line}: columns.{name}: no channel of rig {rig.name!r}; expected one of: "
                f"{', '.join(allowed)}"
            )
        si = "s" if name == TIME else rig.unit_of(name)
        try:
            factor, shift = unit_map(si if column.unit is None else column.unit, si)
        except UnitError as error:
            unit_line = lines.get(("columns", name, "unit"), line)
            raise InputError(f"{path}:{unit_line}: columns.{name}.unit: {error}") from error
        if name == TIME and column.delay:
            raise InputError(
                f"{path}:{line}: columns.{name}.delay: time has no delay; expected the delay of "
                "the lagging columns"
            )
        maps[name] = (factor * column.scale, factor * column.offset + shift)
    return maps


def _all_channels(rig: Rig) -> tuple[str, ...]:
    if rig.electric:
        return rig.channels
    commands = [ch.channel(ch.COMMAND, i + 1) for i in range(len(rig.joints))]
    return (*ch.measured(len(rig.joints), supply=True, temperature=True), *commands)


def channels_of(rig: Rig) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return (channels a record must have, channels it may have) of an import."""
    if rig.electric:
        return rig.channels, ()
    required = ch.measured(len(rig.joints), supply=False, temperature=False)
    return required, tuple(name for name in _all_channels(rig) if name not in required)
