"""The driver of valves of CiA 408 on a CANopen bus (docs/wire-canopen-408.md).

One node for each joint. The host is the sample clock: each tick it sends SYNC, receives the nodes'
synchronous TPDOs, and sends control word, set point and its heartbeat (`drivers.polled`). The
package `canopen` is an optional dependency, imported when a rig names this kind of wire.
"""

from __future__ import annotations

import importlib
import io
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Final, Unpack

import numpy as np
from pydantic import Field

from drivers.base import (
    Array,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    PackageMissing,
    WireSettings,
)
from drivers.can_port import BusPlace, BusSettings, CanPort
from drivers.polled import Pacing, PolledDriver
from drivers.settings import DRIVER
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import cia408
from rig.model.wire.can_frames import CanFrame
from rig.model.wire.cia408 import Control, ValveState
from rig.model.wire.codes import decode_input

logger = logging.getLogger(__name__)

PACKAGE: Final = "canopen"
_COMMON: Final = frozenset({ch.SUPPLY, ch.TEMPERATURE})
_PRE_OPERATIONAL: Final = 0x80  # NMT command
_NODES: Final = range(1, 128)


class ValveBusSettings(BusSettings):
    """The bus, the valves' node numbers by joint, and their EDS file."""

    example: ClassVar = "canopen-408://socketcan/can0?bitrate=500000"

    nodes: tuple[int, ...] | None = Field(default=None, description="default: 1, 2 ...")
    host: int = Field(default=127, ge=1, le=127, description="the node number of this program")
    eds: str | None = Field(default=None, description="an EDS file; default: the shipped valve's")


class CanOpenValves:
    """`drivers.polled.InputsOutputs` over the nodes of a bus."""

    def __init__(self, wire: Wire, rig: Rig, clock: Callable[[], float]) -> None:
        settings = ValveBusSettings.of(wire)
        self._wire, self._rig, self._settings, self._clock = wire, rig, settings, clock
        self._numbers = settings.nodes or tuple(range(1, len(rig.joints) + 1))
        if len(set(self._numbers)) != len(rig.joints) or settings.host in self._numbers:
            raise InputError(
                f"wire: nodes: {list(self._numbers)}; expected {len(rig.joints)} different "
                f"numbers, none of them the host's {settings.host}"
            )
        try:
            self._canopen = importlib.import_module(PACKAGE)
        except ImportError as error:
            raise PackageMissing(
                f"wire: kind: {wire.kind} needs the package {PACKAGE}: "
                "pip install 'bramah[canopen]'"
            ) from error
        self._sdo_errors = self._canopen.SdoAbortedError, self._canopen.SdoCommunicationError
        self._eds, self._source = _eds(settings)
        self._received = threading.Condition()
        self._awaited_ids: set[int] = set()
        self._network: Any = None
        self._nodes: list[Any] = []
        self._mappings = self._find_sensors()
        keys = {0x580 + n for n in self._numbers} | self._tpdo_ids
        # Of every node: which of them is another host, the valves say.
        keys |= {cia408.HEARTBEAT_ID + n for n in _NODES}
        keys |= {cia408.EMERGENCY_ID + n for n in self._numbers}
        place = BusPlace.of(settings.bus)
        self._port = CanPort(place, settings.bitrate, None, frozenset(keys), deliver=self._deliver)
        self._beat = threading.Lock()  # one heartbeat at a time
        self._last_heartbeat = 0.0
        # So that a call every period sends one in time.
        period = 1.0 / rig.sample_rate
        self._interval = max(wire.watchdog / DRIVER.heartbeats - 0.5 * period, 0.0)
        self._at_zero = True  # whether the newest set points are all zero
        self._idle_ended = threading.Event()
        self._idle_loss: str | None = None  # why the bus was lost between two calls
        self._in_control = False  # whether the valves supervise this host's heartbeat
        self._heard: set[int] = set()  # numbers of the nodes whose heartbeats were heard
        self._states: list[int] = [ValveState.INIT] * len(rig.joints)
        self._operational: set[int] = set()  # numbers of the nodes that said so since the start
        self._node_fault: str | None = None  # which valve has left operation since then

    @property
    def watchdog(self) -> float | None:
        """Seconds after which a node that misses the host's heartbeat zeroes its output."""
        return self._wire.watchdog

    def open(self) -> str:
        """Open the bus, configure the nodes, bring them to HOLD; a fault in one stays.

        Raises DeviceBusy where another host drives them.
        """
        self.close()
        self._port.open()
        self._make_network()
        self._refuse_other_host()
        self._in_control = True
        milliseconds = round(1e3 * self._wire.watchdog)
        for node in self._nodes:
            self._configure(node, milliseconds)
        self._heartbeat(force=True)
        self._at_zero, self._idle_loss = True, None
        self._idle_ended = threading.Event()
        threading.Thread(
            target=self._beat_at_zero, args=(self._idle_ended,), name="bramah-valves", daemon=True
        ).start()
        self._start_nodes()
        self._send(np.zeros(len(self._nodes)), Control.DISABLED)
        self.read()
        self._send(np.zeros(len(self._nodes)), Control.DISABLED | Control.HOLD)
        return f"{len(self._nodes)} valve(s) of CiA 408 at {self._port.where}"

    def read(self) -> Array:
        """Return one sample of every channel [SI], (channels,), by SYNC and the nodes' TPDOs."""
        self._usable()
        self._heartbeat()
        with self._received:
            self._awaited_ids = set(self._tpdo_ids)
        self._port.send(CanFrame(cia408.SYNC_ID, b""))
        end = time.monotonic() + self._wire.timeout
        with self._received:
            while self._awaited_ids:
                remaining = end - time.monotonic()
                if remaining <= 0.0 or self._port.fault is not None:
                    break
                self._received.wait(min(remaining, 0.05))
            missing = sorted({1 + (cob - 1) % 0x80 for cob in self._awaited_ids})
        if missing:
            self._usable()  # a bus that has gone is the cause
            # A late answer would be mistaken for the next one.
            self._port.close()
            nodes = " and ".join(f"node {number}" for number in missing)
            raise DeviceLost(
                f"{nodes} at {self._port.where} did not answer SYNC for "
                f"{self._wire.timeout:g} s; check wiring, node numbers and that the bus runs at "
                f"{self._settings.bitrate} bit/s"
            )
        self._states = [node.tpdo[cia408.STATUS_WORD].raw & 0xF for node in self._nodes]
        return np.array([self._value(name) for name in self._rig.channels])

    def write(self, volts: Array) -> None:
        """Put out voltages [V]: set points in ACTIVE, or HOLD where all are zero."""
        self._usable()
        moving = bool(volts.any())
        self._at_zero = self._at_zero and not moving
        self._heartbeat()
        hold = Control.DISABLED | Control.HOLD
        self._send(volts, hold | Control.ACTIVE if moving else hold)
        self._at_zero = not moving

    def close(self, *, tripped: bool = False) -> None:
        """Disable the valves if the bus works, and stop their supervision of the heartbeat.

        After a trip they keep the supervision: each goes to a fault, which refuses every host.
        """
        self._idle_ended.set()
        if self._port.is_open and self._in_control and not tripped:
            with suppress(DeviceError, *self._sdo_errors):
                self._send(np.zeros(len(self._nodes)), Control.DISABLED)
                for node in self._nodes:
                    supervised = node.sdo[cia408.CONSUMER_HEARTBEAT][1]
                    if supervised.raw >> 16 == self._settings.host:
                        supervised.raw = 0
        self._in_control = False
        self._port.close()

    def zero_beside_host(self) -> None:
        """Disable the valves and take them out of operation, although another host drives them.

        That host then misses their samples and ends. Raises DeviceLost if a valve does not answer.
        """
        self._port.open(shared=True)
        self._make_network()
        try:
            for node in self._nodes:
                self._network.send_message(0, bytes([_PRE_OPERATIONAL, node.id]))
            for node in self._nodes:
                node.sdo[cia408.CONTROL_WORD].raw = int(Control.DISABLED)
                # Out of operation a valve obeys no host, and the end of the other host is no fault.
                node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw = 0
        except self._sdo_errors as error:
            raise DeviceLost(f"a valve at {self._port.where} has not confirmed: {error}") from error
        finally:
            self._port.close()

    def fault(self) -> str | None:
        """Return which valve is in a fault or out of operation, None if none is."""
        for number, state in zip(self._numbers, self._states, strict=True):
            if not state & 0b1000:
                name = ValveState(state).name if state in set(ValveState) else f"{state:04b}"
                return (
                    f"valve {number} is in {name}: it missed the host's heartbeat or has found a "
                    "fault of its own"
                )
        return self._node_fault

    def reset(self) -> None:
        """Clear the faults by a rising reset bit, the outputs at zero."""
        zero = np.zeros(len(self._nodes))
        self._start_nodes()
        self._heartbeat(force=True)
        for word in (Control.DISABLED, Control.DISABLED | Control.RESET, Control.DISABLED):
            self._send(zero, word)
        end = time.monotonic() + DRIVER.state_seconds
        self.read()
        while self.fault() is not None and time.monotonic() < end:
            self.read()
        if (fault := self.fault()) is not None:
            raise DeviceError(f"{fault}; the reset did not clear it: remove its cause first")
        self._send(zero, Control.DISABLED | Control.HOLD)

    # -- inside -----------------------------------------------------------------------------

    def _find_sensors(self) -> dict[str, tuple[int, int, int]]:
        """Return (node index, TPDO number, index in it) of every channel except the spools."""
        nodes = self._remote_nodes(self._canopen.Network())
        self._tpdo_ids = set()
        mappings: dict[str, tuple[int, int, int]] = {}
        for index, node in enumerate(nodes):
            for number, pdo in node.tpdo.items():
                for entry, variable in enumerate(pdo):
                    kind = variable.name.rpartition(".")[2]
                    name = kind if kind in _COMMON else ch.channel(kind, index + 1)
                    if name in self._rig.channels and name not in mappings:
                        mappings[name] = (index, number, entry)
                        self._tpdo_ids.add(pdo.cob_id)
            for required in (cia408.STATUS_WORD, cia408.ACTUAL_VALUE):
                pdo = next((p for p in node.tpdo.values() if _maps(p, required)), None)
                if pdo is None:
                    raise InputError(f"{self._source}: no TPDO carries object 0x{required:X}")
                self._tpdo_ids.add(pdo.cob_id)
        for name in self._rig.channels:
            if ch.kind_of(name)[0] != ch.SPOOL and name not in mappings:
                kind = ch.kind_of(name)[0]
                raise InputError(f"{self._source}: no TPDO carries {kind}, which {name} needs")
        return mappings

    def _remote_nodes(self, network: Any) -> list[Any]:
        nodes = []
        for number in self._numbers:
            text = io.StringIO(self._eds)
            text.name = "valve.eds"  # the library chooses its reader by the name's ending
            try:
                node = self._canopen.RemoteNode(number, text)
                network.add_node(node)
                node.tpdo.read(from_od=True)
                node.rpdo.read(from_od=True)
            except Exception as error:  # any exception of the reader for a damaged file
                reason = " ".join(str(error).split())
                raise InputError(f"{self._source}: not an EDS file of a valve: {reason}") from error
            nodes.append(node)
        return nodes

    def _make_network(self) -> None:
        port = self._port

        class Network(self._canopen.Network):  # type: ignore[misc,name-defined]
            """The library's network over this port, without a thread or periodic sender."""

            def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
                port.send(CanFrame(can_id, bytes(data)))

        network = Network()
        self._nodes = self._remote_nodes(network)
        self._network = network
        for node in self._nodes:
            node.sdo.RESPONSE_TIMEOUT = self._wire.timeout
            node.tpdo.subscribe()

    def _start_nodes(self) -> None:
        """Bring the nodes into operation (NMT)."""
        self._operational, self._node_fault = set(), None
        for number in self._numbers:
            self._network.send_message(0, bytes([1, number]))

    def _refuse_other_host(self) -> None:
        """Raise DeviceBusy if the heartbeat of another host that the valves supervise is received.

        Two hosts would overwrite each other's set points, and the end of one would switch the
        supervision of the other off.
        """
        self._heard = set()
        try:
            watched = [node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw for node in self._nodes]
        except self._sdo_errors:
            return  # `_configure` reports the cause
        hosts = {entry >> 16 & 0x7F for entry in watched if entry}
        end = time.monotonic() + self._wire.watchdog
        while hosts and time.monotonic() < end:
            if others := hosts & self._heard:
                self._port.close()
                raise DeviceBusy(
                    f"another host with the number {min(others)} drives the valves at "
                    f"{self._port.where}: its heartbeat is heard; end its run, or stop it"
                )
            time.sleep(DRIVER.can_full)

    def _configure(self, node: Any, milliseconds: int) -> None:
        """Check a node's identity and configure its reaction to a lost host."""
        try:
            profile = node.sdo[0x1000].raw & 0xFFFF
            if profile != cia408.DEVICE_TYPE:
                raise DeviceError(
                    f"node {node.id} at {self._port.where} is of profile {profile}, expected "
                    f"{cia408.DEVICE_TYPE}"
                )
            node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw = self._settings.host << 16 | milliseconds
            node.sdo[cia408.DEVICE_MODE].raw = cia408.BY_BUS
            node.sdo[cia408.CONTROL_MODE].raw = cia408.POSITION_OPEN_LOOP
        except self._canopen.SdoAbortedError as error:
            raise DeviceError(f"node {node.id} refused its configuration: {error}") from error
        except self._canopen.SdoCommunicationError as error:
            raise DeviceLost(
                f"no valve answers as node {node.id} at {self._port.where}: check wiring, node "
                f"numbers and that the bus runs at {self._settings.bitrate} bit/s"
            ) from error

    def _deliver(self, key: int, data: bytes) -> None:
        kind, number = key & ~0x7F, key & 0x7F
        if kind == cia408.HEARTBEAT_ID:
            self._heard.add(number)
            self._note_state(number, data[0] if data else cia408.BOOT_UP)
            return
        if kind == cia408.EMERGENCY_ID:
            code, register = int.from_bytes(data[:2], "little"), data[2:3].hex()
            logger.warning("valve %d: emergency 0x%04X, register 0x%s", number, code, register)
            return
        network = self._network
        if network is None:
            return
        network.notify(key, bytearray(data), time.time())
        with self._received:
            self._awaited_ids.discard(key)
            if not self._awaited_ids:
                self._received.notify_all()

    def _note_state(self, number: int, state: int) -> None:
        """Keep the state in a node's heartbeat: leaving operation is a fault, as is a restart."""
        if state == cia408.OPERATIONAL:
            self._operational.add(number)
        elif number in self._numbers and (state == cia408.BOOT_UP or number in self._operational):
            what = "has restarted" if state == cia408.BOOT_UP else f"is in NMT state {state}"
            self._node_fault = f"valve {number} {what}: look at its supply and its plug"

    def _heartbeat(self, *, force: bool = False) -> None:
        with self._beat:
            now = self._clock()
            if force or now - self._last_heartbeat > self._interval:
                state = bytes([cia408.OPERATIONAL])
                self._port.send(CanFrame(cia408.HEARTBEAT_ID + self._settings.host, state))
                self._last_heartbeat = now

    def _beat_at_zero(self, ended: threading.Event) -> None:
        """Send the heartbeat while all set points are zero, whatever else this program does.

        With a set point only the thread that serves the outputs sends it, so that a program that
        stands still sends none.
        """
        try:
            while not ended.wait(self._wire.watchdog / DRIVER.heartbeats):
                if self._at_zero:
                    self._heartbeat()
        except DeviceError as error:
            if not ended.is_set():
                self._idle_loss = str(error)

    def _send(self, volts: Array, word: int) -> None:
        for node, volt, joint in zip(self._nodes, volts, self._rig.joints, strict=True):
            pdo = node.rpdo[1]
            pdo[cia408.CONTROL_WORD].raw = int(word)
            share = float(volt) / joint.valve.command_range
            pdo[cia408.SET_POINT].raw = round(share * cia408.FULL_SCALE)
            self._port.send(CanFrame(pdo.cob_id, bytes(pdo.data)))

    def _value(self, name: str) -> float:
        kind, joint = ch.kind_of(name)
        sensor = self._rig.sensors.of(kind)
        if kind == ch.SPOOL:
            share = self._nodes[(joint or 1) - 1].tpdo[cia408.ACTUAL_VALUE].raw / cia408.FULL_SCALE
            return float(share * max(map(abs, sensor.range)))
        node, pdo, entry = self._mappings[name]
        raw = self._nodes[node].tpdo[pdo][entry].raw
        return float(decode_input(raw, *sensor.range, sensor.bits))

    def _usable(self) -> None:
        if not self._port.is_open:
            raise DeviceLost(self._idle_loss or f"the bus {self._port.where} is closed")
        if self._port.fault is not None:
            self._port.receive(0.0)


class CanOpen408Driver(PolledDriver):
    """`drivers.base.Driver` of valves of CiA 408; a valve's own fault is a latched trip."""

    settings: ClassVar[type[WireSettings]] = ValveBusSettings

    def __init__(self, wire: Wire, rig: Rig, **pacing: Unpack[Pacing]) -> None:
        self._valves = CanOpenValves(wire, rig, pacing.get("clock", time.monotonic))
        super().__init__(wire, rig, self._valves, **pacing)

    def connect(self) -> DeviceInfo:
        """Open the bus, zero the outputs; a fault in a valve stays until `reset`."""
        info = super().connect()
        self._latch_fault()
        return info

    def close_tripped(self) -> None:
        """Zero the outputs, then fall silent, so that each valve latches a fault; never raises."""
        self._make_safe()
        self._valves.close(tripped=True)
        self.close()

    def _reopened_at_zero(self) -> None:
        """Take the valves out of operation, whoever drives them, before anything is configured."""
        self._safely(self._valves.zero_beside_host)

    def _read_sample(self) -> tuple[Array, float]:
        """Read one sample; a valve's own fault is a trip at once."""
        sample = super()._read_sample()
        self._latch_fault()
        return sample

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws at one tick; refused while a valve is in a fault."""
        self._latch_fault()
        return super().apply(laws, restart=restart)

    def trip_cause(self) -> str | None:
        """Return why the outputs were zeroed without a command, None if they were not."""
        cause = super().trip_cause()
        self._latch_fault()
        return self._trip_cause or cause

    def reset(self) -> None:
        """Clear a latched trip, in the valves as well; only on a person's request."""
        self._safely(self._valves.read)  # to update the valves' states
        if self.trip_cause() is None:
            return
        self._zero_laws()
        self._safely(self._valves.reset)
        super().reset()

    def _latch_fault(self) -> None:
        fault = self._valves.fault()
        if fault is not None and self._trip_cause is None:
            self._zero_laws()
            self._trip_cause = fault


def _maps(pdo: Any, index: int) -> bool:
    return any(variable.index == index for variable in pdo)


def _eds(at: ValveBusSettings) -> tuple[str, str]:
    if at.eds is None:
        return cia408.shipped_eds(), "valve-408.eds (shipped)"
    try:
        return Path(at.eds).expanduser().read_text("utf-8", "replace"), at.eds
    except OSError as error:
        raise InputError(f"wire: eds: {at.eds}: {error.strerror}; expected an EDS file") from error
