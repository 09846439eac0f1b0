"""The driver of a bench on Modbus RTU on a serial line (docs/wire-modbus-rtu.md).

The register map is that of Modbus TCP. RTU frames carry no transaction number, so that a late
answer may be mistaken for the next one: after a request without an answer the driver reads until
the line is quiet, and blocks are identified by sequence numbers.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, ClassVar, Final
from urllib.parse import SplitResult, parse_qsl

from pydantic import Field

from drivers.base import DeviceError, DeviceLost, WireSettings
from drivers.bench_protocol import AnswerDamaged
from drivers.modbus_frames import read_rtu_answer, rtu_frame
from drivers.modbus_tcp import ModbusTcpDriver
from drivers.modbus_transport import ModbusConnection
from drivers.serial_transport import PySerialTransport
from drivers.settings import DRIVER
from rig.model.parts import Wire

UNIT: Final = 1  # of the device on its line


class RtuSettings(WireSettings):
    """The serial line: its device file or port, and its speed; 8 data bits, 1 stop bit."""

    example: ClassVar = "modbus-rtu:///dev/ttyUSB0?baud=921600"

    device: str = Field(min_length=1)
    baud: int = Field(default=921_600, ge=1200)
    parity: str = Field(default="N", pattern="^[NEO]$")

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return device and speed; raises ValueError where the device is missing."""
        if not url.path:
            raise ValueError("no device")
        return {"device": url.path, **dict(parse_qsl(url.query))}


class RtuConnection(ModbusConnection):
    """A serial line that is opened once and, once broken, stays closed until reopened."""

    pipelines = False  # an answer without a number could be to any request

    def __init__(self, settings: RtuSettings, timeout: float) -> None:
        super().__init__(settings.device, UNIT, timeout)
        self._settings = settings
        self._port = PySerialTransport(settings.device, settings.baud, settings.parity)

    @property
    def is_open(self) -> bool:
        """Whether a request may be sent."""
        return self._port.is_open

    def _connect(self) -> None:
        self._port.open()

    def _disconnect(self) -> None:
        self._port.close()

    def _send(self, request: bytes) -> int:
        self._port.read(0.0)  # a late answer that arrived since
        self._port.write(rtu_frame(self._unit, request))
        return 0

    def _receive(self, number: int, timeout: float) -> bytes:
        until, received = time.monotonic() + timeout, b""
        while (remaining := until - time.monotonic()) > 0.0:
            received += self._port.read(remaining)
            if (answer := read_rtu_answer(received, self._unit)) is not None:
                return answer
        raise self._no_answer(len(received)) if received else self._silent()

    def _no_answer(self, received: int) -> DeviceError:
        self.settle()
        return AnswerDamaged(
            f"no valid frame in {received} bytes from {self.where}: check `baud` "
            f"({self._settings.baud}), `parity` ({self._settings.parity}) and the cable"
        )

    def _mismatch(self, text: str) -> DeviceError:
        self.settle()  # a late or repeated answer to an earlier request
        return AnswerDamaged(text)

    def _never_answered(self) -> str:
        return (
            f"not a byte came: check the cable, `device`, `baud` ({self._settings.baud}) and that "
            "the device is on"
        )

    def settle(self) -> None:
        """Read and drop bytes until the line is quiet.

        Raises DeviceLost where the line is lost or does not become quiet.
        """
        start = time.monotonic()
        while self._port.read(DRIVER.quiet):
            if time.monotonic() - start > DRIVER.babble:
                self.close()
                raise DeviceLost(f"{self.where} sends without end; does another host talk on it?")


class ModbusRtuDriver(ModbusTcpDriver):
    """`drivers.base.Driver` over Modbus RTU; see there for each call."""

    settings: ClassVar[type[WireSettings]] = RtuSettings

    @staticmethod
    def connection(wire: Wire, timeout: float) -> ModbusConnection:
        """Return the closed line to the device, which waits `timeout` [s] for an answer."""
        return RtuConnection(RtuSettings.of(wire), timeout)
