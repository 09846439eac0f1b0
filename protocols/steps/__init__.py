"""Kinds of step, one class in one module each; modules here are discovered automatically.

`STEPS` maps a kind's key to its class. `AnyStep` is their union, chosen by the key that a step has.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Discriminator, Tag

from protocols.language.discovery import classes_in
from protocols.steps.base import StepKind, by_rank, choose_kind

_kinds = [k for k in classes_in(sys.modules[__name__], StepKind) if hasattr(k, "key")]
STEPS: dict[str, type[StepKind]] = {found.key: found for found in sorted(_kinds, key=by_rank)}


def kind_of_step(data: Any) -> str | None:
    """Return the key of the kind of a step, or of its data; None if it has none."""
    return choose_kind(data, STEPS)


def _tag_of_step(data: Any) -> str | None:
    key = kind_of_step(data)
    return None if key is None else f"{key} step"


if TYPE_CHECKING:
    AnyStep = StepKind
else:
    _tagged = tuple(Annotated[found, Tag(f"{key} step")] for key, found in STEPS.items())
    AnyStep = Annotated[
        Union[_tagged],  # noqa: UP007 - of the classes discovered
        Discriminator(
            _tag_of_step,
            custom_error_type="step_kind",
            custom_error_message=f"a key that names the kind of step ({', '.join(STEPS)})",
        ),
    ]
    for _kind in STEPS.values():
        _kind.model_rebuild(force=True, _types_namespace={"AnyStep": AnyStep})
