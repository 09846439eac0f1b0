"""`python -m tests.studies variants`: the tests that `make test` leaves out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).parents[3]


def variants(
    only: Annotated[str | None, typer.Option(help="As pytest's -k: of these names.")] = None,
) -> None:
    """Run the tests marked slow: other sizes and forms of what `make test` tries once.

    Example: python -m tests.studies variants --only friction
    """
    words = [sys.executable, "-m", "pytest", "-m", "slow", *(["-k", only] if only else [])]
    raise typer.Exit(subprocess.run(words, cwd=ROOT, check=False).returncode)


def register(app: typer.Typer) -> None:
    """Add this study to the command line."""
    app.command()(variants)
