"""Excitations within the limits of a rig: candidates for the next experiment.

A candidate is one step: joints locked as in some step of the training records (or none locked),
the others moved by one of a few families of lines. The families differ in what catalogue effects
differ in: slow sweeps over the stroke (gravity, springs, offsets, leakage), small amplitudes about
the valve's null (edges), fast lines (oil's softness, lags, delays), motion about a place off the
middle of the stroke (volumes, levers), everything at once. Each is played on the twin and scaled
until it fills its share of the tightest limit.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from analysis.design.limits import Spectrum, forecast_of, tightest_limit
from analysis.design.moves import Tone, with_tones
from analysis.design.twin_records import Played, TwinStep, play
from analysis.regression.conditioned import ConditionedRecord
from analysis.trace.settings import EXPERIMENT
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Family:
    """Lines from `low` to `high` [Hz] at multiples of `base`, amplitudes f^-tilt.

    `level` is the share of `EXPERIMENT.fill` that is used, `centre` the place in the
    stroke as a share of half of it, `words` its description for the user.
    """

    name: str
    words: str
    base: float
    low: float
    high: float
    tilt: float
    level: float = 1.0
    centre: float = 0.0


FAMILIES: Final = (
    Family("wide", "at all frequencies, as much as the limits allow", 0.1, 0.5, 9.5, 0.25),
    Family("slow", "slowly over the whole stroke", 0.1, 0.1, 0.9, 0.5),
    Family("creep", "very slowly in both directions over the whole stroke", 0.1, 0.1, 0.3, 1.0),
    # Changes the pressures most within the limits: residuals by air are twice those up to 15 Hz.
    Family("brisk", "up to 10 Hz with equal amplitudes", 0.2, 0.6, 10.0, 0.0),
    # Its few slow lines move the piston, which the bench needs to centre it.
    # Much faster, a joint that is held and one behind a closed valve resonate otherwise.
    Family("fast", "up to 15 Hz with equal amplitudes", 0.2, 0.6, 15.0, 0.0),
    Family("small", "with small amplitudes about the valve's null", 0.1, 0.3, 5.0, 0.25, 0.12),
    Family(
        "out", "at all frequencies, a quarter of the stroke above mid-stroke", 0.1, 0.5, 9.5, 0.25,
        centre=0.5,
    ),
    Family(
        "in", "at all frequencies, a quarter of the stroke below mid-stroke", 0.1, 0.5, 9.5, 0.25,
        centre=-0.5,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class JointSetting:
    """Position [m] of joints (0-based) behind a `closed` valve or `held` at an end; others move."""

    closed: Mapping[int, float]
    held: Mapping[int, float]

    def moving(self, rig: Rig) -> tuple[int, ...]:
        """The excited joints, 0-based."""
        return tuple(
            j for j in range(len(rig.joints)) if j not in self.closed and j not in self.held
        )


@dataclass(frozen=True)
class CandidateExcitation:
    """One candidate excitation as simulated on the twin, with the data of its protocol step."""

    family: Family
    setting: JointSetting
    tones: Mapping[int, Tone]
    played: Played

    @property
    def step(self) -> TwinStep:
        """The step as the twin runs it."""
        return self.played.step

    @property
    def text(self) -> str:
        """The excitation in words."""
        moved = " and ".join(str(j + 1) for j in self.tones)
        which = f"joint{'s' if len(self.tones) > 1 else ''} {moved} moved"
        stand = [
            *(f"joint {j + 1} locked at {1e3 * p:.0f} mm" for j, p in self.setting.closed.items()),
            *(
                f"joint {j + 1} at its {'minimum' if p < 0 else 'maximum'}"
                for j, p in self.setting.held.items()
            ),
        ]
        return ", ".join([f"{which} {self.family.words}", *stand])


def joint_settings(rig: Rig, records: Sequence[ConditionedRecord]) -> list[JointSetting]:
    """Return the joint settings of the steps of the records, and that of all joints free."""
    settings: list[JointSetting] = []
    for conditioned in records:
        closed, held = {}, {}
        for joint in conditioned.record.locked:
            piston = float(np.nanmean(conditioned.record.channels[ch.channel(ch.PISTON, joint)]))
            half = 0.5 * rig.joints[joint - 1].cylinder.stroke
            if half - abs(piston) < EXPERIMENT.end_distance:
                held[joint - 1] = float(np.copysign(half, piston))
            else:
                closed[joint - 1] = round(piston, 3) + 0.0  # no -0
        settings.append(JointSetting(closed, held))
    settings.append(JointSetting({}, {}))
    return [s for k, s in enumerate(settings) if s.moving(rig) and s not in settings[:k]]


def excitations(
    rig: Rig, records: Sequence[ConditionedRecord], rng: np.random.Generator
) -> Iterator[CandidateExcitation]:
    """Yield every family in every setting that the twin can follow within the limits.

    Yields nothing for a rig without nominal values or with electric joints, which has no twin.
    """
    if rig.electric:
        return
    for setting in joint_settings(rig, records):
        for family in FAMILIES:
            candidate = excitation(rig, setting, family, rng)
            if candidate is not None:
                yield candidate


def excitation(
    rig: Rig, setting: JointSetting, family: Family, rng: np.random.Generator
) -> CandidateExcitation | None:
    """Return a family in a setting, scaled to its share of the limits; None where impossible."""
    tones = {j: _tone(j, family, rng) for j in setting.moving(rig)}
    step = _twin_step(rig, setting, family, tones)
    goal = EXPERIMENT.fill * family.level
    best: CandidateExcitation | None = None
    try:
        for attempt in range(EXPERIMENT.plays):
            played = play(rig, with_tones(step, tones))
            share = tightest_limit(rig, played)[0]
            step = played.step
            if share <= 1.05 * goal:
                best = CandidateExcitation(family, setting, tones, played)
                if share >= 0.9 * goal:
                    break
            if attempt == 0 and len(tones) == 1:
                tones = {j: _flattened(rig, played, t) for j, t in tones.items()}
            factor = float(np.clip(goal / share, 0.1, 5.0))
            tones = {j: replace(t, spectrum=t.spectrum * factor) for j, t in tones.items()}
    except InputError as error:
        log.info("%s is not possible: %s", family.name, error)
    return best


def _flattened(rig: Rig, played: Played, tone: Tone) -> Tone:
    forecast = forecast_of(rig, played, tone.joint, tone.lines)
    return replace(tone, spectrum=forecast.flattened(tone.spectrum, EXPERIMENT.phase_rounds)[0])


def _tone(joint: int, family: Family, rng: np.random.Generator) -> Tone:
    lines = np.arange(round(family.low / family.base), round(family.high / family.base) + 1)
    lines = lines[lines % 2 == 1]
    size = lines.astype(np.float64) ** -family.tilt
    size *= EXPERIMENT.first_rms * np.sqrt(2) * family.level / np.linalg.norm(size)
    return Tone(joint, lines, size * np.exp(2j * np.pi * rng.random(len(lines))), ())


def _twin_step(
    rig: Rig, setting: JointSetting, family: Family, tones: Mapping[int, Tone]
) -> TwinStep:  # fmt: skip
    period = round(rig.sample_rate / family.base)
    places = {j: family.centre * 0.5 * rig.joints[j].cylinder.stroke for j in tones}
    return TwinStep(
        name=f"next_{family.name}",
        waves={j: np.zeros(period) for j in tones},
        lines=(),
        held=dict(setting.held),
        closed=dict(setting.closed),
        centres=places,
        biases={},
        samples=period,
        repeats=EXPERIMENT.repeats,
        yields=dict.fromkeys(setting.closed, EXPERIMENT.closed_travel),
        offsets=dict.fromkeys(tones, EXPERIMENT.centring_offset),
        loops=dict.fromkeys(tones, EXPERIMENT.position_gain),
    )


def protocol(
    rig: Rig, chosen: Sequence[CandidateExcitation], name: str, scale: float = 1.0,
    rng: np.random.Generator | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the mapping of a protocol file with these steps; with `rng` phases are drawn again."""
    return {
        "name": name,
        "description": "; ".join(candidate.text for candidate in chosen),
        "joints": len(rig.joints),
        "steps": [
            _step_mapping(rig, candidate, k, scale, rng)
            for k, candidate in enumerate(chosen, start=1)
        ],
    }


def _step_mapping(
    rig: Rig,
    candidate: CandidateExcitation,
    number: int,
    scale: float,
    rng: np.random.Generator | None,
) -> dict[str, Any]:
    locks = [
        {"joint": j + 1, "at": "closed", "piston": f"{1e3 * p:.6g} mm",
         "tolerance": f"{1e3 * EXPERIMENT.closed_travel:g} mm"}
        for j, p in candidate.setting.closed.items()
    ] + [
        {"joint": j + 1, "at": "end_max" if p > 0 else "end_min",
         "tolerance": f"{1e3 * EXPERIMENT.end_travel:g} mm"}
        for j, p in candidate.setting.held.items()
    ]  # fmt: skip
    offset = f"{1e3 * EXPERIMENT.centring_offset:g} mm"
    excite = []
    for j, tone in candidate.tones.items():
        n = candidate.step.period
        spectrum = tone.spectrum if rng is None else _other_phases(tone, n, rng)
        excite.append(
            {
                "joint": j + 1,
                "signal": {
                    "kind": "lines",
                    "base_frequency": f"{rig.sample_rate / candidate.step.period:.9g} Hz",
                    "lines": [int(k) for k in tone.lines],
                    "amplitudes": [f"{scale * abs(a):.5g} V" for a in spectrum],
                    "phases": [f"{np.angle(a):.5g} rad" for a in spectrum],
                },
                "centre": f"{1e3 * candidate.step.centres[j]:.6g} mm",
                "centring": {
                    "mode": "open-loop",
                    "position_gain": f"{EXPERIMENT.position_gain:g} V/m",
                    "drift": offset,
                    "offset": offset,
                    "tries": 6,
                },
            }
        )
    return {
        "name": f"next{number}_{candidate.family.name}",
        "lock": locks,
        "excite": excite,
        "repeats": EXPERIMENT.repeats if rng is None else EXPERIMENT.held_out_repeats,
    }


def _other_phases(tone: Tone, n: int, rng: np.random.Generator) -> Spectrum:
    """Return a tone's spectrum with new phases, of several draws the one with the smallest peak.

    `n` is the number of samples of a period.
    """
    size, best_spectrum, least_peak = np.abs(tone.spectrum), tone.spectrum, np.inf
    for _ in range(EXPERIMENT.phase_draws):
        spectrum = size * np.exp(2j * np.pi * rng.random(len(size)))
        signals = np.zeros((2, n // 2 + 1), dtype=np.complex128)
        signals[0, tone.lines], signals[1, tone.lines] = spectrum, spectrum / (1j * tone.lines)
        # Of the command and of its integral, which the piston follows.
        peak = float(np.prod(np.ptp(np.fft.irfft(signals, n, axis=1), axis=1)))
        if peak < least_peak:
            best_spectrum, least_peak = spectrum, peak
    return best_spectrum
