"""`python -m tests.studies NAME`: run one study, reproduction or measured machine."""

from __future__ import annotations

import logging
import os
import sys

import typer

from rig.cli.errors import guarded
from tests.studies.conformance import command as conformance
from tests.studies.effects import command as effects
from tests.studies.estimators import command as estimators
from tests.studies.estimators import design_command as design
from tests.studies.faults import command as faults
from tests.studies.foreign import command as foreign
from tests.studies.fuzz import command as fuzz
from tests.studies.guard import command as guard
from tests.studies.machines import crane_command as crane
from tests.studies.machines import electric_command as electric
from tests.studies.machines import emps_command as emps
from tests.studies.machines import measured_figures
from tests.studies.machines import pendulum_command as pendulum
from tests.studies.nights import command as nights
from tests.studies.reproduction import command as reproduction
from tests.studies.trace import command as trace
from tests.studies.trace import evidence_command as evidence
from tests.studies.variants import command as variants
from tests.studies.wires import command as wires

# As in `rig.cli.main`: matrices are tall and narrow, BLAS threads slow each other down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

STUDIES = (
    trace,
    evidence,
    foreign,
    estimators,
    design,
    effects,
    guard,
    reproduction,
    crane,
    emps,
    pendulum,
    electric,
    measured_figures,
    faults,
    conformance,
    wires,
    fuzz,
    nights,
    variants,
)

app = typer.Typer(
    name="python -m tests.studies",
    help="Measure the method on simulated benches, the paper's tables and measured machines.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)
for study in STUDIES:
    study.register(app)


def run(arguments: list[str] | None = None) -> None:
    """Run a study and exit with the code that `bramah` would have; `--debug` may stand anywhere."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    logging.basicConfig(level=logging.DEBUG if debug else logging.WARNING, stream=sys.stderr)
    sys.exit(guarded(lambda: app(words, standalone_mode=False), debug=debug))


if __name__ == "__main__":
    run()
