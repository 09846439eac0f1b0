"""The `check` verb: a protocol proved on the twin, and the errors it would leave."""

from __future__ import annotations

from pathlib import Path

import typer

from rig.cli.options import (
    DurationOption,
    JsonOption,
    ProtocolArgument,
    RepeatsOption,
    RigOption,
    ScaleOption,
    SetOption,
    StepOption,
    WaveSeedOption,
    overridden,
)
from rig.cli.output import Countdown, write_json


def check(
    protocol: ProtocolArgument,
    rig: RigOption,
    repeats: RepeatsOption = None,
    duration: DurationOption = None,
    amplitude_scale: ScaleOption = 1.0,
    wave_seed: WaveSeedOption = None,
    step: StepOption = None,
    set_: SetOption = None,
    json: JsonOption = None,
) -> None:
    """Prove a protocol against the limits on the twin and predict its errors; nothing moves.

    Example: bramah check lock-and-excite --rig shinshu-2dof
    """
    from protocols.files import library
    from protocols.files.plan import resolve
    from rig.cli.proofs import proved
    from rig.cli.sheets import check_text
    from rig.runs.rigs import load_bench

    changes = overridden(repeats, duration, amplitude_scale, wave_seed, step, set_)
    bench = load_bench(rig)
    plan = resolve(library.load(protocol, changes.parameters), bench, changes)
    proof = proved(plan, bench, predict=True, tell=Countdown("checking"))
    write_json(json, {**proof.report.as_dict(), "identification": proof.prediction})
    if json != Path("-"):
        known = "\n\nunchanged since it was proved; the kept proof stands" if proof.reused else ""
        typer.echo(f"{check_text(proof.report)}\n\n{proof.text}{known}")
    proof.report.require()


def register(app: typer.Typer) -> None:
    """Add this verb to the command line."""
    app.command()(check)
