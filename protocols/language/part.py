"""Base of every part of a protocol file: frozen, in SI, unknown keys refused."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationInfo

from rig.model.quantity import UnitError, parse_quantity, shown_in_schema


class ProtocolPart(BaseModel):
    """A part of a protocol file."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _position_gain(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, str):
        return parse_quantity(value, "V/m")
    if info.context:
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '15 V/m'")
    return value


PositionGain = Annotated[float, BeforeValidator(_position_gain), shown_in_schema("V/m")]
