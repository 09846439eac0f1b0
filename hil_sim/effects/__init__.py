"""The effects that a simulated bench may have: one class each, in the modules named here."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from hil_sim.effects import fluid, friction, measurement, mechanics, valve
from hil_sim.effects.base import PlantEffect, named_classes

MODULES = (friction, mechanics, valve, fluid, measurement)
CLASSES = named_classes(PlantEffect, MODULES)

if TYPE_CHECKING:
    AnyEffect = PlantEffect
else:
    AnyEffect = Annotated[reduce(or_, CLASSES), Field(discriminator="name")]
