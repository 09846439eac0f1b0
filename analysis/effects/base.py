"""An effect: a term with the information that the trace needs to name or reject it.

An effect is one more term (`analysis.terms.base`): it may change the signals that all terms see
(`prepare`), add columns to rows, and contribute in simulation. Linear coefficients come from least
squares; few shape parameters are searched within physical bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    FAMILIES,
    Coefficient,
    Columns,
    Kernel,
    Term,
    Used,
    equation,
    kernel,
)
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.model.units import plain

Array = NDArray[np.float64]

# Order of preparation: sensors, null of the spool, its lag, its edges, volumes of the chambers,
# supply and return (whose flow depends on the volumes), the rest.
SENSOR, NULL, LAG, EDGES, VOLUME, SUPPLY, PLANT = range(7)


@dataclass(frozen=True)
class Shape:
    """A shape parameter: its name, SI unit, physical bounds and grid of starting points.

    At `neutral` the effect vanishes; None where its size is a linear coefficient. With `resolution`
    the low bound is only the resolution of the data, so that a value there is acceptable. Where a
    shape `saturates` so is the high bound, beyond which its curve hardly changes. A `detail` is an
    optional shape parameter, last in the list: it is searched only where the records require it,
    does not count as complexity, and does not reject an effect at its bounds. A `fixed` one, a knot
    of a curve, is placed by the data beforehand and never searched.
    """

    parameter: str
    unit: str
    low: float
    high: float
    grid: tuple[float, ...]
    neutral: float | None = None
    resolution: bool = False
    saturates: bool = False
    detail: bool = False
    fixed: bool = False

    def is_present(self, value: float) -> bool:
        """Return whether a form has this parameter: 0 outside its bounds marks its absence."""
        return value != 0.0 or self.low <= 0.0

    @property
    def middle(self) -> float:
        """The middle point of the grid."""
        return self.grid[len(self.grid) // 2]


# [sample periods] below which a spool delay may be an artefact of a command held between samples:
# four times the `path_between_samples` of `identify`.
BETWEEN_SAMPLES: Final = 0.2
LONGEST_LAG: Final = 0.1  # [s] longest delay or time constant on a bench
LONGEST_SAMPLES: Final = 100  # [samples] the same on a large machine: slow, and sampled slowly


def longest_lag(rig: Rig) -> float:
    """Return the longest delay or time constant [s] that an effect of a rig may have."""
    return max(LONGEST_LAG, LONGEST_SAMPLES / rig.sample_rate)


def between_samples(rig: Rig, seconds: float) -> str:
    """Return why a spool delay [s] may be an artefact of sampling ('' if it is longer).

    The signals are linear between samples: under a held command, a first-order spool of time
    constant tau then has an apparent delay of dt^2 / (12 tau).
    """
    if seconds * rig.sample_rate >= BETWEEN_SAMPLES:
        return ""
    return f"a delay of {1e6 * seconds:.3g} us may come from a command held between samples"


# The signal of each quantity (see `Effect.abscissa`), of a joint or of its chambers.
OF_JOINT: Final = {
    "velocity": "sd", "position": "s", "joint position": "q", "absolute angle": "theta",
    "spool": "u",
}  # fmt: skip
OF_CHAMBER: Final = {"pressure": "p", "pressure rate": "pd"}
UNNAMED: Final = ("piston", "spool", "position", "drive")  # sensors that `place` omits


@dataclass(frozen=True)
class Branch:
    """One line of an effect's curve: y(x) = sum of weights (m,) times parameters, by name.

    The parameters are the rows' coefficients (1/b under the name of b); `reciprocal` marks 1 / y.
    """

    label: str
    x: Array
    weights: Mapping[str, Array]
    unit_x: str
    unit_y: str
    reciprocal: bool = False


@dataclass(frozen=True)
class Evidence:
    """Records for an effect that chooses its starting points by the data.

    `signals` are those of each averaged record, as the model sees them, `valid` within its rows;
    `residuals` holds its residual by equation: instants (m,) [s] and whitened residual (m,).
    """

    signals: Sequence[Signals]
    residuals: Sequence[Mapping[str, tuple[Array, Array]]]

    def of_joint(self, joint: int, values: Callable[[Signals], Array]) -> Array:
        """Return values (n,) where rows of a joint may lie, of all records in which it is excited.

        Motion at a record's ends, where the filters give no rows, would place knots where nothing
        determines the curve.
        """
        parts = [values(s)[s.valid[:, joint]] for s in self.signals if s.excited[joint]]
        return np.concatenate(parts) if parts else np.zeros(0)

    def of_bench(self, values: Callable[[Signals], Array]) -> Array:
        """Return values (n,) where rows of any joint may lie, of all records."""
        parts = [values(s)[s.valid.any(axis=1)] for s in self.signals]
        return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True)
class Effect(Term):
    """A candidate of the trace at one place (`where`); a subclass overrides methods as needed.

    `variable` names in plain words what the effect's contribution depends on, `quantity` what its
    residual is plotted against (see `plotted`, `abscissa`); `confounders` are
    effects whose columns are similar on poor excitation, `separated_by` an excitation on which they
    differ; `includes` names effects that are limits of this one and that it replaces, `beside` says
    that it may also act together with them, `excludes` names those that cannot act at the same
    place.

    `shape_stems` are the names of its shape parameters without the `suffix` of the place.

    `stage` orders the terms' `prepare` (see `ordered`): sensor errors are undone first, then come
    effects on the spool and on the oil. `alters` names the families of rows that `prepare` changes:
    others need not be rebuilt for another shape. `adds_to_gains` marks effects whose columns add to
    those of the orifices, under the same gains. `rescales` marks effects that multiply signals and
    their noise by a factor. `hydraulic` marks effects on oil, valve or cylinder, not for electric
    joints. `smallest_coefficients` and `smallest_shape` [SI] are those of the smallest size of
    interest on a bench of some kW at some MPa.

    `amplifies` marks effects whose correction amplifies noise (a lag): such a rival may be true
    although its residual is larger.

    `exact` marks effects whose equation is a definition (a gain, an offset, a delay, a mass): a
    residual that they leave is not due to an error of their form.

    `mechanism` is the physical law, `element` the part of the machine: base, load, supply, tank, or
    of its joint the joint, piston, valve, chamber or sensor. `free` marks a mechanism without a
    named form, whose curve is estimated from the data (see `curve`): tried only where no named
    effect explains the records. `by_data`: its starting points follow from the records (`points`).
    """

    family: ClassVar[str] = ""
    mechanism: ClassVar[str] = ""
    element: ClassVar[str] = "joint"
    free: ClassVar[bool] = False
    by_data: ClassVar[bool] = False
    smallest_coefficients: ClassVar[tuple[float, ...]] = ()
    smallest_shape: ClassVar[tuple[float, ...]] = ()
    variable: ClassVar[str] = ""
    quantity: ClassVar[str] = ""
    confounders: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    includes: ClassVar[tuple[str, ...]] = ()
    beside: ClassVar[bool] = False
    excludes: ClassVar[tuple[str, ...]] = ()
    shape_stems: ClassVar[tuple[str, ...]] = ()
    stage: ClassVar[int] = PLANT
    alters: ClassVar[tuple[str, ...]] = tuple(FAMILIES)
    hydraulic: ClassVar[bool] = False
    adds_to_gains: ClassVar[bool] = False
    rescales: ClassVar[bool] = False
    amplifies: ClassVar[bool] = False
    exact: ClassVar[bool] = False

    @property
    def place(self) -> str:
        """Its place as reported: `bench`, `joint I` or `joint I cap|rod`."""
        words = self.where.split()
        if words[0] == "bench":
            return "bench"
        return " ".join(words[:2]) if words[-1] in UNNAMED else self.where

    def variable_on(self, rig: Rig) -> str:
        """Return what the effect follows, in words; electric joints have no piston."""
        return self.variable.replace("piston", "joint") if rig.electric else self.variable

    @property
    def joint(self) -> int:
        """Its joint, 0-based; raises InputError where `where` names none."""
        words = self.where.split()
        if len(words) < 2 or words[0] != "joint" or not words[1].isdecimal() or words[1] == "0":
            raise InputError(f"effect {self.name!r}: where {self.where!r} is not like 'joint 1'")
        return int(words[1]) - 1

    @property
    def side(self) -> str:
        """The part of `where` after the joint: `cap`, `rod`, a sensor, or ''."""
        return self.where.split()[2] if len(self.where.split()) > 2 else ""

    @property
    def least_joints(self) -> int:
        """Return the least number of moving joints that separates it from other effects."""
        return 1

    def limited_shape(self, shape: Sequence[float]) -> tuple[float, ...]:
        """Return the shape limited to bounds that depend on its other numbers."""
        return tuple(shape)

    def shape_of_smallest_size(self) -> tuple[float, ...]:
        """Return the shapes of its smallest size of interest."""
        return self.smallest_shape

    def absorbed(self, rig: Rig) -> str:
        """Return why the baseline's free parameters hide it completely ('' if they do not)."""
        return ""

    def inseparable(self, shape: Sequence[float] = ()) -> tuple[tuple[str, str], ...]:
        """Return (name, where) of effects that no data can separate from it at a shape."""
        return ()

    def inseparable_beside(
        self, rig: Rig, shape: Sequence[float], others: Sequence[Used]
    ) -> tuple[tuple[str, str], ...]:
        """Return `inseparable`, with those that hold beside the `others` of a set on a rig."""
        return self.inseparable(shape)

    def usual_beside(
        self, rig: Rig, shape: Sequence[float], others: Sequence[Used]
    ) -> tuple[tuple[str, str], ...]:
        """Return those of `inseparable_beside` that are the usual cause of the same records."""
        return ()

    def alike_together(self, rig: Rig) -> tuple[tuple[str, str], ...]:
        """Return two effects, as (name, where), that together nearly act as this one; else ()."""
        return ()

    @classmethod
    def places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every `where` of this effect on a rig; none without the oil it acts on."""
        return () if cls.hydraulic and "fluid" not in rig.families else cls.all_places(rig)

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return the places on a rig that has what the effect acts on.

        By default the bench, or every joint where `where` is a joint's.
        """
        if cls.where == "bench":
            return ("bench",)
        return tuple(f"joint {i}" for i in range(1, len(rig.joints) + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the shape parameters, none by default."""
        return ()

    @property
    def suffix(self) -> str:
        """The end of its parameters' names: `1`, `1_cap`, '' for the bench."""
        return "_".join(self.where.split()[1:])

    def shape_names(self) -> tuple[str, ...]:
        """Name the shape parameters; their number does not depend on the rig."""
        end = f"_{self.suffix}" if self.suffix else ""
        return tuple(f"{stem}{end}" for stem in self.shape_stems)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return the starting points of shapes that follow from the data."""
        raise NotImplementedError

    def further_points(self, rig: Rig) -> tuple[tuple[float, ...], ...]:
        """Return starting points in addition to the grid, in another form of the effect."""
        return ()

    def branches(self, rig: Rig, shape: Sequence[float]) -> tuple[Branch, ...]:
        """Return the lines of the effect's curve, none by default."""
        return ()

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Return why sign or size of the fitted parameters is not physical ('' if it is).

        `values` holds the effect's own linear coefficients and the model's other parameters. By
        default only the shapes are judged, by their bounds.
        """
        return self.outside(rig, shape)

    def not_shown(
        self, rig: Rig, values: Mapping[str, float], shape: Sequence[float],
        terms: Sequence[Used], signals: Sequence[Signals],
    ) -> str:  # fmt: skip
        """Return why the records do not show what sets the effect apart ('' if they do).

        `terms` are all of the model, `values` its linear coefficients.
        """
        return ""

    def without_fall(self, rig: Rig, shape: Sequence[float]) -> tuple[float, ...] | None:
        """Return the shape of a friction whose level does not fall with speed, None if it cannot.

        Beside a level of another contact it is a detail of that contact's form.
        """
        return None

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State a size at the conditions of the records ('' where its parameter states it)."""
        return ""

    def extrapolated(
        self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]
    ) -> Mapping[str, tuple[float, float]]:
        """Return, by name, the range of shape parameters that are extrapolated by the form."""
        return {}

    def plotted(self) -> str:
        """Name the quantity of `abscissa`; its unit is in `analysis.report.plots.trace_plots`."""
        return self.quantity

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return, by equation, the variable (n,) to plot that equation's residual against.

        By default `quantity` of its joint or chamber, or of all where it acts on the bench.
        """
        joints = range(signals.joints) if self.where == "bench" else (self.joint,)
        if self.quantity in OF_CHAMBER:
            sides, field = (self.side,) if self.side else ("cap", "rod"), OF_CHAMBER[self.quantity]
            return {
                equation(f"flow_{side}", i): getattr(signals, f"{field}_{side}")[:, i]
                for i in joints
                for side in sides
            }
        x = getattr(signals, OF_JOINT[self.quantity])
        rows = "mechanical" if self.family in ("mechanics", "friction") else "fluid"
        return {equation(kind, i): x[:, i] for i in joints for kind in FAMILIES[rows]}

    def shape_of(self, rig: Rig, shape: Sequence[float]) -> tuple[float, ...]:
        """Return the shape, or the middle of each parameter's grid where none is given."""
        if len(shape):
            return tuple(shape)
        return tuple(s.middle for s in self.shapes(rig) if not s.detail)

    def full_shape(self, rig: Rig, shape: Sequence[float]) -> tuple[float, ...]:
        """Return `shape_of` with 0 for each detail that the shape lacks."""
        known = self.shape_of(rig, shape)
        return (*known, *(0.0 for _ in self.shape_names()[len(known) :]))

    def remembers(self, shape: Sequence[float]) -> bool:
        """Return whether the effect has memory (a hidden state in use) at a shape."""
        return len(shape) > 0

    def detailed_shapes(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the shape completed by details, once for each starting point of their search."""
        return ((*shape, *(s.middle for s in self.shapes(rig)[len(shape) :])),)

    def alternatives_to_detail(self) -> tuple[Effect, ...]:
        """Return effects preferred to a detail of this one's form where both fit as well."""
        return ()

    def is_alternative_to_detail(self, other: Effect) -> bool:
        """Return whether either of two effects is preferred to a detail of the other's form."""
        return self in other.alternatives_to_detail() or other in self.alternatives_to_detail()

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return starting shapes of the search for other forms of the same effect."""
        return ()

    def coefficients_comparable(self, shape: Sequence[float], other: Sequence[float]) -> bool:
        """Return whether the coefficients mean the same in the forms of two shapes."""
        return True

    def simpler_equivalent(self, rig: Rig, values: Mapping[str, float], times: float = 1.0) -> str:
        """Return the name of the effect in `includes` that this one equals ('' if none).

        `values` holds the effect's linear coefficients; the tolerance is multiplied by `times`.
        """
        return ""

    def distinct(self, intervals: Mapping[str, tuple[float, float]]) -> bool:
        """Return whether it differs from every effect of `includes` throughout `intervals`.

        `intervals` holds the 95 % intervals of its linear coefficients, errors of forms included.
        False where it cannot be judged.
        """
        return False

    def outside(self, rig: Rig, shape: Sequence[float]) -> str:
        """Return which shape parameter lies on or beyond its bounds, in words ('' if none).

        Details are not tested: their value does not decide whether the effect exists.
        """
        for s, value in zip(self.shapes(rig)[: len(shape)], shape, strict=True):
            if s.detail or s.fixed or not s.is_present(value):
                continue
            margin = 1e-3 * (s.high - s.low)
            allowed = s.resolution or s.neutral == s.low
            low = s.low if allowed else s.low + margin
            high = s.high if s.saturates else s.high - margin
            if not low <= value <= high:
                return (
                    f"{s.parameter} = {plain(value, 4)} {s.unit} lies at the edge of what is "
                    f"physical, {plain(s.low, 4)} to {plain(s.high, 4)}"
                )
        return ""


@dataclass(frozen=True)
class SignalEffect(Effect):
    """An effect that acts only on the signals that all terms see (`prepare`), with shapes only."""

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return nothing: it has shapes only."""
        return ()

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return nothing: other terms' columns are of the prepared signals."""
        return {}


def exponent(shape: Sequence[float]) -> float:
    """Return the exponent of a shape with this one number; 1 where it is missing or 0."""
    return float(shape[0]) if len(shape) and shape[0] else 1.0


def out_of_range(parameter: str, value: float, unit: str, high: float, low: float = 0.0) -> str:
    """Return the message for a coefficient that is not within (low, high) ('' if it is)."""
    if low < value < high:
        return ""
    shown, least, most = (plain(x, 4) for x in (value, low, high))
    return f"{parameter} = {shown} {unit} is not between {least} and {most}"


def shapes_of(rig: Rig, used: Used) -> tuple[Shape, ...]:
    """Return the shape parameters that a used term has, none for a term that is no effect."""
    return used.term.shapes(rig)[: len(used.shape)] if isinstance(used.term, Effect) else ()


def shape_values(rig: Rig, used: Used) -> dict[str, float]:
    """Return the values of a used term's shape parameters, by name."""
    return {s.parameter: v for s, v in zip(shapes_of(rig, used), used.shape, strict=True)}


def ordered(terms: Sequence[Used]) -> tuple[Used, ...]:
    """Return the terms in the order in which they must prepare (see `Effect.stage`), stable."""
    return tuple(sorted(terms, key=lambda used: getattr(used.term, "stage", PLANT)))


@kernel
def _nothing(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    pass


NO_KERNEL: Kernel = _nothing  # of effects that do not act on the plant


def open_shapes(rig: Rig, used: Used) -> bool:
    """Return whether a term is an effect whose required shape is missing.

    A contact's presliding distance and details of a form are optional.
    """
    if len(used.shape) or not isinstance(used.term, Effect):
        return False
    return any(not (s.resolution or s.detail) for s in used.term.shapes(rig))
