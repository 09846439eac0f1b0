"""The faults that a simulated bench may have while it runs: one class each."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from hil_sim.faults import device, machine, sensors, wire
from hil_sim.faults.base import Fault

CLASSES: tuple[type[Fault], ...] = tuple(
    kind
    for module in (sensors, machine, device, wire)
    for kind in vars(module).values()
    if isinstance(kind, type)
    and issubclass(kind, Fault)
    and "name" in kind.__annotations__
    and kind is not Fault
)

if TYPE_CHECKING:
    AnyFault = Fault
else:
    AnyFault = Annotated[reduce(or_, CLASSES), Field(discriminator="name")]
