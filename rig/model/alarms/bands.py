"""The section `alarms` of a rig file: warning and trip bands per channel, action of each check.

Glossary: a *band* is the allowed range of a channel; a *warning* is reported and recorded, a *trip*
zeroes the outputs and latches; the *dead band* is how far a value must be back inside before a
warning returns; the *delay* is how long a value must be outside before it counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from rig.model import channels as ch
from rig.model.parts import Part
from rig.model.quantity import Time, parse_quantity

Action = Literal["trip", "warn", "ignore"]
Range = tuple[float, float]
_OPEN = (-math.inf, math.inf)


class AlarmBand(Part):
    """Bands of one channel, in the channel's SI unit; omitted values keep their defaults.

    An end of a band may be null: that side is then not monitored.
    """

    warning: tuple[float | None, float | None] | None = None
    warning_delay: Time | None = Field(default=None, ge=0, le=10)
    trip: tuple[float | None, float | None] | None = None
    trip_delay: Time | None = Field(default=None, ge=0, le=1)
    dead_band: float | None = Field(default=None, ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for key in ("warning", "trip"):
            low, high = ends(getattr(self, key))
            if not low < high:
                raise ValueError(f"{key}: lower {low:g} is not below upper {high:g}")
            if 2 * (self.dead_band or 0.0) >= high - low:
                raise ValueError(
                    f"dead_band {self.dead_band:g}: leaves nothing of the {key} band "
                    f"{low:g} to {high:g}"
                )
        return self


class CheckActions(Part):
    """The action of each plausibility check."""

    frozen_sensor: Action = "trip"
    spool_not_following: Action = "trip"
    chamber_without_pressure: Action = "trip"
    supply_lost: Action = "trip"
    nothing_moves: Action = "warn"
    pressure_above_supply: Action = "warn"
    drift_at_rest: Action = "warn"
    swapped_pressures: Action = "warn"
    drifting_pressure_sensor: Action = "warn"
    noisy_sensor: Action = "warn"


class Alarms(Part):
    """The section `alarms`; `warning_share` of each limit is the warning level without a band."""

    warning_share: float = Field(default=0.9, gt=0.5, le=1.0)
    channels: dict[str, AlarmBand] = Field(default_factory=dict)
    checks: CheckActions = CheckActions()

    @field_validator("channels", mode="before")
    @classmethod
    def _units(cls, value: Any, info: ValidationInfo) -> Any:
        """Read the ends of bands in their channel's unit, which follows from the channel's name."""
        if not isinstance(value, dict) or not info.context:
            return value
        return {name: _in_si(name, band) for name, band in value.items()}


def _in_si(name: Any, band: Any) -> Any:
    if not isinstance(band, dict):
        return band
    unit = ch.unit_of(str(name))
    read = dict(band)
    for key in ("warning", "trip"):
        if isinstance(read.get(key), list | tuple):
            read[key] = tuple(v if v is None else parse_quantity(str(v), unit) for v in read[key])
    if read.get("dead_band") is not None:
        width = "delta_degC" if unit == "degC" else unit
        read["dead_band"] = parse_quantity(str(read["dead_band"]), width)
    return read


def ends(band: tuple[float | None, float | None] | None) -> Range:
    """Return the ends of a band; infinite where it is open or omitted."""
    low, high = band or (None, None)
    return -math.inf if low is None else low, math.inf if high is None else high


def refuse_unreachable(
    alarms: Alarms, recorded: tuple[str, ...], seen: Callable[[str], Range],
    limits: Mapping[str, Range],
) -> None:  # fmt: skip
    """Raise ValueError, naming the key, for a band that can never take effect.

    Each end must lie where its channel can read (`seen`), a trip band within the channel's
    `limits`, a warning band within the trip band.
    """
    for name, band in alarms.channels.items():
        where = f"alarms channels {name}"
        if name not in recorded:
            raise ValueError(f"{where}: this rig has no such channel; it has {' '.join(recorded)}")
        _inside(band.trip, seen(name), f"{where} trip", "the range of its sensor,")
        _inside(band.warning, seen(name), f"{where} warning", "the range of its sensor,")
        outer = limits.get(name, _OPEN)
        _inside(band.trip, outer, f"{where} trip", "its limits,")
        low, high = ends(band.trip)
        trip = max(low, outer[0]), min(high, outer[1])
        _inside(band.warning, trip, f"{where} warning", "what trips,")


def _inside(
    band: tuple[float | None, float | None] | None, outer: Range, key: str, what: str
) -> None:
    for end in band or ():
        if end is not None and not outer[0] <= end <= outer[1]:
            raise ValueError(
                f"{key}: {end:g} is outside {what} {outer[0]:g} to {outer[1]:g}; no sample "
                "can reach it"
            )
