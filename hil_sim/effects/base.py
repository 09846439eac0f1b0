"""Base of the effects of the simulated bench: frozen data, a place, and changes of the plant.

An effect is one class of a module of this package, discovered automatically
(`hil_sim.effects.CLASSES`). `where` is ``joint I``, ``bench`` or ``joint I cap|rod``; effects of
measurement name a channel. Quantities are SI.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, TypeVar, get_args

from numpy.typing import NDArray
from pydantic import BeforeValidator, ValidationInfo, field_validator

from rig.model.parts import Part
from rig.model.quantity import UnitError, parse_quantity
from rig.model.rig import Rig

Kind = TypeVar("Kind")
Table = NDArray[Any]  # structured, one row per joint or channel (`hil_sim.plant.kernel_data`)
Size = tuple[float, float]  # smallest and largest, SI


def in_unit(si: str) -> BeforeValidator:
    """Return a validator that reads ``"80 N"`` in the SI unit `si`; a bare number is SI in code."""

    def read(value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, str) or (info.context and si):
            return read_with_unit(value, si)
        return value

    return BeforeValidator(read)


def read_with_unit(value: Any, si: str) -> float:
    """Read a file's value in the SI unit `si`; raises UnitError without a unit."""
    if not isinstance(value, str):
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '1 {si}'")
    return parse_quantity(value, si)


def with_units(value: Any, info: ValidationInfo, unit_of: Callable[[str], str]) -> Any:
    """Read a file's mapping of quantities whose SI unit follows from the key."""
    if not isinstance(value, dict) or not info.context:
        return value
    return {str(k): read_with_unit(v, unit_of(str(k))) for k, v in value.items()}


@dataclass(frozen=True)
class Tables:
    """The plant's tables under construction; the arrays are filled in place."""

    rig: Rig
    joints: Table
    bench: Table
    inertia: Table
    channels: Table


def named_classes(base: type[Kind], modules: Iterable[ModuleType]) -> tuple[type[Kind], ...]:
    """Return the classes of modules that derive from `base` and have a name in scenario files."""
    return tuple(
        kind
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type)
        and issubclass(kind, base)
        and "name" in kind.__annotations__
        and kind is not base
    )


_WHERE = re.compile(r"^(?:bench|joint (?P<joint>[1-9])(?: (?P<chamber>cap|rod))?)$")
_FORMS = {"bench": "bench", "joint": "joint I", "chamber": "joint I cap|rod"}


class PlantEffect(Part):
    """One effect: possible places, random ranges, changes of the tables.

    `places` are the forms of place where it can be. `drawn_at` is where a random scenario puts it:
    ``bench``, ``joint``, ``chamber`` or ``pressure`` (a pressure's channel); `sizes` are the ranges
    [SI] of its keys, drawn log-uniformly; keys in `signed` have a random sign. `forms` are the
    values of its key `form`: different physics of the same cause. Random scenarios draw only
    classes with `drawn`: a further one would change the scenario of every seed.
    """

    places: ClassVar[tuple[str, ...]] = ("joint",)
    drawn: ClassVar[bool] = True
    drawn_at: ClassVar[str]
    sizes: ClassVar[Mapping[str, Size]]
    signed: ClassVar[tuple[str, ...]] = ()
    forms: ClassVar[tuple[str, ...]] = ()
    name: str

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        if "form" in cls.model_fields:
            cls.forms = get_args(cls.model_fields["form"].annotation)

    @classmethod
    def effect_name(cls) -> str:
        """Return the effect's name in scenario files."""
        return str(get_args(cls.model_fields["name"].annotation)[0])

    @property
    def place(self) -> str:
        """Its place, as text."""
        return str(getattr(self, "where", None) or getattr(self, "channel", ""))

    @property
    def joint(self) -> int | None:
        """Its joint, 0-based; None for the bench."""
        match = _WHERE.match(self.place)
        return int(match["joint"]) - 1 if match and match["joint"] else None

    @property
    def chamber(self) -> str | None:
        """``cap``, ``rod``, or None for both or neither."""
        match = _WHERE.match(self.place)
        return match["chamber"] if match else None

    @field_validator("where", check_fields=False)
    @classmethod
    def _known_place(cls, value: str) -> str:
        match = _WHERE.match(value)
        form = None
        if match is not None:
            form = "chamber" if match["chamber"] else "joint" if match["joint"] else "bench"
        if form not in cls.places:
            expected = " or ".join(f"'{_FORMS[place]}'" for place in cls.places)
            raise ValueError(f"{value!r} is not where this effect can be; expected {expected}")
        return value

    def apply(self, t: Tables) -> None:
        """Put the effect into the plant's tables."""
        raise NotImplementedError


class JointEffect(PlantEffect):
    """An effect on one joint."""

    drawn_at = "joint"
    where: str


class BenchEffect(PlantEffect):
    """An effect on the whole bench."""

    places = ("bench",)
    drawn_at = "bench"
    where: str = "bench"


def set_relief(t: Tables, override: float) -> None:
    """Set the relief valve so that the idle pump's whole flow passes at the rig's set pressure.

    slope over cracking, rounded by w: k (x + sqrt(x^2 + w^2)) / 2 = Q_pump at x = D - w^2 / 4 D
    with D = Q_pump / k, the override.
    """
    rounding = t.bench["relief_rounding"]
    t.bench["relief_slope"] = t.rig.supply.flow / override
    t.bench["relief_crack"] = t.rig.supply.pressure - (override - rounding**2 / (4.0 * override))
