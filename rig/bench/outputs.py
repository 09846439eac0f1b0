"""A driver of which every failing call leaves the outputs at zero before the failure shows."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

from drivers.base import DeviceError, DeviceInfo, DeviceLost, Driver, OutputLaw
from rig.model.rig import Rig

log = logging.getLogger(__name__)
Result = TypeVar("Result")

_ZERO_ATTEMPTS = 2


class Outputs:
    """The outputs of one device: the way to zero them, and a guard around every other call."""

    def __init__(self, rig: Rig, driver: Driver) -> None:
        self.driver = driver
        self._rig = rig
        self._connected = False
        self._silent = False

    def connect(self) -> DeviceInfo:
        """Open the wire, check that device and rig fit, zero the outputs; DeviceError if not."""
        info = self.driver.connect()
        self._connected = True
        self.driver.zero_outputs()
        for what, found, wanted in (
            ("joints", info.joints, len(self._rig.joints)),
            ("measured channels", info.channels, len(self._rig.channels)),
            ("samples a second", info.sample_rate, self._rig.sample_rate),
        ):
            if found != wanted:
                raise DeviceError(
                    f"the device {info.identity!r} has {found:g} {what}, "
                    f"rig {self._rig.name!r} has {wanted:g}; is it the right rig file?"
                )
        return info

    def zero(self) -> bool:
        """Put the outputs to zero now; False (and logged once) if the device does not answer."""
        if not self._connected:
            return False
        problem: Exception | None = None
        for _ in range(1 if self._silent else _ZERO_ATTEMPTS):
            try:
                self.driver.zero_outputs()
            except Exception as error:
                problem = error
            else:
                self._silent = False
                return True
        if not self._silent:
            log.error(
                "outputs not confirmed at zero (%s); the device's watchdog zeroes them in %g s",
                problem,
                self._rig.wire.watchdog,
            )
        self._silent = True
        return False

    def safely(self, call: Callable[[], Result]) -> Result:
        """Do one thing; whatever goes wrong in it, outputs are at zero before that shows."""
        try:
            return call()
        except BaseException as error:
            if isinstance(error, DeviceLost):
                log.error("%s", error)
                self._silent = True
            self.zero()
            raise

    def bounded(self, laws: Sequence[OutputLaw]) -> list[OutputLaw]:
        """Return the laws with their limit no wider than each joint's; ValueError if unfit."""
        joints = self._rig.joints
        if len(laws) != len(joints):
            raise ValueError(f"{len(laws)} output laws given for {len(joints)} joints")
        return [
            _bounded(law, joint.limits.command) for law, joint in zip(laws, joints, strict=True)
        ]

    def close(self) -> bool:
        """Zero once more, stop the stream, close the wire; says whether zero is sure; no raise."""
        zeroed = self.zero() or not self._connected
        if self._connected and not self._silent:
            with suppress(DeviceError):
                self.driver.stop()
        self.driver.close()
        self._connected = False
        return zeroed


def _bounded(law: OutputLaw, most: float) -> OutputLaw:
    numbers = (law.gain, law.bias, law.position_gain, law.setpoint, law.limit)
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"an output law needs finite numbers, not {law}")
    return replace(law, limit=min(max(law.limit, 0.0), most))
