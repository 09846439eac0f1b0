"""The rig description: a whole bench, its channels and what it is designed to be.

The bench's pieces stand in `rig.model.parts`.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)

from rig.model import channels as ch
from rig.model.parameters import MAX_JOINTS, parameter_names, parameter_unit
from rig.model.parts import Array, Joint, Oil, Part, Sensors, Supply, Wire
from rig.model.quantity import Acceleration, Frequency, parse_quantity


class Rig(Part):
    """A whole test bench."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")
    description: str = ""
    gravity: Acceleration = Field(default=9.8, gt=0)
    sample_rate: Frequency = Field(gt=0)
    supply: Supply
    oil: Oil
    joints: tuple[Joint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    sensors: Sensors
    wire: Wire = Wire()
    nominal: dict[str, float] = Field(
        default_factory=dict,
        description="design values by parameter name, for the twin and the report, not the fit",
    )

    @model_validator(mode="wrap")
    @classmethod
    def _by_type(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Any:
        """Hand a description of electric joints to `rig.model.electric.ElectricRig`."""
        types = _types(data) if cls is Rig else set()
        if "electric" not in types:
            return handler(data)
        if types != {"electric"}:
            raise ValueError("joints of both types, hydraulic and electric, in one rig: not yet")
        from rig.model.electric import ElectricRig  # noqa: PLC0415 - it is a Rig itself

        return ElectricRig.model_validate(data, context=info.context)

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_units(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, dict) or "joints" not in info.data:
            return value
        joints = len(info.data["joints"])
        known = parameter_names(joints)
        for name in value:
            if name not in known:
                raise ValueError(
                    f"{name!r} is no parameter of a rig with {joints} joint(s); "
                    f"expected one of: {' '.join(known)}"
                )
        if not info.context:
            return value
        return {k: parse_quantity(str(v), parameter_unit(k)) for k, v in value.items()}

    @property
    def electric(self) -> bool:
        """Whether the joints are electric (`rig.model.electric`)."""
        return False

    @property
    def position_kind(self) -> str:
        """Channel kind of a joint's position."""
        return ch.PISTON

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Channel kinds that an excited joint needs."""
        return ch.JOINT_KINDS

    @property
    def base_angle(self) -> float:
        """Known inclination of the base [rad], added to every absolute angle."""
        return 0.0

    def unit_of(self, channel: str) -> str:
        """Return the unit of a channel's samples."""
        return ch.unit_of(channel)

    def unit_of_parameter(self, name: str) -> str:
        """Return the SI unit of a parameter."""
        return parameter_unit(name)

    @property
    def channels(self) -> tuple[str, ...]:
        """The measured channels, in the order every block and file keeps."""
        return ch.measured(
            len(self.joints),
            supply=self.sensors.supply_pressure is not None,
            temperature=self.sensors.oil_temperature is not None,
        )

    @property
    def recorded(self) -> tuple[str, ...]:
        """The measured channels, then the commands put out."""
        return (*self.channels, *(ch.channel(ch.COMMAND, i + 1) for i in range(len(self.joints))))

    def chamber_volumes(self, joint: int, piston: Array) -> tuple[Array, Array]:
        """Return (V_cap, V_rod) [m^3] of joint `joint` (0-based) at piston displacement s [m]."""
        c = self.joints[joint].cylinder
        half = c.stroke / 2
        s = np.asarray(piston, dtype=np.float64)
        return (
            c.cap_pipe_volume + (half + s) * c.cap_area,
            c.rod_pipe_volume + (half - s) * c.rod_area,
        )


def _types(data: Any) -> set[str]:
    """Return the types of the joints of a raw description, as far as it is one."""
    joints = data.get("joints") if isinstance(data, dict) else None
    if not isinstance(joints, list | tuple):
        return set()
    return {str(j.get("type", "hydraulic")) for j in joints if isinstance(j, dict)}
