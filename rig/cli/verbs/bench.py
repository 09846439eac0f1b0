"""The `bench` verb: the performance figures of README and docs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption, writable_file
from rig.cli.text.output import printed_at_end, progress, write_json


def bench(
    json: JsonOption = None,
    minutes: Annotated[
        float, typer.Option(min=0.02, help="Minutes of real-time acquisition over each wire.")
    ] = 10.0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of simulated benches to identify, from seed 100 on.")
    ] = 10,
    only: Annotated[
        str | None,
        typer.Option(
            help="One of: plant, analysis, trace, growth, run, stream, demo, acquisition, wires, "
            "faults, screen."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Measure 10 stops by key at the screen instead of 200.")
    ] = False,
    docs: Annotated[
        Path | None,
        typer.Option(help="Also write the table to this Markdown file.", callback=writable_file),
    ] = None,
) -> None:
    """Measure this machine: plant, identification, ten unseen benches, acquisition.

    Example: bramah bench --minutes 0.5 --seeds 2
    """
    from rig.cli.bench.figures import as_json, measure, page, text
    from rig.runs.files import write_text

    figures = measure(minutes, seeds, only, progress, quick=quick)
    with printed_at_end(json, lambda: text(figures)):
        write_json(json, as_json(figures))
        if docs is not None:
            write_text(docs, page(figures))
