"""A driver whose outputs are zeroed before any error of a call is raised; proof that they are."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from drivers.base import (
    DeviceError,
    DeviceInfo,
    DeviceLost,
    Driver,
    LatchesTrip,
    OutputLaw,
    SampleBlock,
    zeroed_without_host,
)
from rig.bench.settings import BENCH
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed

log = logging.getLogger(__name__)
Result = TypeVar("Result")

UNSURE: Final = "outputs not confirmed at zero"


def zero_patiently(driver: Driver) -> None:
    """Zero the outputs; a device that refuses, as a busy one does, is asked again for a while.

    Raises DeviceLost at once, the last refusal (DeviceError) after `BENCH.zero_patience`.
    """
    deadline = time.monotonic() + BENCH.zero_patience
    while True:
        try:
            return driver.zero_outputs()
        except DeviceError as error:
            if isinstance(error, DeviceLost) or time.monotonic() > deadline:
                raise
        time.sleep(BENCH.zero_pause)


class Outputs:
    """The outputs of one device: zeroing them, and a wrapper for every other call."""

    def __init__(self, rig: Rig, driver: Driver) -> None:
        self.driver = driver
        self._rig = rig
        self._connected = False  # whether the device has answered, so that its outputs may not be 0
        self._at_zero = True  # no device has answered yet, or the last one has confirmed zero
        self._silent = False
        self._logged = False  # whether an unconfirmed zero has been logged
        self._armed_from: int | None = None  # tick from which on a law may output a voltage

    def connect(self) -> DeviceInfo:
        """Open the wire, compare device and rig, zero the outputs; raises DeviceError."""
        info = self.driver.connect()
        self._connected, self._at_zero = True, False
        self.driver.zero_outputs()
        self._at_zero = True
        for quantity, found, expected in (
            ("joints", info.joints, len(self._rig.joints)),
            ("measured channels", info.channels, len(self._rig.channels)),
            ("samples a second", info.sample_rate, self._rig.sample_rate),
        ):
            if found != expected:
                raise DeviceError(
                    f"the device {info.identity!r} has {found:g} {quantity}, "
                    f"rig {self._rig.name!r} has {expected:g}; use the rig file of this device"
                )
        return info

    def zero(self) -> bool:
        """Set the outputs to zero now; False (logged once) if the device does not confirm it."""
        self._armed_from = None
        if not self._connected:
            return False
        problem: BaseException | None = None
        for _ in range(1 if self._silent else BENCH.zero_attempts):
            try:
                zero_patiently(self.driver)
            except (Exception, SystemExit) as error:
                problem = error
                if isinstance(error, DeviceError) and not isinstance(error, DeviceLost):
                    break  # it has refused for long enough
            else:
                self._silent = self._logged = False
                self._at_zero = True
                return True
        self._at_zero = False
        if not self._logged:
            log.error(
                "%s (%s); %s: keep away from the machine, use its emergency stop",
                UNSURE,
                problem,
                zeroed_without_host(self.driver, self._rig.wire.watchdog),
                extra={"alarm": True},
            )
        self._silent = self._logged = True
        return False

    def surely_zero(self) -> bool:
        """Zero the outputs of a connected device; return whether the outputs are known to be zero.

        They are not after a device was lost, also while the wire is closed to connect again.
        """
        return self.zero() if self._connected else self._at_zero

    def safely(self, call: Callable[[], Result]) -> Result:
        """Return the result of `call`; on any error zero the outputs before raising it."""
        with self:
            return call()

    def __enter__(self) -> None:
        """Enter a block of `safely`."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: object
    ) -> None:
        if error is None:
            return
        if isinstance(error, DeviceLost):
            self._silent = True
        self.zero()  # stated first in the message: whether the outputs are at zero
        if isinstance(error, DeviceLost):
            log.error("%s", error)
        if isinstance(error, SystemExit):  # its code may be 0, which would state that all is done
            raise DeviceError("the driver or a library ended the program: sys.exit()") from error

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool) -> int:
        """Set the laws of all joints at one tick and return it; zero the outputs on failure."""
        self._at_zero = False
        tick = self.safely(lambda: self.driver.apply(laws, restart=restart))
        self._armed_from = tick if any(law.limit > 0.0 for law in laws) else None
        return tick

    def zeroed_elsewhere(self, block: SampleBlock) -> bool:
        """Return whether a block shows that another client has zeroed the outputs."""
        in_force = self._armed_from is not None and block.tick >= self._armed_from
        return in_force and not block.armed and not block.tripped

    def bounded(self, laws: Sequence[OutputLaw]) -> list[OutputLaw]:
        """Return the laws limited to each joint's limits.command; raises ValueError."""
        joints = self._rig.joints
        if len(laws) != len(joints):
            raise ValueError(f"{len(laws)} output laws given for {len(joints)} joints")
        return [
            _bounded(law, joint.limits.command) for law, joint in zip(laws, joints, strict=True)
        ]

    def record_zero(
        self, keep: Callable[[SampleBlock], None], clock: Callable[[], float], seconds: float
    ) -> bool:
        """Record blocks until every command has been zero for `seconds` of consecutive samples.

        Call with the outputs zeroed. Returns False if the device still reports a command at the
        end. Ends early if the device or the disk fails, and after `seconds` plus
        `BENCH.queued_seconds` of device time, or that much wall time plus two answer times.
        """
        rig = self._rig
        needed = round(seconds * rig.sample_rate)
        longest = round((seconds + BENCH.queued_seconds) * rig.sample_rate)
        deadline = clock() + seconds + BENCH.queued_seconds + 2 * rig.wire.timeout
        quiet = recorded = 0
        moving = False
        while quiet < needed and recorded < longest and clock() < deadline:
            try:
                block = self.safely(self.driver.read_block)
                keep(block)
            except (DeviceError, RecordingFailed) as error:
                log.warning("%.1f s recorded after zeroing: %s", recorded / rig.sample_rate, error)
                return True
            nonzero = np.flatnonzero((block.data[:, len(rig.channels) :] != 0.0).any(axis=1))
            zero_samples = len(block.data) - 1 - int(nonzero[-1]) if len(nonzero) else None
            moving = zero_samples == 0
            quiet = quiet + len(block.data) if zero_samples is None else zero_samples
            recorded += len(block.data)
        return not moving

    def close(self, *, tripped: bool = False) -> bool:
        """Zero again, stop the stream, close the wire; return whether zero was confirmed.

        Never raises. After a trip a driver that can closes the wire so that the device latches it.
        """
        zeroed = self.surely_zero()
        if tripped and not self._silent and isinstance(self.driver, LatchesTrip):
            self.driver.close_tripped()
        else:
            if self._connected and not self._silent:
                with suppress(DeviceError):
                    self.driver.stop()
            self.driver.close()
        self._connected = False
        return zeroed


def _bounded(law: OutputLaw, most: float) -> OutputLaw:
    numbers = (law.gain, law.bias, law.position_gain, law.setpoint, law.limit)
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"expected finite numbers in an output law, found {law}")
    return replace(law, limit=min(max(law.limit, 0.0), most))
