"""The result of a trace, as data and as JSON."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from analysis.identify.output_error.hidden_states import ShootingEstimate
from analysis.simulation.model import Estimate, Model, estimate_json, finite
from analysis.trace.data.noise_floor import Floor
from analysis.trace.data.spectral_lines import SpectralLines
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.settings import CLUES, TRACE
from rig.model.channels import place_in_words
from rig.model.units import plain

Array = NDArray[np.float64]

CLEAN: Final = "clean"
EXPLAINED: Final = "explained"
CONFOUNDED: Final = "confounded"
UNEXPLAINED: Final = "unexplained"
NAMED: Final = "named"
FREE: Final = "free"
_NAME: Final = re.compile(r"[a-z]+(?:_[a-z]+)*(?:_[0-9]+)?")


@dataclass(frozen=True)
class Formula:
    """A formula that an equation's residual follows: coefficient [SI] by monomial.

    `share` is the share of the held-out energy above noise that it removes; `at_piston`: its value
    is a force at the piston [N], not the equation's torque or flow.
    """

    equation: str
    terms: Mapping[str, float]
    share: float
    at_piston: bool

    @property
    def text(self) -> str:
        """The formula in one line."""
        parts = [
            f"{'' if value < 0 else '+'}{plain(value, 3)} {name}".replace("e-0", "e-")
            for name, value in self.terms.items()
        ]
        line = " ".join(parts).removeprefix("+")
        what = "force at the piston [N]" if self.at_piston else f"{self.equation} [SI]"
        return f"{what} ≈ {line}"

    @property
    def sure(self) -> bool:
        """Whether it is listed before curves: few monomials, with a variable, that leave little."""
        return (
            self.share >= CLUES.leading_share
            and len(self.terms) <= CLUES.leading_monomials
            and bool(self.variables)
        )

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables of its first monomial that has any, in order."""
        for name in self.terms:
            names = [word for word in _NAME.findall(name) if word != "sign"]
            if names:
                return tuple(dict.fromkeys(names))
        return ()


@dataclass(frozen=True)
class Rival:
    """An effect that may take the place of a judged one.

    `ratio` and `training_ratio` are the whitened residual rms of the set with the rival over that
    of the best set, held out and in training. `tied`: the records cannot separate the two. `at` is
    the rival's place in the catalogue, with sensor or chamber. `moved` names the baseline parameter
    that a tied rival changes most, with its relative change; None if it changes none noticeably.
    `beside` is a second effect, which fits in the place of the judged one only with the first.
    """

    name: str
    where: str
    ratio: float
    training_ratio: float
    tied: bool
    at: str = ""
    moved: tuple[str, float] | None = None
    beside: Rival | None = None

    @property
    def location(self) -> str:
        """Where it is, in words: of a sensor or chamber, which; with the effect beside it."""
        place = place_in_words(self.at or self.where)
        other = self.beside
        return f"{place} with {other.name} at {other.location}" if other else place

    @property
    def effects(self) -> tuple[Rival, ...]:
        """The rival and the effect beside it, each as a rival by itself."""
        alone = replace(self, beside=None)
        return (alone, *self.beside.effects) if self.beside else (alone,)


@dataclass(frozen=True)
class Gate:
    """One condition for naming an effect: its name, whether it holds, and the figures."""

    name: str
    ok: bool
    detail: str


@dataclass(frozen=True)
class Curve:
    """One line y(x) of an effect's curve with the 95 % band of it; arrays (m,)."""

    label: str
    x: Array
    y: Array
    lo: Array
    hi: Array
    unit_x: str
    unit_y: str


@dataclass(frozen=True)
class JudgedEffect:
    """An effect with its parameters, evidence and the gates it passed or not.

    `removed_fraction` is the share of held-out energy above noise that the effect removes in the
    equations where it acts, beside the other effects. `shot` are the shapes of an effect with a
    hidden state by multiple shooting. `mechanism` is the part of the physics in which it acts; a
    `free` effect is described by its `curves` instead of a name. `rms_without` and `rms_with` are
    the held-out rms in its equations without and with it, over the noise of the averaged repeats.
    `at` is its place in the catalogue, with sensor or chamber.
    """

    name: str
    where: str
    parameters: Mapping[str, Estimate]
    p_value: float
    removed_fraction: float
    rivals: tuple[Rival, ...]
    gates: tuple[Gate, ...]
    variable: str = ""
    shot: ShootingEstimate | None = None
    mechanism: str = ""
    free: bool = False
    curves: tuple[Curve, ...] = ()
    rms_without: float = math.nan
    rms_with: float = math.nan
    at: str = ""

    @property
    def location(self) -> str:
        """Where it is, in words: of a sensor or chamber, which."""
        return place_in_words(self.at or self.where)

    @property
    def named(self) -> bool:
        """Whether every gate holds."""
        return all(gate.ok for gate in self.gates)


@dataclass(frozen=True)
class Dependence:
    """A variable that the remaining residual depends on.

    `share` is the share of held-out energy above noise that its curve removes. The curve may
    multiply another variable, `by`; `words` describe a dependence that is more than one curve.
    """

    variable: str
    share: float
    equation: str
    by: str = ""
    words: str = ""

    @property
    def text(self) -> str:
        """The dependence in words."""
        return self.words or self.variable


@dataclass(frozen=True)
class FreeCurves:
    """The first seconds of a held-out record: measured, and free runs before and after, SI.

    `time` has shape (n,), so has every channel of `measured`, `before` and `after`.
    """

    record: str
    time: Array
    units: Mapping[str, str]
    measured: Mapping[str, Array]
    before: Mapping[str, Array]
    after: Mapping[str, Array]


@dataclass(frozen=True)
class DetectionLimit:
    """The largest size of an effect that would leave no residual above the noise.

    `size` [unit] is the difference of the effect's number `quantity` from its `neutral` value. An
    effect of this size would change `parameter` by `shift`, a share of its value. Not `possible`:
    no machine has an effect of this size, so that none is excluded.
    """

    name: str
    where: str
    at: str
    quantity: str
    size: float
    unit: str
    neutral: float
    parameter: str
    shift: float
    possible: bool


@dataclass(frozen=True)
class Trace:
    """The result of a trace, in SI units and percent; before and after: without, with the effects.

    `noise_floor`, `before` and `after` are rms residuals of the judging rows, by equation; `size`
    is the rms of each equation's right side. `fit_*` and `rmse_*` are of free runs over whole
    held-out and judging records, `window_*` of 0.25 s windows restarted from the data.

    `floors` are the training records' residuals under the baseline, split into repeatable part and
    noise; `lines` are the spectral lines of the training residual, largest first. `notes` state
    where the evidence is weak. `refused` are effects that fitted best but failed a gate.
    `rows_before` and `rows_after` are the fits that the errors are computed with, temperature and
    spool path included; the models are at the rig's nominal temperature.
    """

    verdict: str
    effects: tuple[JudgedEffect, ...]
    noise_floor: Mapping[str, float]
    before: Mapping[str, float]
    after: Mapping[str, float]
    fit_before: Mapping[str, float]
    fit_after: Mapping[str, float]
    model_before: Model
    model_after: Model
    unexplained_fraction: float
    depends_on: tuple[Dependence, ...]
    next_experiment: Mapping[str, Any] | None
    floors: tuple[Floor, ...]
    rows_before: ExactFit
    rows_after: ExactFit
    notes: tuple[str, ...] = ()
    sentence: str = ""
    seconds: float = 0.0
    refused: tuple[JudgedEffect, ...] = ()
    size: Mapping[str, float] = field(default_factory=dict)
    rmse_before: Mapping[str, float] = field(default_factory=dict)
    rmse_after: Mapping[str, float] = field(default_factory=dict)
    window_before: Mapping[str, float] = field(default_factory=dict)
    window_after: Mapping[str, float] = field(default_factory=dict)
    lines: tuple[SpectralLines, ...] = ()
    formulas: tuple[Formula, ...] = ()
    free_curves: FreeCurves | None = None
    detection_limits: tuple[DetectionLimit, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the model after has other terms than the model before."""
        return self.model_after.terms != self.model_before.terms

    @property
    def errors_changed(self) -> bool:
        """Whether the effects change an error, also of a torque that is in no model."""
        return self.changed or self.after != self.before

    @property
    def tied_at(self) -> list[tuple[str, str]]:
        """Name and catalogue place (with sensor or chamber) of the rivals of `tied`."""
        return sorted({(r.name, r.at or r.where) for r in self._tied_rivals})

    @property
    def tied(self) -> list[tuple[str, str]]:
        """Name and place of the rivals that the data cannot separate from an effect named."""
        return sorted({(r.name, r.where) for r in self._tied_rivals})

    @property
    def _tied_rivals(self) -> list[Rival]:
        return [x for e in self.effects for r in e.rivals if r.tied for x in r.effects]

    def worst(self, error: Mapping[str, float]) -> float:
        """Return the largest of the held-out errors, `before` or `after`, over its noise floor."""
        return float(np.nanmax([error[e] / max(self.noise_floor[e], 1e-30) for e in error]))

    @property
    def above_floor(self) -> list[str]:
        """The equations whose `after` exceeds `TRACE.noted_ratio` noise floors, worst first."""
        over = {e: error / max(self.noise_floor[e], 1e-30) for e, error in self.after.items()}
        return sorted((e for e in over if over[e] > TRACE.noted_ratio), key=lambda e: -over[e])

    def remaining_share(self, equation: str) -> float:
        """Return the energy above noise of `after` over that of `before`, in an equation."""
        floor, before, after = (
            error[equation] ** 2 for error in (self.noise_floor, self.before, self.after)
        )
        return (after - floor) / max(before - floor, 1e-30)

    @property
    def residual_variables(self) -> tuple[str, ...]:
        """The variables that the remaining residual depends on, strongest first, each once."""
        names = [name for d in self.depends_on for name in (d.variable, d.by) if name]
        return tuple(dict.fromkeys(names))


def to_json(result: Trace) -> dict[str, Any]:
    """Return the contract's JSON.

    Added to it are `refused at gates size rmse window_rmse noise lines notes sentence seconds
    detection_limits`, and `free_run`, to be drawn.
    """
    return {
        "verdict": result.verdict,
        "effects": [_effect(e) for e in result.effects],
        "refused": [_effect(e) for e in result.refused],
        "error": {
            "noise_floor": _numbers(result.noise_floor),
            "before": _numbers(result.before),
            "after": _numbers(result.after),
        },
        "fit": {"before": _numbers(result.fit_before), "after": _numbers(result.fit_after)},
        "size": _numbers(result.size),
        "rmse": {"before": _numbers(result.rmse_before), "after": _numbers(result.rmse_after)},
        "window_rmse": {
            "before": _numbers(result.window_before), "after": _numbers(result.window_after),
        },
        "free_run": _free_run(result.free_curves) if result.free_curves else None,
        "parameters": {
            "before": _parameters(result.model_before),
            "after": _parameters(result.model_after),
        },
        "unexplained": {
            "fraction": finite(result.unexplained_fraction),
            "depends_on": list(result.residual_variables),
            "shares": {d.text: finite(d.share) for d in result.depends_on},
            "formulas": [
                {
                    "equation": f.equation, "text": f.text, "share": finite(f.share),
                    "terms": dict(f.terms),
                }
                for f in result.formulas
            ],
        },
        "next_experiment": dict(result.next_experiment) if result.next_experiment else None,
        "noise": [
            {
                "step": f.group[1], "equation": f.equation, "noise": finite(f.noise),
                "repeatable": finite(f.repeatable), "source": f.source, "count": f.count,
            }
            for f in result.floors
        ],
        "lines": [_lines(lines) for lines in result.lines],
        "detection_limits": [asdict(limit) for limit in result.detection_limits],
        "notes": list(result.notes),
        "sentence": result.sentence,
        "seconds": result.seconds,
    }  # fmt: skip


def _effect(effect: JudgedEffect) -> dict[str, Any]:
    return {
        "name": effect.name,
        "where": effect.where,
        "at": effect.at or effect.where,
        "mechanism": effect.mechanism,
        "form": FREE if effect.free else NAMED,
        "curve": _curve(effect.curves[0]) if effect.curves else None,
        "curves": [_curve(curve) for curve in effect.curves],
        "parameters": {n: estimate_json(e) for n, e in effect.parameters.items()},
        "p_value": finite(effect.p_value),
        "removed_fraction": finite(effect.removed_fraction),
        "rivals": [
            {
                "name": r.name, "where": r.where, "at": r.at or r.where,
                "held_out_ratio": finite(r.ratio), "training_ratio": finite(r.training_ratio),
                "tied": r.tied,
                "moved": {"parameter": r.moved[0], "relative": r.moved[1]} if r.moved else None,
                "beside": [x.name for x in rival.effects if (x.name, x.at) != (r.name, r.at)],
            }
            for rival in effect.rivals for r in rival.effects
        ],
        "gates": [{"name": g.name, "ok": g.ok, "detail": g.detail} for g in effect.gates],
        "shooting": _shot(effect.shot) if effect.shot else None,
    }  # fmt: skip


def _curve(curve: Curve) -> dict[str, Any]:
    numbers = {n: [float(v) for v in getattr(curve, n)] for n in ("x", "y", "lo", "hi")}
    return {"label": curve.label, **numbers, "unit_x": curve.unit_x, "unit_y": curve.unit_y}


def _free_run(curves: FreeCurves) -> dict[str, Any]:
    def numbers(values: Array) -> list[float | None]:
        return [finite(float(f"{v:.6g}")) for v in values]

    kinds = ("measured", "before", "after")
    channels = {
        name: {"unit": curves.units[name], **{k: numbers(getattr(curves, k)[name]) for k in kinds}}
        for name in curves.measured
    }
    return {"record": curves.record, "time": numbers(curves.time), "channels": channels}


def _shot(shot: ShootingEstimate) -> dict[str, Any]:
    return {
        "parameters": {n: estimate_json(e) for n, e in shot.shapes.items()},
        "windows": shot.windows, "settled": shot.settled, "taken": shot.taken,
        "held_out_windows": {"rows": finite(shot.before), "shooting": finite(shot.after)},
    }  # fmt: skip


def _lines(lines: SpectralLines) -> dict[str, Any]:
    return {
        "step": lines.group[1], "equation": lines.equation,
        "above_noise": finite(lines.above_noise),
        "shares": _numbers(lines.shares), "shares_after": _numbers(lines.shares_after),
        "text": lines.text,
    }  # fmt: skip


def _numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: finite(value) for name, value in values.items()}


def _parameters(model: Model) -> dict[str, Any]:
    return {name: estimate_json(e) for name, e in model.parameters.items()}
