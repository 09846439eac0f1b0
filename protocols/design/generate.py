"""Generates the lock-and-excite steps of a rig, with the proof that they determine all parameters.

Every candidate is sized on the twin until it keeps all limits (`protocols.design.candidates`); the
rows of its record follow from its motion there, and the smallest set is chosen by them
(`protocols.design.selection`). Rows and verdicts come from a predictor, an argument, so that
protocols and analysis stay independent.

Validation steps are sines, which are never used for a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from protocols.design.candidates import (
    CENTRING,
    SPARE,
    candidates,
    described,
    motion_within,
    multisine,
    sized,
)
from protocols.design.check import Twin, centred
from protocols.design.proof import Proof, Reason, Triangles, Verdicts, complete
from protocols.design.selection import Judge, SizedStep, extended, smallest
from protocols.design.settings import DESIGN
from protocols.engine.centring import Array
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.language.waveforms import highest_line
from protocols.signals.sine import Sine
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED, Excite, Lock
from rig.model.parse import InputError
from rig.model.rig import Rig

# A slow sine's travel is proportional to the gain, which differs from the twin's by some percent.
ROOM = {**SPARE, "piston": 0.1}


@dataclass(frozen=True)
class Predictor:
    """The twin, and the analysis of its motion.

    `rows(rig, moved, locked)` returns the triangle of each family's rows, `locked` being 1-based;
    `judge(rig, rows of each step)` returns what they determine together.
    """

    twin: Twin
    rows: Callable[[Rig, Mapping[str, Array], Sequence[int]], Triangles]
    judge: Callable[[Rig, Sequence[Triangles]], Verdicts]

    def judge_of(self, rig: Rig) -> Judge:
        """Return the judge of one rig."""
        return lambda rows: self.judge(rig, rows)


@dataclass(frozen=True)
class GeneratedProtocol:
    """A protocol and its proof."""

    protocol: Protocol
    proof: Proof


def generate(rig: Rig, predictor: Predictor, name: str) -> GeneratedProtocol:
    """Return the smallest set of steps found that determines every parameter of `rig`.

    Raises InputError where no candidate can be run on the rig at all, naming a sample rate too low.
    """
    _require_rate(rig, multisine(DESIGN.amplitude, 0).f_max)
    pool = _pool(rig, predictor)
    if not pool:
        raise InputError(
            f"rig {rig.name!r}: no step keeps the rig's limits on the twin at any amplitude; "
            "are limits, supply and nominal values right?"
        )
    chosen = smallest(pool, predictor.judge_of(rig))
    steps = tuple(
        sized.step.model_copy(update={"name": f"step{n}"})
        for n, sized in enumerate(chosen, start=1)
    )
    protocol = Protocol(
        name=name,
        description=f"Generated for {rig.name}: one joint excited at a time, all others locked",
        joints=len(rig.joints),
        steps=steps,
    )
    return GeneratedProtocol(protocol, prove(protocol, rig, predictor))


def _require_rate(rig: Rig, hertz: float) -> None:
    """Raise InputError where a rig is sampled too slowly for steps up to a frequency [Hz]."""
    allowed = highest_line(rig.sample_rate)
    if hertz >= allowed:
        raise InputError(
            f"rig {rig.name!r}: sample_rate: the steps excite up to {hertz:g} Hz; at "
            f"{rig.sample_rate:g} Hz they must stay below {allowed:g} Hz. Expected more than "
            f"{hertz * rig.sample_rate / allowed:g} Hz, or write a protocol of lower frequencies"
        )


def prove(protocol: Protocol, rig: Rig, predictor: Predictor) -> Proof:
    """Return what the steps of a protocol determine on the twin, and what would help if not all.

    Raises InputError for a protocol that does not fit the rig or that the twin cannot follow.
    """
    plan, judge = resolve(protocol, rig), predictor.judge_of(rig)
    added: list[SizedStep] = []
    reasons: list[Reason] = []
    before = judge([])
    for step, planned in zip(plan.protocol.excitations, plan.steps, strict=True):
        moved = centred(planned, rig, predictor.twin).moved
        rows = predictor.rows(rig, moved, [part.joint + 1 for part in planned.locks])
        added.append(SizedStep(step, rows))
        after = judge([proof.rows for proof in added])
        reasons.append(Reason(step.name, described(step), _why(before, after), after))
        before = after
    return Proof(
        protocol.name, rig.name, tuple(reasons), before,
        () if complete(before) else _help(added, rig, predictor),
    )  # fmt: skip


def _pool(rig: Rig, predictor: Predictor) -> list[SizedStep]:
    """Return every candidate that the rig allows, with its largest allowed amplitude."""
    pool = []
    for seed, step in enumerate(candidates(rig), start=1):
        result = sized(step, seed, rig, predictor.twin)
        if result is not None:
            sized_step, moved = result
            locked = [lock.joint for lock in sized_step.lock]
            pool.append(SizedStep(sized_step, predictor.rows(rig, moved, locked)))
    return pool


def _why(before: Verdicts, after: Verdicts) -> str:
    """Return the contribution of a step: parameters, combinations, or conditioning."""
    learned: list[str] = []
    words = []
    for family, verdict in after.items():
        earlier = before[family]
        identified = [name for name in verdict.identified if name not in earlier.identified]
        learned += identified
        if not identified and verdict.rank > earlier.rank:
            gained = verdict.rank - earlier.rank
            plural = "s" if gained > 1 else ""
            words.append(f"{gained} more combination{plural} of {family} parameters")
        elif earlier.complete and verdict.condition < DESIGN.condition_ratio * earlier.condition:
            words.append(f"{family} condition {earlier.condition:.3g} to {verdict.condition:.3g}")
    words = [f"determines {' '.join(learned)}"] * bool(learned) + words
    return "; ".join(words) or "no new parameter or combination"


def _help(steps: Sequence[SizedStep], rig: Rig, predictor: Predictor) -> tuple[str, ...]:
    """Return the steps, in words, that would make the other parameters identifiable."""
    pool = _pool(rig, predictor)
    further = extended(steps, pool, predictor.judge_of(rig))[len(steps) :]
    return tuple(described(candidate.step) for candidate in further)


def validation(rig: Rig, twin: Twin, name: str) -> Protocol:
    """Return each joint alone, then all at once, at 1 and 3 Hz, as large as limits allow.

    Raises InputError naming a step that exceeds a limit at any amplitude.
    """
    _require_rate(rig, max(DESIGN.sine_frequencies))
    N = len(rig.joints)
    steps = []
    for frequency in DESIGN.sine_frequencies:
        for joint in range(N, 0, -1):
            steps.append(
                _sized_sines(f"joint{joint}_{frequency:g}hz", (joint,), frequency, rig, twin)
            )
        if N > 1:
            all_joints = tuple(range(1, N + 1))
            steps.append(_sized_sines(f"all_{frequency:g}hz", all_joints, frequency, rig, twin))
    return Protocol(
        name=name,
        description=f"Validation records for a model of {rig.name}, 1 and 3 Hz sines",
        joints=N,
        steps=tuple(steps),
    )


def _sized_sines(
    name: str, moving: tuple[int, ...], frequency: float, rig: Rig, twin: Twin
) -> Step:
    for size in range(DESIGN.amplitude_tries):
        peak = DESIGN.sine_alone if len(moving) == 1 else DESIGN.sine_together
        amplitude = peak * DESIGN.amplitude_factor**size
        step = _sines(name, moving, frequency, float(f"{amplitude:.3g}"), len(rig.joints))
        if motion_within(step, rig, twin, ROOM) is not None:
            return step
    raise InputError(
        f"rig {rig.name!r}: {name} passes a limit on the twin at any amplitude; are limits, "
        "supply and nominal values right?"
    )


def _sines(name: str, moving: tuple[int, ...], hertz: float, volts: float, joints: int) -> Step:
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
