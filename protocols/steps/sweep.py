"""Running steps for every value of parameters."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from protocols.steps.base import Macro


class SweepStep(Macro):
    """Repeat `steps` for every combination of values, or for every row of a list.

    `{amplitude: [0.2 V, 0.4 V], frequency: [1 Hz, 3 Hz]}` are four combinations, the last name
    varying fastest; `[{amplitude: 0.2 V, frequency: 3 Hz}, ...]` are rows. Step names get a number.
    """

    key: ClassVar[str] = "sweep"
    nests: ClassVar[bool] = True

    sweep: dict[str, list[Any]] | list[dict[str, Any]] = Field(min_length=1)
    steps: tuple[AnyStep, ...] = Field(min_length=1)  # type: ignore[name-defined]  # noqa: F821
