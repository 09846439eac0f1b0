"""The `effects` verb: what the catalogue holds, and how well it is found on simulated benches."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def effects(
    rig: Annotated[str, typer.Option(help="A shipped rig's name or a rig file.")] = "shinshu-2dof",
    docs: Annotated[
        Path | None, typer.Option(help="Write the pages and pictures of this folder (minutes).")
    ] = None,
    study: Annotated[
        bool, typer.Option("--study", help="Find every effect on a bench that has it.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="These effects only.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated benches.")] = 5,
) -> None:
    """List the effects that a trace may name, with their parameters and bounds.

    Example: python -m tests.studies effects --study --only valve_deadband
    """
    from rig.cli.text.output import progress
    from rig.runs.rigs import load_rig
    from tests.studies.effects import simulated
    from tests.studies.effects.catalogue_text import pages, table

    bench = load_rig(rig)
    if docs is None and not study:
        typer.echo(table(bench))
        return
    outcomes = simulated.study(bench, seed, only or (), progress)
    typer.echo(simulated.table(outcomes))
    if docs is None:
        return
    written = pages(bench)
    written["effects.md"] += (
        "\n## Found on simulated benches\n\n"
        f"One record per step of `{simulated.PROTOCOL}` (seed {seed}) on a bench that has the "
        "effect in the simulator's form. `before` and `after` are residuals over the noise floor "
        "in held-out records (another wave at 0.7 of the amplitude), in the equation in which the "
        "effect is largest.\n\n" + simulated.table(outcomes)
    )
    for name, text in written.items():
        (docs / name).write_text(text, encoding="utf-8")
    (docs / "images").mkdir(exist_ok=True)
    for family, picture in simulated.figures(outcomes).items():
        (docs / "images" / f"effects-{family}.svg").write_text(picture, encoding="utf-8")


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(effects)
