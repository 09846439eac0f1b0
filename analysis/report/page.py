"""HTML pages: a template filled in, and a file written atomically."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from rig.model.parse import InputError
from rig.runs.files import write_text


def page(template: str, context: Mapping[str, Any]) -> str:
    """Return a template filled in, with the common style."""
    environment = Environment(
        loader=FunctionLoader(_read), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    style = Markup(_read("report.css"))
    return environment.get_template(template).render(context, style=style)


def write(path: Path, text: str) -> None:
    """Write a page atomically; raises InputError where it cannot be written."""
    try:
        write_text(path, text)
    except OSError as error:
        raise InputError(f"cannot write the report {path}: {error.strerror or error}") from error


def _read(name: str) -> str:
    return (resources.files("analysis.report") / "templates" / name).read_text(encoding="utf-8")
