"""Checks of laws and waveforms on the host, before they go to a device."""

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
            raise DeviceError(f"law of joint {number} has a value that is not finite: {law}")
        if not 0.0 <= law.limit <= joint.valve.command_range:
            raise DeviceError(
                f"law of joint {number} has the limit {law.limit:g} V, expected 0 to "
                f"{joint.valve.command_range:g} V"
            )
    return tuple(laws)


def possible_wave(joint: int, wave: Array, rig: Rig) -> Array:
    """Return a copy of the waveform [V] of a joint (0-based); raises DeviceError if impossible."""
    if not 0 <= joint < len(rig.joints):
        raise DeviceError(f"no joint {joint + 1} on a rig of {len(rig.joints)}")
    volts = np.array(wave, dtype=np.float64).ravel()
    most = rig.joints[joint].valve.command_range
    if not len(volts):
        raise DeviceError(f"waveform of joint {joint + 1} is empty")
    wrong = np.flatnonzero(~(np.abs(volts) <= most))
    if len(wrong):
        raise DeviceError(
            f"waveform of joint {joint + 1}: sample {wrong[0]} is {volts[wrong[0]]:g} V, "
            f"outside the converter's range of +-{most:g} V"
        )
    return volts
