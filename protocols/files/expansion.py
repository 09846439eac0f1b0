"""Expansion of parameters, sweeps and includes.

Works on the plain data of a file, so that a parameter may replace any value. Every resulting step
keeps its lines in the file, so that errors name them. After an error the following steps are still
read, so that all errors are reported at once.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from protocols.steps import STEPS, kind_of_step
from protocols.steps.base import Macro
from rig.model.parse import InputError, Path, Problem, Unresolved

MOST_STEPS = 1000
_REFERENCE = re.compile(r"\$(?P<name>[a-z][a-z0-9_]*)|\$\$")
Lines = Mapping[Path, int]


@dataclass(frozen=True)
class RawStep:
    """A step as plain data, and the line of each of its keys.

    `places` are file and line of the steps in it that another file defines: of itself at `()`.
    """

    data: Any
    lines: Lines
    places: Mapping[Path, str] = field(default_factory=dict)

    @property
    def included(self) -> bool:
        """Whether another file defines it."""
        return () in self.places


@dataclass(frozen=True)
class Scope:
    """The parameters in force, and those that a sweep varies (by name, as text)."""

    values: Mapping[str, Any]
    swept: Mapping[str, str] = field(default_factory=dict)

    def changed(self, values: Mapping[str, Any], swept: bool = False) -> Scope:
        """Return the scope with other values."""
        as_text = {name: str(value) for name, value in values.items()} if swept else {}
        return Scope({**self.values, **values}, {**self.swept, **as_text})


# Returns each step as plain data, with `RawStep.places`.
Include = Callable[[str, Mapping[str, Any], int], Sequence[tuple[Any, Mapping[Path, str]]]]


@dataclass(frozen=True)
class Expander:
    """Expands the steps of one file, `source`; `include` reads the raw steps of another."""

    source: str
    lines: Lines
    include: Include
    problems: list[Problem] = field(default_factory=list)

    def steps(self, data: Any, path: Path, scope: Scope) -> list[RawStep]:
        """Return the steps of a list, expanded; `problems` receives errors with their lines.

        Raises InputError for more steps than a protocol may have.
        """
        if not isinstance(data, list):
            self._note(path, f"expected a list of steps, found {type(data).__name__}")
            return []
        expanded: list[RawStep] = []
        for index, item in enumerate(data):
            where: Path = (*path, index)
            kind = kind_of_step(item)
            if kind == "set":
                values = self._values(item, "set", where, scope)
                scope = scope.changed(self.substituted(values, (*where, "set"), scope))
            elif kind == "sweep":
                expanded += self._sweep(item, where, scope)
            elif kind == "include":
                expanded += self._included(item, where, scope)
            else:
                expanded.append(self._step(item, kind, where, scope))
            if len(expanded) > MOST_STEPS:
                self._too_many(where, len(expanded))
        return expanded

    def substituted(self, data: Any, where: Path, scope: Scope) -> Any:
        """Return plain data with every `$name` replaced; a name that is not known is noted.

        A text that is nothing but a reference becomes the value itself; within a text the value is
        written out, and `$$` is a dollar.
        """
        if isinstance(data, dict):
            return {k: self.substituted(v, (*where, k), scope) for k, v in data.items()}
        if isinstance(data, list):
            return [self.substituted(v, (*where, k), scope) for k, v in enumerate(data)]
        if not isinstance(data, str) or "$" not in data:
            return data
        names = [match["name"] for match in _REFERENCE.finditer(data)]
        unknown = [name for name in names if name is not None and name not in scope.values]
        for name in unknown:
            self._note(where, f"${name}: {unknown_parameter(name, scope.values)}")
        if unknown:
            return Unresolved(data)

        def value_of(match: re.Match[str]) -> Any:
            return "$" if match["name"] is None else scope.values[match["name"]]

        reference = _REFERENCE.fullmatch(data)
        if reference is not None:
            return value_of(reference)
        return _REFERENCE.sub(lambda match: str(value_of(match)), data)

    def _step(self, item: Any, kind: str | None, where: Path, scope: Scope) -> RawStep:
        depth = len(where)
        below = {p[depth:]: n for p, n in self.lines.items() if p[:depth] == where}
        lines = {(): self._line(where), **below}
        nested = isinstance(item, dict) and kind is not None and STEPS[kind].nests
        fields = {k: v for k, v in item.items() if k != "steps"} if nested else item
        data = self.substituted(fields, where, scope)
        places: dict[Path, str] = {}
        if nested and "steps" in item:
            inner = self.steps(item["steps"], (*where, "steps"), scope)
            data["steps"] = [part.data for part in inner]
            lines = {p: n for p, n in lines.items() if p[:1] != ("steps",) or len(p) == 1}
            for number, part in enumerate(inner):
                lines |= {("steps", number, *p): n for p, n in part.lines.items()}
                places |= {("steps", number, *p): at for p, at in part.places.items()}
        if kind == "excite" and scope.swept:
            data = {**data, "parameters": dict(scope.swept)}
        return RawStep(data, lines, places)

    def _sweep(self, item: Any, where: Path, scope: Scope) -> list[RawStep]:
        self._keys(item, "sweep", where)
        rows = self._rows(item["sweep"], where, scope)
        if "steps" not in item:
            self._note(where, "sweep: steps is missing here")
            return []
        repeated: list[RawStep] = []
        for number, row in enumerate(rows, start=1):
            inner = self.steps(item["steps"], (*where, "steps"), scope.changed(row, swept=True))
            total = len(rows) * len(inner)
            if total > MOST_STEPS:
                self._too_many(where, total)
            repeated += [replace(s, data=_renamed(s.data, f"_{number}")) for s in inner]
        return repeated

    def _rows(self, over: Any, where: Path, scope: Scope) -> list[dict[str, Any]]:
        """Return the parameters' values for each run of a sweep; one empty row for invalid data."""
        key: Path = (*where, "sweep")
        if isinstance(over, dict) and over and all(isinstance(v, list) for v in over.values()):
            self._known(over, key, scope)
            for name, values in over.items():
                if not values:
                    self._note((*key, name), f"sweep {name}: an empty list")
            nonempty = {name: values for name, values in over.items() if values}
            count = math.prod(map(len, nonempty.values()))
            if count > MOST_STEPS:
                self._too_many(where, count)
            rows = itertools.product(*nonempty.values())
            return [dict(zip(nonempty, row, strict=True)) for row in rows]
        if isinstance(over, list) and over and all(isinstance(row, dict) for row in over):
            for number, row in enumerate(over):
                self._known(row, (*key, number), scope)
                if set(row) != set(over[0]):
                    text = "sweep: every row must state the same parameters"
                    self._note((*key, number), text)
            return over
        self._note(key, "sweep: expected lists of values by parameter, or a list of rows of values")
        return [{}]

    def _included(self, item: Any, where: Path, scope: Scope) -> list[RawStep]:
        self._keys(item, "include", where)
        data = self.substituted(item, where, scope)
        name, values = data["include"], data.get("parameters", {})
        if not isinstance(name, str) or not isinstance(values, dict):
            self._note(where, "include: expected a name or path, and parameters by name")
            return []
        line = self._line(where)
        if isinstance(name, Unresolved):
            return []
        try:
            steps = self.include(name, values, line)
        except InputError as error:
            self.problems.append((line, str(error)))
            return []
        return [RawStep(step, {(): line}, places) for step, places in steps]

    def _values(self, item: Any, key: str, where: Path, scope: Scope) -> Mapping[str, Any]:
        self._keys(item, key, where)
        values = item[key]
        if not isinstance(values, dict) or not values:
            self._note(where, f"{key}: expected values by parameter")
            return {}
        self._known(values, (*where, key), scope)
        return dict(values)

    def _keys(self, item: Mapping[str, Any], key: str, where: Path) -> None:
        kind = STEPS[key]
        assert issubclass(kind, Macro)
        for name in item:
            if name not in kind.model_fields:
                text = f"{key}.{name}: unknown key; remove it or correct its spelling"
                self._note((*where, name), text)

    def _known(self, values: Mapping[str, Any], where: Path, scope: Scope) -> None:
        for name in values:
            if name not in scope.values:
                self._note((*where, name), unknown_parameter(name, scope.values))

    def _line(self, where: Path) -> int:
        while where and where not in self.lines:
            where = where[:-1]
        return self.lines.get(where, 1)

    def _location(self, where: Path) -> str:
        return f"{self.source}:{self._line(where)}"

    def _too_many(self, where: Path, count: int) -> None:
        text = f"{count} steps; expected at most {MOST_STEPS} in one protocol"
        raise InputError(f"{self._location(where)}: {text}")

    def _note(self, where: Path, text: str) -> None:
        problem = (self._line(where), f"{self._location(where)}: {text}")
        if problem not in self.problems:  # a sweep reads its steps for each value
            self.problems.append(problem)


def unknown_parameter(name: str, known: Mapping[str, Any]) -> str:
    """Return the error of a parameter that the file does not declare."""
    has = " ".join(known) if known else "none; declare them under 'parameters'"
    return f"no parameter {name!r}; the file has: {has}"


def _renamed(data: Any, ending: str) -> Any:
    if not isinstance(data, dict):
        return data
    changed = dict(data)
    if isinstance(data.get("name"), str):
        changed["name"] = data["name"] + ending
    elif kind_of_step(data) == "warm_up":
        changed["name"] = "warm_up" + ending
    if isinstance(data.get("steps"), list):
        changed["steps"] = [_renamed(step, ending) for step in data["steps"]]
    return changed


def made_unique(steps: Sequence[RawStep]) -> list[RawStep]:
    """Return the steps, with a number appended to repeated names of an included file.

    Nested steps take the number of the step that they are in.
    """
    used = {name for s in steps if not s.included for name in _names(s.data)}
    unique = []
    for step in steps:
        names = _names(step.data) if step.included else []
        number, ending = 1, ""
        while any(name + ending in used for name in names):
            number += 1
            ending = f"_{number}"
        used.update(name + ending for name in names)
        unique.append(replace(step, data=_renamed(step.data, ending)) if ending else step)
    return unique


def _names(data: Any) -> list[str]:
    """Return the name of a step and those of the steps nested in it."""
    if not isinstance(data, dict):
        return []
    own = [data["name"]] if isinstance(data.get("name"), str) else []
    nested = data["steps"] if isinstance(data.get("steps"), list) else []
    return own + [name for step in nested for name in _names(step)]
