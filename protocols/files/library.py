"""Sources of protocols: the shipped ones by name, the user's own by path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from protocols.files.expansion import (
    Expander,
    Lines,
    RawStep,
    Scope,
    made_unique,
    unknown_parameter,
)
from protocols.files.schema import INCOMPLETE, VERSION, Protocol, later_version
from protocols.steps.base import StepKind
from rig.model.parse import InputError, Problem, load_yaml, shipped_files, validate_model
from rig.model.parse import Path as Keys

_PLACEHOLDER = RawStep({"mark": "in place of steps that could not be read"}, {})


def shipped_names() -> tuple[str, ...]:
    """Return the names of the shipped protocols."""
    return tuple(shipped_files("protocols", "shipped"))


def load(name: str | Path, values: Mapping[str, Any] | None = None) -> Protocol:
    """Read a shipped protocol by name or a file by path; raises InputError naming the error.

    `values` replace those of the file's `parameters`. A path that ends in `.py` is a Python
    protocol (`protocols.files.generator`).
    """
    if str(name) not in shipped_names() and str(name).endswith(".py"):
        from protocols.files.generator import load_generator  # noqa: PLC0415 - seldom wanted

        return load_generator(Path(name), values or {})
    return _read(str(name), None, values or {}, ())


def read_protocol(
    text: str, source: str, values: Mapping[str, Any] | None = None, folder: Path | None = None
) -> Protocol:
    """Read the text of a protocol file; its relative paths start from `folder`."""
    return _protocol(text, source, values or {}, folder, (source,))[0]


def parsed_values(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values of `NAME=VALUE` texts as a file would state them; InputError otherwise."""
    values_by_name: dict[str, Any] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise InputError(f"--set {setting}: expected NAME=VALUE, like amplitude=20mm")
        try:
            values_by_name[name.strip()] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise InputError(f"--set {setting}: found {value!r}, expected a YAML value") from error
    return values_by_name


def _text(name: str, folder: Path | None) -> tuple[str, str, Path | None]:
    """Return a protocol's text, its displayed name, and the folder of its relative paths."""
    shipped = shipped_files("protocols", "shipped")
    if name in shipped:
        return shipped[name].read_text("utf-8"), f"{name}.yaml", None
    path = Path(name) if folder is None else folder / name
    try:
        return path.read_text("utf-8"), str(path), path.parent
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file in UTF-8") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); "
            f"shipped protocols are: {' '.join(shipped)}"
        ) from error


def _read(
    name: str, folder: Path | None, values: Mapping[str, Any], chain: tuple[str, ...]
) -> Protocol:
    text, shown, own_folder = _text(name, folder)
    return _protocol(text, shown, values, own_folder, (*chain, shown))[0]


def _protocol(
    text: str, source: str, values: Mapping[str, Any], folder: Path | None, chain: tuple[str, ...]
) -> tuple[Protocol, list[Any]]:
    """Return a protocol and its steps as plain data, fully expanded."""
    data, lines = load_yaml(text, source)
    if not isinstance(data, dict):
        raise InputError(f"{source}:1: expected keys and values, found {type(data).__name__}")
    version = data.get("version", VERSION)
    if isinstance(version, int) and not isinstance(version, bool) and version > VERSION:
        raise InputError(f"{source}:{lines.get(('version',), 1)}: {later_version(version)}")
    declared = data.get("parameters") or {}
    steps: list[RawStep] = []
    problems: list[Problem] = []
    if isinstance(data.get("steps"), list) and isinstance(declared, dict):
        expander = Expander(source, lines, _Includes(folder, chain, source))
        problems = expander.problems
        for name in values:
            if name not in declared:
                problems.append((0, f"{source}: {unknown_parameter(name, declared)}"))
        scope = Scope({**declared, **{k: v for k, v in values.items() if k in declared}})
        steps = made_unique(expander.steps(data["steps"], ("steps",), scope))
        if problems and not steps:
            steps = [_PLACEHOLDER]
        texts = {key: data[key] for key in ("name", "description") if key in data}
        head = {k: v for k, v in data.items() if k not in ("steps", "parameters", *texts)}
        data = expander.substituted(head, (), scope) | texts
        data["parameters"] = dict(scope.values)
        data["steps"] = [step.data for step in steps]
        lines = {p: line for p, line in lines.items() if p[:1] != ("steps",) or len(p) == 1}
        for number, step in enumerate(steps):
            lines |= {("steps", number, *path): line for path, line in step.lines.items()}
    context = {"folder": folder, INCOMPLETE: bool(problems)}
    protocol = validate_model(Protocol, data, lines, source, context, problems)
    places = {("steps", k, *p): at for k, step in enumerate(steps) for p, at in step.places.items()}
    _locate(protocol.steps, source, lines, places, ("steps",), 1)
    if "place" in protocol.model_fields_set:  # else the default, which all protocols share
        protocol.place.locate(f"{source}:{lines.get(('place',), 1)}")
    return protocol, [step.data for step in steps]


def _locate(
    steps: Sequence[StepKind],
    source: str,
    lines: Lines,
    places: Mapping[Keys, str],
    path: Keys,
    line: int,
) -> None:
    """Set file and line of steps, nested ones too; `places` are those of included ones."""
    for number, step in enumerate(steps):
        key = (*path, number)
        step_line = lines.get(key, line)
        step.locate(places.get(key, f"{source}:{step_line}"))
        _locate(getattr(step, "steps", ()), source, lines, places, (*key, "steps"), step_line)


def _places(step: StepKind, path: Keys = ()) -> Iterator[tuple[Keys, str]]:
    """Yield file and line of a step at `path`, and of those nested in it."""
    yield path, step.where
    for number, inner in enumerate(getattr(step, "steps", ())):
        yield from _places(inner, (*path, "steps", number))


class _Includes:
    """Reads the protocols that one file includes; `chain` are the files that led to it."""

    def __init__(self, folder: Path | None, chain: tuple[str, ...], source: str) -> None:
        self._folder, self._chain, self._source = folder, chain, source

    def __call__(
        self, name: str, values: Mapping[str, Any], line: int
    ) -> Sequence[tuple[Any, Mapping[Keys, str]]]:
        """Return the raw steps of a protocol with places; InputError for a cycle, or its errors."""
        try:
            text, shown, folder = _text(name, self._folder)
        except InputError as error:
            raise InputError(f"{self._source}:{line}: include: {error}") from error
        file = Path(shown).resolve()
        repeated = [seen for seen in self._chain if seen == shown or Path(seen).resolve() == file]
        if repeated:
            circle = " -> ".join((*self._chain[self._chain.index(repeated[0]) :], shown))
            raise InputError(f"{self._source}:{line}: include: circular: {circle}")
        protocol, steps = _protocol(text, shown, values, folder, (*self._chain, shown))
        places = (dict(_places(step)) for step in protocol.steps)
        return list(zip(steps, places, strict=True))
