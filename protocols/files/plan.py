"""Resolution of a protocol on a rig into a plan, with all checks possible before any motion.

A plan is in device terms: waveforms in samples at the rig's rate, joints counted from 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from protocols.files.schema import Protocol, every_step
from protocols.language.conditions import Condition, parse_condition, require_known
from protocols.language.waveforms import LONGEST_PERIOD, Waveform, highest_line
from protocols.steps.base import PlannedStep, StepKind
from protocols.steps.excite import MAX_REPEATS, Step
from protocols.steps.lock import LockStep
from protocols.steps.parts import CLOSED, END_MAX, Excite, Lock, Place
from protocols.steps.plans import ExcitePlan, LockPlan, StepPlan
from protocols.steps.warm_up import WarmUpStep
from rig.model.numerics.exponential import exponential
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.model.units import plain

TRIAL_SECONDS = 3.0  # drift is judged over about this long, or one period if that is longer
LOCK_SHARE = 0.25  # of the stroke: a joint that may stand anywhere in it is not locked
LOCK_DEVIATIONS = 6.0  # of the noise of a position: one sample of 10^9 is farther off
LONGEST_RECORD = 86400.0  # [s]
BISECTIONS = 20  # of a gain: to a millionth
OIL_DAMPING = 0.2  # usual damping ratio of a load on its oil (Merritt 1967, chapter 8)


@dataclass(frozen=True)
class Overrides:
    """Changes of a protocol without editing its file; None means unchanged.

    `amplitude_scale` multiplies every amplitude, `seed` gives the steps' multisines the seeds seed,
    seed + 1, ..., `steps` keeps only the steps named; `parameters` are for the reader.
    """

    repeats: int | None = None
    duration: float | None = None
    amplitude_scale: float = 1.0
    seed: int | None = None
    steps: tuple[str, ...] | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """A protocol with its overrides, and its steps in order, as resolved."""

    protocol: Protocol
    rig: str
    sample_rate: float
    sequence: tuple[PlannedStep, ...]

    @property
    def steps(self) -> tuple[StepPlan, ...]:
        """The excitations with records."""
        return tuple(
            plan
            for part in every_planned(self.sequence)
            if isinstance(part.step, Step)
            for plan in part.excitations
        )

    @property
    def excitations(self) -> tuple[StepPlan, ...]:
        """All excitations, in order."""
        return tuple(plan for part in self.sequence for plan in part.all_excitations)

    @property
    def places(self) -> Mapping[str, str]:
        """File and line of each excitation, by name, as far as they are known."""
        return {step.name: step.where for step in self.excitations if step.where}

    @property
    def seconds(self) -> float:
        """Expected length [s]; conditions count with their least time."""
        return sum(part.seconds for part in self.sequence)

    @property
    def longest(self) -> float:
        """Length [s] if every condition lasts until its time-out."""
        return sum(part.longest for part in self.sequence)

    @property
    def records(self) -> tuple[str, ...]:
        """Names of the records, in order; of a repetition those of one round."""
        return tuple(name for part in every_planned(self.sequence) for name in part.records)

    @property
    def estimates(self) -> tuple[str, ...]:
        """The parameters whose on-line estimates its conditions need."""
        conditions = (part.condition for part in every_planned(self.sequence))
        return tuple(dict.fromkeys(name for c in conditions if c for name in c.estimates))


def every_planned(parts: Sequence[PlannedStep]) -> tuple[PlannedStep, ...]:
    """Return planned steps with those nested in them, in order."""
    return tuple(planned for part in parts for planned in (part, *every_planned(part.nested)))


def resolve(protocol: Protocol, rig: Rig, overrides: Overrides | None = None) -> Plan:
    """Return the plan of `protocol` on `rig`; raises InputError naming step, joint and limit."""
    changed = override(protocol, overrides or Overrides())
    if changed.joints != len(rig.joints):
        raise InputError(
            f"protocol {changed.name!r} is for {changed.joints} joint(s), "
            f"rig {rig.name!r} has {len(rig.joints)}; write one whose steps name each joint"
        )
    if problem := _problem_of_place(changed.place, rig):
        where = f"{changed.place.where}: " if changed.place.where else ""
        raise InputError(f"{where}protocol {changed.name!r}: place.{problem}")
    sequence = _RigPlanner(rig).nested(changed.steps)
    return Plan(changed, rig.name, rig.sample_rate, sequence)


def _problem_of_place(place: Place, rig: Rig) -> str | None:
    """Return the setting with which pistons cannot be placed, and why; None if there is none."""
    for number, joint in enumerate(rig.joints):
        stroke = joint.cylinder.stroke
        if place.limit > joint.limits.command:
            return (
                f"limit {place.limit:g} V is above the limit of joint {joint.name!r}, command "
                f"{joint.limits.command:g} V"
            )
        if place.tolerance > LOCK_SHARE * stroke:
            return (
                f"tolerance {1e3 * place.tolerance:g} mm of a stroke of {1e3 * stroke:g} mm counts "
                f"joint {joint.name!r} as in place nearly anywhere; expected at most "
                f"{1e3 * LOCK_SHARE * stroke:g} mm"
            )
        most = largest_position_gain(rig, number)
        if place.position_gain > most:
            return (
                f"position_gain {place.position_gain:g} V/m makes joint {joint.name!r} oscillate "
                f"about its place: with its valve and {rig.sample_rate:g} samples a second "
                f"expected at most {plain(most, 3)} V/m, of oil and load less"
            )
    return None


def largest_position_gain(rig: Rig, joint: int) -> float:
    """Return the position gain [V/m] at which a joint's (0-based) loop ceases to settle.

    Of a sampled law before the valve, a lag of second order, and a piston without load that
    integrates its spool: the loop settles while the eigenvalues of a sample's transition are
    inside the unit circle. Oil and load leave less. Infinite where the piston's gain is unknown.
    """
    try:
        speed = piston_gain(rig, joint)
    except InputError:
        return math.inf
    valve, period = rig.joints[joint].valve, 1.0 / rig.sample_rate
    w, damping = 2.0 * math.pi * valve.natural_frequency, valve.damping_ratio
    # Piston, spool, its rate, and the command that is held for the sample.
    rates = np.zeros((4, 4))
    rates[0, 1], rates[1, 2] = speed, 1.0
    rates[2, 1:] = -(w**2), -2.0 * damping * w, w**2
    moves = exponential(rates * period)

    def settles(gain: float) -> bool:
        loop = moves[:3, :3].copy()
        loop[:, 0] -= gain * moves[:3, 3]
        return bool(np.max(np.abs(np.linalg.eigvals(loop))) < 1.0)

    low, high = 0.0, 4.0 / (speed * period)  # twice that of a valve without lag
    for _ in range(BISECTIONS):
        gain = 0.5 * (low + high)
        low, high = (gain, high) if settles(gain) else (low, gain)
    return low


def largest_centring_gain(rig: Rig, joint: int) -> float:
    """Return the position gain [V/m] up to which a joint (0-based) settles with its oil and load.

    The load on the oil has the frequency w, w^2 = b (A_c^2 / V_c + A_r^2 / V_r) G^2 / M in the
    middle of the stroke, and the damping ratio d of `OIL_DAMPING`: the loop settles below a speed
    per displacement of 2 d w (Merritt 1967, chapter 8). Without nominal b or M, and at most,
    `largest_position_gain`.
    """
    most = largest_position_gain(rig, joint)
    b, M = (rig.nominal.get(name, 0.0) for name in ("b", f"M{joint + 1}"))
    if math.isinf(most) or not (b > 0.0 and M > 0.0):
        return most
    part = rig.joints[joint]
    cylinder, lever = part.cylinder, abs(float(part.geometry(0.0)[1]))
    cap, rod = map(float, rig.chamber_volumes(joint, np.array(0.0)))
    stiffness = b * (cylinder.cap_area**2 / cap + cylinder.rod_area**2 / rod)
    frequency = lever * math.sqrt(stiffness / M)
    return min(most, 2.0 * OIL_DAMPING * frequency / piston_gain(rig, joint))


def override(protocol: Protocol, overrides: Overrides) -> Protocol:
    """Return the protocol with overrides applied; raises InputError for an invalid one."""
    if overrides.repeats is not None and not 1 <= overrides.repeats <= MAX_REPEATS:
        raise InputError(f"repeats is {overrides.repeats}; expected 1 to {MAX_REPEATS}")
    if not overrides.amplitude_scale > 0.0 or not math.isfinite(overrides.amplitude_scale):
        raise InputError(f"the amplitude's scale is {overrides.amplitude_scale:g}; expected > 0")
    if overrides.seed is not None and overrides.seed < 0:
        raise InputError(f"the seed is {overrides.seed}; expected 0 or more")
    selected = _selected(protocol, overrides.steps)
    numbers = iter(range(len(protocol.excitations)))

    def change(step: StepKind) -> StepKind:
        return _changed(step, next(numbers), overrides) if isinstance(step, Step) else step

    return protocol.model_copy(update={"steps": mapped(selected, change)})


def mapped(
    steps: Sequence[StepKind], change: Callable[[StepKind], StepKind]
) -> tuple[StepKind, ...]:  # fmt: skip
    """Return steps with every one of them, nested ones too, replaced by `change`."""
    mapped_steps = []
    for step in steps:
        inner = getattr(step, "steps", None)
        copy = step if inner is None else step.model_copy(update={"steps": mapped(inner, change)})
        mapped_steps.append(change(copy))
    return tuple(mapped_steps)


def _selected(protocol: Protocol, names: Sequence[str] | None) -> tuple[StepKind, ...]:
    if names is None:
        return protocol.steps
    known = [step.name for step in protocol.steps if step.name]
    for name in names:
        if name not in known:
            raise InputError(
                f"protocol {protocol.name!r} has no step {name!r}; it has: {' '.join(known)}"
            )
    return tuple(step for step in protocol.steps if step.name in names)


def _changed(step: Step, index: int, overrides: Overrides) -> Step:
    excite = []
    for part in step.excite:
        signal = part.signal.scaled(overrides.amplitude_scale)
        if overrides.seed is not None:
            signal = signal.reseeded(overrides.seed + index)
        excite.append(part.model_copy(update={"signal": signal}))
    return step.model_copy(
        update={
            "excite": tuple(excite),
            "repeats": step.repeats if overrides.repeats is None else overrides.repeats,
            "duration": step.duration if overrides.duration is None else overrides.duration,
        }
    )


class _RigPlanner:
    """Resolves steps on one rig; keeps the locks in force (`protocols.steps.base.Planner`)."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._in_force: dict[int, Lock] = {}
        self._waves: dict[tuple[str, int], Waveform] = {}

    def condition(self, text: str) -> Condition:
        """Read a condition; InputError where the rig cannot judge it."""
        try:
            parsed = parse_condition(text)
            require_known(parsed, self.rig)
        except ValueError as error:
            raise InputError(f"condition: {error}") from error
        return parsed

    def nested(self, steps: Sequence[StepKind]) -> tuple[PlannedStep, ...]:
        """Resolve steps in their order; InputError with a line for each problem of any of them."""
        planned: list[PlannedStep] = []
        problems: list[str] = []
        for step in steps:
            try:
                planned.append(step.plan(self))
            except InputError as error:
                problems += [_located(line, step) for line in str(error).splitlines()]
                if isinstance(step, LockStep):
                    break  # later steps would lack its joint
        if problems:
            raise InputError("\n".join(dict.fromkeys(problems)))
        return tuple(planned)

    def locked(self, locks: Sequence[Lock]) -> None:
        """Keep locks for the steps that follow."""
        self._in_force = {part.joint: part for part in locks}

    def locks(self, step: StepKind, locks: Sequence[Lock]) -> tuple[LockPlan, ...]:
        """Resolve locks; InputError naming step, joint and stroke."""
        return tuple(_lock(part, step.name or step.key, self.rig) for part in locks)

    def excitation(self, step: StepKind) -> StepPlan:
        """Resolve what a step locks and excites."""
        assert isinstance(step, Step | WarmUpStep)
        parts = step.excite if isinstance(step, Step) else step.move
        excite = tuple(self._excite(part, step.name) for part in parts)
        named = {part.joint for part in parts} | {part.joint for part in step.lock}
        inherited = tuple(lock for joint, lock in self._in_force.items() if joint not in named)
        rate = self.rig.sample_rate
        period = math.lcm(*(e.wave.period for e in excite))
        if period > LONGEST_PERIOD * rate:
            raise InputError(
                f"step {step.name!r}: its waveforms repeat together only after "
                f"{period / rate:g} s; choose frequencies with a short common period"
            )
        duration, repeats, warm_up = None, 1, 1
        if isinstance(step, Step):
            duration, repeats, warm_up = step.duration, step.repeats, step.warm_up
        record = period if duration is None else _record_samples(step.name, duration, period, rate)
        return StepPlan(
            name=step.name,
            locks=self.locks(step, (*step.lock, *inherited)),
            excite=excite,
            repeats=repeats,
            period=period,
            record=record,
            trial=period * max(1, round(min(record, TRIAL_SECONDS * rate) / period)),
            warm_up=period * warm_up,
            ramp=step.ramp,
            settle=step.settle,
            where=step.where,
        )

    def _excite(self, part: Excite, step: str) -> ExcitePlan:
        # Steps of a sweep often share a waveform, and a multisine of low crest factor takes long.
        name = (part.signal.model_dump_json(), part.joint)
        if name not in self._waves:
            self._waves[name] = _waveform(part, step, self.rig)
        return _excite(part, step, self._waves[name], self.rig)


def _located(problem: str, step: StepKind) -> str:
    """Return a problem with its step's file and line, unless it has those of a nested step."""
    has_place = any(problem.startswith(f"{part.where}: ") for part in every_step([step]))
    has_place = has_place or not step.where
    return problem if has_place else f"{step.where}: {problem}"


def _record_samples(step: str, duration: float, period: int, rate: float) -> int:
    if not duration <= LONGEST_RECORD:  # NaN as well
        raise InputError(
            f"step {step!r}: duration {duration:g} s; expected at most {LONGEST_RECORD:g} s"
        )
    count = duration * rate / period
    if round(count) < 1 or abs(count - round(count)) > 1e-6 * count:
        raise InputError(
            f"step {step!r}: duration {duration:g} s is {count:.6g} periods of "
            f"{period / rate:g} s; expected a whole number, so that repeats start alike"
        )
    return round(count) * period


def _lock(part: Lock, step: str, rig: Rig) -> LockPlan:
    stroke = rig.joints[part.joint - 1].cylinder.stroke
    half = stroke / 2
    if part.at == CLOSED:
        if abs(part.piston) > half:
            raise InputError(
                f"step {step!r}: joint {part.joint} is to be locked at "
                f"{1e3 * part.piston:g} mm, outside its stroke of +-{1e3 * half:g} mm"
            )
        piston = part.piston
    else:
        piston = half if part.at == END_MAX else -half
    noise = rig.sensors.of(rig.position_kind).noise
    if part.tolerance < LOCK_DEVIATIONS * noise:
        raise InputError(
            f"step {step!r}: the lock of joint {part.joint} has a tolerance of "
            f"{1e3 * part.tolerance:g} mm, and the noise of its sensor is {1e3 * noise:g} mm, so "
            "that noise alone would trip the bench; expected at least "
            f"{1e3 * LOCK_DEVIATIONS * noise:g} mm"
        )
    if part.tolerance > LOCK_SHARE * stroke:
        raise InputError(
            f"step {step!r}: the lock of joint {part.joint} has a tolerance of "
            f"{1e3 * part.tolerance:g} mm of a stroke of {1e3 * stroke:g} mm, so that a joint that "
            f"moves would count as locked; expected at most {1e3 * LOCK_SHARE * stroke:g} mm"
        )
    return LockPlan(part.joint - 1, part.at, piston, part.tolerance)


def piston_gain(rig: Rig, joint: int) -> float:
    """Return the steady speed [m/s] per volt of command of a joint (0-based), both ways' mean.

    Without load: A_c p_c = A_r p_r, A_c v = C_pp u sqrt(p_s - p_c), A_r v = C_mp u sqrt(p_r) give
    (v/u)^2 = A_c p_s / (A_c^3 / C_pp^2 + A_r^3 / C_mp^2) for u > 0, and alike with C_pm, C_mm and
    A_r p_s for u < 0. Raises InputError for a rig without these nominal values.
    """
    part = rig.joints[joint]
    names = [f"C_{signs}_{joint + 1}" for signs in ("pp", "mp", "pm", "mm")]
    missing = [name for name in names if not rig.nominal.get(name, 0.0) > 0.0]
    if rig.electric or missing:
        raise InputError(
            f"rig {rig.name!r} states no nominal {' '.join(missing) or 'valve gains'}: an "
            "amplitude of a length needs them; expected volts"
        )
    pp, mp, pm, mm = (rig.nominal[name] for name in names)
    cap, rod = part.cylinder.cap_area, part.cylinder.rod_area
    extending = math.sqrt(cap * rig.supply.pressure / (cap**3 / pp**2 + rod**3 / mp**2))
    retracting = math.sqrt(rod * rig.supply.pressure / (cap**3 / pm**2 + rod**3 / mm**2))
    return 0.5 * (extending + retracting) * part.valve.spool_gain


def _waveform(part: Excite, step: str, rig: Rig) -> Waveform:
    where = f"step {step!r}, joint {part.joint}"
    try:
        if getattr(part.signal, "travel", None) is None:
            return part.signal.waveform(rig.sample_rate)
        return part.signal.sized(piston_gain(rig, part.joint - 1), rig.sample_rate)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


def _excite(part: Excite, step: str, wave: Waveform, rig: Rig) -> ExcitePlan:
    joint = rig.joints[part.joint - 1]
    where = f"step {step!r}, joint {part.joint}"
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
    allowed = highest_line(rig.sample_rate)
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
    gain, most = part.centring.position_gain, largest_centring_gain(rig, part.joint - 1)
    if gain > most:
        raise InputError(
            f"{where}: centring.position_gain {gain:g} V/m makes the piston oscillate: with its "
            f"valve, oil and load expected at most {plain(most, 3)} V/m"
        )
    return ExcitePlan(part.joint - 1, wave, part)
