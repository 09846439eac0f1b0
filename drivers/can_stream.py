"""The driver of a bench on a CAN bus (docs/wire-can.md), and its line of messages."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Final

from pydantic import Field, ValidationInfo, field_validator

from drivers.base import WireSettings
from drivers.can_port import SLCAN, SOCKETCAND, BusPlace, BusSettings, CanPort
from drivers.message_stream import MessageStreamDriver
from drivers.settings import DRIVER
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.can_database import database_text
from rig.model.wire.can_frames import (
    BlockCollector,
    PartCollector,
    alive_frame,
    part_frames,
    stream_seconds,
    zero_frame,
)
from rig.model.wire.can_layout import CanLayout, read_layout
from rig.model.wire.frames import WireFrame
from rig.model.wire.registers import BlockLayout
from rig.model.wire.serial_messages import Message

_SLCAN_DATA_RATES: Final = (2_000_000, 5_000_000)


class CanSettings(BusSettings):
    """The bus: python-can's interface and channel, its rates, and its messages."""

    example: ClassVar = "can://socketcan/can0?bitrate=1000000"

    data_bitrate: int | None = Field(
        default=None, ge=10_000, le=12_000_000, description="of CAN FD's data phase [bit/s]"
    )
    dbc: str | None = Field(default=None, description="a DBC file; default: made for the rig")

    @field_validator("data_bitrate")
    @classmethod
    def _carries_fd(cls, value: int | None, info: ValidationInfo) -> int | None:
        interface = BusPlace.of(info.data["bus"]).interface if "bus" in info.data else ""
        if value is not None and interface == SOCKETCAND:
            raise ValueError("socketcand carries no CAN FD frames; expected no such key")
        if value is not None and interface == SLCAN and value not in _SLCAN_DATA_RATES:
            raise ValueError("slcan has 2000000 and 5000000 bit/s")
        return value


class CanLine:
    """`drivers.message_link.MessageLine` over a `CanPort`; see there for each call."""

    def __init__(self, port: CanPort, layout: CanLayout, block: BlockLayout, bitrate: int) -> None:
        self._port, self._layout, self._bitrate = port, layout, bitrate
        self.where = port.where
        self._answers = PartCollector()
        self._blocks = BlockCollector(layout, block)
        self._damaged = 0  # when the bus was opened
        self._stream = (0, 0)  # the request that started it, its session

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent and received."""
        return self._port.is_open

    @property
    def damaged(self) -> int:
        """Total of incomplete answers and blocks, and of blocks of other streams."""
        return self._answers.damaged + self._blocks.damaged

    def open(self, *, shared: bool = False) -> None:
        """Open the bus; raises as `CanPort.open`."""
        self._port.open(shared=shared)
        self._answers.reset()
        self._blocks.reset()
        self._damaged = self.damaged

    def send(self, message: WireFrame) -> None:
        """Send a message; raises DeviceLost when the bus is lost."""
        if message.type == Message.ALIVE_NOTE:
            self._port.send(alive_frame(self._layout, message))
            return
        if message.type == Message.ZERO:
            # One frame of highest priority, which cannot mix with requests of others; the request
            # after it is answered.
            self._port.send(zero_frame(self._layout))
        if message.type == Message.START:
            self._stream = (message.number, message.session)
        for frame in part_frames(self._layout.request, message):
            self._port.send(frame)

    def receive(self, timeout: float) -> list[WireFrame]:
        """Return the complete messages; raises DeviceLost when the bus is lost."""
        messages = []
        for key, data in self._port.receive(timeout):
            if self._blocks.takes(key):
                message = self._blocks.feed(key, data, *self._stream)
            else:
                message = self._answers.feed(data)
            if message is not None:
                messages.append(message)
        return messages

    def complaint(self, received: int) -> str:
        """Return what may explain missing answers, or ''."""
        counts = self._port.counts
        if counts.errors:
            return (
                f"{counts.errors} error frames came: check that every node runs at {self._bitrate} "
                "bit/s, and the termination"
            )
        if not received and counts.accepted:
            return (
                f"{counts.accepted} frames of the bench's identifiers came, none a whole message: "
                "another node uses them, or the device has another DBC file"
            )
        if not received and counts.foreign:
            return (
                f"{counts.foreign} frames came, none with an identifier of {self._layout.source}: "
                "check the DBC file and that this is the bench's bus"
            )
        if not received:
            return (
                "no frame came: check wiring, termination and that the bus runs at "
                f"{self._bitrate} bit/s"
            )
        if counts.overrun:
            return f"{counts.overrun} frames came faster than this program took them"
        damaged = self.damaged - self._damaged
        return f"{damaged} messages came damaged: check wiring and termination" if damaged else ""

    def close(self) -> None:
        """Close the bus; never raises."""
        self._port.close()


class CanStreamDriver(MessageStreamDriver):
    """`drivers.base.Driver` over a CAN bus; see there for each call."""

    settings: ClassVar[type[WireSettings]] = CanSettings

    def __init__(
        self,
        wire: Wire,
        rig: Rig,
        *,
        port: CanPort | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        settings = CanSettings.of(wire)
        self._bitrate = settings.bitrate
        layout = can_layout(settings, rig)
        block = reg.block_layout(len(rig.channels), len(rig.joints))
        _check_load(layout, block, settings, rig)
        if port is None:
            keys = frozenset(message.key for message in layout.from_bench)
            port = CanPort(BusPlace.of(settings.bus), settings.bitrate, settings.data_bitrate, keys)
        super().__init__(wire, rig, CanLine(port, layout, block, settings.bitrate), clock)

    def _address(self) -> str:
        """Return the bus and its rate."""
        return f"{self._link.where} ({self._bitrate} bit/s)"


def can_layout(settings: CanSettings, rig: Rig) -> CanLayout:
    """Return the messages of the bus: of its DBC file, or of the rig's default one.

    Raises InputError for a file that cannot be read or lacks required signals.
    """
    if settings.dbc is None:
        return read_layout(
            database_text(rig, fd=settings.data_bitrate is not None),
            f"the DBC made for {rig.name}",
            rig,
        )
    try:
        text = Path(settings.dbc).expanduser().read_text("cp1252", "replace")
    except OSError as error:
        raise InputError(
            f"wire: dbc: {settings.dbc}: {error.strerror}; expected a DBC file"
        ) from error
    layout = read_layout(text, settings.dbc, rig)
    if layout.fd and settings.data_bitrate is None:
        raise InputError(
            f"wire: data_bitrate: {settings.dbc} has CAN FD frames; expected the rate of their "
            "data phase"
        )
    return layout


def _check_load(layout: CanLayout, block: reg.BlockLayout, settings: CanSettings, rig: Rig) -> None:
    data_bitrate = settings.data_bitrate or settings.bitrate
    seconds = stream_seconds(layout, block, settings.bitrate, data_bitrate)
    load = seconds * rig.sample_rate / block.samples
    if load > DRIVER.bus_load:
        faster = "" if layout.fd else ", or CAN FD (data_bitrate)"
        fits = DRIVER.bus_load * block.samples / seconds
        raise InputError(
            f"wire: bitrate: {len(rig.recorded)} values at {rig.sample_rate:g} Hz take "
            f"{100 * load:.0f} % of a bus of {settings.bitrate} bit/s at worst, "
            f"{100 * DRIVER.bus_load:.0f} % expected at most: {fits:.0f} Hz fit; "
            f"choose a lower sample_rate, a higher bitrate{faster}"
        )
