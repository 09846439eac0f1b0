"""The `check` verb: a protocol's limits checked on the twin, and its expected errors."""

from __future__ import annotations

from pathlib import Path

import typer

from rig.cli.options import (
    DurationOption,
    JsonOption,
    ModelOption,
    NominalOption,
    ProtocolArgument,
    RepeatsOption,
    RigOption,
    ScaleOption,
    SetOption,
    StepOption,
    WaveSeedOption,
    overridden,
)
from rig.cli.text.output import Countdown, progress, write_json


def check(
    protocol: ProtocolArgument,
    rig: RigOption,
    repeats: RepeatsOption = None,
    duration: DurationOption = None,
    amplitude_scale: ScaleOption = 1.0,
    wave_seed: WaveSeedOption = None,
    step: StepOption = None,
    set_: SetOption = None,
    model: ModelOption = None,
    nominal: NominalOption = False,
    json: JsonOption = None,
) -> None:
    """Prove a protocol against the limits on the twin and predict its errors; nothing moves.

    Example: bramah check lock-and-excite --rig shinshu-2dof
    """
    from protocols.files import library
    from protocols.files.plan import resolve
    from rig.cli.execution.device import bench_at
    from rig.cli.proof.proofs import proved
    from rig.cli.proof.twin_choice import twin_source
    from rig.cli.text.sheets import check_text

    changes = overridden(repeats, duration, amplitude_scale, wave_seed, step, set_)
    bench = bench_at(rig, None)
    plan = resolve(library.load(protocol, changes.parameters), bench, changes)
    source = twin_source(bench, model, nominal)
    proof = proved(plan, bench, predict=True, progress=Countdown("checking"), source=source)
    if proof.warning or json == Path("-"):
        progress(proof.twin_text)
    document = proof.report.as_dict()
    used = {"model": proof.source.as_dict(), "warning": proof.warning}
    write_json(json, {**document, **used, "identification": proof.prediction})
    if json != Path("-"):
        known = (
            "\n\nnothing has changed since the last proof; it is shown again"
            if proof.reused
            else ""
        )
        typer.echo(f"{check_text(proof.report)}\n\n{proof.twin_text}\n\n{proof.text}{known}")
    proof.report.require()
