"""Checks of laws and waveforms for drivers whose device does not check them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple

import numpy as np

from drivers.base import Array, DeviceError, OutputLaw
from rig.model.rig import Rig


def possible_laws(laws: Sequence[OutputLaw], rig: Rig) -> tuple[OutputLaw, ...]:
    """Return one law per joint; raises DeviceError naming the joint of an impossible law."""
    if len(laws) != len(rig.joints):
        raise DeviceError(f"{len(laws)} laws for a rig of {len(rig.joints)} joints")
    for number, (law, joint) in enumerate(zip(laws, rig.joints, strict=True), start=1):
        if not all(math.isfinite(value) for value in astuple(law)):
            raise DeviceError(f"law of joint {number}: not finite: {law}")
        if not 0.0 <= law.limit <= joint.valve.command_range:
            raise DeviceError(
                f"law of joint {number}: limit {law.limit:g} V, expected 0 to "
                f"{joint.valve.command_range:g} V"
            )
    return tuple(laws)


def possible_wave(joint: int, wave: Array, rig: Rig) -> Array:
    """Return a copy of the waveform [V] of a joint (0-based); raises DeviceError if impossible."""
    if not 0 <= joint < len(rig.joints):
        raise DeviceError(f"no joint {joint + 1} on a rig of {len(rig.joints)}")
    volts = np.array(wave, dtype=np.float64).ravel()
    most = rig.joints[joint].valve.command_range
    if not len(volts) or not (np.abs(volts) <= most).all():
        raise DeviceError(
            f"waveform of joint {joint + 1}: expected at least one sample, all within +-{most:g} V"
        )
    return volts
