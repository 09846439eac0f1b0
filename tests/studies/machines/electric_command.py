"""The `electric` verb: a simulated electric arm on a slope that nobody has measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption
from rig.cli.text.output import progress, write_json


def electric(
    slope: Annotated[
        float | None,
        typer.Option(
            help="Of the base [deg]; drawn from the seed where not given.", min=-80, max=80
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the machine, its slope and noise.")] = 100,
    seeds: Annotated[
        int, typer.Option(min=1, help="Machines to survey instead of one, from --seed on.")
    ] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Write CSV files, a manifest and a run folder here.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Identify a simulated electric arm together with the unknown inclination of its base.

    Example: python -m tests.studies electric --slope 12 --out runs/slope
    """
    import math

    from analysis.identify.result import to_json
    from rig.cli.text.render import identification_text, validation_text
    from tests.studies.machines import electric as study

    if seeds > 1:
        found = study.survey(range(seed, seed + seeds), progress)
        write_json(json, study.survey_json(found))
        if json != Path("-"):
            typer.echo(study.survey_text(found))
        return
    angle = None if slope is None else math.radians(slope)
    story = study.arm_story(seed, angle, ("both at once",))
    result = story.found["both at once"]
    write_json(json, to_json(result))
    if out is not None:
        progress(f"records in {study.write_records(story, out)}")
    if json != Path("-"):
        typer.echo(identification_text(result, story.arm.truth()))
        typer.echo("\nnew motion, driven by the measured current:")
        typer.echo(validation_text(story.judged))


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(electric)
