"""Read the tables of a rig file's section `wire`: one entry per channel and per output.

Every error names the key: a channel that the rig does not measure, a missing one, a wrong key, a
unit of another dimension.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import ValidationError

from rig.model.parse import NO_NUMBER, InputError, boolean_numbers, problem_text, read_quantity
from rig.model.parts import Part
from rig.model.rig import Rig

Entry = TypeVar("Entry", bound=Part)

# Unit of a difference, where the unit of a value has an offset.
_DIFFERENCE = {"degC": "delta_degC"}


def read_entry(model: type[Entry], raw: Any, key: str) -> Entry:
    """Read the keys below `key` as `model`; raises InputError naming key and expectation."""
    if not isinstance(raw, Mapping):
        raise InputError(f"wire: {key}: expected keys and values, found {raw!r}")
    try:
        entry = model.model_validate(raw)
    except ValidationError as error:
        problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        problem = problems[0]
        where = ".".join([key, *(str(part) for part in problem["loc"][:1])])
        known = " ".join(model.model_fields)
        if problem["type"] == "extra_forbidden":
            text = f"unknown key; expected: {known}"
        elif problem["type"] == "missing":
            text = f"is missing; expected: {known}"
        else:
            text = problem_text(problem)
        raise InputError(f"wire: {where}: {text}") from error
    for path in boolean_numbers(raw, entry):
        raise InputError(f"wire: {key}.{'.'.join(map(str, path))}: {NO_NUMBER}")
    return entry


def inputs_by_channel(model: type[Entry], raw: Mapping[str, Any], rig: Rig) -> tuple[Entry, ...]:
    """Read one entry per measured channel, in the order of `Rig.channels`; raises InputError."""
    _complete("inputs", list(raw), rig.channels, f"rig {rig.name!r} measures")
    return tuple(read_entry(model, raw[name], f"inputs.{name}") for name in rig.channels)


def outputs_by_joint(model: type[Entry], raw: Mapping[int, Any], rig: Rig) -> tuple[Entry, ...]:
    """Read one entry per joint, numbered from 1 in the file; raises InputError."""
    joints = range(1, len(rig.joints) + 1)
    _complete("outputs", [str(key) for key in raw], [str(i) for i in joints], "the joints are")
    return tuple(read_entry(model, raw[i], f"outputs.{i}") for i in joints)


def _complete(table: str, names: Sequence[str], expected: Sequence[str], description: str) -> None:
    for name in names:
        if name not in expected:
            raise InputError(f"wire: {table}.{name}: unknown; {description}: {' '.join(expected)}")
    missing = [name for name in expected if name not in names]
    if missing:
        raise InputError(f"wire: {table}: no entry for: {' '.join(missing)}")


def scale_of(text: Any, unit: str, key: str, per: str = "") -> float:
    """Read a scale in a channel's SI unit per `per`, such as '/V'; not zero; raises InputError."""
    scale = read_quantity(text, f"{_DIFFERENCE.get(unit, unit)}{per}", f"wire: {key}")
    if scale == 0.0:
        raise InputError(f"wire: {key}: is zero; every reading would be the same")
    return scale


def offset_of(text: Any, unit: str, key: str) -> float:
    """Read the value [SI] at a reading of zero, by default 0; raises InputError."""
    return 0.0 if text is None else read_quantity(text, unit, f"wire: {key}")


def refuse_short_reach(
    rig: Rig, name: str, ends: tuple[float, float], needed: tuple[float, float], step: float
) -> None:
    """Raise InputError where the numbers of an input do not cover the range that a channel needs.

    `ends` [SI] are the values at both ends of the register or converter, `needed` [SI] the range of
    the sensor or its limits, `step` [SI] one code. A limit beyond an end could never trip, and the
    drive would go on. The lower end of a pressure or temperature is not checked: numbers without a
    sign are common there.
    """
    least, most = min(ends), max(ends)
    unit = rig.unit_of(name)
    below = unit not in ("Pa", "degC") and least > needed[0] + step
    if below or most < needed[1] - step:
        raise InputError(
            f"wire: inputs.{name}: its numbers end at {least:.6g} and {most:.6g} {unit}, expected "
            f"them to reach {needed[0]:.6g} and {needed[1]:.6g} {unit}: a limit beyond them could "
            "never trip; a wider type or input range, a larger scale, or the sensor's true range?"
        )
