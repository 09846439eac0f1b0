"""The `bramah` command: verbs, and nothing that a verb does."""

from __future__ import annotations

import logging
import sys

import typer

from rig.cli import (
    analysis_commands,
    bench_commands,
    demo_command,
    design_command,
    design_study_command,
    figures_command,
)
from rig.cli.errors import guarded

app = typer.Typer(
    name="bramah",
    help="Run a hydraulic robot's test bench, identify its parameters, say what the model lacks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)
for module in (
    demo_command,
    bench_commands,
    analysis_commands,
    design_command,
    design_study_command,
    figures_command,
):
    module.register(app)


def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with the contract's code; `--debug` may stand anywhere."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    sys.exit(guarded(lambda: app(words, standalone_mode=False), debug=debug))
