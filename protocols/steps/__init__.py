"""Kinds of step, one class in one module each; modules here are discovered automatically.

`STEPS` maps a kind's key to its class. `AnyStep` is their union, chosen by the key that a step has.
"""

from __future__ import annotations

import sys
from difflib import get_close_matches
from typing import TYPE_CHECKING, Annotated, Any, Final, Union

from pydantic import Discriminator, Tag

from protocols.language.part import classes_in
from protocols.steps.base import StepKind

MISSPELT: Final = 0.8  # similarity (difflib) from which an unknown key is a kind's, misspelt
_kinds: tuple[type[StepKind], ...] = classes_in(sys.modules[__name__], StepKind)
STEPS: dict[str, type[StepKind]] = {
    kind.key: kind
    for kind in sorted(
        (k for k in _kinds if hasattr(k, "key")), key=lambda kind: (kind.rank, kind.key)
    )
}


def kind_of_step(data: Any) -> str | None:
    """Return the key of the kind of a step, or of its data; None if it has none.

    The first kind of `STEPS` counts whose key is in the data. With a misspelt key of a kind it has
    none: the step's other keys would be read as those of another kind.
    """
    if isinstance(data, StepKind):
        return data.key
    if not isinstance(data, dict):
        return None
    keys = {name for kind in STEPS.values() for name in kind.model_fields}
    if any(get_close_matches(str(key), STEPS, 1, MISSPELT) for key in data if key not in keys):
        return None
    return next((key for key in STEPS if key in data), None)


def _tag_of_step(data: Any) -> str | None:
    key = kind_of_step(data)
    return None if key is None else f"{key} step"


if TYPE_CHECKING:
    AnyStep = StepKind
else:
    _tagged = tuple(Annotated[kind, Tag(f"{key} step")] for key, kind in STEPS.items())
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
