"""The `bramah` command: verbs, and nothing that a verb does."""

from __future__ import annotations

import importlib
import logging
import os
import pkgutil
import sys
from typing import Final

import typer

import rig.cli
from rig.cli.errors import LogFormatter, guarded

# Matrices here are tall and narrow, and there are many: BLAS threads get in each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Shown first, in this order; every other module named *_command registers its verbs after them.
FIRST: Final = ("demo_command", "bench_commands", "plan_command", "analysis_commands")

app = typer.Typer(
    name="bramah",
    help="Run a hydraulic robot's test bench, identify its parameters, say what the model lacks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)
_found = [m.name for m in pkgutil.iter_modules(rig.cli.__path__) if "_command" in m.name]
for name in (*FIRST, *sorted(set(_found) - set(FIRST))):
    importlib.import_module(f"rig.cli.{name}").register(app)


def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with the contract's code; `--debug` may stand anywhere."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, handlers=[handler])
    sys.exit(guarded(lambda: app(words, standalone_mode=False), debug=debug))
