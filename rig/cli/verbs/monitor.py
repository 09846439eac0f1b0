"""The `monitor` verb: the operator's screen."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.errors import WorkError
from rig.cli.options import EndpointOption
from rig.cli.text.output import is_terminal, progress


def monitor(
    rig: Annotated[str | None, typer.Option("--rig", help="Show only runs of this rig.")] = None,
    plain: Annotated[
        bool,
        typer.Option("--plain", help="Print one line per second, for screen readers and logs."),
    ] = False,
    web: Annotated[
        bool,
        typer.Option(
            "--web", help="Show the screen in a browser of this machine; prints its address."
        ),
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(help="Port of --web; 0 takes a free one.  [default: 0]", min=0, max=65535),
    ] = None,
    runs: Annotated[
        Path, typer.Option("--runs", help="Folder of the listed runs and of new ones.")
    ] = Path(),
    endpoint: EndpointOption = None,
) -> None:
    """Watch, start and command a protocol; space stops it, q leaves it running.

    With --web in a browser, also over ssh: ssh -t -L 8123:127.0.0.1:8123 BENCH
    bramah monitor --web --port 8123, then open the printed address.

    Example: bramah monitor --rig shinshu-2dof
    """
    from rig.model.parse import InputError
    from rig.runs.rigs import load_rig, shipped_rigs

    if web and plain:
        raise InputError("--web cannot be used with --plain: expected one of them")
    if port is not None and not web:
        raise InputError(f"--port {port}: expected with --web only")

    # Sessions are listed by the rig's name, not by the name of its file.
    described = None
    if rig is not None and (rig in shipped_rigs() or Path(rig).is_file()):
        described = load_rig(rig)
    name = described.name if described is not None else rig
    wire = None
    if rig is not None and endpoint is not None:
        from drivers.registry import wire_at

        wire = wire_at(endpoint, load_rig(rig).wire)
    if plain:
        from rig.tui.plain import print_status

        print_status(name, typer.echo, wire)
        return
    if web:
        raise typer.Exit(_serve(rig, runs, endpoint, port or 0))
    # With TEXTUAL_DRIVER the browser's page is the terminal.
    if not is_terminal(sys.stdin) and "TEXTUAL_DRIVER" not in os.environ:
        raise InputError(
            "the screen needs a terminal, but standard input is none: expected --plain (lines of "
            "text) or --web (a browser)"
        )
    from rig.tui.app import main
    from rig.tui.browse import BrowserState

    browsed = BrowserState(folder=runs, rig=rig or "", endpoint=endpoint)
    if described is not None:
        browsed = replace(browsed, joints=len(described.joints))
    raise typer.Exit(main(name, browsed, wire))


def _serve(rig: str | None, runs: Path, endpoint: str | None, port: int) -> int:
    """Serve the screen to browsers of this machine until a signal; return the exit code."""
    if find_spec("textual_serve") is None:
        raise WorkError(
            "--web needs the package textual-serve, which is not installed: "
            "pip install 'bramah[web]'"
        )
    from rig.queue.processes import BRAMAH
    from rig.tui.web.server import listen, serve

    options = {"--rig": rig, "--runs": str(runs), "--endpoint": endpoint}
    words = [word for name, value in options.items() if value is not None for word in (name, value)]
    try:
        listening = listen(port)
    except OSError as error:
        raise WorkError(
            f"--port {port}: {error.strerror}; expected a free port, or 0 to take one"
        ) from error

    def ready(address: str) -> None:
        typer.echo(address)
        progress(
            "open this address in a browser of this machine; keep it secret, it gives control "
            "of runs. Ctrl-C closes the pages and ends no run"
        )

    return serve([*BRAMAH, "monitor", *words], listening, ready)
