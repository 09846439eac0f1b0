"""The expected behaviour of a protocol on a rig, as a test sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Any, Final, Self

from protocols.design.settings import DESIGN
from rig.model.parse import InputError
from rig.model.units import LIMITS, display_unit

NOMINAL: Final = "nominal values"


@dataclass(frozen=True)
class MotionPrediction:
    """One line of the report: quantity, predicted range, allowed range, unit.

    `joint` is 1-based, None for the bench. Only a `binding` line can refuse the plan; the others
    state where records will be worse (a sagging supply, cavitation). `spread` is the part of the
    range, below and above, due to the uncertainty of the twin's parameters; `low` and `high`
    include it.
    """

    quantity: str
    joint: int | None
    low: float
    high: float
    allowed_low: float
    allowed_high: float
    unit: str
    binding: bool = True
    spread: tuple[float, float] = (0.0, 0.0)

    @property
    def margin(self) -> float:
        """Distance of the prediction from the nearest limit, in `unit`; negative if exceeded.

        A flow that begins at zero has an upper limit only.
        """
        above = self.allowed_high - self.high
        return (
            above
            if self.low == self.allowed_low == 0.0
            else min(self.low - self.allowed_low, above)
        )

    @property
    def ok(self) -> bool:
        """Whether the limit is kept."""
        return self.margin >= 0.0


@dataclass(frozen=True)
class StepCheck:
    """The predictions of one step, and the bias [V] of each excited joint (1-based) on the twin."""

    step: str
    predictions: tuple[MotionPrediction, ...]
    biases: Mapping[int, float]

    @property
    def ok(self) -> bool:
        """Whether every limit is kept."""
        return all(line.ok for line in self.predictions if line.binding)


def widened(central: StepCheck, others: Sequence[StepCheck]) -> StepCheck:
    """Widen each predicted range by two standard deviations of its ends over further twins.

    A standard deviation is the root mean square difference from the central prediction. A fixed end
    of a range (no flow below zero) is kept, because no twin differs there.
    """
    if not others:
        return central
    by_quantity = [{(p.quantity, p.joint): p for p in other.predictions} for other in others]
    lines = []
    for line in central.predictions:
        matching = [k[name] for k in by_quantity if (name := (line.quantity, line.joint)) in k]
        below, above = (
            DESIGN.sigmas
            * math.sqrt(sum((end(p) - end(line)) ** 2 for p in matching) / max(len(matching), 1))
            for end in (attrgetter("low"), attrgetter("high"))
        )
        lines.append(
            replace(line, low=line.low - below, high=line.high + above, spread=(below, above))
        )
    return replace(central, predictions=tuple(lines))


@dataclass(frozen=True)
class Moment:
    """A step in the run's schedule: its start, its expected and its longest time [s]."""

    name: str
    title: str
    begins: float
    seconds: float
    longest: float


@dataclass(frozen=True)
class CheckReport:
    """The expected behaviour of a protocol on a rig; `twin` names the parameters simulated.

    `places` holds file and line of each step, by name; it is not part of the stored report.
    """

    protocol: str
    rig: str
    seconds: float
    steps: tuple[StepCheck, ...] = field(default=())
    timeline: tuple[Moment, ...] = ()
    scales: Mapping[str, float | None] = field(default_factory=dict)
    twin: str = NOMINAL
    places: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the report that `as_dict` wrote; KeyError or TypeError for anything else."""
        steps = tuple(
            StepCheck(
                entry["step"],
                tuple(_line(line) for line in entry["predictions"]),
                {int(joint): bias for joint, bias in entry["biases"].items()},
            )
            for entry in data["steps"]
        )
        timeline = tuple(Moment(**entry) for entry in data["timeline"])
        return cls(
            data["protocol"], data["rig"], data["seconds"], steps, timeline, data["scales"],
            data["twin"],
        )  # fmt: skip

    def _start(self, step: str) -> str:
        """Return the start of a step as text for a refusal."""
        moments = [moment for moment in self.timeline if moment.name == step]
        return f", about {moments[0].begins:.0f} s into the run" if moments else ""

    def _remedy(self, step: str) -> str:
        return f"; {remedy_text(self.scales[step])}" if step in self.scales else ""

    @property
    def refused(self) -> tuple[str, ...]:
        """One line per limit that would be exceeded."""
        return tuple(
            _text(check.step, line, self.twin) + self._start(check.step) + self._remedy(check.step)
            for check in self.steps
            for line in check.predictions
            if line.binding and not line.ok
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """One line per expectation that is not a limit but will not be met."""
        return tuple(
            _text(check.step, line, self.twin)
            for check in self.steps
            for line in check.predictions
            if not line.binding and not line.ok
        )

    @property
    def ok(self) -> bool:
        """Whether every limit is kept."""
        return not self.refused

    def require(self) -> None:
        """Raise InputError naming the first limit that would be exceeded."""
        if self.refused:
            more = f" (and {len(self.refused) - 1} more)" if len(self.refused) > 1 else ""
            step = next(check.step for check in self.steps if not check.ok)
            where = f"{self.places[step]}: " if step in self.places else ""
            raise InputError(f"{where}protocol {self.protocol!r} refused: {self.refused[0]}{more}")

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain data in SI."""
        return {
            "protocol": self.protocol,
            "rig": self.rig,
            "seconds": self.seconds,
            "ok": self.ok,
            "twin": self.twin,
            "timeline": [asdict(moment) for moment in self.timeline],
            "scales": dict(self.scales),
            "steps": [
                {
                    "step": check.step,
                    "biases": {str(j): v for j, v in check.biases.items()},
                    "predictions": [
                        {
                            "quantity": line.quantity,
                            "joint": line.joint,
                            "predicted": [line.low, line.high],
                            "allowed": [line.allowed_low, line.allowed_high],
                            "margin": line.margin,
                            "unit": line.unit,
                            "binding": line.binding,
                            "ok": line.ok,
                            "spread": list(line.spread),
                        }
                        for line in check.predictions
                    ],
                }
                for check in self.steps
            ],
        }


def _text(step: str, line: MotionPrediction, twin: str) -> str:
    shown = display_unit(line.unit, LIMITS)
    scale, unit = shown.scale, shown.text
    where = "the bench" if line.joint is None else f"joint {line.joint}"
    low, high = scale * line.low, scale * line.high
    twin_text = "" if twin == NOMINAL else f" ({twin})"
    return (
        f"{step}, {where}: {line.quantity} {low:.4g} to {high:.4g} {unit} on the twin{twin_text}, "
        f"allowed {scale * line.allowed_low:.4g} to {scale * line.allowed_high:.4g} {unit}"
    )


def _line(data: Mapping[str, Any]) -> MotionPrediction:
    low, high = data["predicted"]
    lowest, highest = data["allowed"]
    return MotionPrediction(
        data["quantity"], data["joint"], low, high, lowest, highest, data["unit"], data["binding"],
        (data["spread"][0], data["spread"][1]),
    )  # fmt: skip


def remedy_text(scale: float | None) -> str:
    """Return the factor of amplitudes by which a refused step passes, in words; None: not found."""
    if scale is None:
        return "no smaller amplitude was found to pass"
    return f"{scale:g} times this amplitude would pass"
