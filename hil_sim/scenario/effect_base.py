"""What every effect of a scenario is: frozen data with a place that it can be at."""

from __future__ import annotations

import re
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, field_validator

_WHERE = re.compile(r"^(?:bench|joint (?P<joint>[1-9])(?: (?P<chamber>cap|rod))?)$")
_FORMS = {"bench": "bench", "joint": "joint I", "chamber": "joint I cap|rod"}


class Effect(BaseModel):
    """One effect; `places` are the forms of place where it can be."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    places: ClassVar[tuple[str, ...]] = ("joint",)

    @property
    def place(self) -> str:
        """Where it is, as text."""
        return str(getattr(self, "where", None) or getattr(self, "channel", ""))

    @property
    def joint(self) -> int | None:
        """Its joint, 0-based; None for the bench."""
        match = _WHERE.match(self.place)
        return int(match["joint"]) - 1 if match and match["joint"] else None

    @property
    def chamber(self) -> str | None:
        """``cap``, ``rod`` or None for both or neither."""
        match = _WHERE.match(self.place)
        return match["chamber"] if match else None

    @field_validator("where", check_fields=False)
    @classmethod
    def _known_place(cls, value: str) -> str:
        match = _WHERE.match(value)
        form = None
        if match is not None:
            form = "chamber" if match["chamber"] else "joint" if match["joint"] else "bench"
        if form not in cls.places:
            expected = " or ".join(f"'{_FORMS[place]}'" for place in cls.places)
            raise ValueError(f"{value!r} is not where this effect can be; expected {expected}")
        return value
