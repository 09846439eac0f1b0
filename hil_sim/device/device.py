"""The device behind the wire: sample clock, output laws, blocks, watchdog, control.

It is independent of Modbus: `hil_sim.device.register_map` maps addresses to its methods. Virtual
time: the plant advances by one block when the host reads and nothing is queued, and pauses
otherwise. Real time: the sample clock follows the wall clock.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from hil_sim.device.laws import LawTable, Refused
from hil_sim.device.queue import BlockQueue
from hil_sim.faults.device import ClockDrift, ClockJump, DeviceFault, QueueOverrun, Reboots
from hil_sim.plant.interface import Law, PlantInterface, Prefetch, Rewindable
from rig.model.parts import WATCHDOG_RANGE
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.codes import Codes
from rig.model.wire.registers import BlockHeader, Refusal, Status, TripCause

logger = logging.getLogger(__name__)

QUEUE_SECONDS = 4.0  # [s] of samples that the queue holds
SETTLE_SECONDS = 0.2  # [s] of virtual time with zero outputs after the host was lost
VIRTUAL_SILENCE = 10.0  # [s] least watchdog time in virtual time, which pauses between requests
POLL_SECONDS = 0.05  # [s] longest wait between two polls
WATCHDOG_RANGE_MS = (round(1e3 * WATCHDOG_RANGE[0]), round(1e3 * WATCHDOG_RANGE[1]))
_U32 = 0xFFFF_FFFF
# Integers, because every block needs them and an enumeration is slow.
_STREAMING, _TRIPPED = int(Status.STREAMING), int(Status.TRIPPED)
_ARMED, _CONTROLLED = int(Status.ARMED), int(Status.CONTROLLED)


class Device:
    """One bench: a plant with converters, a clock, laws, a queue and a watchdog.

    `client` arguments are any hashable that identifies a connection. Methods called by a client
    raise `Refused` where the device refuses. `faults` break the device while it runs; `on_restart`
    is called when it restarts, so that a server can end its connections.
    """

    def __init__(
        self,
        rig: Rig,
        plant: PlantInterface,
        *,
        realtime: bool,
        clock: Callable[[], float] = time.monotonic,
        virtual_silence: float = VIRTUAL_SILENCE,
        faults: Sequence[DeviceFault] = (),
    ) -> None:
        self.rig = rig
        self.realtime = realtime
        self.layout = reg.block_layout(len(rig.channels), len(rig.joints))
        self.on_restart: Callable[[], None] = lambda: None
        self._faults = sorted(faults, key=lambda fault: fault.at)
        self._virtual_silence = virtual_silence
        # In real time the plant is never ahead of the clock; faults may change it between blocks.
        prefetches = not realtime and not faults
        self._prefetch = Prefetch(plant) if prefetches and isinstance(plant, Rewindable) else None
        self._plant: PlantInterface = plant if self._prefetch is None else self._prefetch
        self._clock = clock
        self._last_request = self._last_poll = self._origin = clock()
        self._drift = 0.0  # relative error of the sample clock, positive if fast
        self._zero_tick = 0  # of the plant, at the device's tick 0
        self._first_tick = plant.tick
        self._restart_end = -math.inf  # [s] of the clock
        self._plant_failed = False
        self._power_up()

    def _power_up(self) -> None:
        rig = self.rig
        self.laws = LawTable(rig)
        blocks = max(2, round(QUEUE_SECONDS * rig.sample_rate / self.layout.samples))
        self.queue = BlockQueue(self.layout, blocks)
        self.outputs = np.zeros(len(rig.joints), dtype=np.int64)
        self.cause = TripCause.NONE
        self.trip_tick = 0
        self.apply_tick = 0
        self.streaming = False
        self.heartbeat = 0
        self.acknowledged = 0
        self.watchdog_ms = int(np.clip(round(rig.wire.watchdog * 1e3), *WATCHDOG_RANGE_MS))
        self._controller: object | None = None

    # -- requests of a client --------------------------------------------------------------

    @property
    def tick(self) -> int:
        """Samples measured so far, by the device's counter."""
        return self._plant.tick - self._zero_tick

    @property
    def restarting(self) -> bool:
        """Whether the device is restarting and does not answer."""
        return self._clock() < self._restart_end

    @property
    def status(self) -> Status:
        """The status bits, without BLOCK."""
        return Status(
            _STREAMING * self.streaming
            + _TRIPPED * (self.cause != TripCause.NONE)
            + _ARMED * self.laws.armed
            + _CONTROLLED * (self._controller is not None)
        )

    def take_control(self, client: object) -> None:
        """Give `client` control, also as a heartbeat; refused while another client has it."""
        if self._controller is None:
            self._controller = client
        elif self._controller is not client:
            raise Refused(Refusal.NOT_IN_CONTROL)
        self._last_request = self._clock()

    def beat(self, client: object, heartbeat: int) -> None:
        """Reset the watchdog if the heartbeat changed, since a repeating host may hang."""
        previous_request = self._last_request
        self.take_control(client)
        if heartbeat == self.heartbeat:
            self._last_request = previous_request
        self.heartbeat = heartbeat

    def set_watchdog(self, milliseconds: int) -> None:
        """Set the time without heartbeat after which the outputs are zeroed."""
        low, high = WATCHDOG_RANGE_MS
        if not low <= milliseconds <= high:
            raise Refused(Refusal.OUT_OF_RANGE)
        self.watchdog_ms = milliseconds

    def zero(self) -> None:
        """Zero all outputs now; any client may, at any time."""
        self.catch_up()
        self.laws.zero()
        self.outputs[:] = 0

    def apply(self, *, restart: bool) -> None:
        """Apply the staged laws from the next sample on."""
        if self.cause != TripCause.NONE and self.laws.would_arm():
            raise Refused(Refusal.TRIPPED)
        self.catch_up()
        self.apply_tick = self.tick
        self.laws.apply(self._plant.tick, restart=restart)

    def start(self) -> None:
        """Stream from the next sample on, numbered from 0, waveforms at their first sample."""
        self.catch_up()
        self.queue.clear()
        self.laws.restart(self._plant.tick)
        self.streaming = True

    def stop(self) -> None:
        """Stop streaming and drop what is queued."""
        self.streaming = False
        self.queue.clear()

    def reset(self) -> None:
        """Clear a latched trip; the outputs stay zero until laws are applied again."""
        if self._plant_failed:
            raise Refused(Refusal.FAULT)
        self.cause = TripCause.NONE

    def acknowledge(self, sequence: int) -> None:
        """Release the block that the host has received."""
        self.acknowledged = sequence
        self.queue.acknowledge(sequence)

    def read_block(self, client: object) -> bytes:
        """Return the oldest block with its header, only a header with zeros if there is none."""
        if client is not self._controller:
            raise Refused(Refusal.NOT_IN_CONTROL)
        self.measure_ahead()
        block = self.queue.offer()
        if block is None:
            header = BlockHeader(0, self.tick & _U32, self.status, 0)
            return reg.pack_header(header).ljust(2 * self.layout.words, b"\0")
        header = BlockHeader(
            block.sequence, block.tick & _U32, self.status | Status.BLOCK, len(self.queue) - 1
        )
        return reg.pack_header(header) + block.samples

    def measure_ahead(self) -> None:
        """Measure what the host may read: up to the present, or one block in virtual time."""
        self.catch_up()
        if not self.realtime and self.streaming and not len(self.queue):
            self._run(self.layout.samples)

    def prefetch(self) -> None:
        """Compute in idle time what the host will most likely read next.

        It has no effect until it is read, and is discarded at a change of laws.
        """
        if self._prefetch is not None and self.streaming and not self._plant_failed:
            self._prefetch.prefetch(self.layout.samples, self.laws.active)

    # -- actions without a request -------------------------------------------------------------

    def disconnected(self, client: object) -> None:
        """Handle the end of a connection; without its controller the device zeroes its outputs."""
        if client is not self._controller:
            return
        self._controller = None
        if self.streaming or self.laws.armed:
            self.trip(TripCause.HOST_LOST)
            self.stop()
            with suppress(Refused):
                self._settle()

    def idle_seconds(self) -> float:
        """Return how long `poll` may wait: until the block being filled is due."""
        if not self.realtime or self._plant_failed:
            return POLL_SECONDS
        samples = self._plant.tick - self._first_tick + self.queue.room
        due = self._origin + samples / self._rate - self._clock()
        return min(max(due, 0.0), POLL_SECONDS)

    def poll(self) -> None:
        """Do everything due by the clock; to be called again after `idle_seconds`."""
        now = self._clock()
        pause, self._last_poll = now - self._last_poll, now
        if pause > 2 * POLL_SECONDS:
            # While the device itself was paused the host does not count as silent.
            self._last_request += pause
        with suppress(Refused):  # a fault, already tripped and logged
            self.catch_up()
            if self._controller is not None and now - self._last_request > self._silence_allowed():
                self._controller = None
                if self.streaming or self.laws.armed:
                    self.trip(TripCause.WATCHDOG)
                    self._settle()

    def trip(self, cause: TripCause) -> None:
        """Zero the outputs and latch the cause; the first cause stays until reset."""
        self.laws.zero()
        self.outputs[:] = 0
        if self.cause == TripCause.NONE:
            self.cause = cause
            self.trip_tick = self.tick
            logger.warning("tripped at tick %d: %s", self.tick, reg.TRIP_TEXT[cause])

    def catch_up(self) -> None:
        """Run the plant up to the present, in real time only."""
        if not self.realtime or self._plant_failed:
            return
        rate = self._rate
        # A millionth of a sample early, so that rounding does not delay a sample that is due.
        elapsed = int((self._clock() - self._origin) * rate + 1e-6)
        due = elapsed - (self._plant.tick - self._first_tick)
        longest = int(QUEUE_SECONDS * rate)
        if due > longest:
            # The computer was suspended: the device's clock pauses instead of catching up hours.
            self._origin += (due - longest) / rate
            due = longest
        self._run(due)

    def restart(self, boot: float) -> None:
        """Lose all state as at power-on, and do not answer for `boot` [s]."""
        logger.warning("restarts at tick %d", self.tick)
        self._power_up()
        self._zero_tick = self._plant.tick
        self._restart_end = self._clock() + boot
        self.on_restart()

    @property
    def _rate(self) -> float:
        """The actual sample rate of the device [1/s]."""
        return self.rig.sample_rate * (1.0 + self._drift)

    def _begin_faults(self) -> None:
        now = self._plant.tick / self.rig.sample_rate
        while self._faults and self._faults[0].at <= now:
            fault = self._faults.pop(0)
            if isinstance(fault, Reboots):
                self.restart(fault.boot)
            elif isinstance(fault, ClockJump):
                self._zero_tick -= round(fault.step * self.rig.sample_rate)
            elif isinstance(fault, QueueOverrun):
                self.queue.lose_next(fault.blocks)
            elif isinstance(fault, ClockDrift):
                # From now on; earlier samples are unchanged.
                self._origin, self._first_tick = self._clock(), self._plant.tick
                self._drift = fault.rate
                if fault.until is not None:
                    end = fault.model_copy(update={"at": fault.until, "until": None, "rate": 0.0})
                    self._faults = sorted([*self._faults, end], key=lambda entry: entry.at)

    def _silence_allowed(self) -> float:
        seconds = self.watchdog_ms * 1e-3
        return seconds if self.realtime else max(seconds, self._virtual_silence)

    def _settle(self) -> None:
        if not self.realtime:
            self._run(round(SETTLE_SECONDS * self.rig.sample_rate))

    def _run(self, ticks: int) -> None:
        while ticks > 0:
            if self.queue.room == self.layout.samples:
                self._begin_faults()
            count = min(ticks, self.queue.room)
            tick = self.tick
            measured, commands = self._advance(count, self.laws.active)
            self.outputs = commands[-1].copy()
            if self.streaming:
                self.queue.add(tick, measured, commands)
            ticks -= count

    def _advance(self, count: int, laws: tuple[Law, ...]) -> tuple[Codes, Codes]:
        if self._plant_failed:
            raise Refused(Refusal.FAULT)
        try:
            return self._plant.advance(count, laws)
        except Exception as error:
            # Any error in the plant counts as a fault of the bench.
            self._plant_failed = True
            self.trip(TripCause.FAULT)
            logger.exception("the plant failed at tick %d", self.tick)
            raise Refused(Refusal.FAULT) from error
