"""Parts that several kinds of step share: places, locks, excited joints.

Glossary: a *period* is the time after which the uploaded waveform starts again; a *record* is one
repeat of one step, a whole number of periods; *centring* keeps the mean of an excited piston in
place without disturbing the waveform; a *detection line* is a frequency left empty, at which a
response is due to nonlinearity.
"""

from __future__ import annotations

from typing import Final, Literal, Self

from pydantic import Field, model_validator

from protocols.language.part import LocatedPart, PositionGain, ProtocolPart
from protocols.signals import Signal
from rig.model.parameters import MAX_JOINTS
from rig.model.quantity import Length, Time, Voltage

CLOSED: Final = "closed"
END_MIN: Final = "end_min"
END_MAX: Final = "end_max"
OPEN_LOOP: Final = "open-loop"


class Place(LocatedPart):
    """Settings for positioning pistons before excitation."""

    position_gain: PositionGain = Field(default=12.0, gt=0, description="of the loop [V/m]")
    limit: Voltage = Field(default=0.6, gt=0, description="largest command while moving [V]")
    push: Voltage = Field(default=0.4, gt=0, description="held against an end stop [V]")
    tolerance: Length = Field(default=0.5e-3, gt=0, description="in place when closer [m]")
    timeout: Time = Field(default=30.0, gt=0, description="for each move [s]")

    @model_validator(mode="after")
    def _push_is_weaker(self) -> Self:
        if self.push > self.limit:
            raise ValueError(f"push {self.push:g} V is above the limit {self.limit:g} V")
        return self


class Lock(ProtocolPart):
    """A joint that is held during a step."""

    joint: int = Field(ge=1, le=MAX_JOINTS)
    at: Literal["closed", "end_min", "end_max"]
    piston: Length = Field(default=0.0, description="where the valve is closed [m]")
    tolerance: Length = Field(default=2e-3, gt=0, description="movement that breaks the lock [m]")

    @model_validator(mode="after")
    def _piston_only_where_closed(self) -> Self:
        if self.at != CLOSED and "piston" in self.model_fields_set:
            raise ValueError(f"piston belongs to a lock at 'closed'; 'at: {self.at}' has its place")
        return self


class Centring(ProtocolPart):
    """Centring of the mean of an excited piston.

    `open-loop`: the command is the waveform plus a bias that is trimmed between records;
    `position-loop`: the device also drives slowly towards the centre during the record.
    """

    mode: Literal["open-loop", "position-loop"] = "open-loop"
    position_gain: PositionGain = Field(default=2.0, gt=0, description="of the slow loop [V/m]")
    drift: Length = Field(default=2e-3, gt=0, description="allowed within one record [m]")
    offset: Length = Field(default=4e-3, gt=0, description="allowed of a record's mean [m]")
    tries: int = Field(default=4, ge=1, le=50, description="trims before giving up")


class Excite(ProtocolPart):
    """A joint that is moved by a waveform during a step."""

    joint: int = Field(ge=1, le=MAX_JOINTS)
    signal: Signal
    centre: Length = Field(default=0.0, description="mean piston position [m]")
    centring: Centring = Centring()


def require_one_role(name: str, joints: tuple[int, ...]) -> None:
    """Raise ValueError where a joint is named twice by one step."""
    for joint in joints:
        if joints.count(joint) > 1:
            raise ValueError(
                f"step {name!r}: joint {joint} stands more than once; "
                "a joint is either locked or excited, once"
            )
