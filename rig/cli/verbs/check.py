"""The `check` verb: a protocol's limits checked on the twin, and its expected errors."""

from __future__ import annotations

from pathlib import Path

from rig.cli import options as opt
from rig.cli.text.output import Countdown, print_result, progress


def check(
    protocol: opt.ProtocolArgument,
    rig: opt.RigOption,
    repeats: opt.RepeatsOption = None,
    duration: opt.DurationOption = None,
    amplitude_scale: opt.ScaleOption = 1.0,
    wave_seed: opt.WaveSeedOption = None,
    step: opt.StepOption = None,
    set_: opt.SetOption = None,
    model: opt.ModelOption = None,
    nominal: opt.NominalOption = False,
    json: opt.JsonOption = None,
) -> None:
    """Prove a protocol against the limits on the twin and predict its errors; nothing moves.

    Example: bramah check lock-and-excite --rig shinshu-2dof
    """
    from protocols.files import library
    from protocols.files.plan import resolve
    from rig.cli.execution.device import bench_at, warn_of_limits
    from rig.cli.proof.proofs import proved
    from rig.cli.proof.twin_choice import twin_source
    from rig.cli.text.sheets import check_text

    changes = opt.overridden(repeats, duration, amplitude_scale, wave_seed, step, set_)
    bench = bench_at(rig, None, on_twin=True)
    warn_of_limits(bench)
    plan = resolve(library.load(protocol, changes.parameters), bench, changes)
    source = twin_source(bench, model, nominal)
    proof = proved(plan, bench, predict=True, progress=Countdown("checking"), source=source)
    if proof.warning or json == Path("-"):
        progress(proof.twin_text)
    document = {
        **proof.report.as_dict(),
        "model": proof.source.as_dict(),
        "warning": proof.warning,
        "identification": proof.prediction,
    }
    parts = [check_text(proof.report), proof.twin_text, proof.text]
    if proof.reused:
        parts.append("nothing has changed since the last proof; it is shown again")
    print_result(json, document, "\n\n".join(parts))
    proof.report.require()
