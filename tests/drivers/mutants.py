"""Drivers and devices that are each wrong in one way a real one could be, and what notices it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.base import OFF, Array, DeviceError, DeviceInfo, DeviceLost, OutputLaw, SampleBlock
from tests.drivers.memory_bench import SAMPLES, MemoryDevice, MemoryDriver

# -- outputs left on ---------------------------------------------------------------------------


class CloseLeavesOutputsOn(MemoryDriver):
    def close(self) -> None:
        self.link.session = None


class ConnectLeavesOutputsOn(MemoryDriver):
    def connect(self) -> DeviceInfo:
        info = super().connect()
        on = [OutputLaw(bias=0.2, limit=1.0)] * len(self.rig.joints)
        self.ask(lambda device: setattr(device, "laws", on))
        return info


class ZeroKeepsBias(MemoryDevice):
    def zero(self) -> None:
        self.laws = [replace(law, gain=0.0, position_gain=0.0) for law in self.laws]


class ZeroKeepsPositionLaw(MemoryDevice):
    def zero(self) -> None:
        self.laws = [replace(law, gain=0.0, bias=0.0) for law in self.laws]


class ZeroForgetsLastJoint(MemoryDevice):
    def zero(self) -> None:
        self.laws[:-1] = [OFF] * (self.joints - 1)


class ZeroOnlyWhileStreaming(MemoryDevice):
    def zero(self) -> None:
        if self.streaming:
            super().zero()


class ZeroNeedsASession(MemoryDriver):
    def zero_outputs(self) -> None:
        self.ask(lambda device: device.zero())


class StartBringsLawsBack(MemoryDevice):
    kept: Sequence[OutputLaw] = ()

    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        self.kept = list(laws)
        return super().apply(laws, restart)

    def start(self) -> None:
        super().start()
        if self.kept and self.cause is None:
            self.laws = list(self.kept)


class UploadBringsLawsBack(MemoryDevice):
    before: Sequence[OutputLaw] = ()

    def zero(self) -> None:
        self.before = list(self.laws)
        super().zero()

    def upload(self, joint: int, wave: Array) -> None:
        super().upload(joint, wave)
        if self.before and self.cause is None and self.streaming:
            self.laws, self.before = list(self.before), ()


class ReconnectResumesLaws(MemoryDevice):
    """Keeps the laws of a session for the first stream of the next one."""

    kept: Sequence[OutputLaw] = ()
    ended = False

    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        self.kept = list(laws)
        return super().apply(laws, restart)

    def host_gone(self) -> None:
        super().host_gone()
        self.ended = True

    def start(self) -> None:
        super().start()
        if self.ended and self.kept and self.cause is None:
            self.laws, self.kept, self.ended = list(self.kept), (), False


class WatchdogNotSet(MemoryDriver):
    def set_watchdog(self, device: MemoryDevice) -> None:
        device.watchdog = None


class LostHostUnnoticed(MemoryDevice):
    def host_gone(self) -> None:
        self.stop()

    def host_silent(self) -> None:
        if self.streaming:
            super().host_silent()


# -- trips -------------------------------------------------------------------------------------


class ConnectClearsTrip(MemoryDriver):
    def connect(self) -> DeviceInfo:
        info = super().connect()
        self.reset()
        return info


class StartClearsTrip(MemoryDevice):
    def start(self) -> None:
        self.cause = None
        super().start()


class TripDoesNotLatch(MemoryDevice):
    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        self.cause = None
        return super().apply(laws, restart)


class TripUnmarked(MemoryDriver):
    def read_block(self) -> SampleBlock:
        return replace(super().read_block(), tripped=False)


class ResetResumesLaws(MemoryDevice):
    before: Sequence[OutputLaw] = ()

    def trip(self, why: str) -> None:
        self.before = list(self.laws)
        super().trip(why)

    def reset(self) -> None:
        if self.cause is not None and self.before:
            self.laws = list(self.before)
        super().reset()


class ResetStopsTheStream(MemoryDevice):
    def reset(self) -> None:
        super().reset()
        self.streaming = False


# -- samples -----------------------------------------------------------------------------------


class SwallowsLoss(MemoryDriver):
    """Returns the last block again where the device is lost."""

    last: SampleBlock | None = None

    def read_block(self) -> SampleBlock:
        try:
            self.last = super().read_block()
        except DeviceLost:
            if self.last is None:
                raise
        return self.last


class RepeatsUnderNewNumber(MemoryDriver):
    """Hands out every ninth block's samples as those of the one before."""

    kept: Array | None = None

    def read_block(self) -> SampleBlock:
        block = super().read_block()
        if block.sequence % 9 == 8 and self.kept is not None:
            return replace(block, data=self.kept)
        self.kept = block.data
        return block


class DropsUncounted(MemoryDriver):
    dropped = 0

    def start(self) -> None:
        super().start()
        self.dropped = 0

    def read_block(self) -> SampleBlock:
        block = super().read_block()
        if block.sequence == 7:
            self.dropped = 1
            block = super().read_block()
        return replace(block, sequence=block.sequence - self.dropped)


class LostAnswerIsLostBlock(MemoryDriver):
    """Acknowledges a block before it has arrived and numbers those that do."""

    counted = -1

    def start(self) -> None:
        super().start()
        self.counted = -1

    def read_block(self) -> SampleBlock:
        for _ in range(2):
            try:
                block = self.link.ask(self, lambda device: device.read(self.acknowledged))
            except TimeoutError:
                self.acknowledged += 1
                continue
            if block is None:
                raise DeviceError("the device does not stream")
            self.acknowledged = block.sequence
            self.counted += 1
            return replace(block, sequence=self.counted)
        self.link.end(self)
        raise DeviceLost("no answer")


class StaleBlockAfterRestart(MemoryDriver):
    """Reads a block ahead and hands it out in the stream after."""

    ahead: SampleBlock | None = None

    def read_block(self) -> SampleBlock:
        block, self.ahead = self.ahead, None
        return super().read_block() if block is None else block

    def start(self) -> None:
        try:
            self.ahead = super().read_block()
        except DeviceError:
            self.ahead = None
        super().start()


class MadeUpBlock(MemoryDriver):
    """Makes up a block of zeros where the device does not stream."""

    def read_block(self) -> SampleBlock:
        try:
            return super().read_block()
        except DeviceError as error:
            if "stream" not in str(error):
                raise
            data = np.zeros((SAMPLES, len(self.rig.recorded)))
            marks = np.zeros((SAMPLES, len(self.rig.channels)), dtype=np.bool_)
            return SampleBlock(0, 0, data, marks, 0, tripped=False)


class SequenceGoesOn(MemoryDevice):
    def start(self) -> None:
        number = self.sequence
        super().start()
        self.sequence = number


class ApplyTickOffByOne(MemoryDriver):
    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        return super().apply(laws, restart=restart) + 1


class BlockTickIsItsLast(MemoryDriver):
    def read_block(self) -> SampleBlock:
        block = super().read_block()
        return replace(block, tick=block.tick + SAMPLES - 1)


class SaturationMissing(MemoryDevice):
    def marks(self, data: Array) -> np.ndarray:
        return np.zeros_like(super().marks(data))


class SaturationOfWholeBench(MemoryDevice):
    def marks(self, data: Array) -> np.ndarray:
        found = super().marks(data)
        return np.repeat(found.any(axis=1, keepdims=True), found.shape[1], axis=1)


# -- laws and waveforms ------------------------------------------------------------------------


class RestartIgnored(MemoryDevice):
    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        return super().apply(laws, False)


class AlwaysRestarts(MemoryDevice):
    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        return super().apply(laws, True)


class StartKeepsPhase(MemoryDevice):
    def start(self) -> None:
        origin = self.origin
        super().start()
        self.origin = origin


class LimitIgnored(MemoryDevice):
    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        wide = [replace(law, limit=10.0) if law.limit else law for law in laws]
        return super().apply(wide, restart)


class LimitOfWaveformOnly(MemoryDevice):
    """Bounds the waveform and adds the bias afterwards."""

    def command(self, joint: int) -> float:
        law, wave = self.laws[joint], self.active[joint]
        if not law.gain:
            return super().command(joint)
        volts = law.gain * wave[(self.tick - self.origin) % len(wave)]
        return float(np.clip(volts, -law.limit, law.limit) + law.bias)


class LawsOfJointsSwapped(MemoryDevice):
    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        return super().apply(list(laws)[::-1], restart)


class UploadOverwritesFirst(MemoryDevice):
    def upload(self, joint: int, wave: Array) -> None:
        super().upload(0, wave)


class UploadActsAtOnce(MemoryDevice):
    def upload(self, joint: int, wave: Array) -> None:
        super().upload(joint, wave)
        self.active = list(self.waves)


class UploadNeedsRestart(MemoryDevice):
    """Takes a new waveform over only with a restart, not with any next law."""

    def apply(self, laws: Sequence[OutputLaw], restart: bool) -> int:
        before = self.active
        tick = super().apply(laws, restart)
        if not restart:
            self.active = before
        return tick


class LongWaveformCut(MemoryDevice):
    def upload(self, joint: int, wave: Array) -> None:
        super().upload(joint, wave[:2048])


class LawOfStoppedStreamLost(MemoryDevice):
    """A law that was applied while the stream was stopped is gone when it starts."""

    def start(self) -> None:
        if not self.streaming:
            self.laws = [OFF] * self.joints
        super().start()


class NanTakenForOff(MemoryDriver):
    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        known = [law if np.isfinite(law.bias) else OFF for law in laws]
        return super().apply(known, restart=restart)


class RefusedLawHalfActs(MemoryDriver):
    """Sends the laws one by one, those before the bad one included."""

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        try:
            return super().apply(laws, restart=restart)
        except DeviceError:
            self.ask(lambda device: device.laws.__setitem__(0, OFF))
            raise


class MissingLawsFilledUp(MemoryDriver):
    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        missing = len(self.rig.joints) - len(laws)
        return super().apply([*laws, *[OFF] * missing], restart=restart)


# -- errors and identity -----------------------------------------------------------------------


class RaisesValueError(MemoryDriver):
    def upload(self, joint: int, wave: Array) -> None:
        if not 0 <= joint < len(self.rig.joints):
            raise ValueError(f"no joint {joint + 1}")
        super().upload(joint, wave)


class RaisesTimeoutError(MemoryDriver):
    """Lets the transport's own OSError out of a call that has no second try."""

    def trip_cause(self) -> str | None:
        return self.link.ask(self, lambda device: device.cause)


class CloseRaises(MemoryDriver):
    def close(self) -> None:
        try:
            self.ask(lambda device: device.zero())
            self.ask(lambda device: device.stop())
        finally:
            self.link.end(self)


class OtherRigAccepted(MemoryDriver):
    def check_identity(self) -> None:
        self.ask(lambda device: device.rig)


@dataclass(frozen=True)
class Mutant:
    """A wrong driver or device."""

    wrong: type[MemoryDriver] | type[MemoryDevice]

    @property
    def driver(self) -> type[MemoryDriver]:
        """The driver to try."""
        return self.wrong if issubclass(self.wrong, MemoryDriver) else MemoryDriver

    @property
    def device(self) -> type[MemoryDevice]:
        """The device behind it."""
        return self.wrong if issubclass(self.wrong, MemoryDevice) else MemoryDevice
