"""The `plan` verb: a rig's lock-and-excite steps, with proof that they determine all parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.errors import WorkError
from rig.cli.options import JsonOption, ProtocolFileOption, RigOption, writable_file
from rig.cli.text.output import print_result


def plan(
    rig: RigOption,
    out: ProtocolFileOption = None,
    validation: Annotated[
        Path | None,
        typer.Option(help="Write a protocol for validation data here.", callback=writable_file),
    ] = None,
    prove: Annotated[
        str | None,
        typer.Option(help="Prove this protocol (a name or a file) instead of generating one."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Generate a rig's lock-and-excite steps and prove that they determine all parameters.

    Ends with 1 where they do not.

    Example: bramah plan --rig digger-3dof --out digger.yaml --validation digger-validate.yaml
    """
    from rig.cli.proof.step_planning import plan_steps
    from rig.cli.text.sheets import proof_text

    proof = plan_steps(rig, out, validation, prove)
    print_result(json, proof.as_dict(), proof_text(proof))
    if not proof.complete:
        undetermined = [n for v in proof.verdicts.values() for n in v.undetermined]
        raise WorkError(f"{proof.protocol}: does not determine {' '.join(undetermined)}")
