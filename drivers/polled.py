"""A bench without a sample clock: waveforms, position loop and limits run here, at the host's rate.

Glossary: a *tick* is a time k / sample_rate since the first connect; to *serve* a tick is to read
the inputs, evaluate the output laws and write the outputs; the device's *silence* is the time
since its outputs were last written.

The law of tick k is that of `drivers.base`, with the position s read in that tick. A late host
serves the newest due tick, so that waveforms keep their phase; skipped ticks are interpolated or
missing (`rig.model.wire.resample`). The command of a row is the voltage put out in its tick or, for
a skipped tick, the one held then.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Protocol, TypedDict, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.base import (
    ActiveLaw,
    Array,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    SampleBlock,
    WireSettings,
    possible_laws,
    possible_wave,
)
from drivers.settings import DRIVER
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.units import plain
from rig.model.wire.resample import LONGEST, Resampler, Row

logger = logging.getLogger(__name__)
Result = TypeVar("Result")


class InputsOutputs(Protocol):
    """A device that only reads and writes: the interface to implement for a new one.

    Every method may raise DeviceLost (it does not answer) or DeviceError (invalid answer, or
    refusal); an OSError counts as lost, any other exception as an error of the device.
    """

    @property
    def watchdog(self) -> float | None:
        """Seconds without a write after which the device zeroes its outputs; None: never."""

    def open(self) -> str:
        """Open the device and set its watchdog; return its identity. May be called again."""

    def read(self) -> Array:
        """Return one sample of every channel [SI], shape (channels,), ordered as Rig.channels."""

    def write(self, volts: Array) -> None:
        """Put out voltages [V], shape (joints,), at once; it also feeds the device's watchdog."""

    def close(self) -> None:
        """Close the device; closing twice does nothing."""


@runtime_checkable
class ZeroesBesideHost(Protocol):
    """A device whose outputs can be put to zero although it cannot be opened.

    Another host may drive them, or a watchdog may be missing.
    """

    def zero_beside_host(self) -> None:
        """Put every output to zero and end the other host's control; closes the device.

        Raises DeviceLost if the device does not confirm it.
        """


@dataclass(frozen=True)
class Timing:
    """Counts of the ticks that a host has served, late or not, since connecting.

    `served` ticks were read and written, `late` of them more than half a period after their time,
    the worst by `worst` [s]; `missing` ticks are in no block.
    """

    served: int = 0
    late: int = 0
    missing: int = 0
    worst: float = 0.0


class Pacing(TypedDict, total=False):
    """The clock [s] and the wait [s] of a host that paces samples, to be replaced in tests."""

    clock: Callable[[], float]
    sleep: Callable[[float], None]


class PolledDriver:
    """`drivers.base.Driver` over an `InputsOutputs`; see there for each call.

    Only `read_block` serves ticks: between two calls the outputs hold their voltage. After a pause
    longer than `wire.watchdog` (or the device's own watchdog), the next tick zeroes the outputs and
    latches a trip. `clock` [s] and `sleep` [s] may be replaced in tests. Raises InputError for a
    rig it cannot run, or a device that does not zero its outputs by itself, unless
    `accept_no_watchdog`.
    """

    settings: ClassVar[type[WireSettings]] = WireSettings
    host_timed: ClassVar[bool] = True

    def __init__(
        self,
        wire: Wire,
        rig: Rig,
        device: InputsOutputs,
        *,
        accept_no_watchdog: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if rig.electric:
            raise InputError(
                f"wire: kind: {wire.kind} puts out valve voltages; rig {rig.name!r} has electric "
                "joints"
            )
        self._silence_allowed = _silence_allowed(wire, rig, device.watchdog, accept_no_watchdog)
        self._wire, self._rig, self._device = wire, rig, device
        self._clock, self._sleep = clock, sleep
        samples = max(1, round(DRIVER.block_seconds * rig.sample_rate))
        self._block_samples = min(DRIVER.block_samples, samples)
        sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
        low, high = np.array([sensor.range for sensor in sensors], dtype=np.float64).T
        rounding = DRIVER.rounding * (high - low)
        self._low, self._high = low + rounding, high - rounding
        self._positions = [
            rig.channels.index(ch.channel(rig.position_kind, i + 1)) for i in range(len(rig.joints))
        ]
        self._uploaded: list[Array] = [np.zeros(1) for _ in rig.joints]
        self._laws = [ActiveLaw(wave=wave) for wave in self._uploaded]
        self._resampler = Resampler()
        self._rows: deque[tuple[Row, Array, float]] = deque()
        self._origin: float | None = None
        self._open = self._streaming = False
        self._sequence = 0
        self._block_end: int | None = None  # tick after the last block of the stream
        self._last = -1  # newest tick that was served or is in a row
        self._volts = np.zeros(len(rig.joints))
        self._written = 0.0
        self._trip_cause: str | None = None
        self._lost_cause: str | None = None  # why the device was lost, until it is reopened
        self._timing = Timing()

    @property
    def timing(self) -> Timing:
        """Counts of ticks served, late and missing so far."""
        return replace(self._timing, missing=self._resampler.missing)

    @property
    def lacks_watchdog(self) -> bool:
        """Whether nothing zeroes the outputs when the host or the wire fails."""
        return self._device.watchdog is None

    # -- session ----------------------------------------------------------------------------

    def connect(self) -> DeviceInfo:
        """Open the device, zero its outputs, and check that it is fast enough for the rig."""
        self._zero_laws()
        self._streaming = False
        identity = self._safely(self._device.open)
        self._open, self._lost_cause = True, None
        try:
            self._write(self._volts)
            self._check_speed()
        except BaseException:
            self._close_device()
            raise
        if self._device.watchdog is None:
            logger.warning(
                "%s does not zero its outputs by itself: if this program or the wire fails, the "
                "valves stay where they are; keep the emergency stop within reach",
                identity,
            )
        if self._origin is None:
            self._origin = self._clock()
        return DeviceInfo.of(self._rig, identity, self._block_samples, virtual_time=False)

    def close(self) -> None:
        """Zero the outputs if the device still answers, then close; never raises."""
        self._zero_laws()
        self._streaming = False
        try:
            if self._open:
                self._write(self._volts)
        except DeviceError as error:
            logger.debug("while closing: %s", error)
        finally:
            self._close_device()
        timing = self.timing
        if timing.served:
            logger.info(
                "%d ticks served, %d late by more than half a period, worst %.3g ms; %d missing",
                timing.served,
                timing.late,
                timing.worst * 1e3,
                timing.missing,
            )

    def zero_outputs(self) -> None:
        """Put every output to zero now, and keep them so; reopens the device if need be."""
        self._zero_laws()
        if self._open:
            try:
                self._write(self._volts)
            except DeviceError as error:
                logger.warning("zeroing needs a second try: %s", error)
            else:
                return
        self._streaming = False
        self._close_device()
        self._reopened_at_zero()

    def _reopened_at_zero(self) -> None:
        """Open the device and put its outputs to zero; beside another host without opening it."""
        try:
            self._safely(self._device.open)
        except DeviceError as error:
            if not isinstance(self._device, ZeroesBesideHost):
                raise
            self._safely(self._device.zero_beside_host)
            if not isinstance(error, DeviceBusy):
                logger.warning("the outputs are at zero, but the device cannot be used: %s", error)
            return
        self._open, self._lost_cause = True, None
        try:
            self._write(self._volts)
        except DeviceError:
            self._close_device()
            raise

    def trip_cause(self) -> str | None:
        """Return why the driver has zeroed the outputs, None if it has not."""
        self._require_open()
        if self._streaming:
            self._trip_on_silence()
        return self._trip_cause

    def reset(self) -> None:
        """Clear a latched trip; only on a person's request."""
        if self._trip_cause is not None:
            self._trip_cause = None
            self._written = self._clock()  # the pause that caused the trip is over

    # -- outputs ----------------------------------------------------------------------------

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of joint `joint`'s (0-based) waveform [V]; it acts from `apply` on."""
        self._require_open()
        self._uploaded[joint] = possible_wave(joint, wave, self._rig)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws at one tick; `restart` starts the waveforms there. Returns that tick."""
        self._require_open()
        if self._streaming:
            self._trip_on_silence()
        laws = possible_laws(laws, self._rig)
        if self._trip_cause is not None and any(law.limit > 0.0 for law in laws):
            raise DeviceError(f"tripped: {self._trip_cause}; find the cause, then reset it")
        tick = self._next_tick()
        starts = [tick if restart else law.start for law in self._laws]
        self._laws = [
            ActiveLaw(**asdict(law), wave=wave, start=start)
            for wave, start, law in zip(self._uploaded, starts, laws, strict=True)
        ]
        return tick

    # -- samples ----------------------------------------------------------------------------

    def start(self) -> None:
        """Start serving ticks, with new block numbers and waveforms from their beginning."""
        self._require_open()
        self._rows.clear()
        self._resampler.restart()
        self._sequence, self._block_end = 0, None
        self._written = self._clock()
        self._last = max(self._last, math.floor(self._periods(self._written) + DRIVER.early))
        self._laws = [replace(law, start=self._last + 1) for law in self._laws]
        values, at = self._read_sample()  # sample from which the first tick is interpolated
        self._resampler.add(at, values, self._saturated(values))
        self._streaming = True

    def stop(self) -> None:
        """Stop serving ticks and zero the outputs, because no law is evaluated then."""
        self._require_open()
        self._streaming = False
        self._rows.clear()
        self._zero_laws()
        self._write(self._volts)

    def read_block(self) -> SampleBlock:
        """Serve ticks until a block is full or a gap ends it, and return it.

        Raises DeviceLost or DeviceError, with the outputs zeroed if the device still accepts
        writes.
        """
        if not self._streaming:
            if self._lost_cause is not None:
                raise DeviceLost(self._lost_cause)
            raise DeviceError(f"the device of wire {self._wire.kind} is not started; start it")
        longest = self._wire.timeout + self._block_samples / self._rig.sample_rate
        longest += self._silence_allowed
        deadline, cause = self._clock() + longest, self._trip_cause
        try:
            while (block := self._block(full=self._clock() <= deadline)) is None:
                if self._clock() > deadline:
                    self._trip_on_silence()
                    if self._trip_cause == cause:
                        raise DeviceError(
                            f"no two samples of wire {self._wire.kind} came within {LONGEST:g} "
                            f"periods of {self._rig.sample_rate:g} Hz; lower the rig's sample_rate"
                        )
                    # This host stood still, not the device: the next block must report the trip.
                    deadline, cause = self._clock() + longest, self._trip_cause
                self._serve()
        except BaseException:
            self._make_safe()
            raise
        return block

    # -- inside -----------------------------------------------------------------------------

    def _serve(self) -> None:
        """Wait for the next tick; read, evaluate the laws, write; append the resulting rows."""
        self._trip_on_silence()
        tick = self._wait()
        values, at = self._read_sample()
        self._trip_on_silence()
        held, self._volts = self._volts, self._outputs(tick, values[self._positions])
        self._write(self._volts)
        lateness = at - tick
        read_at = at / self._rig.sample_rate
        for row in self._resampler.add(at, values, self._saturated(values)):
            commands = self._volts if row.tick == tick else held
            self._rows.append((row, commands, read_at if row.tick == tick else math.nan))
            self._last = row.tick
        self._last = max(self._last, tick)
        old = self._timing
        self._timing = replace(
            old,
            served=old.served + 1,
            late=old.late + (lateness > DRIVER.late),
            worst=max(old.worst, lateness / self._rig.sample_rate),
        )

    def _block(self, *, full: bool) -> SampleBlock | None:
        """Return the oldest rows as a block; with `full` None if incomplete without a gap."""
        rows = self._rows
        count = 0
        for row, _, _ in rows:
            if count == self._block_samples or row.tick != rows[0][0].tick + count:
                break
            count += 1
        if count == 0 or (full and count < self._block_samples and count == len(rows)):
            return None
        selected = [rows.popleft() for _ in range(count)]
        first = selected[0][0].tick
        if self._block_end is not None and first > self._block_end:
            self._sequence += 1  # a gap counts as one block
        self._block_end = first + count
        block = SampleBlock(
            sequence=self._sequence,
            tick=first,
            data=np.array([np.concatenate((row.values, volts)) for row, volts, _ in selected]),
            saturated=np.array([row.saturated for row, _, _ in selected]),
            backlog=0,
            tripped=self._trip_cause is not None,
            read_at=np.array([at for _, _, at in selected]),
        )
        self._sequence += 1
        return block

    def _periods(self, now: float) -> float:
        """Return the time `now` [s] of the clock in periods since tick 0."""
        origin = now if self._origin is None else self._origin
        return (now - origin) * self._rig.sample_rate

    def _next_tick(self) -> int:
        """Return the tick to serve next: the newest due one, never one already in a row."""
        due = math.floor(self._periods(self._clock()) + DRIVER.early)
        return max(self._last + 1, due)

    def _wait(self) -> int:
        while True:
            tick = self._next_tick()
            ahead = tick - self._periods(self._clock())
            if ahead <= DRIVER.early:
                return tick
            self._sleep(ahead / self._rig.sample_rate)

    def _read_sample(self) -> tuple[Array, float]:
        """Read one sample; return it with its time [periods], the middle of the reading."""
        before = self._clock()
        values = np.asarray(self._safely(self._device.read), dtype=np.float64)
        after = self._clock()
        shape = (len(self._rig.channels),)
        if values.shape != shape:
            raise DeviceError(
                f"a sample of shape {values.shape} came, expected {shape}: one value for each of "
                f"{' '.join(self._rig.channels)}"
            )
        return values, self._periods((before + after) / 2)

    def _saturated(self, values: Array) -> NDArray[np.bool_]:
        marks: NDArray[np.bool_] = (values <= self._low) | (values >= self._high)
        return marks

    def _outputs(self, tick: int, positions: Array) -> Array:
        """Return the outputs (joints,) [V] at a tick; zero for a joint whose position is NaN."""
        return np.array(
            [
                law.volts(tick, position) if math.isfinite(position) else 0.0
                for law, position in zip(self._laws, positions, strict=True)
            ]
        )

    def _write(self, volts: Array) -> None:
        self._safely(lambda: self._device.write(volts.copy()))
        self._written = self._clock()

    def _trip_on_silence(self) -> None:
        """Zero the outputs and trip if they were not written within the watchdog's time."""
        silence = self._clock() - self._written
        if silence <= self._silence_allowed:
            return
        self._zero_laws()
        if self._trip_cause is None:
            self._trip_cause = (
                f"watchdog: the host did not serve the outputs for {silence:.3g} s, allowed "
                f"{self._silence_allowed:g} s (before sample {self._next_tick()})"
            )
            logger.warning("%s", self._trip_cause)
        self._write(self._volts)

    def _check_speed(self) -> None:
        period = 1.0 / self._rig.sample_rate
        fastest = math.inf
        for _ in range(DRIVER.trials):
            before = self._clock()
            self._read_sample()
            self._write(self._volts)
            fastest = min(fastest, self._clock() - before)
        if fastest > period:
            raise DeviceError(
                f"one reading and writing takes {fastest * 1e3:.3g} ms, but the rig's sample_rate "
                f"of {self._rig.sample_rate:g} Hz leaves {period * 1e3:.3g} ms; lower it to "
                f"{plain(0.5 / fastest, 3)} Hz or less"
            )

    def _zero_laws(self) -> None:
        self._laws = [ActiveLaw(wave=law.wave, start=law.start) for law in self._laws]
        self._volts = np.zeros(len(self._rig.joints))

    def _make_safe(self) -> None:
        """Drop all laws and try once to zero the outputs, after a failed tick."""
        self._zero_laws()
        self._streaming = False
        if self._open:
            with suppress(DeviceError):
                self._write(self._volts)

    def _require_open(self) -> None:
        if not self._open or self._origin is None:
            raise DeviceLost(
                self._lost_cause or f"the device of wire {self._wire.kind} is closed; connect first"
            )

    def _close_device(self) -> None:
        self._open = False
        try:
            self._device.close()
        except Exception as error:  # a device that fails while closing counts as closed
            logger.debug("while closing: %s", error)

    def _safely(self, call: Callable[[], Result]) -> Result:
        """Call the device; raises only DeviceLost and DeviceError."""
        try:
            return call()
        except DeviceLost as error:
            self._lost_cause = str(error)
            raise
        except DeviceError:
            raise
        except OSError as error:
            self._lost_cause = f"the device of wire {self._wire.kind} is gone: {error}"
            raise DeviceLost(self._lost_cause) from error
        except (Exception, SystemExit) as error:  # a library's sys.exit() would end a run as done
            raise DeviceError(
                f"the device of wire {self._wire.kind} failed: {type(error).__name__}: {error}"
            ) from error


def _silence_allowed(wire: Wire, rig: Rig, watchdog: float | None, accepted: bool) -> float:
    """Return the longest pause [s] before outputs are zeroed; raises InputError if unsuitable."""
    if watchdog is None and not accepted:
        raise InputError(
            f"wire: zero_by: the device of wire {wire.kind} does not zero its outputs when the "
            "host falls silent; name its watchdog, or say accept_no_watchdog: true"
        )
    if watchdog is not None and watchdog > wire.watchdog:
        raise InputError(
            f"wire: zero_by: the device zeroes its outputs after {watchdog:g} s, wire.watchdog "
            f"promises {wire.watchdog:g} s; shorten the one or lengthen the other"
        )
    allowed = wire.watchdog if watchdog is None else watchdog
    least = DRIVER.silent_periods / rig.sample_rate
    if allowed < least:
        raise InputError(
            f"wire: watchdog: {allowed:g} s is shorter than {DRIVER.silent_periods} sample periods "
            f"({least:g} s); outputs are written once a period"
        )
    return allowed
