"""From a protocol and a rig to a plan: everything that can be checked before anything moves.

A plan is in device terms: waveforms in samples at the rig's rate, joints counted from 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocols.files.schema import CLOSED, END_MAX, Excite, Lock, Multisine, Place, Protocol, Step
from protocols.files.waveforms import Waveform, make_waveform, scaled
from rig.model.parse import InputError
from rig.model.rig import Rig

MOVE_SECONDS = 4.0  # a joint's way to its place, for the estimate of the duration only
TRIAL_SECONDS = 3.0  # drift is judged over about this long, or one period if that is longer
FIRM_SECONDS = 3.0  # at full size under the firm loop, until its mean correction is known
LOOSEN_SECONDS = 8.0  # about as long as it takes to loosen that loop, for the estimate only
LONGEST_PERIOD = 600.0  # [s] a common period of two joints beyond this is a mistake
NYQUIST_SHARE = 4.0  # excited lines stay below Nyquist / 4


@dataclass(frozen=True)
class Overrides:
    """What a person changes of a protocol without editing its file; None leaves it alone.

    `amplitude_scale` multiplies every amplitude, `seed` gives the steps' multisines the seeds
    seed, seed + 1, ..., `steps` keeps only the steps named.
    """

    repeats: int | None = None
    duration: float | None = None
    amplitude_scale: float = 1.0
    seed: int | None = None
    steps: tuple[str, ...] | None = None


@dataclass(frozen=True)
class LockPlan:
    """A joint (0-based) to be held; `piston` [m] is where it is to stand."""

    joint: int
    at: str
    piston: float
    tolerance: float


@dataclass(frozen=True)
class ExcitePlan:
    """A joint (0-based) to be moved by one waveform about a centre [m]."""

    joint: int
    wave: Waveform
    settings: Excite

    @property
    def centre(self) -> float:
        """Where the mean of the piston is kept [m]."""
        return self.settings.centre


@dataclass(frozen=True)
class StepPlan:
    """One step, lengths in samples.

    `period` is common to all its waveforms; `record`, `trial` (over which the bias is judged)
    and `warm_up` (under the slow loop) are multiples of it. `ramp` and `settle` are in seconds.
    """

    name: str
    locks: tuple[LockPlan, ...]
    excite: tuple[ExcitePlan, ...]
    repeats: int
    period: int
    record: int
    trial: int
    warm_up: int
    ramp: float
    settle: float

    @property
    def lines(self) -> tuple[int, ...]:
        """The lines any joint excites, as multiples of 1 / the common period."""
        found = {k * (self.period // e.wave.period) for e in self.excite for k in e.wave.lines}
        return tuple(sorted(found))

    @property
    def tries(self) -> int:
        """How often a bias is trimmed, or a disturbed record repeated, before giving up."""
        return max(e.settings.centring.tries for e in self.excite)

    def samples(self, rate: float) -> int:
        """Samples from the start of the waveform to its end, if the second trim is good."""
        growing = (self.ramp + 1.5 * FIRM_SECONDS + LOOSEN_SECONDS) * rate
        settling = math.ceil(growing / self.period) * self.period + self.warm_up
        return settling + 2 * self.trial + self.repeats * self.record


@dataclass(frozen=True)
class Plan:
    """What the engine runs: the protocol with its overrides, its steps, its expected length."""

    protocol: Protocol
    rig: str
    sample_rate: float
    steps: tuple[StepPlan, ...]
    seconds: float

    @property
    def place(self) -> Place:
        """How pistons are brought to their places."""
        return self.protocol.place

    @property
    def records(self) -> tuple[str, ...]:
        """Names of the records it leaves, in their order."""
        return tuple(f"{s.name}_r{r}" for s in self.steps for r in range(1, s.repeats + 1))


def resolve(protocol: Protocol, rig: Rig, overrides: Overrides | None = None) -> Plan:
    """Return the plan of `protocol` on `rig`; raises InputError naming step, joint and limit."""
    changed = override(protocol, overrides or Overrides())
    if changed.joints != len(rig.joints):
        raise InputError(
            f"protocol {changed.name!r} is for {changed.joints} joint(s), "
            f"rig {rig.name!r} has {len(rig.joints)}; write one whose steps name each joint"
        )
    for joint in rig.joints:
        if changed.place.limit > joint.limits.command:
            raise InputError(
                f"protocol {changed.name!r}: place.limit {changed.place.limit:g} V is above "
                f"the limit of joint {joint.name!r}, command {joint.limits.command:g} V"
            )
    steps = tuple(_step(step, rig) for step in changed.steps)
    return Plan(changed, rig.name, rig.sample_rate, steps, _seconds(steps, rig))


def override(protocol: Protocol, overrides: Overrides) -> Protocol:
    """Return the protocol with what was overridden; raises InputError for what does not fit."""
    if overrides.repeats is not None and overrides.repeats < 1:
        raise InputError(f"repeats is {overrides.repeats}; expected at least 1")
    if not overrides.amplitude_scale > 0.0 or not math.isfinite(overrides.amplitude_scale):
        raise InputError(f"the amplitude's scale is {overrides.amplitude_scale:g}; expected > 0")
    if overrides.seed is not None and overrides.seed < 0:
        raise InputError(f"the seed is {overrides.seed}; expected 0 or more")
    kept = _kept(protocol, overrides.steps)
    steps = tuple(_changed(step, place, overrides) for place, step in enumerate(kept))
    return protocol.model_copy(update={"steps": steps})


def _kept(protocol: Protocol, names: Sequence[str] | None) -> tuple[Step, ...]:
    if names is None:
        return protocol.steps
    known = [step.name for step in protocol.steps]
    for name in names:
        if name not in known:
            raise InputError(
                f"protocol {protocol.name!r} has no step {name!r}; it has: {' '.join(known)}"
            )
    return tuple(step for step in protocol.steps if step.name in names)


def _changed(step: Step, place: int, overrides: Overrides) -> Step:
    excite = []
    for part in step.excite:
        signal = scaled(part.signal, overrides.amplitude_scale)
        if overrides.seed is not None and isinstance(signal, Multisine):
            signal = signal.model_copy(update={"seed": overrides.seed + place})
        excite.append(part.model_copy(update={"signal": signal}))
    return step.model_copy(
        update={
            "excite": tuple(excite),
            "repeats": step.repeats if overrides.repeats is None else overrides.repeats,
            "duration": step.duration if overrides.duration is None else overrides.duration,
        }
    )


def _step(step: Step, rig: Rig) -> StepPlan:
    excite = tuple(_excite(part, step, rig) for part in step.excite)
    period = math.lcm(*(e.wave.period for e in excite))
    if period > LONGEST_PERIOD * rig.sample_rate:
        raise InputError(
            f"step {step.name!r}: its waveforms repeat together only after "
            f"{period / rig.sample_rate:g} s; choose frequencies with a short common period"
        )
    record = period if step.duration is None else _whole(step, period, rig.sample_rate)
    return StepPlan(
        name=step.name,
        locks=tuple(_lock(part, step, rig) for part in step.lock),
        excite=excite,
        repeats=step.repeats,
        period=period,
        record=record,
        trial=period * max(1, round(min(record, TRIAL_SECONDS * rig.sample_rate) / period)),
        warm_up=period * step.warm_up,
        ramp=step.ramp,
        settle=step.settle,
    )


def _whole(step: Step, period: int, rate: float) -> int:
    assert step.duration is not None
    count = step.duration * rate / period
    if round(count) < 1 or abs(count - round(count)) > 1e-6 * count:
        raise InputError(
            f"step {step.name!r}: duration {step.duration:g} s is {count:.6g} periods of "
            f"{period / rate:g} s; expected a whole number, so that repeats start alike"
        )
    return round(count) * period


def _lock(part: Lock, step: Step, rig: Rig) -> LockPlan:
    half = rig.joints[part.joint - 1].cylinder.stroke / 2
    if part.at == CLOSED:
        if abs(part.piston) > half:
            raise InputError(
                f"step {step.name!r}: joint {part.joint} is to be locked at "
                f"{1e3 * part.piston:g} mm, outside its stroke of +-{1e3 * half:g} mm"
            )
        piston = part.piston
    else:
        piston = half if part.at == END_MAX else -half
    return LockPlan(part.joint - 1, part.at, piston, part.tolerance)


def _excite(part: Excite, step: Step, rig: Rig) -> ExcitePlan:
    joint = rig.joints[part.joint - 1]
    where = f"step {step.name!r}, joint {part.joint}"
    try:
        wave = make_waveform(part.signal, rig.sample_rate)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    peak = float(np.max(np.abs(wave.samples)))
    if peak > joint.limits.command:
        raise InputError(
            f"{where}: the command reaches {peak:.3g} V; limits.command allows "
            f"{joint.limits.command:g} V"
        )
    if peak * joint.valve.spool_gain > joint.valve.spool_stroke:
        raise InputError(
            f"{where}: a command of {peak:.3g} V moves the spool "
            f"{peak * joint.valve.spool_gain:.3g} V; its stroke is {joint.valve.spool_stroke:g} V"
        )
    highest = wave.lines[-1] * rig.sample_rate / wave.period
    allowed = rig.sample_rate / 2.0 / NYQUIST_SHARE
    if highest >= allowed:
        raise InputError(
            f"{where}: excites {highest:g} Hz; at {rig.sample_rate:g} samples a second "
            f"stay below {allowed:g} Hz"
        )
    low, high = joint.limits.piston
    if not low < part.centre < high:
        raise InputError(
            f"{where}: centre {1e3 * part.centre:g} mm is outside limits.piston, "
            f"{1e3 * low:g} to {1e3 * high:g} mm"
        )
    return ExcitePlan(part.joint - 1, wave, part)


def _seconds(steps: Sequence[StepPlan], rig: Rig) -> float:
    moves = sum(MOVE_SECONDS * (1 + len(s.locks)) + 2.0 * s.settle for s in steps)
    return moves + sum(s.samples(rig.sample_rate) for s in steps) / rig.sample_rate
