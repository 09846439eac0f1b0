"""One measured performance figure and its limit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number and its upper limit, or its lower limit if `above`."""

    group: str
    name: str
    value: float
    unit: str = ""
    limit: float | None = None
    above: bool = False

    @property
    def ok(self) -> bool:
        """Whether the number is within its limit; True without a limit."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.above else self.value <= self.limit
