"""The `check` verb: a protocol proved on the twin, and the errors it would leave."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import (
    DurationOption,
    JsonOption,
    RepeatsOption,
    RigOption,
    ScaleOption,
    StepOption,
    WaveSeedOption,
)
from rig.cli.output import write_json


def check(
    protocol: Annotated[str, typer.Argument(help="A shipped protocol's name, or a file.")],
    rig: RigOption,
    repeats: RepeatsOption = None,
    duration: DurationOption = None,
    amplitude_scale: ScaleOption = 1.0,
    wave_seed: WaveSeedOption = None,
    step: StepOption = None,
    json: JsonOption = None,
) -> None:
    """Prove a protocol against the limits on the twin and predict its errors; nothing moves.

    Example: bramah check lock-and-excite --rig shinshu-2dof
    """
    from protocols.files.plan import Overrides
    from rig.cli.predicted_errors import as_dict, foresee, prediction_text
    from rig.cli.sheets import check_text

    steps = tuple(step) if step else None
    changes = Overrides(repeats, duration, amplitude_scale, wave_seed, steps)
    found = foresee(protocol, rig, changes)
    write_json(json, as_dict(found))
    if json != Path("-"):
        typer.echo(f"{check_text(found.limits)}\n\n{prediction_text(found)}")
    found.limits.require()


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(check)
