"""Base of the faults of the simulated bench: frozen data, times, and actions.

A fault begins at `at` seconds of the device's time and ends at `until` (never, if not given). It is
one class of a module of this package. It acts on the plant's tables (`begin` changes them and
returns a function that restores them), on the converter codes of a block (`distort`), on the device
(`hil_sim.faults.device`), or on frames (`hil_sim.faults.wire`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hil_sim.effects.base import Tables
from rig.model.parts import Part
from rig.model.quantity import Time
from rig.model.rig import Rig
from rig.model.wire.codes import Codes

Restore = Callable[[], None]


class Fault(Part):
    """One fault: its name, and its times [s of the device's time]."""

    name: str
    at: Time = Field(default=0.0, ge=0)
    until: Time | None = None

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.until is not None and self.until <= self.at:
            raise ValueError(f"until {self.until:g} s is not after at {self.at:g} s")
        return self

    @classmethod
    def fault_name(cls) -> str:
        """Return the fault's name in scenario files."""
        return str(get_args(cls.model_fields["name"].annotation)[0])

    @property
    def place(self) -> str:
        """Its place, as text."""
        return str(getattr(self, "where", None) or getattr(self, "channel", None) or "bench")

    def begin(self, tables: Tables) -> Restore | None:
        """Change the plant's tables; return a function that restores them, None if unchanged."""
        return None

    def distort(
        self, codes: Codes, last: Codes, seconds: NDArray[np.float64], rig: Rig,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Change codes (n, channels) in place; `last` (channels,) are those before the fault began.

        `seconds` (n,) is the time since its beginning at each row.
        """


def set_field(row: Any, field: str, value: float) -> Restore:
    """Set a field of a table's row; return a function that restores it."""
    before = row[field].copy()

    def restore() -> None:
        row[field] = before

    row[field] = value
    return restore
