"""Simulated valves of CiA 408 on one bus: a node for each joint, in real time.

A node puts out its set point in state ACTIVE and zero in every other. Without the heartbeat of its
host for the time in object 0x1016 it goes to FAULT_DISABLED, and stays there until a reset.
"""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import canopen
import numpy as np

from hil_sim.device.can.adapters import Adapter
from hil_sim.device.laws import OFF
from hil_sim.device.lifetime import ParentProcess, termination_signals, while_served
from hil_sim.plant.interface import Law, PlantInterface
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.wire import cia408
from rig.model.wire.can_frames import CanFrame
from rig.model.wire.cia408 import ValveState
from rig.model.wire.codes import decode_input

logger = logging.getLogger(__name__)

POLL_SECONDS = 0.01  # longest wait for a frame between two advances of the plant
_LONGEST_STEP = 4.0  # [s] simulated at once; after a longer pause the clock skips the rest


class AdapterNetwork(canopen.Network):
    """A CANopen network whose frames go through an `Adapter`."""

    def __init__(self, adapter: Adapter) -> None:
        super().__init__()
        self._adapter = adapter

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame."""
        self._adapter.send([CanFrame(can_id, bytes(data))])


class ValveNode:
    """One valve: its object dictionary, state and supervision of the host's heartbeat."""

    def __init__(self, network: canopen.Network, number: int, clock: Callable[[], float]) -> None:
        eds: Any = io.StringIO(cia408.shipped_eds())
        eds.name = "valve-408.eds"
        self.state = ValveState.INIT
        self._control_word = 0
        self._clock = clock
        self._heartbeat: float | None = None
        # Every variable here is an integer, which the library's types do not state.
        self.node: Any = canopen.LocalNode(number, eds)
        node: Any = self.node
        network.add_node(node)
        node.tpdo.read(from_od=True)
        node.rpdo.read(from_od=True)
        node.rpdo.subscribe()
        node.rpdo[1].add_callback(self._commanded)
        node.add_write_callback(self._written)
        node.nmt.state = "PRE-OPERATIONAL"

    @property
    def set_point(self) -> float:
        """The effective set point [1]; 0 in every state but ACTIVE."""
        if self.state != ValveState.ACTIVE or self.node.nmt.state != "OPERATIONAL":
            return 0.0
        value = self.node.rpdo[1][1].raw / cia408.FULL_SCALE
        return float(np.clip(value, -1.0, 1.0))

    def heartbeat(self, producer: int) -> None:
        """Note a heartbeat of node `producer`."""
        if producer == self._consumed()[0]:
            self._heartbeat = self._clock()

    def watch(self) -> bool:
        """Go to FAULT_DISABLED if the host's heartbeat is overdue; return whether it did."""
        allowed = self._consumed()[1]
        if self._heartbeat is None or not allowed or self._clock() - self._heartbeat <= allowed:
            return False
        self._heartbeat = None
        self.state = ValveState.FAULT_DISABLED
        logger.warning("valve %d: the host's heartbeat is lost; outputs zero", self.node.id)
        return True

    def transmit(self, spool: float, sensors: Sequence[int]) -> None:
        """Send the synchronous TPDOs: spool as a share of its range, the sensors' codes."""
        if self.node.nmt.state != "OPERATIONAL":
            return
        tpdo = self.node.tpdo
        tpdo[1][0].raw = int(self.state)
        tpdo[1][1].raw = round(spool * cia408.FULL_SCALE)
        for position, code in enumerate(sensors):
            tpdo[2 + position // 3][position % 3].raw = code
        for number in (1, 2, 3):
            tpdo[number].transmit()

    def _consumed(self) -> tuple[int, float]:
        """Return the supervised host's node number and the time [s] allowed between heartbeats."""
        entry = self.node.sdo[cia408.CONSUMER_HEARTBEAT][1].raw
        return entry >> 16 & 0x7F, 1e-3 * (entry & 0xFFFF)

    def _commanded(self, pdo: Any) -> None:
        self._apply(pdo[0].raw)

    def _written(self, index: int, data: bytes, **_: object) -> None:
        if index == cia408.CONTROL_WORD:
            self._apply(int.from_bytes(data, "little"))
        elif index == cia408.CONSUMER_HEARTBEAT:
            self._heartbeat = None  # CiA 301: supervision begins with the next heartbeat

    def _apply(self, control_word: int) -> None:
        self.state = cia408.next_state(self.state, self._control_word, control_word)
        self._control_word = control_word


class ValveBench:
    """All valves of a rig with the plant; `volts` are the valves' outputs."""

    def __init__(
        self,
        rig: Rig,
        plant: PlantInterface,
        adapter: Adapter,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rig, self._plant, self._adapter, self._clock = rig, plant, adapter, clock
        self._network = AdapterNetwork(adapter)
        joints = range(1, len(rig.joints) + 1)
        self.valves = [ValveNode(self._network, number, self._clock) for number in joints]
        self._origin, self._first = self._clock(), plant.tick
        self._codes = np.zeros(len(rig.channels), dtype=np.int64)

    @property
    def volts(self) -> list[float]:
        """The outputs [V]."""
        pairs = zip(self.valves, self._rig.joints, strict=True)
        return [valve.set_point * joint.valve.command_range for valve, joint in pairs]

    def poll(self, timeout: float) -> None:
        """Receive frames for `timeout` [s] at most, run the plant, supervise the heartbeat."""
        for frame in self._adapter.receive(timeout):
            self._catch_up()
            if frame.identifier == cia408.SYNC_ID:
                self._transmit()
            elif frame.identifier >> 7 == cia408.HEARTBEAT_ID >> 7:
                for valve in self.valves:
                    valve.heartbeat(frame.identifier & 0x7F)
            else:
                self._network.notify(frame.identifier, bytearray(frame.data), time.time())
        self._catch_up()
        for valve in self.valves:
            valve.watch()

    def _catch_up(self) -> None:
        rate = self._rig.sample_rate
        due = int((self._clock() - self._origin) * rate) - (self._plant.tick - self._first)
        longest = int(_LONGEST_STEP * rate)
        if due > longest:
            self._origin += (due - longest) / rate
            due = longest
        if due > 0:
            laws = [Law(OFF.wave, bias=volts, limit=abs(volts)) for volts in self.volts]
            measured, _ = self._plant.advance(due, laws)
            self._codes = measured[-1]

    def _transmit(self) -> None:
        measured = self._rig.channels
        sensor = self._rig.sensors.spool
        for index, valve in enumerate(self.valves, start=1):
            code = self._codes[measured.index(ch.channel(ch.SPOOL, index))]
            spool = decode_input(code, *sensor.range, sensor.bits) / max(map(abs, sensor.range))
            channels = [ch.channel(kind, index) for kind in (ch.PISTON, ch.CAP, ch.ROD)]
            channels += [ch.SUPPLY, ch.TEMPERATURE]
            codes = [int(self._codes[measured.index(n)]) if n in measured else 0 for n in channels]
            valve.transmit(float(spool), codes)


def serve_valves(
    rig: Rig,
    plant: PlantInterface,
    adapter: Adapter,
    on_ready: Callable[[str], None],
    parent: ParentProcess | None,
) -> None:
    """Serve a plant behind valve nodes 1 to N until SIGTERM, SIGINT or the end of `parent`."""
    bench = ValveBench(rig, plant, adapter)
    try:
        with termination_signals() as ended:
            on_ready(adapter.endpoint.replace("can://", "canopen-408://", 1))
            for _ in while_served(ended, parent):
                bench.poll(POLL_SECONDS)
    finally:
        adapter.close()
