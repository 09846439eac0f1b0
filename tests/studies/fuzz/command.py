"""`python -m tests.studies fuzz`: damaged frames and files by the million."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli.text.output import progress, table


def fuzz(
    cases: Annotated[int, typer.Option(min=100, help="Over all readers, by their shares.")] = (
        1_000_000
    ),
    seed: Annotated[int, typer.Option(min=0, help="Of the damage.")] = 0,
    only: Annotated[str | None, typer.Option(help="One reader only.")] = None,
) -> None:
    """Damage frames and files and read them: no crash, hang or unbounded memory.

    Example: python -m tests.studies fuzz --cases 20000
    """
    from tests.studies.fuzz.run import fuzz as run
    from tests.studies.fuzz.targets import MAKERS, SHARES

    rows, wrong = [], False
    for key in MAKERS if only is None else [only]:
        found = run(key, max(1, round(cases * SHARES[key])), seed)
        progress(f"{found.name}: {found.cases} cases")
        wrong = wrong or bool(found.wrong)
        rows.append(
            [
                found.name,
                str(found.cases),
                str(found.refused),
                f"{1e3 * found.slowest:.1f} ms (case {found.slowest_case})",
                f"{found.grown / 1e6:.0f} MB",
                "; ".join(f"{n} x {what}" for what, n in found.wrong.most_common(3)) or "nothing",
            ]
        )
    header = ["reader", "cases", "refused", "slowest", "memory grew", "what may not happen"]
    typer.echo(table(header, rows))
    if wrong:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add this study to `python -m tests.studies`."""
    app.command()(fuzz)
