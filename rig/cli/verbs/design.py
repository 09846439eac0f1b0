"""The `design` verb."""

from __future__ import annotations

from typing import Annotated

import typer

from rig.cli import options as opt


def design(
    protocol: opt.ProtocolArgument,
    rig: opt.RigOption,
    out: opt.ProtocolFileOption = None,
    criterion: Annotated[
        str, typer.Option(help="D, E, or the name of the parameter to improve.")
    ] = "E",
    budget: Annotated[
        int, typer.Option(min=1, max=5000, help="Number of simulations per step on the twin.")
    ] = 300,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the search; the same seed gives the same result.")
    ] = 0,
    model: opt.ModelOption = None,
    nominal: opt.NominalOption = False,
    json: opt.JsonOption = None,
) -> None:
    """Improve a protocol's multisines for better estimates, within the rig's limits.

    Example: bramah design lock-and-excite-multisine --rig shinshu-2dof --criterion b --out b.yaml
    """
    from rig.cli.proof.predicted_errors import design_json, design_protocol, design_text
    from rig.cli.proof.twin_choice import load_twin, twin_source, twin_text
    from rig.cli.text.output import print_result, progress
    from rig.runs.files import write_text
    from rig.runs.rigs import load_bench

    bench = load_bench(rig)
    source = twin_source(bench, model, nominal)
    parameters = load_twin(source, bench)
    progress(twin_text(source, parameters.warning))
    designed = design_protocol(protocol, rig, criterion, budget, seed, parameters)
    if out is not None:
        write_text(out, designed.text)
    text = f"{design_text(designed, out)}\nlimits and errors predicted on: {parameters.text}"
    print_result(json, design_json(designed), text)
