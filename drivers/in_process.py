"""A driver over any Python object that advances in this process: for tests, twins and notebooks.

The object has one method, `advance(ticks, laws)`: `ticks` times it measures, evaluates one
`ActiveLaw` per joint and holds the output; it returns samples, shape (ticks, channels), and
outputs, shape (ticks, joints). Integers are converter codes (`rig.model.wire.codes`), floats are
SI. Time is virtual: it advances only while a block is read.

In a rig file `object: package.module:name` names a callable that takes the rig and returns it;
naming it runs that module's code.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, Protocol
from urllib.parse import SplitResult

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.base import (
    OFF,
    ActiveLaw,
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
from rig.model.wire.codes import decode_input, decode_output

logger = logging.getLogger(__name__)

BLOCK_SAMPLES = 10  # of each call of `advance`, hence of each block
_ZERO_WAVE = np.zeros(1)


class Advancing(Protocol):
    """The interface of an object that advances in this process."""

    def advance(self, ticks: int, laws: Sequence[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Run `ticks` samples under laws like `ActiveLaw`; return (measured, outputs)."""


class InProcessSettings(WireSettings):
    """The object: the import path of a callable that takes the rig and returns it."""

    example: ClassVar = "in-process://package.module:name"

    object: str = Field(default="", pattern=r"^([\w.]+:\w+)?$")

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return the import path; raises ValueError where there is none."""
        if ":" not in url.netloc:
            raise ValueError("no import path")
        return {"object": url.netloc}


class InProcessDriver:
    """`drivers.base.Driver` over an object of this process; see there for the calls.

    `make` returns the object for each session; by default the wire's `object` is imported.
    """

    settings: ClassVar[type[WireSettings]] = InProcessSettings
    host_timed: ClassVar[bool] = False

    def __init__(
        self, wire: Wire, rig: Rig, *, make: Callable[[Rig], Advancing] | None = None
    ) -> None:
        self._path = InProcessSettings.of(wire).object
        self._rig = rig
        self._make = make
        self._object: Advancing | None = None
        self._tick = 0
        self._streaming = False
        self._clear()

    def _clear(self) -> None:
        joints = len(self._rig.joints)
        self._laws: tuple[OutputLaw, ...] = (OFF,) * joints
        self._uploaded: list[Array] = [_ZERO_WAVE] * joints
        self._played: list[Array] = [_ZERO_WAVE] * joints
        self._wave_start = self._tick
        self._sequence = 0

    def connect(self) -> DeviceInfo:
        """Make the object; raises DeviceError where it cannot be made or cannot advance."""
        make = self._make or self._imported()
        try:
            device = make(self._rig)
        except Exception as error:
            raise DeviceError(f"the object of the wire in-process failed: {error!r}") from error
        if not callable(getattr(device, "advance", None)):
            raise DeviceError(f"{device!r} has no method advance(ticks, laws)")
        self._object = device
        self._streaming = False
        self._clear()
        name = type(device).__name__
        return DeviceInfo.of(self._rig, name, BLOCK_SAMPLES, virtual_time=True)

    def setup_problem(self) -> str | None:
        """Return why the object of the wire cannot be imported, None if it can."""
        if self._make is None:
            try:
                self._imported()
            except DeviceError as error:
                return str(error)
        return None

    def _imported(self) -> Callable[[Rig], Advancing]:
        module, _, name = self._path.partition(":")
        if not name:
            raise DeviceError("wire: object: expected package.module:name, a callable of the rig")
        try:
            factory: Callable[[Rig], Advancing] = getattr(importlib.import_module(module), name)
        except Exception as error:  # any exception of the imported module
            raise DeviceError(f"wire: object: cannot import {self._path}: {error!r}") from error
        return factory

    def close(self) -> None:
        """Drop laws and object; never raises."""
        self._streaming = False
        self._clear()
        self._object = None

    def zero_outputs(self) -> None:
        """Put every output to zero from the next sample on; time stands still until then."""
        self._laws = (OFF,) * len(self._rig.joints)

    def reset(self) -> None:
        """Do nothing: the object does not trip."""
        self._require_connected()

    def trip_cause(self) -> str | None:
        """Return None: the object does not trip."""
        self._require_connected()
        return None

    def upload(self, joint: int, wave: Array) -> None:
        """Store a waveform [V]; it acts from `apply` on."""
        self._require_connected()
        self._uploaded[joint] = possible_wave(joint, wave, self._rig)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws from the next sample on; returns its tick."""
        self._require_connected()
        self._laws = possible_laws(laws, self._rig)
        self._played = list(self._uploaded)
        if restart:
            self._wave_start = self._tick
        return self._tick

    def start(self) -> None:
        """Start a stream at the next sample."""
        self._require_connected()
        self._streaming, self._sequence, self._wave_start = True, 0, self._tick

    def stop(self) -> None:
        """Stop streaming."""
        self._require_connected()
        self._streaming = False

    def read_block(self) -> SampleBlock:
        """Advance the object by one block; raises DeviceLost where it fails."""
        device = self._require_connected()
        if not self._streaming:
            raise DeviceError("the object does not stream (not started)")
        laws = [
            ActiveLaw(**asdict(law), wave=wave, start=self._wave_start)
            for law, wave in zip(self._laws, self._played, strict=True)
        ]
        try:
            measured, outputs = device.advance(BLOCK_SAMPLES, laws)
            block = self._block(np.asarray(measured), np.asarray(outputs))
        except (Exception, SystemExit) as error:  # any exception of the user's object
            self.close()
            raise DeviceLost(f"the object of the wire in-process failed: {error!r}") from error
        self._tick += BLOCK_SAMPLES
        self._sequence += 1
        return block

    def _block(self, measured: NDArray[Any], outputs: NDArray[Any]) -> SampleBlock:
        rig = self._rig
        shapes = (BLOCK_SAMPLES, len(rig.channels)), (BLOCK_SAMPLES, len(rig.joints))
        if (measured.shape, outputs.shape) != shapes:
            raise ValueError(f"advance returned {measured.shape} and {outputs.shape}, not {shapes}")
        data = np.empty((BLOCK_SAMPLES, len(rig.recorded)))
        saturated = np.empty(measured.shape, dtype=np.bool_)
        for column, name in enumerate(rig.channels):
            sensor = rig.sensors.of(ch.kind_of(name)[0])
            values = measured[:, column]
            ends: tuple[float, float] = sensor.range
            if np.issubdtype(measured.dtype, np.integer):
                data[:, column] = decode_input(values, *sensor.range, sensor.bits)
                ends = (0, (1 << sensor.bits) - 1)
            else:
                data[:, column] = values
            saturated[:, column] = (values <= ends[0]) | (values >= ends[1])
        for joint, column in enumerate(range(len(rig.channels), len(rig.recorded))):
            valve, values = rig.joints[joint].valve, outputs[:, joint]
            if np.issubdtype(outputs.dtype, np.integer):
                values = decode_output(values, valve.command_range, valve.command_bits)
            data[:, column] = values
        return SampleBlock(self._sequence, self._tick, data, saturated, 0, tripped=False)

    def _require_connected(self) -> Advancing:
        if self._object is None:
            raise DeviceLost("the wire in-process is not connected")
        return self._object
