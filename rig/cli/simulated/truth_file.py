"""The file of a simulated bench's true parameters: `sim --truth`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rig.cli.text.output import write_json
from rig.model.parse import InputError

SCENARIO: Final = "scenario"  # key beside the parameters' names


def write_truth(path: Path | None, parameters: Mapping[str, float], scenario: Any) -> None:
    """Write true parameters [SI] by name and, under `scenario`, the hidden effects."""
    write_json(path, {**parameters, SCENARIO: scenario})


def read_truth(path: Path) -> dict[str, float]:
    """Read the parameters that `bramah sim --truth` wrote; raises InputError for other files."""
    try:
        truth = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): float(value) for name, value in truth.items() if name != SCENARIO}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} cannot be read as true parameters ({error}); expected the JSON file that "
            "`bramah sim --truth` writes"
        ) from error
