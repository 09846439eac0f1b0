"""The driver of a bench on a CAN bus, described by a DBC file (docs/wire-can.md)."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Final

from pydantic import Field, ValidationInfo, field_validator

from drivers.base import WireSettings
from drivers.can_link import CanLine
from drivers.can_port import SLCAN, SOCKETCAND, BusPlace, BusSettings, CanPort
from drivers.message_stream import MessageStreamDriver
from drivers.settings import DRIVER
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.can_database import database_text
from rig.model.wire.can_frames import stream_seconds
from rig.model.wire.can_layout import CanLayout, read_layout

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
        at = CanSettings.of(wire)
        self._bitrate = at.bitrate
        layout = can_layout(at, rig)
        block = reg.block_layout(len(rig.channels), len(rig.joints))
        _check_load(layout, block, at, rig)
        if port is None:
            wanted = frozenset(message.key for message in layout.from_bench)
            port = CanPort(BusPlace.of(at.bus), at.bitrate, at.data_bitrate, wanted)
        super().__init__(wire, rig, CanLine(port, layout, block, at.bitrate), clock)

    def _place(self) -> str:
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


def _check_load(layout: CanLayout, block: reg.BlockLayout, at: CanSettings, rig: Rig) -> None:
    seconds = stream_seconds(layout, block, at.bitrate, at.data_bitrate or at.bitrate)
    load = seconds * rig.sample_rate / block.samples
    if load > DRIVER.bus_load:
        faster = "" if layout.fd else ", or CAN FD (data_bitrate)"
        fits = DRIVER.bus_load * block.samples / seconds
        raise InputError(
            f"wire: bitrate: {len(rig.recorded)} values at {rig.sample_rate:g} Hz take "
            f"{100 * load:.0f} % of a bus of {at.bitrate} bit/s at worst, "
            f"{100 * DRIVER.bus_load:.0f} % expected at most: {fits:.0f} Hz fit; "
            f"choose a lower sample_rate, a higher bitrate{faster}"
        )
