"""An I/O module that knows nothing of benches: registers, a watchdog, two cylinders behind it.

Run as a program, ``python -m tests.drivers.plain_module [parent]`` prints its port. Each write of
the outputs moves the plant by one step of STEP seconds, so that a host in fake time sees the same
as one in real time. Its map, which only a rig file tells a host:

holding registers (functions 3, 6, 16)
    0 piston_1 int16 10 um    1 spool_1 int16 1 mV    2 cap_1, 4 rod_1 float32 low word first, bar
    100 valve 1, 101 valve 2 int16 5 mV, read back as put out
    200 watchdog [ms], 0 is off       210, 211 the voltages put out, int16 mV; ignores writes
    300 a write of n lets the next read of register 0 wait for n ms
    301 a write of n lets the next n requests be refused as busy (exception 6)
    302 after a write of 1 the valves keep their voltage, whatever is written and acknowledged
    303 after a write of 1 the valves' registers cannot be read (exception 1)
input registers (function 4)
    10 piston_2 int32 um      12 spool_2 int16 1 mV
    13 cap_2 uint32 1 Pa above -1 bar                 15 rod_2 uint16 1 kPa above -1 bar
    16 supply float32 high word first, MPa            18 oil int16 0.1 K above 5 degC
"""

from __future__ import annotations

import asyncio
import logging
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

ROOT = Path(__file__).parents[2]
STEP = 0.01
SPEED_PER_VOLT = 0.02
LIFETIME = 120.0  # a server that nobody ends, ends

WIRE = """
wire:
  kind: modbus-map
  host: 127.0.0.1
  port: {port}
  unit: 7
  timeout: 5 s
  watchdog: 2 s
  inputs:
    piston_1: {{function: 3, address: 0, type: int16, scale: 0.01 mm, offset: 0 mm}}
    spool_1: {{function: 3, address: 1, type: int16, scale: 1 mV}}
    cap_pressure_1: {{function: 3, address: 2, type: float32, word_order: little, scale: 1 bar}}
    rod_pressure_1: {{function: 3, address: 4, type: float32, word_order: little, scale: 1 bar}}
    piston_2: {{function: 4, address: 10, type: int32, scale: 1 um}}
    spool_2: {{function: 4, address: 12, type: int16, scale: 0.001 V}}
    cap_pressure_2: {{function: 4, address: 13, type: uint32, scale: 1 Pa, offset: -1 bar}}
    rod_pressure_2: {{function: 4, address: 15, type: uint16, scale: 1 kPa, offset: -0.1 MPa}}
    supply_pressure: {{function: 4, address: 16, type: float32, word_order: big, scale: 1 MPa}}
    oil_temperature:
      {{function: 4, address: 18, type: int16, scale: 0.1 delta_degC, offset: 5 degC}}
  outputs:
    1: {{address: 100, type: int16, scale: 0.005 V}}
    2: {{address: 101, type: int16, scale: 5 mV}}
  zero_by: {{watchdog_register: 200, milliseconds: 1500}}
"""


class Module:
    """The registers and what is behind them."""

    def __init__(self) -> None:
        self.volts = [0.0, 0.0]
        self.piston = [0.0, 0.0]
        self.watchdog = 0
        self.wait = 0.0
        self.busy = 0
        self.keeps = False
        self.unread = False
        self._written = time.monotonic()

    async def access(
        self,
        function: int,
        first: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | None,
    ) -> ExcCodes | None:
        """Serve one request: keep what is written, bring up to date what is read."""
        if self.busy and address != 301:
            self.busy -= 1
            return ExcCodes.DEVICE_BUSY
        if self.watchdog and time.monotonic() - self._written > self.watchdog * 1e-3:
            self.volts = [0.0, 0.0]
        if values is not None:
            return self._write(address, list(values))
        if self.unread and address in (100, 101):
            return ExcCodes.ILLEGAL_FUNCTION
        if address == 0:
            wait, self.wait = self.wait, 0.0
            await asyncio.sleep(wait)
        for at, data in (self._holding() if function == 3 else self._inputs()).items():
            words = struct.unpack(f">{len(data) // 2}H", data)
            registers[at - first : at - first + len(words)] = words
        return None

    def _write(self, address: int, words: list[int]) -> ExcCodes | None:
        if self.keeps and address in (100, 101):
            return None
        if address in (100, 101):
            for i, word in enumerate(words):
                signed = struct.unpack(">h", struct.pack(">H", word))[0]
                self.volts[address - 100 + i] = 0.005 * signed
            self._written = time.monotonic()
            for i, volts in enumerate(self.volts):
                self.piston[i] += SPEED_PER_VOLT * volts * STEP
        elif address == 200:
            self.watchdog = words[0]
        elif address == 300:
            self.wait = words[0] * 1e-3
        elif address == 301:
            self.busy = words[0]
        elif address == 302:
            self.keeps = bool(words[0])
        elif address == 303:
            self.unread = bool(words[0])
        elif address not in (210, 211):
            return ExcCodes.ILLEGAL_ADDRESS
        return None

    def _holding(self) -> dict[int, bytes]:
        piston, spool = round(self.piston[0] * 1e5), round(100 * self.volts[0])
        cap, rod = struct.pack(">f", 20.0), struct.pack(">f", 15.5)
        return {
            0: struct.pack(">hh", piston, spool),
            2: cap[2:] + cap[:2] + rod[2:] + rod[:2],
            100: struct.pack(">hh", *(round(volts / 0.005) for volts in self.volts)),
            200: struct.pack(">H", self.watchdog),
            210: struct.pack(">hh", *(round(1e3 * volts) for volts in self.volts)),
        }

    def _inputs(self) -> dict[int, bytes]:
        piston, spool = round(self.piston[1] * 1e6), round(100 * self.volts[1])
        return {10: struct.pack(">ihIHfh", piston, spool, 2_100_000, 1_650, 7.0, 350)}


def plain(first: int, end: int) -> SimData:
    return SimData(first, count=end - first, values=0, datatype=DataType.REGISTERS)


async def serve(parent: int) -> None:
    """Serve until the parent process is gone."""
    module = Module()
    bits = [SimData(0, values=[False] * 16, datatype=DataType.BITS)]
    holding = [plain(0, 6), plain(100, 102), plain(200, 201), plain(210, 212), plain(300, 304)]
    device = SimDevice(7, simdata=(bits, bits, holding, [plain(10, 19)]), action=module.access)
    server = ModbusTcpServer(device, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    transport = server.transport
    print(transport.sockets[0].getsockname()[1], flush=True)  # type: ignore[union-attr] # noqa: T201
    ends = time.monotonic() + LIFETIME
    while os.getppid() == parent and time.monotonic() < ends:
        await asyncio.sleep(0.1)
    await server.shutdown()


@contextmanager
def module_process() -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The module as a process; gives (process, port) and ends it afterwards."""
    command = [sys.executable, "-m", "tests.drivers.plain_module", str(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert process.stdout is not None
            yield process, int(process.stdout.readline())
        finally:
            process.terminate()
            process.wait(10)


if __name__ == "__main__":
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    asyncio.run(serve(int(sys.argv[1])))
