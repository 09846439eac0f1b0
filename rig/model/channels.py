"""Names and units of the channels of a bench (`spool_i piston_i cap_pressure_i …`).

Electric joints have `position_i` and `drive_i` instead; their units are the joint's
(`Rig.unit_of`). Glossary: joint i is 1-based in names and 0-based in arrays; `command_i` is the
voltage that the device put out to the valve of joint i, recorded with the measured channels.
"""

from __future__ import annotations

import re
from typing import Final

SPOOL: Final = "spool"
PISTON: Final = "piston"
CAP: Final = "cap_pressure"
ROD: Final = "rod_pressure"
COMMAND: Final = "command"
SUPPLY: Final = "supply_pressure"
TEMPERATURE: Final = "oil_temperature"
POSITION: Final = "position"
DRIVE: Final = "drive"

JOINT_KINDS: Final = (SPOOL, PISTON, CAP, ROD)
ELECTRIC_KINDS: Final = (POSITION, DRIVE)
UNITS: Final[dict[str, str]] = {
    SPOOL: "V",
    PISTON: "m",
    CAP: "Pa",
    ROD: "Pa",
    COMMAND: "V",
    SUPPLY: "Pa",
    TEMPERATURE: "degC",
}
_KINDS = "|".join((*JOINT_KINDS, COMMAND, *ELECTRIC_KINDS))
_NAME = re.compile(rf"^(?P<kind>{_KINDS})_(?P<joint>[1-9]\d*)$")


def channel(kind: str, joint: int) -> str:
    """Name the channel of one kind at joint `joint` (1-based): ``channel("spool", 2)``."""
    return f"{kind}_{joint}"


def kind_of(name: str) -> tuple[str, int | None]:
    """Split a channel's name into (kind, joint or None for the bench); raises ValueError."""
    if name in (SUPPLY, TEMPERATURE):
        return name, None
    match = _NAME.match(name)
    if match is None:
        raise ValueError(f"unknown channel {name!r}; expected one like 'cap_pressure_1'")
    return match["kind"], int(match["joint"])


def place_in_words(where: str) -> str:
    """Return an effect's `where` in words: ``joint 1, spool`` for ``joint 1 spool``."""
    words = where.split()
    count = 2 if words[:1] == ["joint"] else 1
    return ", ".join(" ".join(part) for part in (words[:count], words[count:]) if part)


def unit_of(name: str) -> str:
    """Return the SI unit of a channel's samples; raises ValueError for an unknown name.

    Empty for an electric joint's channel, whose unit is the rig's (`Rig.unit_of`).
    """
    return UNITS.get(kind_of(name)[0], "")


def measured(joints: int, *, supply: bool, temperature: bool) -> tuple[str, ...]:
    """Return the measured channels in the order of blocks and files."""
    names = [channel(kind, i) for i in range(1, joints + 1) for kind in JOINT_KINDS]
    return (*names, *([SUPPLY] if supply else []), *([TEMPERATURE] if temperature else []))
