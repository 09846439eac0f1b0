"""The section `tolerances` of a rig file: uncertainty of its areas, volumes and pin distances.

Each value is a standard uncertainty (one sigma) of every number of its kind, at every joint,
independently of the others. Without the section the numbers count as exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from pydantic import Field, ValidationError

from rig.model.parts import Joint, Part
from rig.model.quantity import Length, Ratio

MOST: Final = 0.2  # of an area or a volume: more is a percentage without its sign


class Tolerances(Part):
    """Standard uncertainties: areas and volumes relative to the number, lengths in metres."""

    area: Ratio = Field(default=0.0, ge=0, lt=MOST, description="of cap_area and rod_area")
    volume: Ratio = Field(default=0.0, ge=0, lt=MOST, description="of the pipe volumes")
    pin: Length = Field(default=0.0, ge=0, description="of base_pin and arm_pin [m]")
    mid_length: Length = Field(default=0.0, ge=0, description="of mid_length [m]")


# Of each tolerance: the part of a joint, its keys, and whether it is relative to the number.
_KINDS: Final = {
    "area": ("cylinder", ("cap_area", "rod_area"), True),
    "volume": ("cylinder", ("cap_pipe_volume", "rod_pipe_volume"), True),
    "pin": ("linkage", ("base_pin", "arm_pin"), False),
    "mid_length": ("linkage", ("mid_length",), False),
}


@dataclass(frozen=True)
class UncertainNumber:
    """A number of joint `joint` (0-based) that has a tolerance, and its sigma in its SI unit.

    `kind` is the key of `tolerances`, `part` and `key` those of the joint; `stated` is the
    tolerance in words.
    """

    joint: int
    kind: str
    part: str
    key: str
    sigma: float
    stated: str

    @property
    def name(self) -> str:
        """The number's name in words: cap_area of joint 1."""
        return f"{self.key} of joint {self.joint + 1}"

    def moved(self, joints: Sequence[Joint]) -> tuple[Joint, ...]:
        """Return the joints with this number increased by one sigma."""
        out = list(joints)
        joint = out[self.joint]
        part = getattr(joint, self.part)
        part = part.model_copy(update={self.key: getattr(part, self.key) + self.sigma})
        out[self.joint] = joint.model_copy(update={self.part: part})
        return tuple(out)


def uncertain_numbers(
    tolerances: Tolerances | None, joints: Sequence[Joint]
) -> tuple[UncertainNumber, ...]:
    """Return the numbers of the joints that have a tolerance above zero, joint after joint."""
    if tolerances is None:
        return ()
    out = []
    for i, joint in enumerate(joints):
        for kind, (part, keys, relative) in _KINDS.items():
            stated = getattr(tolerances, kind)
            words = f"{100 * stated:.3g} %" if relative else f"{1e3 * stated:.3g} mm"
            for key in keys:
                size = getattr(getattr(joint, part), key) if relative else 1.0
                if stated > 0:
                    out.append(UncertainNumber(i, kind, part, key, stated * size, words))
    return tuple(out)


def refuse_open_triangles(tolerances: Tolerances | None, joints: Sequence[Joint]) -> None:
    """Raise ValueError if a linkage with a length increased by its tolerance cannot close."""
    for number in uncertain_numbers(tolerances, joints):
        if number.part != "linkage":
            continue
        joint = number.moved(joints)[number.joint]
        try:
            Joint.model_validate(joint.model_dump())
        except ValidationError as error:
            raise ValueError(
                f"{number.kind} {number.stated}: with {number.name} larger by it the linkage's "
                "triangle does not close over the stroke; expected a smaller one"
            ) from error


def widest(stated: Iterable[Tolerances | None]) -> Tolerances | None:
    """Return the largest of each tolerance; None where none are stated."""
    known = [tolerances for tolerances in stated if tolerances is not None]
    if not known:
        return None
    return Tolerances(
        **{key: max(getattr(each, key) for each in known) for key in Tolerances.model_fields}
    )
