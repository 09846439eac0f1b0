"""A driver that plays a recorded run like a device (docs/runs.md, "records.h5").

All records and the samples between them are played in the order of recording. The commands in the
samples are the recorded ones, whatever the host requests. Laws with an output are therefore
refused, unless `ignore_outputs` is true; laws of zero are accepted. Samples lost when recording
count as missing here. The run is played as fast as it is read (`pace: 0`, virtual time) or `pace`
times as fast as recorded.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import SplitResult, parse_qsl

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.base import (
    Array,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    SampleBlock,
    WireSettings,
    possible_laws,
    possible_wave,
)
from rig.model import channels as ch
from rig.model.parts import Wire
from rig.model.rig import Rig

logger = logging.getLogger(__name__)

ARCHIVE = "records.h5"
FORMAT = 1
BETWEEN = "between"


class ReplaySettings(WireSettings):
    """The run to play, and how.

    `run` is a run folder or a records.h5; `pace` is how many times as fast as recorded (0: as fast
    as it is read); `ignore_outputs` accepts laws that a recording cannot follow.
    """

    example: ClassVar = "replay:///home/me/runs/monday?pace=1"

    run: str = Field(min_length=1)
    pace: float = Field(default=0.0, ge=0.0)
    ignore_outputs: bool = False
    block_samples: int = Field(default=10, ge=1, le=10_000)

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return the path and the options behind ``?``; raises ValueError without a path."""
        if not url.path:
            raise ValueError("no run")
        return {"run": f"{url.netloc}{url.path}", **dict(parse_qsl(url.query))}


class ReplayDriver:
    """`drivers.base.Driver` over a recording; see there for each call."""

    settings: ClassVar[type[WireSettings]] = ReplaySettings
    host_timed: ClassVar[bool] = False

    def __init__(
        self,
        wire: Wire,
        rig: Rig,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._settings = ReplaySettings.of(wire)
        self._rig = rig
        self._clock, self._sleep = clock, sleep
        path = Path(self._settings.run)
        self._path = path / ARCHIVE if path.is_dir() else path
        self._data: Array | None = None
        self._streaming = False
        self._tick = self._sequence = 0

    # -- session ----------------------------------------------------------------------------

    def connect(self) -> DeviceInfo:
        """Read the recording; raises DeviceLost without one, DeviceError for another rig's."""
        self._data = self._read()
        self._streaming = False
        self._tick = self._sequence = 0
        pace = self._settings.pace
        name = f"recording {self._path}"
        return DeviceInfo.of(self._rig, name, self._settings.block_samples, virtual_time=not pace)

    def setup_problem(self) -> str | None:
        """Return that there is no recording, None if there is."""
        if self._path.is_file():
            return None
        return f"wire: run: {self._path}: no such file; expected a run folder, or a records.h5"

    def close(self) -> None:
        """Drop the recording; never raises."""
        self._data, self._streaming = None, False

    def zero_outputs(self) -> None:
        """Do nothing: a recording has no outputs."""

    def reset(self) -> None:
        """Do nothing: a recording does not trip."""
        self._require_connected()

    def trip_cause(self) -> str | None:
        """Return None: a recording does not trip."""
        self._require_connected()
        return None

    def upload(self, joint: int, wave: Array) -> None:
        """Check a waveform [V] and discard it."""
        self._require_connected()
        possible_wave(joint, wave, self._rig)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Accept laws without output, others only with `ignore_outputs`; return the tick."""
        self._require_connected()
        for number, law in enumerate(possible_laws(laws, self._rig), start=1):
            drives = law.limit > 0.0 and (law.gain, law.bias, law.position_gain) != (0.0, 0.0, 0.0)
            if drives and not self._settings.ignore_outputs:
                raise DeviceError(
                    f"a recording follows no law (joint {number}); "
                    "wire: ignore_outputs: true plays on regardless"
                )
        return self._tick

    # -- samples ----------------------------------------------------------------------------

    def start(self) -> None:
        """Start a stream at the end of the previous one; pacing begins here."""
        self._require_connected()
        self._streaming, self._sequence = True, 0
        self._pace_start, self._pace_tick = self._clock(), self._tick

    def stop(self) -> None:
        """Stop streaming."""
        self._require_connected()
        self._streaming = False

    def read_block(self) -> SampleBlock:
        """Return the next samples up to a lost one; raises DeviceLost at the end."""
        data = self._require_connected()
        if not self._streaming:
            raise DeviceError("the recording does not stream (not started)")
        first = self._tick
        present = np.flatnonzero(~np.isnan(data[first:]).all(axis=1))
        if not len(present):
            self._streaming = False
            raise DeviceLost(f"{self._path} has ended at sample {len(data)}; play a longer run")
        first += int(present[0])
        rows = data[first : first + self._settings.block_samples]
        gaps = np.flatnonzero(np.isnan(rows).all(axis=1))
        rows = rows[: gaps[0]] if len(gaps) else rows
        if first > self._tick and self._sequence:
            self._sequence += -(-(first - self._tick) // self._settings.block_samples)
        self._tick = first + len(rows)
        backlog = self._wait(self._tick)
        measured = rows[:, : len(self._low)]
        saturated = (measured <= self._low) | (measured >= self._high)
        block = SampleBlock(self._sequence, first, rows.copy(), saturated, backlog, tripped=False)
        self._sequence += 1
        return block

    def _wait(self, tick: int) -> int:
        """Wait until the sample before `tick` is due; return the number of further blocks due."""
        rate = self._settings.pace * self._rig.sample_rate
        if not rate:
            return 0
        due = self._pace_start + (tick - self._pace_tick) / rate
        late = self._clock() - due
        if late < 0.0:
            self._sleep(-late)
            return 0
        assert self._data is not None
        remaining = len(self._data) - tick
        return min(int(late * rate), remaining) // self._settings.block_samples

    # -- the file ---------------------------------------------------------------------------

    def _require_connected(self) -> Array:
        if self._data is None:
            raise DeviceLost("the wire replay is not connected")
        return self._data

    def _read(self) -> Array:
        kinds = [ch.kind_of(name)[0] for name in self._rig.channels]
        ranges = np.array([self._rig.sensors.of(kind).range for kind in kinds])
        self._low, self._high = ranges[:, 0], ranges[:, 1]
        try:
            with h5py.File(self._path, "r") as file:
                if int(file.attrs.get("format", 0)) != FORMAT:
                    raise DeviceError(f"{self._path}: expected a records.h5 of format {FORMAT}")
                parts = [self._columns(group) for group in _in_order(file)]
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise DeviceLost(f"{self._path}: cannot be read: {error}") from error
        if not parts:
            raise DeviceError(f"{self._path}: holds no samples; play another run")
        return np.concatenate(parts)

    def _columns(self, group: Any) -> Array:
        rate = float(group.attrs["sample_rate"])
        if not np.isclose(rate, self._rig.sample_rate, rtol=1e-6):
            raise DeviceError(
                f"{self._path}: {group.name} was sampled at {rate:g} Hz, rig {self._rig.name!r} "
                f"has {self._rig.sample_rate:g} Hz"
            )
        names, expected = {str(name) for name in group}, set(self._rig.recorded)
        if names != expected:
            raise DeviceError(
                f"{self._path}: {group.name} is of another rig: "
                f"lacks {sorted(expected - names)}, has also {sorted(names - expected)}"
            )
        columns: list[NDArray[np.float64]] = [
            np.asarray(group[name][:], dtype=np.float64) for name in self._rig.recorded
        ]
        return np.column_stack(columns)


def _in_order(file: Any) -> Iterator[Any]:
    """Yield the groups with samples in the order they were taken."""
    groups = [group for name, group in file.items() if name != BETWEEN]
    groups += list(file.get(BETWEEN, {}).values())

    def order(group: Any) -> tuple[int, int, str]:
        attributes = group.attrs
        return (
            int(attributes.get("stream", 0)),
            int(attributes.get("start_tick", 0)),
            str(group.name),
        )

    yield from sorted(groups, key=order)
