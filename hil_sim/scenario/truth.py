"""Load the true parameters of the simulated bench, and constants that only the plant needs.

A shipped machine file `machines/<rig name>.yaml` holds them; a rig without one is built from its
own `nominal` values. None of this is sent over a wire.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator

from hil_sim.effects.base import in_unit, with_units
from rig.model.parameters import parameter_names, parameter_unit
from rig.model.parse import InputError, parse_model, shipped_files
from rig.model.parts import Part
from rig.model.quantity import Pressure, Ratio, Volume
from rig.model.rig import Rig


class Constants(Part):
    """Plant-only constants [SI]; the defaults suit a small bench on mineral oil."""

    laminar_transition: Pressure = Field(
        default=50e3, gt=0, description="pressure drop below which an orifice is laminar"
    )
    residual_air: Ratio = Field(
        default=1e-5, gt=0, lt=0.1, description="undissolved gas at 1 atm, by volume"
    )
    bulk_temperature: Annotated[float, in_unit("delta_degC^-1")] = Field(
        default=-0.004, description="relative change of the bulk modulus per kelvin"
    )
    spool_rate: Annotated[float, in_unit("V/s")] = Field(default=140.0, gt=0)
    contact_stiffness: Annotated[float, in_unit("N/m^1.5")] = Field(default=5e9, gt=0)
    contact_damping: Annotated[float, in_unit("s/m")] = Field(default=10.0, ge=0)
    supply_volume: Volume = Field(default=0.5e-3, gt=0)
    relief_override: Pressure = Field(
        default=0.15e6, gt=0, description="from cracking to passing the whole pump flow"
    )
    relief_rounding: Pressure = Field(default=20e3, gt=0)


class TrueMachine(Part):
    """The true parameters by name [SI] and the plant's constants."""

    parameters: dict[str, float]
    constants: Constants = Constants()

    @field_validator("parameters", mode="before")
    @classmethod
    def _units(cls, value: Any, info: ValidationInfo) -> Any:
        return with_units(value, info, parameter_unit)


def machine_text(name: str) -> str | None:
    """Return the machine file shipped for the rig called `name`, None where there is none."""
    file = shipped_files("hil_sim", "machines").get(name)
    return None if file is None else file.read_text(encoding="utf-8")


def load_machine(rig: Rig, overrides: Mapping[str, float] | None = None) -> TrueMachine:
    """Return the machine of `rig`, parameters [SI] overridden by name.

    Raises InputError naming parameters that are missing or that the rig does not have.
    """
    names = parameter_names(len(rig.joints))
    text = machine_text(rig.name)
    if text is None:
        machine, source = TrueMachine(parameters=dict(rig.nominal)), f"rig {rig.name!r}: nominal"
    else:
        source = f"machines/{rig.name}.yaml"
        machine = parse_model(TrueMachine, text, source)
    for name in (*machine.parameters, *(overrides or {})):
        if name not in names:
            where = "scenario parameters" if name in (overrides or {}) else source
            raise InputError(
                f"{where}: {name!r} is no parameter of a rig with {len(rig.joints)} joint(s); "
                f"expected one of: {' '.join(names)}"
            )
    merged = {**machine.parameters, **(overrides or {})}
    if rig.gravity == 0.0:  # in a horizontal plane weights have no effect, and no file needs them
        merged = {name: 0.0 for name in names if name.startswith("W")} | merged
    missing = [name for name in names if name not in merged]
    if missing:
        raise InputError(
            f"{source}: the simulated bench needs every parameter; missing: {' '.join(missing)}"
        )
    return TrueMachine(parameters={n: merged[n] for n in names}, constants=machine.constants)
