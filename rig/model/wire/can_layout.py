"""The required content of a DBC file of a bench on a CAN bus, and the place of each value.

Both ends find their values by the names of signals; messages, identifiers, places, sizes and byte
orders are those of the file (docs/wire-can.md). Glossary: a *row* is one sample of every channel
and command, in one or several frames; a signal's *raw* value is the whole number that its bits
hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from cantools.database import load_string
from cantools.database.can import Database
from cantools.database.errors import Error

from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.rig import Rig

CLASSIC_BYTES: Final = 8
FD_SIZES: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
EXTENDED: Final = 1 << 31  # set in a `CanMessage.key` of a 29-bit identifier
SESSION_BITS: Final = 15  # of a session's number in the host's sign of life

ZERO: Final = {"zero_key": 8}
ALIVE: Final = {
    "alive_stream": 16,
    "alive_acknowledge": 16,
    "alive_heartbeat": 16,
    "alive_session": SESSION_BITS,
    "alive_resend": 1,
}
REQUEST: Final = {"request_part": 8}
ANSWER_PARTS: Final = {"answer_part": 8}
SYNC: Final = {"sync_tick": 32, "sync_sequence": 16, "sync_status": 16}
ROW: Final = {"row": 4}
CHECK: Final = {"check_sum": 32, "check_oldest": 16, "check_backlog": 16}

_TOLERANCE = 1e-6  # of a factor, and of a sensor's range


@dataclass(frozen=True)
class CanSignal:
    """Place of a raw value in a message's bytes, read as one number of either byte order."""

    name: str
    shift: int
    bits: int
    big_endian: bool
    signed: bool

    def read(self, data: bytes) -> int:
        """Return the raw value in the bytes of a frame."""
        number = int.from_bytes(data, "big" if self.big_endian else "little")
        raw = (number >> self.shift) & ((1 << self.bits) - 1)
        return raw - (1 << self.bits) if self.signed and raw >> (self.bits - 1) else raw


@dataclass(frozen=True)
class CanMessage:
    """One message of the file; `size` [bytes] is that of each of its frames."""

    name: str
    identifier: int
    extended: bool
    size: int
    fd: bool
    signals: Mapping[str, CanSignal]

    @property
    def key(self) -> int:
        """The identifier, distinct for 11 and 29 bits."""
        return self.identifier | (EXTENDED if self.extended else 0)

    def pack(self, values: Mapping[str, int]) -> bytes:
        """Return the bytes of a frame with these raw values, all other bits zero."""
        little = big = 0
        for name, value in values.items():
            signal = self.signals[name]
            bits = (value & ((1 << signal.bits) - 1)) << signal.shift
            if signal.big_endian:
                big |= bits
            else:
                little |= bits
        data = little.to_bytes(self.size, "little")
        if not big:
            return data
        return bytes(a | b for a, b in zip(data, big.to_bytes(self.size, "big"), strict=True))

    def unpack(self, data: bytes) -> dict[str, int]:
        """Return every raw value in the bytes of a frame."""
        return {name: signal.read(data) for name, signal in self.signals.items()}


@dataclass(frozen=True)
class CanLayout:
    """The messages of a bench by purpose; `columns` names a row's signals in order."""

    source: str
    zero: CanMessage
    alive: CanMessage
    request: CanMessage
    answer: CanMessage
    sync: CanMessage
    rows: tuple[CanMessage, ...]
    check: CanMessage
    columns: tuple[str, ...]

    @property
    def from_bench(self) -> tuple[CanMessage, ...]:
        """The messages that the bench sends."""
        return (self.answer, self.sync, *self.rows, self.check)

    @property
    def from_host(self) -> tuple[CanMessage, ...]:
        """The messages that the host sends."""
        return (self.zero, self.alive, self.request)

    @property
    def fd(self) -> bool:
        """Whether there are frames of CAN FD."""
        return any(message.fd for message in (*self.from_bench, *self.from_host))


def read_layout(text: str, source: str, rig: Rig) -> CanLayout:
    """Read a DBC file's text for a rig.

    Raises InputError naming the file and the first signal that is missing, duplicated, too short,
    or converted differently from the rig's sensor or valve.
    """
    reader = _Reader(_parsed(text, source), source)
    rows = reader.rows(rig)
    layout = CanLayout(
        source,
        reader.message_of(ZERO),
        reader.message_of(ALIVE),
        reader.parts(REQUEST),
        reader.parts(ANSWER_PARTS),
        reader.message_of(SYNC),
        rows,
        reader.message_of(CHECK),
        rig.recorded,
    )
    keys: dict[int, str] = {}
    for message in (*layout.from_host, *layout.from_bench):
        other = keys.setdefault(message.key, message.name)
        if other != message.name or sum(m is message for m in rows) > 1:
            raise InputError(
                f"{source}: messages {other} and {message.name} share the identifier "
                f"0x{message.identifier:X}"
            )
    roles = [*layout.from_host, layout.answer, layout.sync, layout.check]
    for message in rows:
        for role in roles:
            if message.name == role.name:
                raise InputError(
                    f"{source}: message {message.name} carries samples and "
                    f"{next(iter(role.signals))}; give each its own message"
                )
    if len({role.name for role in roles}) < len(roles):
        raise InputError(f"{source}: two kinds of message share one; see docs/wire-can.md")
    return layout


def _parsed(text: str, source: str) -> Database:
    try:
        database = load_string(text, "dbc")
    # The parser raises exceptions of any class for a damaged text.
    except (Error, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{source}: not a DBC file: {reason[:200]}") from error
    if not isinstance(database, Database):
        raise InputError(f"{source}: not a DBC file of a CAN bus")
    return database


class _Reader:
    """Finds signals by name and raises InputError for unusable ones."""

    def __init__(self, database: Database, source: str) -> None:
        self._source = source
        self._places: dict[str, list[tuple[Any, Any]]] = {}
        for message in database.messages:
            for signal in message.signals:
                self._places.setdefault(signal.name, []).append((message, signal))

    def message_of(self, needed: Mapping[str, int]) -> CanMessage:
        """Return the one message that contains all of these signals."""
        signals = [(name, *self._signal(name, bits)) for name, bits in needed.items()]
        message = signals[0][1]
        for name, other, _ in signals:
            if other is not message:
                raise InputError(
                    f"{self._source}: signal {name} stands in message {other.name}, "
                    f"{signals[0][0]} in {message.name}; expected in one message"
                )
        return self._message(message, [signal for _, _, signal in signals])

    def parts(self, needed: Mapping[str, int]) -> CanMessage:
        """Return the message whose first byte is this signal; the others carry bytes."""
        message = self.message_of(needed)
        (signal,) = message.signals.values()
        first = 8 * (message.size - 1) if signal.big_endian else 0
        if signal.bits != 8 or signal.shift != first or message.size < CLASSIC_BYTES:
            raise InputError(
                f"{self._source}: signal {signal.name}: expected the first byte of a message of "
                f"{CLASSIC_BYTES} bytes or more"
            )
        return message

    def rows(self, rig: Rig) -> tuple[CanMessage, ...]:
        """Return the messages of a row, the one with the row's number first."""
        first, number = self._signal("row", ROW["row"])
        signals: dict[str, list[Any]] = {first.name: [number]}
        messages = {first.name: first}
        for name in rig.recorded:
            message, signal = self._signal(name, _bits(rig, name))
            self._same_conversion(signal, rig)
            messages[message.name] = message
            signals.setdefault(message.name, []).append(signal)
        return tuple(self._message(messages[name], signals[name]) for name in messages)

    def _signal(self, name: str, bits: int) -> tuple[Any, Any]:
        places = self._places.get(name, [])
        if not places:
            raise InputError(
                f"{self._source}: signal {name} is missing; the bench needs it (`bramah dbc` "
                "writes the whole file of a rig)"
            )
        if len(places) > 1:
            names = " and ".join(message.name for message, _ in places)
            raise InputError(f"{self._source}: signal {name} stands in {names}; expected in one")
        message, signal = places[0]
        if signal.length < bits:
            raise InputError(
                f"{self._source}: signal {name} has {signal.length} bits, expected {bits} or more"
            )
        if signal.is_multiplexer or signal.multiplexer_ids or signal.conversion.is_float:
            raise InputError(
                f"{self._source}: signal {name} is multiplexed or a float; expected a whole number "
                "that every frame of its message carries"
            )
        return message, signal

    def _message(self, message: Any, signals: Sequence[Any]) -> CanMessage:
        size = message.length
        fd = bool(message.is_fd) or size > CLASSIC_BYTES
        if size not in FD_SIZES:
            raise InputError(
                f"{self._source}: message {message.name} has {size} bytes, which no frame has"
            )
        return CanMessage(
            message.name,
            message.frame_id,
            bool(message.is_extended_frame),
            size,
            fd,
            {signal.name: _place(signal, size) for signal in signals},
        )

    def _same_conversion(self, signal: Any, rig: Rig) -> None:
        low, high, top, signed = converter_of(rig, signal.name)
        step = (high - low) / top
        scale, offset = float(signal.scale), float(signal.offset)
        if (
            abs(scale - step) > _TOLERANCE * step
            or abs(offset - low) > _TOLERANCE * (high - low)
            or bool(signal.is_signed) != signed
        ):
            unit = ch.unit_of(signal.name)
            raise InputError(
                f"{self._source}: signal {signal.name}: factor {scale:.9g}, offset {offset:.9g}"
                f"{', signed' if signal.is_signed else ''}; rig {rig.name!r} converts by "
                f"{step:.9g} and {low:.9g} {unit}{', signed' if signed else ''}"
            )


def converter_of(rig: Rig, name: str) -> tuple[float, float, int, bool]:
    """Return (value of code 0, of the largest code [SI], largest code, whether signed)."""
    kind, joint = ch.kind_of(name)
    if kind == ch.COMMAND:
        valve = rig.joints[(joint or 1) - 1].valve
        return 0.0, valve.command_range, (1 << (valve.command_bits - 1)) - 1, True
    sensor = rig.sensors.of(kind)
    return *sensor.range, (1 << sensor.bits) - 1, False


def _bits(rig: Rig, name: str) -> int:
    kind, joint = ch.kind_of(name)
    if kind == ch.COMMAND:
        return rig.joints[(joint or 1) - 1].valve.command_bits
    return rig.sensors.of(kind).bits


def _place(signal: Any, size: int) -> CanSignal:
    big = signal.byte_order == "big_endian"
    shift = signal.start
    if big:
        # A Motorola signal starts at its highest bit: byte * 8 + bit, where bit 7 comes first.
        first = 8 * (signal.start // 8) + 7 - signal.start % 8
        shift = 8 * size - first - signal.length
    return CanSignal(signal.name, shift, signal.length, big, bool(signal.is_signed))
