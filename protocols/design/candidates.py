"""The candidate lock-and-excite steps of a rig of N joints, and their largest amplitudes.

One joint is excited. Joints below it (towards the base) only rotate the whole arm: they are locked
at mid-stroke with closed valves. Joints beyond it determine the inertia at the excited one: each is
held by a push at either end stop, or at mid-stroke by a closed valve.

Lower bound. A joint that moves alone has one inertia, M_kk at the pose of the joints beyond it; a
chain of N links has N (N + 1) / 2 inertia parameters. So no fewer than N (N + 1) / 2 such steps
determine them all: 1, 3, 6, 10 steps for 1, 2, 3, 4 joints.

A step is scaled to the largest amplitude within the rig's limits by its motion on the twin.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Mapping

from protocols.design.check import Twin, centred, judge_motion
from protocols.design.check_report import MotionPrediction
from protocols.design.settings import DESIGN
from protocols.engine.centring import Array
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.signals.multisine import Multisine
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED, END_MAX, END_MIN, Centring, Excite, Lock
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)

CENTRING = Centring(drift=4e-3, offset=4e-3, tries=6)
# Share of a limit's range kept for differences between bench and twin.
SPARE = {"pump flow": 0.03, "cap_pressure (cavitation, supply)": 0.1,
         "rod_pressure (cavitation, supply)": 0.1, "piston": 0.05}  # fmt: skip


def candidates(rig: Rig) -> tuple[Step, ...]:
    """Return all candidate steps, outermost joint first, with their first amplitude."""
    N = len(rig.joints)
    steps: list[Step] = []
    for excited in range(N, 0, -1):
        for places in _places(N - excited):
            beyond = tuple(zip(range(excited + 1, N + 1), places, strict=True))
            steps.append(_step(excited, beyond, f"c{len(steps) + 1}"))
    return tuple(steps)


def _places(count: int) -> Iterator[tuple[str, ...]]:
    """Yield the positions of `count` joints, end stops first."""
    for places in itertools.product((END_MIN, END_MAX, CLOSED), repeat=count):
        at_ends = sum(place != CLOSED for place in places)
        if count <= DESIGN.exhaustive_joints or at_ends <= DESIGN.most_at_ends:
            yield places


def _step(excited: int, beyond: tuple[tuple[int, str], ...], name: str) -> Step:
    closed = tuple(
        Lock(joint=joint, at=CLOSED, piston=0.0, tolerance=DESIGN.closed_tolerance)
        for joint in [*range(1, excited), *(j for j, place in beyond if place == CLOSED)]
    )
    ends = tuple(
        Lock(joint=joint, at=place, tolerance=DESIGN.end_tolerance)
        for joint, place in beyond
        if place != CLOSED
    )
    signal = multisine(DESIGN.amplitude, 0)
    excite = Excite(joint=excited, signal=signal, centre=0.0, centring=CENTRING)
    return Step(name=name, lock=(*closed, *ends), excite=(excite,), repeats=DESIGN.repeats)


def multisine(amplitude: float, seed: int, tilt: float = 0.4) -> Multisine:
    """Return the shipped multisine: odd lines, 0.5 to 9.5 Hz, a quarter of them left empty."""
    return Multisine(
        kind="multisine", base_frequency=0.1, f_min=0.5, f_max=9.5, amplitude=amplitude,
        amplitude_is="rms", odd=True, detection_fraction=0.25, tilt=tilt, seed=seed,
    )  # fmt: skip


def played(step: Step, amplitude: float, tilt: float, seed: int) -> Step:
    """Return a candidate with another multisine: amplitude [V] rms, tilt, seed of its phases."""
    signal = multisine(float(f"{amplitude:.3g}"), seed, tilt)
    excite = tuple(part.model_copy(update={"signal": signal}) for part in step.excite)
    return step.model_copy(update={"excite": excite})


def described(step: Step) -> str:
    """Return a step in words: "excite joint 1; joint 2 at end_min, joint 3 closed"."""
    moving = ", ".join(f"joint {part.joint}" for part in step.excite)
    locks = sorted(step.lock, key=lambda lock: lock.joint)
    still = ", ".join(f"joint {lock.joint} {_lock_text(lock)}" for lock in locks)
    return f"excite {moving}" + (f"; {still}" if still else "")


def _lock_text(lock: Lock) -> str:
    if lock.at != CLOSED:
        return f"at {lock.at}"
    return f"closed at {1e3 * lock.piston:g} mm"


def motion_within(
    step: Step, rig: Rig, twin: Twin, spare: Mapping[str, float] = SPARE
) -> Mapping[str, Array] | None:
    """Return one period of a step's motion on the twin, None if it exceeds a limit.

    `spare` is the share of a quantity's range that must stay free.
    """
    try:
        protocol = Protocol(name="candidate", joints=len(rig.joints), steps=(step,))
        planned = resolve(protocol, rig).steps[0]
        centring = centred(planned, rig, twin)
    except InputError as error:
        log.debug("%s", error)
        return None
    lines = judge_motion(planned, rig, centring).predictions
    return centring.moved if all(_has_margin(line, spare) for line in lines) else None


def sized(step: Step, seed: int, rig: Rig, twin: Twin) -> tuple[Step, Mapping[str, Array]] | None:
    """Return a candidate with the largest amplitude in limits, and its motion; None without one.

    Where the arm resonates, a multisine of little tilt must stay small: a steeper one is tried
    next, and the largest is used.
    """
    by_amplitude: dict[float, tuple[Step, Mapping[str, Array]]] = {}
    for tilt in DESIGN.tilts:
        for size in range(DESIGN.amplitude_tries):
            tried = played(step, DESIGN.amplitude * DESIGN.amplitude_factor**size, tilt, seed)
            moved = motion_within(tried, rig, twin)
            if moved is not None:
                signal = tried.excite[0].signal
                assert isinstance(signal, Multisine)  # as `played` makes them
                by_amplitude.setdefault(signal.amplitude, (tried, moved))
                break
        if by_amplitude and max(by_amplitude) >= DESIGN.low_amplitude:
            break
    if not by_amplitude:
        log.info("left out: %s", described(step))
        return None
    return by_amplitude[max(by_amplitude)]


def _has_margin(line: MotionPrediction, spare: Mapping[str, float]) -> bool:
    required = spare.get(line.quantity, 0.0) * (line.allowed_high - line.allowed_low)
    room = line.margin if line.joint is not None else line.allowed_high - line.high
    return room >= required
