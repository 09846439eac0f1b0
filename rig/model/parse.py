"""YAML text to models: an error lists every problem with file, line, key and what is expected."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from textwrap import shorten
from typing import Any, Final, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from rig.model.quantity import FROM_FILE, UnitError, parse_quantity

_MOST = 30  # problems of one file that are listed; a file with more is of another kind
_MOST_REPEATED = 100_000  # values that the aliases of a file may add; more only fill the memory
Model = TypeVar("Model", bound=BaseModel)
Path = tuple[str | int, ...]


class InputError(ValueError):
    """Bad input by the user: the message says what to do, a line for each problem (exit code 2)."""


# YAML 1.1 reads 7e-4 as text, because a number needs a dot there.
_FLOAT = re.compile(r"^[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)$")


class _Loader(yaml.SafeLoader):
    """A separate safe loader, so that its resolver does not change the library's."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return a node's value; raises YAMLError with the line, also for the date 2026-13-01."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, AttributeError) as error:
            problem = f"{_cut(repr(node.value))} cannot be read ({error})"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from error


_Loader.yaml_implicit_resolvers = {
    key: list(value) for key, value in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


def _lines(node: yaml.Node, path: Path, numbers: dict[Path, int], source: str) -> None:
    numbers.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            name = str(key.value)
            line = key.start_mark.line + 1
            if name in seen:
                raise InputError(f"{source}:{line}: key {name!r} occurs twice")
            seen.add(name)
            numbers[(*path, name)] = line
            _lines(value, (*path, name), numbers, source)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            numbers[(*path, index)] = value.start_mark.line + 1
            _lines(value, (*path, index), numbers, source)


def _expanded(node: yaml.Node, sizes: dict[int, int], source: str) -> int:
    """Return the number of values of a node with its aliases written out; InputError if huge."""
    if id(node) not in sizes:
        sizes[id(node)] = 1  # where a node contains itself
        inner = node.value if isinstance(node, yaml.CollectionNode) else []
        parts = itertools.chain(*inner) if isinstance(node, yaml.MappingNode) else inner
        sizes[id(node)] = size = 1 + sum(_expanded(part, sizes, source) for part in parts)
        if size > _MOST_REPEATED + len(sizes):
            raise InputError(
                f"{source}:{node.start_mark.line + 1}: {size} values once its aliases (*name) are "
                f"written out; expected at most {_MOST_REPEATED} repeated ones in a file"
            )
    return sizes[id(node)]


def load_yaml(text: str, source: str) -> tuple[Any, dict[Path, int]]:
    """Parse YAML safely into (data, line of each path); raises InputError with the line."""
    try:
        loader = _Loader(text)
    except yaml.YAMLError as error:  # the reader rejects characters before parsing
        problem = str(error).splitlines()[0]
        raise InputError(f"{source}:1: not a YAML text: {problem}") from error
    try:
        node = loader.get_single_node()
        if node is None:
            raise InputError(f"{source}:1: the file is empty")
        _expanded(node, {}, source)
        lines: dict[Path, int] = {}
        _lines(node, (), lines, source)
        return loader.construct_document(node), lines
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark is not None else 1
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{source}:{line}: not valid YAML: {problem}") from error
    except RecursionError as error:
        raise InputError(f"{source}:1: nested too deeply to be a description") from error
    except (ValueError, OverflowError) as error:  # an escape beyond Unicode
        if isinstance(error, InputError):
            raise
        raise InputError(f"{source}:{loader.line + 1}: not valid YAML: {error}") from error
    finally:
        loader.dispose()


Problem = tuple[int, str]  # the line of a file, and the sentence that describes the problem


class Unresolved(str):
    """A text in place of a value that could not be found; its further errors are not reported."""

    __slots__ = ()


def refusal(problems: Iterable[Problem], source: str) -> InputError:
    """Return the error that states each problem once, in the order of the file, `_MOST` at most."""
    ordered = [text for _, text in sorted(problems, key=lambda problem: problem[0])]
    shown = list(dict.fromkeys(line for text in ordered for line in text.splitlines()))
    if len(shown) > _MOST:
        shown[_MOST:] = [f"{source}: and {len(shown) - _MOST} more"]
    return InputError("\n".join(shown))


# Names for pydantic's types in the words of a file's author.
WANTED: Final = {
    ("model_type", "model_attributes_type", "dict_type", "mapping_type"): "keys and values",
    ("tuple_type", "list_type"): "a list (each entry after a dash)",
    ("string_type",): "text",
    ("bool_type", "bool_parsing"): "true or false",
    ("int_type", "int_parsing", "int_from_float"): "a whole number",
    ("float_type", "float_parsing"): "a number",
}
NO_NUMBER: Final = (
    "expected a number, found true or false (YAML reads yes, no, on and off as these)"
)
FOUND_AT_MOST: Final = 60  # characters of a wrong value that a message repeats


def _problems(
    error: ValidationError, lines: dict[Path, int], source: str, model: type[BaseModel]
) -> list[Problem]:
    """Return the problems with their lines."""
    problems: list[Problem] = []
    said: set[tuple[str | int, str]] = set()
    for problem in _causes(error):
        if isinstance(problem["input"], Unresolved):
            continue
        path, text = tuple(problem["loc"]), problem_text(problem)
        # A tagged union puts its tag into the path; drop parts that the file does not have.
        known: Path = ()
        for part in path:
            if (*known, part) in lines:
                known = (*known, part)
        # A problem repeated by a YAML alias counts once.
        mistake = (path[-1] if path else "", f"{text} {problem['input']!r}")
        repeated = bool(lines) and known[-1:] != path[-1:] and problem["type"] != "missing"
        if repeated and mistake in said:
            continue
        said.add(mistake)
        if lines:
            path = (*known, path[-1]) if problem["type"] == "missing" else known
        line = lines.get(known, 1)
        if (here := (f"{line} {known[-1:]}", f"{text} {problem['input']!r}")) in said:
            continue  # a step that a sweep repeats
        if lines:
            said.add(here)
        where = ".".join(str(part) for part in path) or model.__name__.lower()
        problems.append((line, f"{source}:{line}: {where}: {text}"))
    return problems


def boolean_numbers(data: Any, made: Any, path: Path = ()) -> Iterator[Path]:
    """Yield where a boolean of a file became a number: pydantic reads `yes` as 1."""
    if isinstance(data, bool) and isinstance(made, int | float) and not isinstance(made, bool):
        yield path
    elif isinstance(data, dict) and isinstance(made, BaseModel | dict):
        fields = made if isinstance(made, dict) else dict(made)
        for key, value in data.items():
            yield from boolean_numbers(value, fields.get(key), (*path, key))
    elif isinstance(data, list | tuple) and isinstance(made, list | tuple):
        for index, (value, inner) in enumerate(zip(data, made, strict=False)):
            yield from boolean_numbers(value, inner, (*path, index))


def _causes(error: ValidationError) -> list[ErrorDetails]:
    """Return the problems without consequential ones: a list too short for its invalid members."""
    problems = error.errors()
    places = [tuple(problem["loc"]) for problem in problems]
    return [
        problem
        for problem, at in zip(problems, places, strict=True)
        if problem["type"] not in ("too_short", "too_long")
        or not any(len(other) > len(at) and other[: len(at)] == at for other in places)
    ]


def first_problem(error: ValidationError) -> str:
    """Return the key of pydantic's first problem, and the problem."""
    problem = error.errors()[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem_text(problem)}"


def problem_text(problem: ErrorDetails) -> str:
    """Return pydantic's problem with a value in the words of a file's author."""
    text = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "extra_forbidden":
        return "unknown key; remove it or correct its spelling"
    if problem["type"] == "missing":
        return "is missing here"
    if problem["type"] == "value_error":
        return text
    context = problem.get("ctx", {})
    if problem["type"] == "union_tag_invalid":
        name = context["discriminator"].strip("'")
        return f"{name}: expected one of {context['expected_tags']}, found {context['tag']!r}"
    if problem["type"] == "union_tag_not_found":
        text = f"a key {context['discriminator']}"
    elif problem["type"] in ("too_short", "too_long"):
        most = problem["type"] == "too_long"
        number = context["max_length" if most else "min_length"]
        text = f"{'at most' if most else 'at least'} {number} of them"
    elif problem["type"] == "string_too_long":
        text = f"text of at most {context['max_length']} characters"
    elif problem["type"] == "string_pattern_mismatch":
        text = f"text that matches {context['pattern']}"
    text = text.removeprefix("Input should be ")
    wanted = next((wanted for kind, wanted in WANTED.items() if problem["type"] in kind), text)
    value = problem["input"]
    found = f"the keys {', '.join(map(str, value))}" if value and isinstance(value, dict) else ""
    return f"expected {wanted}, found {_cut(found or repr(value))}"


def _cut(text: str) -> str:
    """Return a text in one line of FOUND_AT_MOST characters, cut between words if it has any."""
    cut = shorten(text, FOUND_AT_MOST)
    return cut if cut != "[...]" else f"{text[: FOUND_AT_MOST - 6]} [...]"


def shipped_files(package: str, folder: str) -> dict[str, Traversable]:
    """Return the YAML files that a package ships in a folder, by name and in its order."""
    files = resources.files(package).joinpath(folder).iterdir()
    named = {file.name[:-5]: file for file in files if file.name.endswith(".yaml")}
    return {name: named[name] for name in sorted(named)}


def parse_model(model: type[Model], text: str, source: str) -> Model:
    """Read YAML text as `model`, units required beside numbers; raises as `validate_model`."""
    data, lines = load_yaml(text, source)
    return validate_model(model, data, lines, source)


def validate_model(
    model: type[Model],
    data: Any,
    lines: dict[Path, int],
    source: str,
    context: Mapping[str, Any] | None = None,
    known: Sequence[Problem] = (),
) -> Model:
    """Validate loaded YAML as `model`; raises InputError with a line for each problem.

    Each line names file, line, key, the value found and the one expected. `context` is passed to
    the model's validators with `FROM_FILE`. `known` are problems that the reader found before: they
    are listed with the model's own, and with any of them validation fails.
    """
    if not isinstance(data, dict):
        raise InputError(f"{source}:1: expected keys and values, found {type(data).__name__}")
    try:
        made = model.model_validate(data, context={**FROM_FILE, **(context or {})})
    except ValidationError as error:
        raise refusal([*known, *_problems(error, lines, source, model)], source) from error
    except RecursionError as error:
        raise InputError(f"{source}:1: refers to itself (a YAML alias?)") from error
    wrong: dict[tuple[int, str | int], str] = {}  # a value repeated by a YAML alias counts once
    for path in boolean_numbers(data, made):
        wrong.setdefault((lines.get(path, 1), path[-1]), f"{'.'.join(map(str, path))}: {NO_NUMBER}")
    if known or wrong:
        found = [(line, f"{source}:{line}: {text}") for (line, _), text in wrong.items()]
        raise refusal([*known, *found], source)
    return made


def read_quantity(text: Any, si: str, source: str) -> float:
    """Read one quantity of a file in the SI unit `si`; raises InputError prefixed by `source`."""
    try:
        if not isinstance(text, str):
            raise UnitError(f"{text!r} has no unit; write one beside the number, like '1 {si}'")
        return parse_quantity(text, si)
    except UnitError as error:
        raise InputError(f"{source}: {error}") from error
