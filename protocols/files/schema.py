"""The protocol file: frozen models that hold data in SI and refuse what makes no sense alone.

Glossary: a *step* locks some joints and excites the others; a *period* is the time after which
the uploaded waveform starts again; a *record* is one repeat of one step, a whole number of
periods; *centring* keeps the mean of an excited piston at its place without disturbing the
waveform; a *detection line* is a frequency left empty to see what nonlinearity puts there.
What depends on the rig (joints that exist, limits, sample rate) is checked by
`protocols.files.plan`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from rig.model.parameters import MAX_JOINTS
from rig.model.quantity import Angle, Frequency, Length, Time, UnitError, Voltage, parse_quantity

CLOSED: Final = "closed"
END_MIN: Final = "end_min"
END_MAX: Final = "end_max"
OPEN_LOOP: Final = "open-loop"
POSITION_LOOP: Final = "position-loop"
MAX_REPEATS = 1000


def _position_gain(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, str):
        return parse_quantity(value, "V/m")
    if info.context:
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '15 V/m'")
    return value


PositionGain = Annotated[float, BeforeValidator(_position_gain)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Place(_Part):
    """How pistons are brought to their places, before anything is excited."""

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


class Lock(_Part):
    """A joint that stays where it is during a step."""

    joint: int = Field(ge=1, le=MAX_JOINTS)
    at: Literal["closed", "end_min", "end_max"]
    piston: Length = Field(default=0.0, description="where the valve is closed [m]")
    tolerance: Length = Field(default=2e-3, gt=0, description="movement that breaks the lock [m]")

    @model_validator(mode="after")
    def _piston_only_where_closed(self) -> Self:
        if self.at != CLOSED and "piston" in self.model_fields_set:
            raise ValueError(f"piston belongs to a lock at 'closed'; 'at: {self.at}' has its place")
        return self


class Sine(_Part):
    """One line: A sin(2 pi f t)."""

    kind: Literal["sine"]
    frequency: Frequency = Field(gt=0)
    amplitude: Voltage = Field(gt=0, description="peak of the command [V]")


class Multisine(_Part):
    """Random-phase multisine; odd lines only and with empty detection lines where asked."""

    kind: Literal["multisine"]
    base_frequency: Frequency = Field(gt=0, description="spacing of the lines, 1 / period")
    f_min: Frequency = Field(gt=0)
    f_max: Frequency = Field(gt=0)
    amplitude: Voltage = Field(gt=0, description="of the whole command, see amplitude_is [V]")
    amplitude_is: Literal["rms", "peak"] = "rms"
    odd: bool = Field(default=True, description="leave even lines empty")
    detection_fraction: float = Field(
        default=0.25, ge=0, le=0.5, description="one random line in each group of 1/fraction"
    )
    detection_lines: tuple[int, ...] | None = Field(
        default=None, description="empty lines by number, instead of detection_fraction"
    )
    tilt: float = Field(default=0.0, ge=-2, le=2, description="amplitude follows f^-tilt")
    seed: int = Field(ge=0, description="of phases and detection lines")
    draws: int = Field(default=50, ge=1, le=1000, description="phase draws; lowest crest wins")

    @model_validator(mode="after")
    def _band(self) -> Self:
        if self.f_max < self.f_min:
            raise ValueError(f"f_max {self.f_max:g} Hz is below f_min {self.f_min:g} Hz")
        if self.f_min < self.base_frequency:
            raise ValueError(
                f"f_min {self.f_min:g} Hz is below base_frequency {self.base_frequency:g} Hz: "
                "there is no line"
            )
        both = {"detection_fraction", "detection_lines"} <= self.model_fields_set
        if both and self.detection_lines is not None:
            raise ValueError("give detection_fraction or detection_lines, not both")
        return self


class Lines(_Part):
    """Chosen lines with an amplitude and a phase each: sum_k A_k cos(2 pi k f0 t + phi_k)."""

    kind: Literal["lines"]
    base_frequency: Frequency = Field(gt=0, description="spacing of the lines, 1 / period")
    lines: tuple[int, ...] = Field(min_length=1, description="numbers of the excited lines")
    amplitudes: tuple[Voltage, ...] = Field(description="peak of each line [V]")
    phases: tuple[Angle, ...] = Field(description="of each line's cosine [rad]")
    detection_lines: tuple[int, ...] = Field(default=(), description="lines left empty on purpose")

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        for name, values in (("amplitudes", self.amplitudes), ("phases", self.phases)):
            if len(values) != len(self.lines):
                raise ValueError(f"{name} has {len(values)} entries for {len(self.lines)} lines")
        if any(a <= 0 for a in self.amplitudes):
            raise ValueError("amplitudes must be above zero; leave a line out instead")
        if self.lines[0] < 1 or any(a >= b for a, b in pairwise(self.lines)):
            raise ValueError("lines must be numbers from 1 on in rising order")
        both = sorted(set(self.lines) & set(self.detection_lines))
        if both:
            raise ValueError(f"line {both[0]} is excited and a detection line; it can be one")
        return self


Signal = Annotated[Sine | Multisine | Lines, Field(discriminator="kind")]


class Centring(_Part):
    """How the mean of an excited piston is kept in place.

    `open-loop`: the command is the waveform plus a bias that is trimmed between records;
    `position-loop`: the device also pulls slowly to the centre while it is recorded.
    """

    mode: Literal["open-loop", "position-loop"] = "open-loop"
    position_gain: PositionGain = Field(default=2.0, gt=0, description="of the slow loop [V/m]")
    drift: Length = Field(default=2e-3, gt=0, description="allowed within one record [m]")
    offset: Length = Field(default=4e-3, gt=0, description="allowed of a record's mean [m]")
    tries: int = Field(default=4, ge=1, le=50, description="trims before giving up")


class Excite(_Part):
    """A joint that is moved by a waveform during a step."""

    joint: int = Field(ge=1, le=MAX_JOINTS)
    signal: Signal
    centre: Length = Field(default=0.0, description="mean piston position [m]")
    centring: Centring = Centring()


class Step(_Part):
    """What is locked, what is excited, how long and how often."""

    name: str = Field(pattern=r"^[a-z0-9]+(?:_[a-z0-9]+)*$")
    lock: tuple[Lock, ...] = ()
    excite: tuple[Excite, ...] = Field(min_length=1)
    repeats: int = Field(default=1, ge=1, le=MAX_REPEATS)
    duration: Time | None = Field(default=None, gt=0, description="of a record; one period if not")
    warm_up: int = Field(
        default=1, ge=1, le=1000, description="periods under the slow loop, before the first trim"
    )
    ramp: Time = Field(default=2.0, gt=0, description="the waveform grows to full size in [s]")
    settle: Time = Field(default=1.0, gt=0, description="at rest before a lock is believed [s]")

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints (1-based) it gives a job to, locked ones first."""
        return (*(part.joint for part in self.lock), *(part.joint for part in self.excite))

    @model_validator(mode="after")
    def _one_job_per_joint(self) -> Self:
        joints = self.joints
        for joint in joints:
            if joints.count(joint) > 1:
                raise ValueError(
                    f"step {self.name!r}: joint {joint} stands more than once; "
                    "a joint is either locked or excited, once"
                )
        return self


class Protocol(_Part):
    """A whole experiment."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")
    description: str = ""
    joints: int = Field(ge=1, le=MAX_JOINTS, description="size of the rigs it is written for")
    place: Place = Place()
    steps: tuple[Step, ...] = Field(min_length=1)

    @field_validator("steps")
    @classmethod
    def _names_differ(cls, steps: tuple[Step, ...]) -> tuple[Step, ...]:
        names = [step.name for step in steps]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two steps are called {name!r}; records need different names")
        return steps

    @model_validator(mode="after")
    def _every_joint_has_a_job(self) -> Self:
        wanted = set(range(1, self.joints + 1))
        for step in self.steps:
            found = set(step.joints)
            if found - wanted:
                raise ValueError(
                    f"step {step.name!r}: joint {min(found - wanted)} does not exist; "
                    f"the protocol says joints: {self.joints}"
                )
            if wanted - found:
                raise ValueError(
                    f"step {step.name!r}: joint {min(wanted - found)} is neither locked nor "
                    "excited; say which, so that it is known where it stands"
                )
        return self
