"""Display of SI values in the operator's units (MPa, mm), and times as short text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from rig.model.units import AXES, clock, display_unit


@dataclass(frozen=True)
class Format:
    """Display of a channel's SI unit: its name, factor from SI, decimals.

    `least` is the smallest height [SI] of a plot without limits, so that noise does not look like
    motion.
    """

    unit: str
    factor: float
    decimals: int
    least: float = 0.0

    @property
    def signed(self) -> bool:
        """Whether its sign is always shown, for values of both signs."""
        return self.unit not in ("MPa", "°C")

    def number(self, value: float | None, *, sign: bool = False) -> str:
        """Return the value's digits in the shown unit; an absent or NaN value is a dash."""
        if value is None or math.isnan(value):
            return "–"
        # Adding zero turns the -0.0 of a rounded small negative number into 0.0.
        scaled = round(value * self.factor, self.decimals) + 0.0
        text = f"{scaled:+.{self.decimals}f}" if sign else f"{scaled:.{self.decimals}f}"
        return text.replace("-", "−")

    def short(self, value: float | None, width: int = 12) -> str:
        """Return the value with as few decimals as a limit needs, in `width`: 9, −0.2, 36."""
        if value is None or math.isnan(value):
            return ""
        scaled = round(value * self.factor, self.decimals) + 0.0
        texts = (f"{scaled:.{digits}g}" for digits in range(6, 0, -1))
        return next((t for t in texts if len(t) <= width), "…").replace("-", "−")


# Smallest height [SI] of a plot without limits: noise must not look like motion.
_LEAST: Final = {"Pa": 0.2e6, "m": 2e-3, "V": 0.02, "degC": 2.0}


def shown(unit: str) -> Format:
    """Return the display of an SI unit; an unlisted one keeps its own name."""
    known = display_unit(unit, AXES)
    return Format(known.text, known.scale, known.decimals, _LEAST.get(unit, 0.0))


class Band(IntEnum):
    """Position of a value: well inside its limits, close to one, or beyond it."""

    INSIDE = 0
    NEAR = 1
    BEYOND = 2


def band(value: float, low: float | None, high: float | None, margin: float = 0.02) -> Band:
    """Return the position of a value; NEAR is within `margin` of the range between the limits."""
    beyond = (low is not None and value < low) or (high is not None and value > high)
    if beyond:
        return Band.BEYOND
    if low is None or high is None:
        return Band.INSIDE
    near = margin * (high - low)
    return Band.NEAR if value < low + near or value > high - near else Band.INSIDE


def clock_text(seconds: float) -> str:
    """Return 83 s as 1:23, 3723 s as 1:02:03; an unknown time as a dash."""
    if not math.isfinite(seconds) or seconds < 0:
        return "–"
    return clock(int(seconds))


def age_text(seconds: float) -> str:
    """Return the age of a sample with two digits or so: 0.05 s, 3.2 s, 75 s, 12 min."""
    if seconds < 1:
        return f"{max(seconds, 0.0):.2f} s"
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s" if seconds < 600 else f"{seconds / 60:.0f} min"


def limit(value: float | None) -> float | None:
    """Return a limit that can be drawn, or None for an absent or practically infinite one."""
    return value if value is not None and abs(value) < 1e300 else None
