"""Frames of a CAN bus by python-can: a thread of this module receives, the callers' threads send.

python-can's periodic sender is not used: its thread ends silently with the first error of the bus,
and only the device's watchdog would remain.
"""

from __future__ import annotations

import errno
import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Final
from urllib.parse import SplitResult, parse_qsl

import can
from pydantic import AfterValidator, Field

from drivers.base import DeviceError, DeviceLost, WireSettings
from drivers.can_adapters import SlcanBus, SocketcandBus
from drivers.serial_transport import PortInUse
from drivers.settings import DRIVER
from rig.model.wire.can_frames import CanFrame
from rig.model.wire.can_layout import EXTENDED

logger = logging.getLogger(__name__)

SOCKETCAND: Final = "socketcand"
SLCAN: Final = "slcan"
_GREETING: Final = b"< hi >"
_OPENED: Final = b"< ok >"
_ERRORS: Final = (can.CanError, OSError, ValueError, ImportError, NotImplementedError)


@dataclass(frozen=True)
class BusPlace:
    """The address of a bus: python-can's interface, its channel, a socketcand's host and port."""

    text: str
    interface: str
    channel: str
    host: str = ""
    port: int = 0

    @classmethod
    def of(cls, text: str) -> BusPlace:
        """Read ``INTERFACE/CHANNEL``; raises ValueError naming what was expected."""
        interface, _, channel = text.partition("/")
        if interface not in can.VALID_INTERFACES:
            known = " ".join(sorted(can.VALID_INTERFACES))
            raise ValueError(
                f"no interface {interface!r}; expected INTERFACE/CHANNEL, one of {known}"
            )
        if not channel:
            raise ValueError(f"expected {interface}/CHANNEL, the channel is missing")
        if interface == SOCKETCAND:
            address, _, channel = channel.partition("/")
            host, _, port = address.rpartition(":")
            if not (host and channel and port.isdigit() and 1 <= int(port) <= 65535):
                raise ValueError("expected socketcand/HOST:PORT/CHANNEL, the port 1 to 65535")
            return cls(text, interface, channel, host.strip("[]"), int(port))
        if interface == SLCAN and "/" in channel:
            channel = f"/{channel.lstrip('/')}"  # a device file; COM3 has no slash
        return cls(text, interface, channel)


def _bus(text: str) -> str:
    """Return the text of a bus; raises ValueError as `BusPlace.of`."""
    return BusPlace.of(text).text


class BusSettings(WireSettings):
    """The keys of every wire on a CAN bus: the bus, as `BusPlace.of` reads it, and its rate."""

    bus: Annotated[str, AfterValidator(_bus)] = Field(
        description="INTERFACE/CHANNEL: socketcan/can0, slcan/dev/ttyACM0, "
        "socketcand/HOST:PORT/can0, pcan/PCAN_USBBUS1, virtual/NAME"
    )
    bitrate: int = Field(default=1_000_000, ge=10_000, le=1_000_000, description="[bit/s]")

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return the bus and the keys behind ``?``; ValueError where the bus has another form."""
        return {"bus": _bus(url.netloc + url.path), **dict(parse_qsl(url.query))}


class CanPort:
    """A CAN bus that can be opened and closed any number of times.

    `keys` are the keys (`CanMessage.key`) of the frames to keep; where `deliver` is given, it is
    called with each of them in the receive thread, and `receive` returns none. `counts` counts all
    frames since opening.
    """

    def __init__(
        self,
        place: BusPlace,
        bitrate: int,
        data_bitrate: int | None,
        keys: frozenset[int],
        make: Callable[..., Any] = can.Bus,
        deliver: Callable[[int, bytes], object] | None = None,
    ) -> None:
        self._place, self._bitrate, self._data_bitrate = place, bitrate, data_bitrate
        self.where = place.text
        self._deliver = deliver
        self._keys = keys
        self._make = make
        self._shared = False
        self._sending = threading.Lock()  # adapters write a frame in parts
        self._reader: _Reader | None = None

    @property
    def is_open(self) -> bool:
        """Whether frames can be sent and received."""
        return self._reader is not None

    @property
    def fault(self) -> BaseException | None:
        """The error by which the bus was lost, None while it is not."""
        return None if self._reader is None else self._reader.fault

    @property
    def counts(self) -> FrameCounts:
        """Counts of frames since the bus was last opened."""
        return FrameCounts() if self._reader is None else self._reader.counts

    def open(self, *, shared: bool = False) -> None:
        """Open the bus; raises DeviceLost where there is none, DeviceError where it may not be.

        The port of an slcan adapter belongs to one program, unless `shared`: the adapter then stays
        as the other program has set it.
        """
        self.close()
        self._shared = shared
        # python-can warns of normal conditions, such as half a line; faults are reported here.
        logging.getLogger("can").setLevel(logging.CRITICAL)
        if self._place.interface == SOCKETCAND:
            self._check_socketcand()
        reader = _Reader(self._make_bus, self._keys, self._deliver)
        if not reader.opened.wait(DRIVER.can_open):
            reader.end()
            raise DeviceLost(f"{self.where} did not open within {DRIVER.can_open:g} s")
        if isinstance(reader.fault, PortInUse):
            raise reader.fault
        if reader.fault is not None:
            raise self._opening_error(reader.fault) from reader.fault
        self._reader = reader

    def send(self, frame: CanFrame) -> None:
        """Send a frame; raises DeviceLost when the bus is lost or accepts none."""
        reader = self._usable()
        message = can.Message(
            arbitration_id=frame.identifier,
            data=frame.data,
            is_extended_id=frame.extended,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        end = time.monotonic() + DRIVER.can_send
        while True:
            try:
                with self._sending:
                    reader.bus.send(message, timeout=DRIVER.can_send)
            except _ERRORS as error:
                if _errno(error) != errno.ENOBUFS and "buffer full" not in str(error):
                    raise self._loss(error) from error
                if time.monotonic() > end:
                    self.close()
                    raise DeviceLost(
                        f"{self.where} takes no more frames: no other node acknowledges them; "
                        f"check wiring, termination and that the bus runs at {self._bitrate} bit/s"
                    ) from error
                time.sleep(DRIVER.can_full)
            else:
                return

    def receive(self, timeout: float) -> list[tuple[int, bytes]]:
        """Return (key, bytes) of the frames waiting; nothing after `timeout` [s].

        Raises DeviceLost when the bus is lost.
        """
        reader = self._usable()
        frames: list[tuple[int, bytes]] = []
        with suppress(queue.Empty):
            frames.append(reader.frames.get(timeout=max(timeout, 0.0)))
            while True:
                frames.append(reader.frames.get_nowait())
        frames = [frame for frame in frames if frame[0] >= 0]
        if not frames and reader.fault is not None:
            raise self._loss(reader.fault) from reader.fault
        return frames

    def close(self) -> None:
        """Close the bus; never raises."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.end()

    # -- inside -----------------------------------------------------------------------------

    def _usable(self) -> _Reader:
        if self._reader is None:
            raise DeviceLost(f"the bus {self.where} is closed")
        return self._reader

    def _loss(self, error: BaseException) -> DeviceLost:
        self.close()
        return DeviceLost(f"the bus {self.where} has gone: {_one_line(error)}")

    def _check_socketcand(self) -> None:
        """Raise DeviceError or DeviceLost for another server: python-can would wait for ever."""
        place = self._place
        try:
            with socket.create_connection((place.host, place.port), DRIVER.can_greeting) as host:
                greeting = host.recv(64)
                host.sendall(f"< open {place.channel} >".encode())
                opened = host.recv(64) if greeting.startswith(_GREETING) else b""
        except ConnectionError as error:
            raise DeviceLost(
                f"nobody listens at {place.host}:{place.port} ({error.strerror}); is socketcand "
                "(or `bramah sim`) running there?"
            ) from error
        except TimeoutError as error:
            raise DeviceLost(
                f"what listens at {place.host}:{place.port} has not greeted as socketcand does "
                f"within {DRIVER.can_greeting:g} s; check the port, which another program may have"
            ) from error
        except OSError as error:  # an invalid name
            raise DeviceLost(
                f"no socketcand at {place.host}:{place.port}: {error.strerror or error}"
            ) from error
        if not greeting.startswith(_GREETING):
            raise DeviceError(
                f"{place.host}:{place.port} is no socketcand: it said {greeting[:20]!r}, expected "
                f"{_GREETING!r}"
            )
        if not opened.startswith(_OPENED):
            raise DeviceLost(
                f"the socketcand at {place.host}:{place.port} has no bus {place.channel}: it said "
                f"{opened[:60]!r}"
            )

    def _make_bus(self) -> Any:
        place = self._place
        rates: dict[str, Any] = {"bitrate": self._bitrate}
        if place.interface == SOCKETCAND:
            return SocketcandBus(  # type: ignore[no-untyped-call]
                place.channel, place.host, place.port, tcp_tune=True
            )
        if place.interface == SLCAN:
            rates["sleep_after_open"] = 0.0
            if self._data_bitrate is not None:
                rates["timing"] = can.BitTimingFd.from_sample_point(
                    f_clock=80_000_000,
                    nom_bitrate=self._bitrate,
                    nom_sample_point=80.0,
                    data_bitrate=self._data_bitrate,
                    data_sample_point=75.0,
                )
            if os.name == "posix" and self._make is can.Bus:
                return SlcanBus(place.channel, shared=self._shared, **rates)
        elif self._data_bitrate is not None:
            rates |= {"fd": True, "data_bitrate": self._data_bitrate}
        return self._make(interface=place.interface, channel=place.channel, **rates)

    def _opening_error(self, error: BaseException) -> DeviceError:
        number, text = _errno(error), _one_line(error)
        interface = self._place.interface
        if isinstance(error, can.CanInterfaceNotImplementedError | ImportError):
            return DeviceError(f"the interface {interface} cannot be used here: {text}")
        if number in (errno.EPERM, errno.EACCES):
            return DeviceError(
                f"no permission to open {self.where}; on Linux join the group that owns the "
                "device (often `dialout`), or have an administrator bring the interface up"
            )
        if number == errno.EAFNOSUPPORT:
            return DeviceError(
                f"{self.where}: this system has no SocketCAN; load the kernel's module can_raw, or "
                "reach the bus by another interface"
            )
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            return DeviceLost(
                f"there is no {self.where}; is the adapter plugged in (or `bramah sim` running "
                "there)?"
            )
        if number == errno.ENETDOWN:
            return DeviceLost(
                f"{self.where} is down: ip link set {self._place.channel} up type can bitrate "
                f"{self._bitrate}"
            )
        return DeviceLost(f"cannot open {self.where} at {self._bitrate} bit/s: {text}")


@dataclass
class FrameCounts:
    """Frames since a bus was opened, by kind."""

    accepted: int = 0
    foreign: int = 0
    errors: int = 0
    overrun: int = 0


class _Reader:
    """The receive thread of one opened bus: it opens, receives, and closes it."""

    def __init__(
        self,
        make: Callable[[], Any],
        keys: frozenset[int],
        deliver: Callable[[int, bytes], object] | None,
    ) -> None:
        self._deliver = deliver
        self.bus: Any = None
        self.opened = threading.Event()
        self.fault: BaseException | None = None
        self.frames: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
        self.counts = FrameCounts()
        self._make, self._keys = make, keys
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="can-receive", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End the thread and close the bus; a thread that hangs in a library is left."""
        self._ending = True
        if threading.current_thread() is not self._thread:
            self._thread.join(DRIVER.can_open)

    def _run(self) -> None:
        try:
            self.bus = self._make()
        except Exception as error:  # any exception of a vendor's library
            self.fault = error
            self.opened.set()
            return
        self.opened.set()
        try:
            while not self._ending:
                message = self.bus.recv(DRIVER.can_wait)
                if message is not None:
                    self._take(message)
        except Exception as error:
            self.fault = error
            self.frames.put((-1, b""))  # ends the reader's wait
        finally:
            with suppress(Exception):
                self.bus.shutdown()

    def _take(self, message: Any) -> None:
        key = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        if message.is_error_frame:
            self.counts.errors += 1
        elif message.is_remote_frame or key not in self._keys:
            self.counts.foreign += 1
        elif self.frames.qsize() >= DRIVER.can_frames:
            self.counts.overrun += 1
        else:
            self.counts.accepted += 1
            if self._deliver is None:
                self.frames.put((key, bytes(message.data)))
            else:
                self._deliver(key, bytes(message.data))


def _errno(error: BaseException | None) -> int | None:
    """Return the system's error number of an error, from its chain of causes."""
    while error is not None:
        number = getattr(error, "errno", None) or getattr(error, "error_code", None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return None


def _one_line(error: BaseException) -> str:
    words = str(error).partition("Traceback")[0]  # which python-can appends
    return " ".join(words.split())[:200] or type(error).__name__
