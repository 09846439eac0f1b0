"""The `bramah` command and its verbs; the module of a verb is imported when the verb is called."""

from __future__ import annotations

import ast
import importlib
import io
import logging
import os
import signal
import sys
from collections.abc import Sequence
from keyword import iskeyword
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Final

import typer

from rig.cli.errors import LogFormatter, guarded

# For the many tall, narrow matrices of the analysis, BLAS threads slow each other down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

NAME: Final = "bramah"
COMPLETING: Final = "_BRAMAH_COMPLETE"  # set by the shell's completion, which Typer installs
# In the order of `bramah --help`; each a module of `rig.cli.verbs` with a function or group of its
# name (a keyword of Python with an underscore behind it).
VERBS: Final = (
    "demo", "sim", "check", "run", "queue", "monitor", "runs", "recover", "probe", "stop",
    "depressurise", "reset", "plan", "design", "import", "export", "identify", "validate",
    "simulate", "trace", "loop", "manual", "conformance", "dbc", "schema", "bench",
)  # fmt: skip
GUIDE: Final = """Run a hydraulic robot's test bench, identify its model, find what the model lacks.

Begin with `bramah demo`, which needs no hardware. At a bench: `bramah probe` reads it and moves
nothing, `bramah check` proves a protocol, `bramah run` runs it; then come `bramah identify`,
`bramah validate` and `bramah trace`.
"""


def command_line(verbs: Sequence[str]) -> typer.Typer:
    """Return the command line with `verbs` complete and all others by name and summary only."""
    app = typer.Typer(name=NAME, help=GUIDE, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.callback()(_bramah)
    for verb in VERBS:
        name = f"{verb}_" if iskeyword(verb) else verb
        if verb in verbs:
            work = getattr(importlib.import_module(f"rig.cli.verbs.{name}"), name)
            if isinstance(work, typer.Typer):
                app.add_typer(work, name=verb)
            else:
                app.command(verb)(work)
        else:
            app.command(verb, help=_summary(name))(_not_imported)
    return app


def _print_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        typer.echo(f"bramah {version('bramah')}")
        raise typer.Exit


def _bramah(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Take the options that stand before a verb."""


def _not_imported() -> None:
    raise AssertionError("the verb called was not passed to command_line()")


def _summary(name: str) -> str:
    """Return the first line of a verb's docstring, read from its source without importing it."""
    source = Path(__file__).with_name("verbs").joinpath(f"{name}.py").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        doc = ast.get_docstring(node) if isinstance(node, ast.FunctionDef) else None
        if doc and "Example: bramah" in doc:
            return doc.splitlines()[0]
    raise AssertionError(f"rig/cli/verbs/{name}.py has no verb")


def _words_of_call(words: Sequence[str]) -> Sequence[str]:
    """Return the words of a call, or those typed so far if a shell asks for a completion."""
    if COMPLETING not in os.environ:
        return words
    # bash passes the words in COMP_WORDS, other shells in _TYPER_COMPLETE_ARGS
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
    return line.split()[1:]


def __getattr__(name: str) -> Any:
    # `app` has all verbs, for importers; a call of `run` imports one verb.
    if name == "app":
        return command_line(list(VERBS))
    raise AttributeError(name)


class Interruption:
    """A signal's handler that raises KeyboardInterrupt; `heard` states whether it was called.

    A library that calls Python may swallow the exception; `rig.bench.stops` then still stops.
    A closing terminal sends SIGHUP twice, from the kernel and the shell: only the first counts.
    """

    def __init__(self) -> None:
        self.heard = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt."""
        if self.heard and number == signal.SIGHUP:
            return
        self.heard = True
        raise KeyboardInterrupt


def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its exit code; `--debug` may stand anywhere."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"] or ["--help"]
    handler = logging.StreamHandler()
    handler.setFormatter(LogFormatter("%(levelname)s %(name)s: %(message)s"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        # as standard error: characters that the terminal or a file's encoding lacks, as \xb1
        sys.stdout.reconfigure(errors="backslashreplace")
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, handlers=[handler])
    # Verbs then clean up as after Ctrl-C; while driving, a bench installs its own handlers.
    signal.signal(signal.SIGTERM, Interruption())
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored
        signal.signal(signal.SIGINT, Interruption())
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup sets it
        signal.signal(signal.SIGHUP, Interruption())
    verb = next((word for word in _words_of_call(words) if not word.startswith("-")), "")

    def work() -> int | None:
        app = command_line([verb])
        result: int | None = app(words, prog_name=NAME, standalone_mode=False)
        return result

    sys.exit(guarded(work, debug=debug))


if __name__ == "__main__":
    run()
