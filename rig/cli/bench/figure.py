"""One measured performance figure and the limit that it has to keep."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number: `limit` is what it must keep below, or above if `above`."""

    group: str
    name: str
    value: float
    unit: str = ""
    limit: float | None = None
    above: bool = False

    @property
    def ok(self) -> bool:
        """Whether the limit is kept; always where there is none."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.above else self.value <= self.limit
