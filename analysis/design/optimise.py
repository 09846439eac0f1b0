"""Improvement of an excitation: lines, amplitudes and phases for the worst parameters.

A seeded evolution strategy (one parent, one child) over the spectra of the steps. A child changes
one joint's spectrum in one step: a smooth bump of its amplitudes, another band, a few lines removed
or added, a new tilt, or its phases. Phases are then changed until the forecast peaks are low, and
the whole is scaled to reach the tightest limit. It is judged by the predicted covariance on the
twin (`predict`), with rows and noise as in the identification, and accepted if the criterion falls
and every error stays within its limit (`kept_error`). The information of the other steps is reused,
so a trial costs one step's simulation. Criteria, of the covariance relative to the nominal
parameters (Pintelon and Schoukens, ch. 5; Pronzato and Pazman, Design of Experiments in Nonlinear
Models, ch. 5): D log det, E the largest eigenvalue, or one parameter's variance.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.design.limits import forecast_of, tightest_limit
from analysis.design.moves import Tone, mutated, tilted, tone_of, with_tones
from analysis.design.predict import StepInformation, coefficients, covariance, information
from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, Played, TwinStep, play
from analysis.regression.rows import parameters_of
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used
from rig.model.parse import InputError
from rig.model.rig import Rig

log = logging.getLogger(__name__)
Say = Callable[[str], None]
Passes = Callable[[TwinStep, Mapping[int, Tone]], bool]


@dataclass(frozen=True)
class Candidate:
    """One step of a design: its tones by joint, the twin's motion, the information."""

    tones: Mapping[int, Tone]
    simulated: Played
    information: StepInformation
    share: float
    limit: str


@dataclass(frozen=True)
class Design:
    """The improved steps, and relative standard errors by parameter before and after."""

    steps: tuple[TwinStep, ...]
    tones: tuple[Mapping[int, Tone], ...]
    before: Mapping[str, float]
    after: Mapping[str, float]
    shares_before: Mapping[str, tuple[float, str]]
    shares_after: Mapping[str, tuple[float, str]]
    evaluated: int
    accepted: int


def improve(
    rig: Rig,
    steps: Sequence[TwinStep],
    empty: Mapping[tuple[str, int], tuple[int, ...]],
    criterion: str,
    budget: int,
    rng: np.random.Generator,
    say: Say = log.info,
    passes: Passes = lambda step, tones: True,
) -> Design:
    """Improve the steps' multisines with `budget` simulations of a step on the twin.

    `empty` names the detection lines of (step, 0-based joint) at the step's period; `criterion` is
    D, E or a parameter; `passes` may refuse a step before it is accepted. Raises InputError for an
    unknown criterion and where no step has a multisine.
    """
    search = _Search(rig, criterion, rng)
    candidates = [search.start(step, empty) for step in steps]
    tones = [
        (s, j) for s, c in enumerate(candidates) for j, t in c.tones.items() if len(t.chosen) > 1
    ]
    if not tones:
        raise InputError("no step has a multisine to improve; start from lock-and-excite-multisine")
    search.begin([c.information for c in candidates])
    before = search.errors([c.information for c in candidates])
    shares = {c.information.step: (c.share, c.limit) for c in candidates}
    plays, accepted, children = 0, 0, 0
    for s in dict.fromkeys(s for s, _ in tones):
        candidates[s], cost = search.fitted(candidates[s])
        plays += cost
    best = search.value([c.information for c in candidates])
    search.allow([c.information for c in candidates])
    shapes = [(s, joint, tilt) for tilt in DESIGN.first_tilts for s, joint in tones]
    while plays < budget:
        s, joint, tilt = shapes.pop(0) if shapes else (*tones[int(rng.integers(len(tones)))], None)
        child, cost = search.child(candidates[s], joint, tilt, plays < DESIGN.early_share * budget)
        plays, children = plays + cost, children + 1
        if child is None:
            continue
        trial = [*candidates[:s], child, *candidates[s + 1 :]]
        value = search.value([c.information for c in trial])
        if value < best and passes(child.simulated.step, child.tones):
            candidates, best, accepted = trial, value, accepted + 1
            say(f"{plays:4d} of {budget}: {search.text(value)} ({child.limit} {child.share:.0%})")
    return Design(
        tuple(c.simulated.step for c in candidates), tuple(c.tones for c in candidates), before,
        search.errors([c.information for c in candidates]), shares,
        {c.information.step: (c.share, c.limit) for c in candidates}, children, accepted,
    )  # fmt: skip


class _Search:
    """What all children share: rig, model, criterion, random generator, limits of the errors."""

    def __init__(self, rig: Rig, criterion: str, rng: np.random.Generator) -> None:
        self.rig, self.criterion, self.rng = rig, criterion, rng
        self.terms = tuple(Used(term) for term in baseline_of(rig))
        nominal = coefficients(rig, self.terms)
        self.names = {f: parameters_of(rig, self.terms, f) for f in FAMILIES}
        self.scale = {f: np.array([nominal[n] for n in names]) for f, names in self.names.items()}
        if criterion not in ("D", "E") and criterion not in nominal:
            raise InputError(
                f"--criterion {criterion}: expected D, E or a parameter: {' '.join(nominal)}"
            )
        self.allowed: dict[str, float] = {}
        self.gains: dict[str, Mapping[int, float]] = {}

    def begin(self, steps: Sequence[StepInformation]) -> None:
        """Set the errors' limits; raises InputError where the criterion is undetermined."""
        errors = self.errors(steps)
        undetermined = [n for n, e in errors.items() if not math.isfinite(e)]
        if self.criterion not in ("D", "E"):
            undetermined = [n for n in undetermined if n == self.criterion]
        if undetermined:
            raise InputError(
                f"the steps do not determine {' '.join(undetermined)}; no excitation helps: "
                "add a step that excites the joint concerned"
            )
        finite = {n: e for n, e in errors.items() if math.isfinite(e)}
        sizes = list(finite.values())
        overall = {"D": float(np.exp(np.mean(np.log(sizes)))), "E": max(sizes)}
        start = overall.get(self.criterion, finite.get(self.criterion, 0.0))
        self.allowed = {n: max(DESIGN.kept_error * e, start) for n, e in finite.items()}

    def allow(self, steps: Sequence[StepInformation]) -> None:
        """Raise the allowed errors to those of these steps, as scaled down to the limits."""
        for name, error in self.errors(steps).items():
            if name in self.allowed:
                self.allowed[name] = max(self.allowed[name], 1.001 * error)

    def relative(self, steps: Sequence[StepInformation]) -> dict[str, Array]:
        """Return the covariance of each family relative to the nominal coefficients."""
        return {
            f: covariance(steps, f)[0] / np.outer(self.scale[f], self.scale[f]) for f in FAMILIES
        }

    def errors(self, steps: Sequence[StepInformation]) -> dict[str, float]:
        """Return the relative standard errors by parameter."""
        out = {}
        for family, cov in self.relative(steps).items():
            for name, variance in zip(self.names[family], np.diag(cov), strict=True):
                out[name] = float(np.sqrt(variance))
        return out

    def value(self, steps: Sequence[StepInformation]) -> float:
        """Return the criterion, smaller is better; infinite where an error exceeds its limit."""
        covariances = self.relative(steps)
        errors = self.errors(steps)
        if any(not errors[n] <= limit for n, limit in self.allowed.items()):
            return math.inf
        if self.criterion == "D":
            return float(sum(np.linalg.slogdet(c)[1] for c in covariances.values()))
        if self.criterion == "E":
            return float(max(np.linalg.eigvalsh(c)[-1] for c in covariances.values()))
        return errors[self.criterion] ** 2

    def text(self, value: float) -> str:
        """Return a criterion's value in words, as a relative error."""
        if self.criterion == "D":
            size = sum(len(names) for names in self.names.values())
            return f"D: {100 * math.exp(0.5 * value / size):.4f} % geometric mean"
        target = "worst direction" if self.criterion == "E" else self.criterion
        return f"{target}: {100 * math.sqrt(value):.4f} %"

    def start(self, step: TwinStep, empty: Mapping[tuple[str, int], tuple[int, ...]]) -> Candidate:
        """Simulate the step as the protocol states it and determine its tones."""
        tones = {
            j: tone_of(j, wave, empty.get((step.name, j), ())) for j, wave in step.waves.items()
        }
        candidate = self.judged(step, tones)
        self.gains[step.name] = candidate.simulated.gains
        return candidate

    def judged(self, step: TwinStep, tones: Mapping[int, Tone]) -> Candidate:
        """Simulate a step; raises InputError where the twin cannot."""
        simulated = play(self.rig, step)
        step_information = information(self.rig, simulated, self.terms)
        return Candidate(tones, simulated, step_information, *tightest_limit(self.rig, simulated))

    def fitted(self, candidate: Candidate) -> tuple[Candidate, int]:
        """Scale a step that exceeds a limit down until it keeps them all."""
        cost = 0
        while candidate.share > DESIGN.fill and cost < 6:
            smaller = {
                j: replace(
                    t, spectrum=t.spectrum * (0.98 * DESIGN.fill / min(candidate.share, 2.0))
                )
                for j, t in candidate.tones.items()
            }
            candidate = self.judged(with_tones(candidate.simulated.step, smaller), smaller)
            cost += 1
        return candidate, cost

    def child(
        self, parent: Candidate, joint: int, tilt: float | None, early: bool
    ) -> tuple[Candidate | None, int]:
        """Return a changed copy of one step within the limits, or None, and the simulations spent.

        With a `tilt` all lines are used, amplitudes f^-tilt; without, the change is random. The
        forecast is renewed from each simulation, because the twin is not linear.
        """
        tone = parent.tones[joint]
        spectrum, plays = (
            mutated(tone, early, self.rng) if tilt is None else tilted(tone, tilt, self.rng)
        )
        base, fitting = parent, None
        for cost in range(1, plays + 1):
            forecast = forecast_of(self.rig, base.simulated, joint, tone.lines)
            spectrum, share = forecast.flattened(spectrum, DESIGN.phase_rounds)
            spectrum = spectrum * min(DESIGN.fill / share, DESIGN.largest_scaling)
            tones = {**parent.tones, joint: replace(tone, spectrum=spectrum)}
            try:
                base = self.judged(with_tones(base.simulated.step, tones), tones)
            except InputError:
                spectrum, base = 0.5 * spectrum, parent
                continue
            if not self.centrable(base):
                return fitting, cost
            if base.share <= DESIGN.fill * DESIGN.over_fill:
                fitting = base
                if base.share > DESIGN.near_fill * DESIGN.fill:
                    return fitting, cost
            spectrum = spectrum * (DESIGN.fill / min(base.share, DESIGN.largest_scaling))
        return fitting, plays

    def centrable(self, candidate: Candidate) -> bool:
        """Return whether the pistons' gains are about the same as at the start.

        The bench trims its biases by that gain. A joint that is excited only near its resonance
        shows none, and could not be kept within its stroke.
        """
        simulated = candidate.simulated
        reference = self.gains[simulated.step.name]
        return all(
            abs(math.log(k / reference[j])) < DESIGN.gain_band for j, k in simulated.gains.items()
        )
