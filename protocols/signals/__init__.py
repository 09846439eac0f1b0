"""Kinds of signal, one class in one module each; modules here are discovered automatically."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Field

from protocols.language.part import classes_in
from protocols.language.signal import SignalKind

SIGNALS: tuple[type[SignalKind], ...] = classes_in(sys.modules[__name__], SignalKind)

if TYPE_CHECKING:
    Signal = SignalKind
else:
    _union: Any = Union[SIGNALS]  # noqa: UP007 - of the classes discovered
    Signal = Annotated[_union, Field(discriminator="kind")]
