"""Python protocols: a function that yields steps, for logic beyond a file.

The module has the head of a file as a dictionary `PROTOCOL`, and defines `steps(parameters)`, which
yields steps as objects or as the dictionaries of a file:

    PROTOCOL = {"name": "falling", "joints": 2, "parameters": {"amplitude": "0.4 V"}}

    def steps(parameters):
        for n in range(3):
            yield {"name": f"size_{n}", "excite": [...]}

All steps are generated before anything is resolved, so that a Python protocol passes the same
checks. What it prints goes to standard error: standard output is for results.
"""

from __future__ import annotations

import importlib.util
import itertools
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from protocols.files.expansion import MOST_STEPS, unknown_parameter
from protocols.files.schema import Protocol
from protocols.steps.base import StepKind
from rig.model.parse import InputError, validate_model


def load_generator(path: Path, values: Mapping[str, Any]) -> Protocol:
    """Run a Python protocol's generator to its end; raises InputError naming the error.

    `values` replace those of its `PROTOCOL["parameters"]`.
    """
    module = _module(path)
    head, steps = getattr(module, "PROTOCOL", None), getattr(module, "steps", None)
    if not isinstance(head, dict) or not callable(steps):
        raise InputError(
            f"{path}: expected a dictionary PROTOCOL and a function steps(parameters) that yields "
            "steps"
        )
    declared = dict(head.get("parameters", {}))
    for name in values:
        if name not in declared:
            raise InputError(f"{path}: {unknown_parameter(name, declared)}")
    parameters = {**declared, **values}
    with _user_code(path, "steps() raised "):
        drawn = list(itertools.islice(steps(parameters), MOST_STEPS + 1))
    if len(drawn) > MOST_STEPS:
        raise InputError(f"{path}: steps() yields more than {MOST_STEPS} steps, the most allowed")
    dictionaries = [step for step in drawn if not isinstance(step, StepKind)]
    if len(dictionaries) == len(drawn):
        data = {**head, "parameters": parameters, "steps": drawn}
        return validate_model(Protocol, data, {}, str(path), {"folder": path.parent})
    if dictionaries:
        raise InputError(f"{path}: steps() yields objects and dictionaries; expected one of them")
    placeholder = {**head, "parameters": parameters, "steps": [{"mark": "to be replaced"}]}
    head_only = validate_model(Protocol, placeholder, {}, str(path), {"folder": path.parent})
    try:
        return Protocol(**{**dict(head_only), "steps": tuple(drawn)})
    except ValueError as error:
        reason = str(error).splitlines()
        raise InputError(f"{path}: {reason[2].strip() if len(reason) > 2 else error}") from error


def _module(path: Path) -> object:
    spec = importlib.util.spec_from_file_location("bramah_python_protocol", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(f"{path}: cannot be read as a Python file")
    module = importlib.util.module_from_spec(spec)
    with _user_code(path, ""):
        spec.loader.exec_module(module)
    return module


@contextmanager
def _user_code(path: Path, doing: str) -> Iterator[None]:
    """Run the user's code; raises InputError with the line at which it failed or left."""
    try:
        with redirect_stdout(sys.stderr):
            yield
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        line = next((f":{f.lineno}" for f in reversed(frames) if f.filename == str(path)), "")
        raise InputError(f"{path}{line}: {doing}{type(error).__name__}: {error}") from error
