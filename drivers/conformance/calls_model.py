"""Model a device under random calls: the law of every tick, and when outputs must be zero."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Final

from drivers.base import Array, DeviceError, OutputLaw, SampleBlock
from drivers.conformance.subject import HEALTHY, Subject
from drivers.conformance.trial import SETTLING, Playing, Trial, require_law
from drivers.conformance.watched import Watched, follows, require, rows_of

_PENDING: Final = -1  # a waveform's first tick is that of the next stream


class DeviceModel:
    """One sequence of calls on one fresh bench, and the expected samples after them."""

    def __init__(self, subject: Subject) -> None:
        self._open_bench = ExitStack()
        self.trial = Trial(subject, self._open_bench.enter_context(subject.make()))
        self.rig = self.trial.rig
        self.has_outputs = subject.capabilities.outputs
        self.driver: Watched = self.trial.driver()
        self.connected = False
        self._clear()

    def _clear(self) -> None:
        """Drop a session; the waveforms stored in the device are then unknown."""
        self.streaming = False
        self.tripped = False
        self.waves: dict[int, Array] = {}  # as uploaded, for the next apply
        self.last_block: SampleBlock | None = None
        self.first_block = False  # the next block is the first of its stream
        self.phase_known = False
        self.settling = 0  # blocks that may still contain the law before the last zero
        self.segments: list[tuple[int, Playing]] = [(0, self.trial.playing(self.trial.off()))]

    # -- calls ------------------------------------------------------------------------------

    def connect(self) -> None:
        """Connect, as in a new session."""
        self.trial.connected(self.driver)
        self._clear()
        self.connected = True
        self.tripped = self.driver.trip_cause() is not None
        self.trial.zero_at_device("after connect")

    def upload(self, joint: int, samples: int, seed: int = 0) -> None:
        """Upload a waveform; it acts from the next apply on."""
        wave = self.trial.wave(samples, seed=100 * seed + samples + joint)
        self.driver.upload(joint, wave)
        self.waves[joint] = wave

    def apply(self, numbers: list[tuple[float, float, float]], restart: bool) -> None:
        """Apply laws of (gain, bias, limit), the last two in parts of the subject's volts."""
        volts = self.trial.volts
        laws = [
            OutputLaw(gain=gain if j in self.waves else 0.0, bias=bias * volts, limit=limit * volts)
            for j, (gain, bias, limit) in enumerate(numbers)
        ]
        restart = restart or not self.phase_known
        if not self.has_outputs:
            laws = self.trial.off()
        elif self.tripped:
            driving = self.trial.driving()
            self.trial.refused("a driving law after a trip", lambda: self.driver.apply(driving))
            laws = self.trial.off()
        tick = self.driver.apply(laws, restart=restart)
        require(tick >= self._next_tick(), f"apply acts from tick {tick}, which was read before")
        origin = tick if restart else self.segments[-1][1].origin
        self.phase_known = True
        self.segments.append((tick, self.trial.playing(laws, dict(self.waves), origin)))

    def apply_impossible(self, value: float) -> None:
        """Apply a law that must be refused and change nothing."""
        laws = self.trial.law(bias=value)
        self.trial.refused(f"a bias of {value}", lambda: self.driver.apply(laws))

    def start(self) -> None:
        """Start a stream; waveforms begin at its first sample."""
        self.driver.start()
        self.streaming, self.first_block, self.phase_known = True, True, True
        self.segments = [(0, replace(self.segments[-1][1], origin=_PENDING))]

    def read(self) -> None:
        """Read a block and compare it with the model; without a stream expect an error."""
        if not self.streaming:
            self.trial.refused("read_block without a stream", self.driver.read_block)
            return
        self._compare(self.driver.read_block())

    def zero(self) -> None:
        """Zero the outputs."""
        self.driver.zero_outputs()
        self.segments = [(self._next_tick(), self.trial.playing(self.trial.off()))]
        self.settling = 0 if self.trial.claims.virtual_time else SETTLING
        self.waves.clear()  # the device may keep them or not
        self.phase_known = False
        self.trial.zero_at_device("after zero_outputs")

    def stop(self) -> None:
        """Stop the stream; where the host evaluates the laws they end with it."""
        self.driver.stop()
        self.streaming = False
        if self.trial.claims.host_timed:
            self.trial.zero_at_device("after stop")
            self.segments = [(self._next_tick(), self.trial.playing(self.trial.off()))]

    def reset(self) -> None:
        """Clear a trip, if there is one."""
        self.driver.reset()
        require(self.driver.trip_cause() is None, "a trip is left after reset")
        self.tripped = False

    def close(self) -> None:
        """Close the session."""
        self.driver.close()
        self.connected = False
        self.trial.zero_at_device("after close")

    def cut(self) -> None:
        """End the link, then check that calls report it and the outputs are zero."""
        self.trial.cut()
        if self.trial.bench.silence is not None:
            self.trial.bench.silence()
            self.trial.zero_at_device("after the end of the link")
        if self.streaming:
            self.trial.refused("read_block over an ended link", self.driver.read_block)
        self.driver.close()
        self.connected = False

    def silence(self) -> None:
        """Wait longer than the watchdog's time."""
        self.trial.silence()
        self.trial.zero_at_device("after a silence longer than the watchdog")
        self.close()

    def spoiled(self, fault: str, name: str) -> None:
        """Make one call while the wire damages answers; after an error zero outputs and close."""
        calls: dict[str, Callable[[], None]] = {
            "read": self.read,
            "start": self.start,
            "stop": self.stop,
            "zero": self.zero,
            "apply": lambda: self.apply([(1.0, 0.5, 0.8)] * self.trial.joints, True),
            "upload": lambda: self.upload(0, 61),
        }
        # Where an error is due anyway, the session may have ended with it.
        failed = self.tripped if name == "apply" else name == "read" and not self.streaming
        self.trial.spoil(fault)
        try:
            calls[name]()
        except DeviceError:
            failed = True
        finally:
            self.trial.spoil(HEALTHY)
        if failed:
            self.trial.zero_somehow(self.driver, f"{fault}: after an error of {name}")
        if failed or name == "zero":  # zeroing may have opened a new link, which ends the session
            self.close()

    def end(self) -> None:
        """Close everything; the outputs are then zero."""
        try:
            self.trial.end()
            self.trial.zero_at_device("after the last close")
        finally:
            self._open_bench.close()

    # -- expected samples -------------------------------------------------------------------

    def _next_tick(self) -> int:
        """Return the tick after the last sample read in this session."""
        return 0 if self.last_block is None else self.last_block.tick + len(self.last_block.data)

    def _compare(self, block: SampleBlock) -> None:
        if self.first_block:
            require(block.sequence == 0, f"a stream begins with block {block.sequence}")
            end = self._next_tick()
            require(block.tick >= end, f"a stream begins at tick {block.tick}, before {end}")
            self.segments = [
                (at, replace(p, origin=block.tick) if p.origin == _PENDING else p)
                for at, p in self.segments
            ]
        elif self.last_block is not None:
            follows(self.last_block, block)
        self.first_block, self.last_block = False, block
        if self.settling:
            self.settling -= 1
        elif self.has_outputs:
            self._follow_law(block)
        while len(self.segments) > 1 and self.segments[1][0] <= self._next_tick():
            self.segments.pop(0)

    def _follow_law(self, block: SampleBlock) -> None:
        """Require each row of a block to follow the law of its tick."""
        end_of_block = block.tick + len(block.data)
        ends = [*(tick for tick, _ in self.segments[1:]), end_of_block]
        for (first, playing), end in zip(self.segments, ends, strict=True):
            low, high = max(first, block.tick), min(end, end_of_block)
            if low < high:
                require_law(rows_of(block, low - block.tick, high - block.tick), playing, self.rig)
