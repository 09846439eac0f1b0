"""The driver of an I/O module or PLC on Modbus TCP, by a register map in the rig file.

Format: docs/wire-modbus-map.md. The device has no sample clock: `drivers.polled` reads and writes
it at the host's rate. Answers have the transaction number of their request, and one with another
number is dropped; after any timeout the connection ends.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Final, Literal, Unpack

import numpy as np
from pydantic import Field

from drivers.base import Array, DeviceError, DeviceLost, WireSettings
from drivers.bench_protocol import DeviceRefused
from drivers.modbus_frames import READ_HOLDING
from drivers.modbus_transport import DeviceAsksAgain, TcpConnection, registers_in_words
from drivers.polled import Pacing, PolledDriver
from drivers.register_types import (
    RegisterType,
    WordOrder,
    decode_registers,
    encode_registers,
    integers,
    word_count,
)
from drivers.settings import DRIVER
from drivers.wire_entries import (
    inputs_by_channel,
    offset_of,
    outputs_by_joint,
    read_entry,
    refuse_short_reach,
    scale_of,
)
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.parts import Part, Wire
from rig.model.rig import Rig

logger = logging.getLogger(__name__)

MAX_READ: Final = 125  # registers in one answer: the protocol's own limit
MAX_WRITE: Final = 123
_LAST_REGISTER: Final = 0xFFFF
_NO_WATCHDOG: Final = "none"
_WORD_ORDER: Final = "word_order"
_OTHER_ORDER: Final = {WordOrder.BIG: WordOrder.LITTLE, WordOrder.LITTLE: WordOrder.BIG}


class MapSettings(WireSettings):
    """The module's address and its register map, entry by entry."""

    host: str = Field(min_length=1)
    port: int = Field(default=502, ge=1, le=65535)
    unit: int = Field(default=1, ge=0, le=255)
    inputs: dict[str, Any]
    outputs: dict[int, Any]
    zero_by: dict[str, Any] | Literal["none"] = _NO_WATCHDOG
    accept_no_watchdog: bool = False


class _NumberEntry(Part):
    address: int = Field(ge=0, le=_LAST_REGISTER)
    type: RegisterType
    word_order: WordOrder = WordOrder.BIG
    scale: str | float
    offset: str | float | None = None


class InputEntry(_NumberEntry):
    """One channel: value = offset + scale * number in its registers."""

    function: Literal[3, 4]


class OutputEntry(_NumberEntry):
    """One joint's valve: the number is (voltage - offset) / scale."""


class ZeroByEntry(Part):
    """The module's own watchdog: its register holds the time in milliseconds."""

    watchdog_register: int = Field(ge=0, le=_LAST_REGISTER)
    milliseconds: int = Field(ge=1, le=0xFFFF)


@dataclass(frozen=True)
class Point:
    """One number of the map: its registers, its type, and value = offset + scale * number."""

    name: str
    function: int
    address: int
    form: RegisterType
    order: WordOrder
    scale: float
    offset: float

    @property
    def words(self) -> int:
        """Its number of registers."""
        return word_count(self.form)

    @property
    def end(self) -> int:
        """The address after its last register."""
        return self.address + self.words

    def value(self, data: bytes) -> float:
        """Return the value [SI] in the bytes of its registers."""
        return self.offset + self.scale * decode_registers(data, self.form, self.order)

    def registers(self, value: float) -> list[int]:
        """Return its registers for a value [SI]; raises ValueError outside the type's range."""
        return encode_registers((value - self.offset) / self.scale, self.form, self.order)


@dataclass(frozen=True)
class Span:
    """Consecutive registers for one request; `points` are (index in the map, point)."""

    function: int
    address: int
    words: int
    points: tuple[tuple[int, Point], ...]

    def __str__(self) -> str:
        names = " ".join(
            f"output {point.name}" if point.name.isdigit() else point.name
            for _, point in self.points
        )
        return f"{registers_in_words(self.address, self.words)} ({names})"


@dataclass(frozen=True)
class RegisterMap:
    """The registers of every channel and output; `watchdog` is None if the module has none."""

    inputs: tuple[Point, ...]
    outputs: tuple[Point, ...]
    watchdog: ZeroByEntry | None


def register_map(settings: MapSettings, rig: Rig) -> RegisterMap:
    """Return the map of a rig file; raises InputError naming the key at fault."""
    inputs = tuple(
        _point(f"inputs.{name}", name, entry, entry.function, rig.unit_of(name))
        for name, entry in zip(
            rig.channels, inputs_by_channel(InputEntry, settings.inputs, rig), strict=True
        )
    )
    outputs = tuple(
        _point(f"outputs.{i}", f"{i}", entry, READ_HOLDING, "V")
        for i, entry in enumerate(outputs_by_joint(OutputEntry, settings.outputs, rig), start=1)
    )
    _refuse_overlap("inputs", inputs)
    _refuse_overlap("outputs", outputs)
    for point in inputs:
        if (numbers := integers(point.form)) is not None:
            low, high = (point.offset + point.scale * number for number in numbers)
            step = abs(point.scale)
            refuse_short_reach(rig, point.name, (low, high), rig.range_of(point.name), step)
    for point, joint in zip(outputs, rig.joints, strict=True):
        _refuse_narrow(point, joint.valve.command_range)
    if settings.zero_by == _NO_WATCHDOG:
        return RegisterMap(inputs, outputs, None)
    watchdog = read_entry(ZeroByEntry, settings.zero_by, "zero_by")
    for point in outputs:
        if point.address <= watchdog.watchdog_register < point.end:
            raise InputError(
                f"wire: zero_by.watchdog_register: {watchdog.watchdog_register} is a register of "
                f"outputs.{point.name}"
            )
    return RegisterMap(inputs, outputs, watchdog)


def _point(key: str, name: str, entry: _NumberEntry, function: int, unit: str) -> Point:
    point = Point(
        name,
        function,
        entry.address,
        entry.type,
        entry.word_order,
        scale_of(entry.scale, unit, f"{key}.scale"),
        offset_of(entry.offset, unit, f"{key}.offset"),
    )
    if point.end > _LAST_REGISTER + 1:
        raise InputError(
            f"wire: {key}.address: {entry.type} at {entry.address} reaches past register "
            f"{_LAST_REGISTER}"
        )
    return point


def _refuse_overlap(table: str, points: Sequence[Point]) -> None:
    ordered = sorted(points, key=lambda p: (p.function, p.address))
    for point, other in pairwise(ordered):
        if point.function == other.function and other.address < point.end:
            raise InputError(
                f"wire: {table}.{other.name}.address: register {other.address} belongs to "
                f"{table}.{point.name} ({point.form} at {point.address}) as well"
            )


def _refuse_narrow(point: Point, reach: float) -> None:
    for volts in (-reach, 0.0, reach):
        try:
            point.registers(volts)
        except ValueError as error:
            raise InputError(
                f"wire: outputs.{point.name}.scale: the register cannot hold {volts:g} V of the "
                f"valve's command_range: {error}"
            ) from error


def spans(points: Iterable[Point], most: int = MAX_READ) -> tuple[Span, ...]:
    """Return the fewest requests for all points without any other register."""
    ordered = sorted(enumerate(points), key=lambda item: (item[1].function, item[1].address))
    groups: list[list[tuple[int, Point]]] = []
    for index, point in ordered:
        if groups:
            first, last = groups[-1][0][1], groups[-1][-1][1]
            if (
                point.function == last.function
                and point.address == last.end
                and point.end - first.address <= most
            ):
                groups[-1].append((index, point))
                continue
        groups.append([(index, point)])
    return tuple(
        Span(
            group[0][1].function,
            group[0][1].address,
            group[-1][1].end - group[0][1].address,
            tuple(group),
        )
        for group in groups
    )


class UnitConnection(TcpConnection):
    """A connection to one unit of an address, closed at the first unanswered request.

    A request that a busy module refuses is sent again until the time limit of an answer.
    """

    def _exchange(self, request: bytes) -> bytes:
        deadline = time.monotonic() + self._timeout
        while True:
            try:
                return super()._exchange(request)
            except DeviceAsksAgain:
                if time.monotonic() > deadline:
                    raise
            time.sleep(DRIVER.busy_pause)

    def _finish_request(self, number: int, limit: float | None) -> bytes:
        try:
            return super()._finish_request(number, limit)
        except DeviceLost:
            self.close()  # late answers are then ignored
            raise


class MappedModule:
    """`drivers.polled.InputsOutputs` over a register map."""

    def __init__(
        self,
        settings: MapSettings,
        registers: RegisterMap,
        ranges: Sequence[tuple[float, float]],
        timeout: float,
    ) -> None:
        """Store a map and the range [SI] of every channel's sensor; open no connection."""
        self._link = UnitConnection(settings.host, settings.port, timeout, settings.unit)
        self._unit = settings.unit
        self._ranges = ranges
        self._identity = f"I/O module at {settings.host}:{settings.port}, unit {settings.unit}"
        self._map = registers
        self._reads = spans(registers.inputs)
        self._writes = spans(registers.outputs, MAX_WRITE)
        self._unread = False  # whether the module has refused to read its outputs back

    @property
    def watchdog(self) -> float | None:
        """Seconds after which the module zeroes its outputs by itself, None if never."""
        entry = self._map.watchdog
        return None if entry is None else entry.milliseconds * 1e-3

    def open(self) -> str:
        """Connect, zero the outputs, set the watchdog and read it back; return address and unit.

        The outputs first: a module that refuses the watchdog may still be driving a valve.
        """
        self._link.open()
        try:
            self._write_zeros()
            self._set_watchdog()
        except DeviceError:
            self._link.close()
            raise
        return self._identity

    def read(self) -> Array:
        """Return one value [SI] of every channel, (channels,), in the order of the rig."""
        values = np.empty(len(self._map.inputs))
        for index, point, data in self._registers():
            values[index] = point.value(data)
        return values

    def doubts(self) -> dict[str, str]:
        """Read once; return the channels that would be plausible with another word order."""
        reasons = {}
        for index, point, data in self._registers():
            other = replace(point, order=_OTHER_ORDER[point.order])
            low, high = self._ranges[index]
            if not _plausible(point, data, low, high) and _plausible(other, data, low, high):
                reasons[point.name] = (
                    f"word order? {other.value(data):.5g} with {_WORD_ORDER}: {other.order}"
                )
        return reasons

    def _registers(self) -> Iterator[tuple[int, Point, bytes]]:
        """Yield (index among the inputs, point, its registers' bytes)."""
        for span in self._reads:
            with self._naming_registers(str(span)):
                data = self._link.read(span.address, span.words, span.function)
            for index, point in span.points:
                first = 2 * (point.address - span.address)
                yield index, point, data[first : first + 2 * point.words]

    def write(self, volts: Array) -> None:
        """Put out one voltage [V] per joint."""
        for span in self._writes:
            words: list[int] = []
            for index, point in span.points:
                words += point.registers(float(volts[index]))
            with self._naming_registers(str(span)):
                self._link.write(span.address, words)

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def confirm_zero(self) -> None:
        """Read the outputs back by function 3; raises DeviceError where one is not at zero.

        A module may answer a write and keep its output. One that does not read its outputs back
        is named in a warning, once.
        """
        for span in self._writes:
            try:
                data = self._link.read(span.address, span.words)
            except DeviceRefused as refused:
                if not self._unread:
                    logger.warning(
                        "the %s acknowledges zero and does not read its outputs back (%s: %s): "
                        "zero is not confirmed; look at the spools", self._identity, span, refused,
                    )  # fmt: skip
                self._unread = True
                continue
            for _, point in span.points:
                first = 2 * (point.address - span.address)
                volts = point.value(data[first : first + 2 * point.words])
                if not abs(volts) <= DRIVER.zero_volts:
                    raise DeviceError(
                        f"output {point.name} of the {self._identity} holds {volts:.3g} V after "
                        f"0 V was written to {span}: it does not obey; use the emergency stop"
                    )

    def zero_beside_host(self) -> None:
        """Put every output to zero without setting the watchdog; closes the connection."""
        self._link.open()
        try:
            self._write_zeros()
        finally:
            self._link.close()

    def _write_zeros(self) -> None:
        self.write(np.zeros(len(self._map.outputs)))
        self.confirm_zero()

    @contextmanager
    def _naming_registers(self, registers: str) -> Iterator[None]:
        try:
            yield
        except DeviceRefused as refused:
            raise DeviceError(
                f"{refused}: {registers} of unit {self._unit}; check `unit`, address and function "
                "in the rig file against the module's manual"
            ) from refused

    def _set_watchdog(self) -> None:
        entry = self._map.watchdog
        if entry is None:
            return
        where = f"register {entry.watchdog_register} (zero_by.watchdog_register)"
        with self._naming_registers(where):
            self._link.write(entry.watchdog_register, [entry.milliseconds])
            data = self._link.read(entry.watchdog_register, 1)
        stored = int.from_bytes(data, "big")
        if stored != entry.milliseconds:
            raise DeviceError(
                f"{where} of the {self._identity} holds {stored} after {entry.milliseconds} was "
                "written; it is no watchdog time in milliseconds"
            )


def _plausible(point: Point, data: bytes, low: float, high: float) -> bool:
    """Return whether registers hold a value that a sensor of this range can have.

    A float read in the wrong order has any magnitude, also far below the sensor's resolution.
    """
    number = point.scale * decode_registers(data, point.form, point.order)
    tiny = 0.0 < abs(number) < DRIVER.resolved * (high - low)
    return low <= point.offset + number <= high and not tiny


class ModbusMapDriver(PolledDriver):
    """`drivers.base.Driver` over a register map; raises InputError for an invalid one."""

    settings: ClassVar[type[WireSettings]] = MapSettings

    def __init__(self, wire: Wire, rig: Rig, **pacing: Unpack[Pacing]) -> None:
        settings = MapSettings.of(wire)
        sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
        ranges = [sensor.range for sensor in sensors]
        self._module = MappedModule(settings, register_map(settings, rig), ranges, wire.timeout)
        super().__init__(
            wire, rig, self._module, accept_no_watchdog=settings.accept_no_watchdog, **pacing
        )

    def zero_outputs(self) -> None:
        """Put every output to zero now and read it back; reopens the module if need be."""
        super().zero_outputs()
        if self._open:
            self._safely(self._module.confirm_zero)

    def doubts(self) -> Mapping[str, str]:
        """Return the channels whose registers may be read in the wrong order, with reasons."""
        self._require_open()
        return self._safely(self._module.doubts)
