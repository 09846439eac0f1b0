"""The faults that a simulated bench may have while it runs: one class each."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from hil_sim.effects.base import named_classes
from hil_sim.faults import device, machine, sensors, wire
from hil_sim.faults.base import Fault

CLASSES = named_classes(Fault, (sensors, machine, device, wire))

if TYPE_CHECKING:
    AnyFault = Fault
else:
    AnyFault = Annotated[reduce(or_, CLASSES), Field(discriminator="name")]
