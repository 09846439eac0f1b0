"""Proves a plan against the rig's limits on a twin, before anything moves.

For a step that is refused it finds a smaller amplitude with which it would pass.

The twin simulates commands; it is an argument, so that protocols and analysis stay independent.
Further twins, with parameters within their intervals, widen each predicted range (`widened`), and
limits are judged at the ends of these ranges. Centring is idealised: the bias is adjusted on the
twin until the piston no longer drifts, and its motion is then judged as if centred to within the
offset that the protocol allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from protocols.design.check_report import CheckReport, Moment, MotionPrediction, StepCheck, widened
from protocols.design.settings import DESIGN
from protocols.engine.centring import Array, follow, under_loop
from protocols.files.plan import Plan
from protocols.steps.base import PlannedStep
from protocols.steps.plans import ExcitePlan, StepPlan
from rig.model.parse import InputError
from rig.model.rig import Rig


class NotCentred(InputError):
    """A step whose pistons cannot be kept centred on the twin."""

    def __init__(self, message: str, step: StepPlan) -> None:
        super().__init__(message, step)  # so that it can be pickled
        self.step = step

    def __str__(self) -> str:
        """Return the message alone."""
        return str(self.args[0])


class Twin(Protocol):
    """Simulates commands (n, joints) [V] from pistons at `start` (joints,) [m].

    `locked` maps 0-based joints to the piston [m] they are held at. Returns `piston`, `speed`,
    `cap_pressure`, `rod_pressure`, each (n, joints), and may return `valid` (n,), 0 after the
    simulation failed.
    """

    def __call__(
        self, rig: Rig, commands: Array, start: Array, locked: Mapping[int, float]
    ) -> Mapping[str, Array]:
        """Run the simulation."""


def check(
    plan: Plan,
    rig: Rig,
    twin: Twin,
    progress: Callable[[float], None] | None = None,
    draws: Sequence[Twin] = (),
) -> CheckReport:
    """Predict every step on the twin and compare with the rig's limits.

    `draws` are twins within the uncertainty of `twin`; `progress` receives the
    share of the steps that is done, after each.
    Raises InputError where the twin cannot follow the commands at all; the report states whether
    limits are kept.
    """
    checked: dict[Hashable, StepCheck] = {}
    steps = []
    for step in plan.excitations:
        content = _content(step)  # steps of a sweep or a repetition are often alike
        if content not in checked:
            checked[content] = check_step(step, rig, twin, draws)
        steps.append(replace(checked[content], step=step.name))
        if progress is not None:
            progress(len(steps) / len(plan.excitations))
    return CheckReport(
        plan.protocol.name, rig.name, plan.seconds, tuple(steps), _timeline(plan),
        places=plan.places,
    )  # fmt: skip


def _content(step: StepPlan) -> Hashable:
    """Return the data that the prediction of a step depends on."""
    waves = tuple((e.joint, e.wave.samples.tobytes(), e.settings) for e in step.excite)
    return waves, step.locks, step.period, step.record


def _timeline(plan: Plan) -> tuple[Moment, ...]:
    """Return the start of each step if every condition holds at once."""
    moments: list[Moment] = []

    def add_moments(parts: Sequence[PlannedStep], begins: float) -> None:
        for part in parts:
            moments.append(Moment(part.name, part.title, begins, part.seconds, part.longest))
            add_moments(part.nested, begins)
            begins += part.seconds

    add_moments(plan.sequence, 0.0)
    return tuple(moments)


def check_step(step: StepPlan, rig: Rig, twin: Twin, draws: Sequence[Twin]) -> StepCheck:
    """Predict one step; raises InputError where the twin, or one of its draws, cannot follow it."""
    centring = centred(step, rig, twin)
    # The bench centres any machine, from the estimate's biases in one or two trials.
    others = [judge_motion(step, rig, centred(step, rig, draw, centring)) for draw in draws]
    return widened(judge_motion(step, rig, centring), others)


def judge_motion(step: StepPlan, rig: Rig, centring: CentredMotion) -> StepCheck:
    """Compare a step's motion on the twin with the rig's limits."""
    lines: list[MotionPrediction] = []
    for part in step.excite:
        lines += _joint_lines(part, rig, centring.biases[part.joint], centring.moved)
    lines.append(_flow_line(step, rig, centring.moved))
    return StepCheck(step.name, tuple(lines), {j + 1: v for j, v in centring.biases.items()})


@dataclass(frozen=True)
class CentredMotion:
    """Biases [V] that keep the pistons centred, and the simulation with the biases `applied` [V].

    `moved` is the last period's motion; `start` (joints,) are the pistons [m] at its beginning.
    """

    biases: dict[int, float]
    applied: dict[int, float]
    start: Array
    moved: Mapping[str, Array]


def centred(
    step: StepPlan, rig: Rig, twin: Twin, near: CentredMotion | None = None
) -> CentredMotion:
    """Find biases that keep the pistons centred, starting with those of `near` if given.

    Raises InputError where the twin cannot follow, NotCentred where another amplitude may help.
    """
    rate, joints = rig.sample_rate, len(rig.joints)
    locked = {part.joint: part.piston for part in step.locks}
    biases = {part.joint: 0.0 for part in step.excite}
    start = np.array([locked.get(j, 0.0) for j in range(joints)])
    for part in step.excite:
        start[part.joint] = part.centre
    if near is not None:
        biases, start = dict(near.applied), near.start.copy()
    seek = round(DESIGN.seek_seconds * rate)
    settled = math.ceil(DESIGN.settle_seconds * rate / step.period) * step.period + step.period
    for attempt in range(DESIGN.bias_tries):
        samples = min(seek, settled) if attempt < 2 and near is None else settled
        applied, initial = dict(biases), start.copy()
        commands = _commands(step, joints, biases, samples, rate)
        moved = twin(rig, commands, start, locked)
        steady = True
        for part in step.excite:
            steady &= _correct_bias(part, step, rate, commands, moved, biases, start)
        if steady and samples == settled:
            last_period = {name: values[-step.period :] for name, values in moved.items()}
            return CentredMotion(biases, applied, initial, last_period)
    numbers = ", ".join(str(part.joint + 1) for part in step.excite)
    raise NotCentred(
        f"{step.located}: on the twin joint {numbers} cannot be centred: after {DESIGN.bias_tries} "
        "biases it still drifts, or its simulation fails (end of the linkage, vacuum); "
        "lower the amplitude, or allow more drift",
        step,
    )


def _correct_bias(
    part: ExcitePlan, step: StepPlan, rate: float, commands: Array, moved: Mapping[str, Array],
    biases: dict[int, float], start: Array,
) -> bool:  # fmt: skip
    """Correct bias and start of one joint by a simulation; return whether it was centred."""
    j = part.joint
    piston = moved["piston"][:, j]
    valid = np.isfinite(piston) & (moved.get("valid", np.ones(len(piston))) > 0.0)
    count = len(piston) if valid.all() else int(np.argmin(valid))
    begin = round(DESIGN.ramp_seconds * rate) if count > 2 * DESIGN.ramp_seconds * rate else 0
    span = slice(max(begin, count - step.period), count)
    response = follow(commands[span, j], piston[span], rate)
    if not response.gain > 0.0:
        raise NotCentred(
            f"{step.located}: on the twin joint {j + 1} does not follow its command "
            f"({response.gain:.3g} m/s per volt, expected more than 0); lower the amplitude, or "
            "correct the nominal parameters of the rig or the model of the twin",
            step,
        )
    allowed = DESIGN.drift_share * part.settings.centring.drift
    offset = float(np.mean(piston[span])) - part.centre
    steady = count == len(piston) and abs(response.drift) * step.record / rate <= allowed
    biases[j] = response.null
    start[j] -= float(np.clip(offset, -5e-3, 5e-3)) if count == len(piston) else 0.0
    return steady


def _commands(
    step: StepPlan, joints: int, biases: Mapping[int, float], samples: int, rate: float
) -> Array:
    """Return growing commands (samples, joints) [V] that end with the end of a period."""
    commands = np.zeros((samples, joints))
    ramp = np.minimum(1.0, np.arange(samples) / (DESIGN.ramp_seconds * rate))
    for part in step.excite:
        wave = np.roll(np.resize(part.wave.samples, step.period), samples % step.period)
        commands[:, part.joint] = ramp * (np.resize(wave, samples) + biases[part.joint])
    return commands


def _joint_lines(
    part: ExcitePlan, rig: Rig, bias: float, moved: Mapping[str, Array]
) -> list[MotionPrediction]:
    j, limits = part.joint, rig.joints[part.joint].limits
    piston = moved["piston"][:, j]
    # Judged as centred exactly, then shifted by the allowed offset to either side.
    piston = piston - np.mean(piston) + part.centre
    offset = part.settings.centring.offset
    low, high = float(piston.min()) - offset, float(piston.max()) + offset
    name = j + 1
    lines = [
        MotionPrediction("piston", name, low, high, *limits.piston, "m"),
        _either_way("piston speed", name, moved["speed"][:, j], limits.speed, "m/s"),
        _either_way("command", name, part.wave.samples + bias, limits.command, "V"),
    ]
    loop = part.settings.centring.position_gain
    wave = np.resize(part.wave.samples, len(piston)) + bias
    pull = loop * max(follow(wave, piston, rig.sample_rate).gain, 1e-6)
    looped = under_loop(piston, pull, rig.sample_rate) + part.centre
    if np.ptp(looped) > DESIGN.largest_widening * np.ptp(piston):
        low, high = float(looped.min()) - offset, float(looped.max()) + offset
        lines.append(
            MotionPrediction("piston under the loop", name, low, high, *limits.piston, "m")
        )
    for chamber in ("cap_pressure", "rod_pressure"):
        pressure = moved[chamber][:, j]
        span = float(pressure.min()), float(pressure.max())
        rates = np.diff(pressure) * rig.sample_rate
        lines += [
            MotionPrediction(chamber, name, *span, *limits.pressure, "Pa"),
            _either_way(f"{chamber} rate", name, rates, limits.pressure_rate, "Pa/s"),
            MotionPrediction(
                f"{chamber} (cavitation, supply)", name, *span, 0.0, rig.supply.pressure, "Pa",
                binding=False,
            ),
        ]  # fmt: skip
    return lines


def _either_way(
    quantity: str, joint: int, values: Array, limit: float, unit: str
) -> MotionPrediction:  # fmt: skip
    return MotionPrediction(
        quantity, joint, float(np.min(values)), float(np.max(values)), -limit, limit, unit
    )


def _flow_line(step: StepPlan, rig: Rig, moved: Mapping[str, Array]) -> MotionPrediction:
    """Predict the pump flow: A_cap ds/dt extending, A_rod |ds/dt| retracting, of all joints."""
    demand = np.zeros(len(moved["speed"]))
    for part in step.excite:
        cylinder = rig.joints[part.joint].cylinder
        speed = moved["speed"][:, part.joint]
        demand += np.where(speed > 0.0, cylinder.cap_area * speed, -cylinder.rod_area * speed)
    peak = float(demand.max())
    return MotionPrediction(
        "pump flow", None, 0.0, peak, 0.0, rig.supply.flow, "m^3/s", binding=False
    )


PERCENT = 100  # factors are tried in hundredths, so that the factor written is the one tried


def passing_scale(step: StepPlan, rig: Rig, twin: Twin, draws: Sequence[Twin]) -> float | None:
    """Return the largest factor of a step's amplitudes with which it keeps every limit, or None.

    Found by bisection in hundredths below 1, and proved on the twin and its `draws`.
    """
    passes, fails = 0, PERCENT
    while fails - passes > 1:
        trial = (passes + fails) // 2
        try:
            passed = check_step(_resized(step, trial / PERCENT), rig, twin, draws).ok
        except InputError:
            passed = False
        if passed:
            passes = trial
        else:
            fails = trial
    return passes / PERCENT if passes else None


def _resized(step: StepPlan, factor: float) -> StepPlan:
    """Return a step with every waveform multiplied."""
    waves = (replace(part.wave, samples=factor * part.wave.samples) for part in step.excite)
    excite = (replace(part, wave=wave) for part, wave in zip(step.excite, waves, strict=True))
    return replace(step, excite=tuple(excite))
