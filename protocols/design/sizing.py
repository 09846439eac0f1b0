"""Scaling of a step to the largest amplitude within the rig's limits, by its motion on the twin."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from protocols.design.candidates import described, played
from protocols.design.check import Twin, centred, judge_motion
from protocols.design.check_report import MotionPrediction
from protocols.design.settings import DESIGN
from protocols.engine.centring import Array
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.signals.multisine import Multisine
from protocols.steps.excite import Step
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)

# Share of a limit's range kept for differences between bench and twin.
SPARE = {"pump flow": 0.03, "cap_pressure (cavitation, supply)": 0.1,
         "rod_pressure (cavitation, supply)": 0.1, "piston": 0.05}  # fmt: skip


def motion_within(
    step: Step, rig: Rig, twin: Twin, spare: Mapping[str, float] = SPARE
) -> Mapping[str, Array] | None:
    """Return one period of a step's motion on the twin, None if it exceeds a limit.

    `spare` is the share of a quantity's range that must stay free.
    """
    try:
        alone = Protocol(name="candidate", joints=len(rig.joints), steps=(step,))
        planned = resolve(alone, rig).steps[0]
        centring = centred(planned, rig, twin)
    except InputError as error:
        log.debug("%s", error)
        return None
    lines = judge_motion(planned, rig, centring).predictions
    return centring.moved if all(_kept(line, spare) for line in lines) else None


def sized(step: Step, seed: int, rig: Rig, twin: Twin) -> tuple[Step, Mapping[str, Array]] | None:
    """Return a candidate with the largest amplitude in limits, and its motion; None without one.

    Where the arm resonates, a multisine of little tilt must stay small: a steeper one is tried
    next, and the largest is used.
    """
    by_amplitude: dict[float, tuple[Step, Mapping[str, Array]]] = {}
    for tilt in DESIGN.tilts:
        for size in range(DESIGN.sizes):
            tried = played(step, DESIGN.amplitude * DESIGN.smaller**size, tilt, seed)
            moved = motion_within(tried, rig, twin)
            if moved is not None:
                signal = tried.excite[0].signal
                assert isinstance(signal, Multisine)  # as `played` makes them
                by_amplitude.setdefault(signal.amplitude, (tried, moved))
                break
        if by_amplitude and max(by_amplitude) >= DESIGN.modest:
            break
    if not by_amplitude:
        log.info("left out: %s", described(step))
        return None
    return by_amplitude[max(by_amplitude)]


def _kept(line: MotionPrediction, spare: Mapping[str, float]) -> bool:
    least = spare.get(line.quantity, 0.0) * (line.allowed_high - line.allowed_low)
    room = line.margin if line.joint is not None else line.allowed_high - line.high
    return room >= least
