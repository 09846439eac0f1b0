"""The driver of a bench behind Modbus RTU on a serial line (docs/wire-modbus-rtu.md).

The register map is that of Modbus TCP. RTU frames carry no transaction number, so that a late
answer to an earlier request may pass for the next one: after a request without an answer the line
is listened to until it is quiet, and blocks carry a sequence number that only the right one has.
"""

from __future__ import annotations

import logging
import os
import select
import time
from collections.abc import Mapping
from typing import Any, ClassVar
from urllib.parse import SplitResult, parse_qs

from pydantic import Field
from pymodbus.client import ModbusSerialClient
from serial import Serial, SerialException

from drivers.base import DeviceError, DeviceLost, WireSettings
from drivers.bench_protocol import AnswerDamaged
from drivers.modbus_tcp import ModbusTcpDriver
from drivers.modbus_transport import ModbusConnection
from drivers.serial_transport import OPENING_ERRORS, why_not_opened
from drivers.settings import DRIVER
from rig.model.parts import Wire

logger = logging.getLogger(__name__)


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
        query = {key: values[-1] for key, values in parse_qs(url.query).items()}
        return {"device": url.path, **query}


class _WaitingClient(ModbusSerialClient):
    """pymodbus's client, which else looks every millisecond whether something has come."""

    def _wait_for_data(self) -> int:
        line: Any = self.socket
        if os.name != "posix" or line is None:
            return int(super()._wait_for_data())
        if select.select([line.fileno()], [], [], self.comm_params.timeout_connect)[0]:
            return int(line.in_waiting)
        return 0


class RtuConnection(ModbusConnection):
    """A serial line that is opened once and, broken once, stays closed until opened again."""

    pipelines = False  # an answer without a number could be that of any request

    def __init__(self, at: RtuSettings, timeout: float) -> None:
        super().__init__(at.device, 0, timeout)
        self.where = at.device
        self._at = at

    def _new_client(self) -> ModbusSerialClient:
        return _WaitingClient(
            self._at.device,
            baudrate=self._at.baud,
            parity=self._at.parity,
            timeout=self._timeout,
            retries=0,
            trace_packet=self._note,
        )

    def _not_connected(self) -> DeviceError:
        # The library keeps the reason to itself.
        try:
            Serial(self._at.device, self._at.baud, exclusive=True).close()
        except OPENING_ERRORS as error:
            return why_not_opened(self._at.device, self._at.baud, error)
        return super()._not_connected()

    def _connected(self, client: Any) -> None:
        client.socket.reset_input_buffer()

    def _answers_earlier_request(self, data: bytes) -> bool:
        return False  # no frame says which request it answers

    def _no_answer(self, received: int) -> DeviceError:
        self.settle()
        return AnswerDamaged(
            f"no valid frame in {received} bytes from {self.where}: check `baud` "
            f"({self._at.baud}), `parity` ({self._at.parity}) and the cable"
        )

    def _mismatch(self, text: str) -> DeviceError:
        self.settle()  # a late or repeated answer to an earlier request
        return AnswerDamaged(text)

    def _never_answered(self) -> str:
        return (
            f"not a byte came: check the cable, `device`, `baud` ({self._at.baud}) and that the "
            "device is on"
        )

    def settle(self) -> None:
        """Read and drop what still arrives, until the line is quiet.

        Raises DeviceLost where the line is gone or does not fall silent.
        """
        line: Any = self._usable().socket
        began = heard = time.monotonic()
        try:
            while time.monotonic() - heard < DRIVER.quiet:
                if line.in_waiting:
                    line.read(line.in_waiting)
                    heard = time.monotonic()
                if heard - began > DRIVER.babble:
                    self.close()
                    raise DeviceLost(
                        f"{self.where} sends without end; does another host talk on it?"
                    )
                time.sleep(DRIVER.quiet / 20)
        except (SerialException, OSError) as error:
            self.close()
            raise DeviceLost(f"the serial line {self.where} is gone: {error}") from error


class ModbusRtuDriver(ModbusTcpDriver):
    """`drivers.base.Driver` over Modbus RTU; see there for what each call promises."""

    settings: ClassVar[type[WireSettings]] = RtuSettings

    @staticmethod
    def connection(wire: Wire, timeout: float) -> ModbusConnection:
        """Return the closed line to the device, which waits `timeout` [s] for an answer."""
        return RtuConnection(RtuSettings.of(wire), timeout)
