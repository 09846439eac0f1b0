"""The effects that a simulated bench may have: one class each, in the modules named here."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from hil_sim.effects import fluid, friction, measurement, mechanics, valve
from hil_sim.effects.base import PlantEffect

MODULES = (friction, mechanics, valve, fluid, measurement)
CLASSES: tuple[type[PlantEffect], ...] = tuple(
    kind
    for module in MODULES
    for kind in vars(module).values()
    if isinstance(kind, type)
    and issubclass(kind, PlantEffect)
    and "name" in kind.__annotations__
    and kind is not PlantEffect
)

if TYPE_CHECKING:
    AnyEffect = PlantEffect
else:
    AnyEffect = Annotated[reduce(or_, CLASSES), Field(discriminator="name")]
