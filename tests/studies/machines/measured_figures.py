"""Errors on measured machines against published ones, where the data are at hand.

Others' data are no part of this project: they are looked for in the folder `BRAMAH_DATA`, else in
`../shared/data` beside the working folder.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import typer

from rig.cli.bench.figure import Figure
from rig.cli.bench.figures import text
from rig.cli.text.output import progress

GROUP = "measured"
UNSEEN = 6.4  # [mm] open-loop error on motion that the fit has not seen
Say = Callable[[str], None]


def data_folder() -> Path:
    """Return where measured data are looked for."""
    return Path(os.environ.get("BRAMAH_DATA", Path("..") / "shared" / "data"))


def measured_figures(say: Say) -> list[Figure]:
    """Measure what the models do on machines that others have recorded."""
    return [*emps_figures(say), *pendulum_figures(say)]


def emps_figures(say: Say) -> list[Figure]:
    """Fit each half of the positioning system's record and judge it on the other."""
    from tests.studies.machines import emps as study

    file = data_folder() / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        say(f"measured: no {file}, left out (set BRAMAH_DATA to the folder that holds emps/)")
        return []
    say("measured: the positioning system, half on half")
    data, effects = study.load(file), study.MODELS["with Fc and offset"]
    out = []
    for estimator, limit in (("ls", None), ("output-error", UNSEEN)):
        errors = study.unseen(data, effects, estimator)
        for name, error in zip(("1st half on 2nd", "2nd half on 1st"), errors, strict=True):
            out.append(Figure(GROUP, f"EMPS, {estimator}, {name}", 1e3 * error, "mm", limit))
    return out


def pendulum_figures(say: Say) -> list[Figure]:
    """Fit the double pendulum and compare its error on new segments with the authors'."""
    from tests.studies.machines import pendulum as study

    folder = data_folder() / "multiarm_pendulum"
    if not folder.is_dir():
        say(f"measured: no {folder}, left out")
        return []
    found = study.compare(study.read_pendulum(folder), say)
    name = "pendulum, error on new segments over the authors', largest"
    return [Figure(GROUP, name, found.over_authors(), "", 1.0)]


def measured() -> None:
    """Print the errors on measured machines beside the published ones.

    Example: python -m tests.studies measured
    """
    typer.echo(text(measured_figures(progress)))


def register(app: typer.Typer) -> None:
    """Add this study to the command line."""
    app.command()(measured)
