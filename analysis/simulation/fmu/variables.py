"""Variables of a mock-up unit: inputs, outputs, start values, parameters, switches.

Value references are those of c/variables.h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from analysis.simulation.model import Model
from rig.model import channels as ch
from rig.model.rig import Rig

INPUT, OUTPUT, START, CONSTANT, LOCKED, EXTRAPOLATE, TIME = 0, 1000, 2000, 3000, 4000, 4100, 9999
_RANGE: Final = 1000  # references between two groups


@dataclass(frozen=True)
class UnitVariable:
    """One variable: name, value reference, SI unit ('' for a switch), start value, description."""

    name: str
    reference: int
    unit: str
    start: float
    description: str


@dataclass(frozen=True)
class UnitVariables:
    """All variables of a model's unit, grouped by causality."""

    inputs: tuple[UnitVariable, ...]
    outputs: tuple[UnitVariable, ...]
    starts: tuple[UnitVariable, ...]
    constants: tuple[UnitVariable, ...]
    switches: tuple[UnitVariable, ...]

    @property
    def default_inputs(self) -> tuple[float, ...]:
        """Start values of the inputs, in the order of their references."""
        return tuple(v.start for v in self.inputs)

    @property
    def default_start(self) -> tuple[tuple[float, ...], ...]:
        """Piston, speed, cap and rod pressure of every joint at the start."""
        joints = {(v.reference - START) // 4 for v in self.starts}
        values = {v.reference - START: v.start for v in self.starts}
        return tuple(tuple(values.get(4 * i + k, 0.0) for k in range(4)) for i in sorted(joints))

    @property
    def units(self) -> list[str]:
        """Every unit that occurs, each once."""
        numbers = (*self.inputs, *self.outputs, *self.starts, *self.constants)
        return list(dict.fromkeys(["s", *(v.unit for v in numbers if v.unit)]))


def unit_variables(model: Model) -> UnitVariables:
    """Return the variables of a model's unit; every joint free and at mid-stroke by default."""
    rig = model.rig
    electric = rig.electric
    supply = 0.0 if electric else rig.supply.pressure
    oil = 0.0 if electric else rig.oil.temperature
    joints = range(1, len(rig.joints) + 1)
    drive = ch.DRIVE if electric else ch.SPOOL
    inputs = [
        UnitVariable(ch.SUPPLY, INPUT, "Pa", supply, "supply pressure"),
        UnitVariable(ch.TEMPERATURE, INPUT + 1, "degC", oil, "oil temperature"),
    ]
    for i in joints:
        name = ch.channel(drive, i)
        quantity = "drive signal" if electric else "spool position as measured"
        inputs.append(
            UnitVariable(name, INPUT + 1 + i, rig.unit_of(name), 0.0, f"joint {i}: {quantity}")
        )
    constants = tuple(
        UnitVariable(f"parameters.{name}", CONSTANT + k, p.unit, p.value, "identified parameter")
        for k, (name, p) in enumerate(model.parameters.items())
    )
    assert len(constants) < _RANGE
    return UnitVariables(
        tuple(inputs),
        tuple(_outputs(rig)),
        tuple(_starts(rig, supply)),
        constants,
        (
            *(
                UnitVariable(f"locked_{i}", LOCKED + i - 1, "", 0.0, f"joint {i} stands still")
                for i in joints
            ),
            UnitVariable(
                "extrapolate_inputs", EXTRAPOLATE, "", 0.0,
                "go on with an input's last slope within a step, instead of holding it",
            ),
        ),
    )  # fmt: skip


def _names(rig: Rig, joint: int) -> list[tuple[str, str, str]]:
    """Return name, unit and description of a joint's four outputs (electric: two)."""
    if rig.electric:
        position = ch.channel(ch.POSITION, joint)
        unit = rig.unit_of(position)
        return [(position, unit, "position"), (f"speed_{joint}", f"{unit}/s", "speed")]
    return [
        (ch.channel(ch.PISTON, joint), "m", "piston position"),
        (f"piston_speed_{joint}", "m/s", "piston speed"),
        (ch.channel(ch.CAP, joint), "Pa", "cap-side pressure"),
        (ch.channel(ch.ROD, joint), "Pa", "rod-side pressure"),
    ]


def _outputs(rig: Rig) -> Iterator[UnitVariable]:
    for i in range(1, len(rig.joints) + 1):
        for k, (name, unit, quantity) in enumerate(_names(rig, i)):
            yield UnitVariable(name, OUTPUT + 4 * (i - 1) + k, unit, 0.0, f"joint {i}: {quantity}")


def _starts(rig: Rig, supply: float) -> Iterator[UnitVariable]:
    for i in range(1, len(rig.joints) + 1):
        values = (0.0, 0.0, 0.5 * supply, 0.5 * supply)
        for k, (name, unit, quantity) in enumerate(_names(rig, i)):
            reference = START + 4 * (i - 1) + k
            about = f"joint {i}: {quantity} at the start"
            yield UnitVariable(f"{name}_start", reference, unit, values[k], about)
