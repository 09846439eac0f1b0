"""Using another protocol's steps."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from protocols.steps.base import Macro


class IncludeStep(Macro):
    """Insert the steps of a shipped protocol, or of another file."""

    key: ClassVar[str] = "include"

    include: str = Field(min_length=1, description="a shipped name, or a path beside this file")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="of the other file, instead of its own values"
    )
