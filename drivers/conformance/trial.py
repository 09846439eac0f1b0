"""Tools of a check: drivers of a fresh bench, requirements, the law that commands must follow.

The law is computed from the formula of `drivers.base`, independently of every driver.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import OFF, Array, DeviceError, DeviceLost, OutputLaw, SampleBlock
from drivers.conformance.subject import HEALTHY, DeviceUnderTest, Subject
from drivers.conformance.watched import NotConforming, Watched, follows, require, rows_of
from rig.model import channels as ch
from rig.model.rig import Rig

PATIENCE = 40  # tries of a call that needs the device to have detected the end of a link
PAUSE = 0.05  # [s] between them
SETTLING = 3  # blocks after zeroing that may still contain the previous law, in real time


@dataclass(frozen=True)
class Playing:
    """The law and waveform [V] of each joint; waveforms begin at tick `origin`."""

    laws: tuple[OutputLaw, ...]
    waves: tuple[Array, ...]
    origin: int = 0

    def volts(self, rig: Rig, ticks: NDArray[np.int64], data: Array) -> Array:
        """Return the commands [V] of the law at `ticks`, shape (n, joints)."""
        columns = []
        for joint, (law, wave) in enumerate(zip(self.laws, self.waves, strict=True)):
            command = law.gain * wave[(ticks - self.origin) % len(wave)] + law.bias
            if law.position_gain:
                at = data[:, rig.recorded.index(ch.channel(rig.position_kind, joint + 1))]
                command = command + law.position_gain * (law.setpoint - at)
            columns.append(np.clip(command, -law.limit, law.limit))
        return np.column_stack(columns)


def steps(rig: Rig) -> Array:
    """Return the step [V] of each joint's output converter, shape (joints,)."""
    valves = [joint.valve for joint in rig.joints]
    return np.array([v.command_range / ((1 << (v.command_bits - 1)) - 1) for v in valves])


def commands(block: SampleBlock, rig: Rig) -> Array:
    """Return the commands [V] in a block, shape (n, joints)."""
    return block.data[:, len(rig.channels) :]


def require_law(block: SampleBlock, playing: Playing, rig: Rig) -> None:
    """Require that every row of a block follows the law, to 1.1 steps of the converter."""
    ticks = block.tick + np.arange(len(block.data))
    expected, measured = playing.volts(rig, ticks, block.data), commands(block, rig)
    fits = np.abs(measured - expected) <= 1.1 * steps(rig) + 1e-9  # NaN never fits
    wrong = np.flatnonzero(~fits.all(axis=1))
    if len(wrong):
        row = int(wrong[0])
        raise NotConforming(
            f"at tick {ticks[row]} the commands are {in_volts(measured[row])}, "
            f"the law makes {in_volts(expected[row])}"
        )


def in_volts(values: Array) -> str:
    """Return voltages of all joints as text."""
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ") V"


class Trial:
    """One run of one check: a bench, and drivers that are closed at its end."""

    def __init__(self, subject: Subject, bench: DeviceUnderTest) -> None:
        self.subject = subject
        self.bench = bench
        self.rig = bench.rig
        self.claims = subject.capabilities
        self.volts = subject.volts
        self.joints = len(bench.rig.joints)
        self._drivers: list[Watched] = []

    def driver(self, rig: Rig | None = None) -> Watched:
        """Return an unconnected driver of the bench's rig or another one."""
        chosen = self.rig if rig is None else rig
        watched = Watched(self.bench.driver(chosen), chosen)
        self._drivers.append(watched)
        return watched

    def connected(self, driver: Watched | None = None) -> Watched:
        """Return a connected driver; waits while the device still serves the previous session."""
        device = self.driver() if driver is None else driver
        patiently(device.connect)
        return device

    def ready(self) -> Watched:
        """Return a connected driver of a device that is not tripped and streams."""
        driver = self.connected()
        if driver.trip_cause() is not None:
            driver.reset()
        driver.start()
        return driver

    def spoil(self, fault: str) -> None:
        """Make the wire apply `fault` from now on."""
        assert self.bench.spoil is not None
        self.bench.spoil(fault)

    def cut(self) -> None:
        """End the link as the death of the host's process does."""
        assert self.bench.cut is not None
        self.bench.cut()

    def silence(self) -> None:
        """Wait longer than the watchdog's time, without a message of the host."""
        assert self.bench.silence is not None
        self.bench.silence()

    def end(self) -> None:
        """Close every driver, the wire healthy again; raises nothing but NotConforming."""
        if self.bench.spoil is not None:
            self.bench.spoil(HEALTHY)
        for driver in self._drivers:
            driver.close()

    # -- laws -------------------------------------------------------------------------------

    def off(self) -> list[OutputLaw]:
        """Return laws that keep every output at zero."""
        return [OFF] * self.joints

    def law(self, joint: int = 0, **values: float) -> list[OutputLaw]:
        """Return laws of which one joint's has these values, bounded by the subject's volts."""
        laws = self.off()
        laws[joint] = OutputLaw(**{"limit": self.volts, **values})
        return laws

    def driving(self) -> list[OutputLaw]:
        """Return a law that puts out most of the subject's volts on every joint."""
        sign = [1.0 if joint % 2 == 0 else -1.0 for joint in range(self.joints)]
        return [OutputLaw(bias=s * 0.8 * self.volts, limit=self.volts) for s in sign]

    def playing(
        self, laws: Sequence[OutputLaw], waves: dict[int, Array] | None = None, origin: int = 0
    ) -> Playing:
        """Return the model of laws with the waveforms uploaded so far."""
        uploaded = waves or {}
        all_waves = tuple(uploaded.get(joint, np.zeros(1)) for joint in range(self.joints))
        return Playing(tuple(laws), all_waves, origin)

    def wave(self, samples: int = 97, seed: int = 1) -> Array:
        """Return a waveform [V] (samples,) of random values, so that its phase is unique."""
        return np.random.default_rng(seed).uniform(-self.volts, self.volts, samples)

    # -- requirements -----------------------------------------------------------------------

    def refused(self, what: str, call: Callable[[], object]) -> None:
        """Require that a call raises DeviceError."""
        try:
            call()
        except DeviceError:
            return
        raise NotConforming(f"not refused: {what}")

    def zero_at_device(self, when: str) -> None:
        """Require that the device's outputs are zero, where there is a probe."""
        if self.bench.outputs is None:
            return
        outputs = np.asarray(self.bench.outputs(), dtype=np.float64)
        require(not outputs.any(), f"{when} the device puts out {in_volts(outputs)}")

    def zero_in_stream(self, driver: Watched, when: str, *, soon: bool = False) -> None:
        """Require a block of zero commands; with `soon` older blocks may precede it."""
        block = driver.read_block()
        older = block.backlog + (0 if self.claims.virtual_time else SETTLING)
        for _ in range(older if soon else 0):
            if not commands(block, self.rig).any():
                return
            block = driver.read_block()
        outputs = commands(block, self.rig)
        wrong = np.flatnonzero(outputs.any(axis=1))
        if len(wrong):
            shown = in_volts(outputs[wrong[-1]])
            raise NotConforming(f"{when} the samples show commands of {shown}")

    def zero_somehow(self, driver: Watched, when: str) -> None:
        """Require that zeroing works within two calls."""
        for remaining in (1, 0):
            try:
                driver.zero_outputs()
            except DeviceError as error:
                require(remaining, f"{when} zero_outputs failed twice: {error}")
            else:
                break
        self.zero_at_device(f"{when} and after zero_outputs")

    def until_law(self, driver: Watched, playing: Playing, first: int, count: int) -> None:
        """Read until `count` blocks from tick `first` on follow the law; earlier ones need not."""
        before: SampleBlock | None = None
        followed = 0
        for _ in range(count + 50):
            block = driver.read_block()
            if before is not None:
                follows(before, block)
            before = block
            skip = max(0, first - block.tick)
            if skip < len(block.data):
                require_law(rows_of(block, skip), playing, self.rig)
                followed += 1
            if followed == count:
                return
        raise NotConforming(f"no block at or after tick {first}, from which the laws act")

    def restarted(
        self, driver: Watched, laws: Sequence[OutputLaw], waves: dict[int, Array], count: int = 2
    ) -> Playing:
        """Apply laws with restart, require that `count` blocks follow them; return what plays."""
        tick = driver.apply(laws, restart=True)
        playing = self.playing(laws, waves, tick)
        self.until_law(driver, playing, tick, count)
        return playing


def patiently(call: Callable[[], object]) -> None:
    """Repeat a call that a device refuses until it has detected the end of the previous link."""
    for remaining in reversed(range(PATIENCE)):
        try:
            call()
        except DeviceError:
            if not remaining:
                raise
            time.sleep(PAUSE)
        else:
            return


def loss_raised_by(call: Callable[[], object]) -> DeviceLost | None:
    """Return the DeviceLost that a call raises within three tries, None if it raises none."""
    for _ in range(3):
        try:
            call()
        except DeviceLost as error:
            return error
        except DeviceError:
            continue
    return None
