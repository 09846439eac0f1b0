"""The `validate` verb: simulation of a model compared with records."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import JsonOption, RunsArgument
from rig.cli.text.output import printed_at_end, write_json


def validate(
    model: Annotated[Path, typer.Argument(help="A model file of `bramah identify --model`.")],
    runs: RunsArgument,
    json: JsonOption = None,
) -> None:
    """Simulate the model with the measured spool and compare the result with the records.

    Example: bramah validate model.json runs/tuesday
    """
    from analysis.simulation.model import load_model
    from analysis.simulation.validate import to_json
    from analysis.simulation.validate import validate as validate_model
    from rig.cli.text.render import validation_text
    from rig.runs.repeated import refuse_repeated
    from rig.runs.store import load_run

    refuse_repeated(runs)
    results = validate_model(load_model(model), [load_run(folder) for folder in runs])
    with printed_at_end(json, lambda: validation_text(results)):
        write_json(json, to_json(results))
