"""Validation steps for a rig of any size: sines, which are never used for a fit."""

from __future__ import annotations

from protocols.design.candidates import CENTRING
from protocols.design.check import Twin
from protocols.design.settings import DESIGN
from protocols.design.sizing import SPARE, motion_within
from protocols.files.schema import Protocol
from protocols.signals.sine import Sine
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED, Excite, Lock
from rig.model.parse import InputError
from rig.model.rig import Rig

# A slow sine's travel is proportional to the gain, which differs from the twin's by some percent.
ROOM = {**SPARE, "piston": 0.1}


def validation(rig: Rig, twin: Twin, name: str) -> Protocol:
    """Return each joint alone, then all at once, at 1 and 3 Hz, as large as limits allow.

    Raises InputError naming a step that exceeds a limit at any amplitude.
    """
    N = len(rig.joints)
    steps = []
    for frequency in DESIGN.sine_frequencies:
        for joint in range(N, 0, -1):
            steps.append(_sized(f"joint{joint}_{frequency:g}hz", (joint,), frequency, rig, twin))
        if N > 1:
            every = tuple(range(1, N + 1))
            steps.append(_sized(f"all_{frequency:g}hz", every, frequency, rig, twin))
    return Protocol(
        name=name,
        description=f"Validation records for a model of {rig.name}, 1 and 3 Hz sines",
        joints=N,
        steps=tuple(steps),
    )


def _sized(name: str, moving: tuple[int, ...], frequency: float, rig: Rig, twin: Twin) -> Step:
    for size in range(DESIGN.sizes):
        first = DESIGN.sine_alone if len(moving) == 1 else DESIGN.sine_together
        amplitude = first * DESIGN.smaller**size
        step = _step(name, moving, frequency, float(f"{amplitude:.3g}"), len(rig.joints))
        if motion_within(step, rig, twin, ROOM) is not None:
            return step
    raise InputError(
        f"rig {rig.name!r}: {name} passes a limit on the twin at any amplitude; are limits, "
        "supply and nominal values right?"
    )


def _step(name: str, moving: tuple[int, ...], hertz: float, volts: float, joints: int) -> Step:
    signal = Sine(kind="sine", frequency=hertz, amplitude=volts)
    return Step(
        name=name,
        lock=tuple(
            Lock(joint=joint, at=CLOSED, piston=0.0, tolerance=DESIGN.closed_tolerance)
            for joint in range(1, joints + 1)
            if joint not in moving
        ),
        excite=tuple(Excite(joint=joint, signal=signal, centring=CENTRING) for joint in moving),
        duration=5.0,
        warm_up=4,
    )
