"""The `schema` verb: the JSON schema of protocol files, for editors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options import writable_file


def schema(
    out: Annotated[
        Path | None,
        typer.Option(help="Write the schema here.  [default: stdout]", callback=writable_file),
    ] = None,
) -> None:
    """Print the JSON schema of protocol files, for completion and checks in editors.

    Example: bramah schema --out protocol.schema.json
    """
    from protocols.files.schema import protocol_schema
    from rig.cli.text.output import write_json

    write_json(Path("-") if out is None else out, protocol_schema())
