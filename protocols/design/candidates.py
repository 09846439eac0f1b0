"""The candidate lock-and-excite steps of a rig of N joints.

One joint is excited. Joints below it (towards the base) only rotate the whole arm: they are locked
at mid-stroke with closed valves. Joints beyond it determine the inertia at the excited one: each is
held by a push at either end stop, or at mid-stroke by a closed valve.

Lower bound. A joint that moves alone has one inertia, M_kk at the pose of the joints beyond it; a
chain of N links has N (N + 1) / 2 inertia parameters. So no fewer than N (N + 1) / 2 such steps
determine them all: 1, 3, 6, 10 steps for 1, 2, 3, 4 joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from protocols.design.settings import DESIGN
from protocols.signals.multisine import Multisine
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED, END_MAX, END_MIN, Centring, Excite, Lock
from rig.model.rig import Rig

CENTRING = Centring(drift=4e-3, offset=4e-3, tries=6)


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
        if count <= DESIGN.all_poses or at_ends <= DESIGN.displaced:
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
    still = ", ".join(f"joint {lock.joint} {_at(lock)}" for lock in locks)
    return f"excite {moving}" + (f"; {still}" if still else "")


def _at(lock: Lock) -> str:
    if lock.at != CLOSED:
        return f"at {lock.at}"
    return f"closed at {1e3 * lock.piston:g} mm"
