"""Base of every part of a protocol file, frozen and in SI, and discovery of its plug-ins."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from types import ModuleType
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, PrivateAttr, ValidationInfo

from rig.model.quantity import UnitError, parse_quantity, shown_in_schema


class ProtocolPart(BaseModel):
    """A part of a protocol file; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class LocatedPart(ProtocolPart):  # noqa: PLW1641 - pydantic hashes frozen models
    """A part that knows where it is written."""

    _where: str = PrivateAttr(default="")

    @property
    def where(self) -> str:
        """Its file and line as `FILE:LINE`, for refusals; empty for a part of no file."""
        return self._where

    def __eq__(self, other: object) -> bool:
        """Return whether a part has the same fields, wherever it is written."""
        return type(self) is type(other) and dict(self) == dict(other)

    def locate(self, where: str) -> None:
        """Set file and line, which the reader knows once the part is made."""
        self._where = where


def _position_gain(value: Any, info: ValidationInfo) -> Any:
    if isinstance(value, str):
        return parse_quantity(value, "V/m")
    if info.context:
        raise UnitError(f"{value!r} has no unit; write one beside the number, like '15 V/m'")
    return value


PositionGain = Annotated[float, BeforeValidator(_position_gain), shown_in_schema("V/m")]


def classes_in(package: ModuleType, base: type) -> tuple[type, ...]:
    """Return the concrete subclasses of `base` in the modules of `package`, by module name.

    A class is taken from the module that defines it; names that begin with '_' are left out.
    """
    classes: list[type] = []
    for entry in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
        module = importlib.import_module(f"{package.__name__}.{entry.name}")
        for name, item in vars(module).items():
            if not inspect.isclass(item) or name.startswith("_") or item is base:
                continue
            if issubclass(item, base) and item.__module__ == module.__name__:
                classes.append(item)
    return tuple(classes)
