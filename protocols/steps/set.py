"""Setting parameters to other values."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from protocols.steps.base import Macro


class SetStep(Macro):
    """Set parameters of the file for the steps that follow in the same list."""

    key: ClassVar[str] = "set"

    set: dict[str, Any] = Field(min_length=1, description="parameter: value")
