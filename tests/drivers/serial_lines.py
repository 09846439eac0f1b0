"""Helpers of serial tests: devices in processes of their own, lines that misbehave."""

from __future__ import annotations

import os
import random
import select
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.base import DeviceLost
from hil_sim.device.device import Device
from hil_sim.device.message_session import SerialSession
from hil_sim.device.pty_line import PtyLine
from tests.drivers.wires import ROOT
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

PREFIX = "serial://"


@contextmanager
def port_of(command: list[str]) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A device's program; gives (process, its port) and ends it afterwards."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert process.stdout is not None
            endpoint = process.stdout.readline().strip()
            assert endpoint.startswith(PREFIX), endpoint
            yield process, endpoint.removeprefix(PREFIX)
        finally:
            process.terminate()
            process.wait(10)


def simulator_command(mode: str) -> list[str]:
    """The program of the simulated bench, which ends with this process."""
    return [sys.executable, "-m", "tests.hil_sim.serial_bench", mode, str(os.getpid())]


class BadLine:
    """A pty before another one; the way back does what `fault` says, from then on.

    "pass" hands bytes on; "lose one" swallows what the device sends next; "silent" swallows all;
    "garbage" replaces it; "unplugged" takes the port away.
    """

    def __init__(self, target: str) -> None:
        self._target = target
        self._line = PtyLine()
        self.port = self._line.name
        self.fault = "pass"
        self._device: int | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End everything."""
        self._closing = True
        self._thread.join(5)
        self._hang_up()
        with suppress(OSError):
            self._line.close()

    def _run(self) -> None:
        while not self._closing:
            if self._line.connected and self._device is not None:
                select.select([self._line.fd, self._device], [], [], 0.02)
            data = self._line.receive(0.0)
            if data is None:
                self._hang_up()
                continue
            if data:
                if self._device is None:
                    flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
                    self._device = os.open(self._target, flags)
                os.write(self._device, data)
            if self._device is not None:
                with suppress(BlockingIOError):
                    if back := os.read(self._device, 4096):
                        self._line.send(self._spoiled(back))
            if self.fault == "unplugged":
                self._line.close()
                return

    def _spoiled(self, data: bytes) -> bytes:
        fault = self.fault
        if fault == "lose one":
            self.fault = "pass"
        return data if fault == "pass" else b"\x55\xaa" * 40 if fault == "garbage" else b""

    def _hang_up(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            os.close(device)


class Faults:
    """Bytes of one direction, a share of the messages spoiled, by a seed.

    What is held back comes after later messages ("late"), or together with the next ("merge").
    """

    KINDS = ("flip", "drop", "double", "split", "merge", "late", "cut", "noise")

    def __init__(self, seed: int, share: float) -> None:
        self._rng = random.Random(seed)
        self.share = share
        self._held: deque[tuple[int, bytes]] = deque()
        self._before = b""
        self.count = dict.fromkeys(self.KINDS, 0)

    def pass_on(self, message: bytes) -> list[bytes]:
        """Return the pieces that arrive now."""
        rng = self._rng
        pieces = [self._before + message]
        self._before = b""
        if rng.random() < self.share:
            kind = rng.choice(self.KINDS)
            self.count[kind] += 1
            pieces = self._spoil(kind, pieces[0])
        self._held = deque((left - 1, data) for left, data in self._held)
        while self._held and self._held[0][0] <= 0:
            pieces.append(self._held.popleft()[1])
        return pieces

    def _spoil(self, kind: str, data: bytes) -> list[bytes]:
        rng = self._rng
        at = rng.randrange(len(data))
        if kind == "merge":
            self._before = data
        elif kind == "late":
            self._held.append((rng.randrange(2, 12), data))
        return {
            "flip": [data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]],
            "drop": [],
            "double": [data, data],
            "split": [data[:at], data[at:]],
            "merge": [],
            "late": [],
            "cut": [data[:at]],
            "noise": [rng.randbytes(at), data],
        }[kind]


class Loop:
    """A `Transport` to a device in this process, with a clock in hand that runs while it waits."""

    where = "loop"

    def __init__(self, *, realtime: bool, seed: int = 0, share: float = 0.0) -> None:
        self.now = 0.0
        rig = seed_rig()
        self.device = Device(rig, IntegratorPlant(rig), realtime=realtime, clock=self.clock)
        self.session = SerialSession(self.device)
        self.forth, self.back = Faults(seed, share), Faults(seed + 1, share)
        self._arrived: deque[bytes] = deque()
        self.is_open = False
        self.sent: list[bytes] = []

    def clock(self) -> float:
        """The time [s]."""
        return self.now

    def open(self, *, shared: bool = False) -> None:
        """Nothing to do."""
        self.is_open = True
        self._arrived.clear()

    def write(self, data: bytes) -> None:
        """Carry out at once what arrives."""
        if not self.is_open:
            raise DeviceLost("closed")
        self.sent.append(data)
        for piece in self.forth.pass_on(data):
            if answer := self.session.receive(piece):
                self._arrived.extend(self.back.pass_on(answer))
        self._push()

    def read(self, timeout: float) -> bytes:
        """Return one piece; time passes only where none is waiting."""
        if not self.is_open:
            raise DeviceLost("closed")
        end = self.now + timeout
        while not self._arrived and self.now < end:
            self.now = min(end, self.now + max(self.device.idle_seconds(), 1e-3))
            self.device.poll()
            self._push()
        return self._arrived.popleft() if self._arrived else b""

    def close(self) -> None:
        """The device does not notice."""
        self.is_open = False

    def _push(self) -> None:
        while block := self.session.push():
            self._arrived.extend(self.back.pass_on(block))
