"""`identify --physical`: physically consistent parameters compared with unconstrained ones."""

from __future__ import annotations

from typing import Any

from analysis.identify.physical import Physical, physical, with_physics
from analysis.identify.physical import to_json as physical_json
from analysis.identify.result import Identification
from analysis.identify.result import to_json as identification_json
from rig.cli.text.output import table


def make_physical(result: Identification) -> tuple[Identification, dict[str, Any], str]:
    """Return the identification with consistent parameters, its JSON and the comparison as text.

    Raises InputError if a parameter is not identified.
    """
    projection = physical(result)
    returned = with_physics(result, projection)
    document = {**identification_json(returned), "physical": physical_json(projection)}
    return returned, document, "\n\n" + physical_text(projection)


def physical_text(physical: Physical) -> str:
    """Return every parameter, unconstrained and at each level, and the level of the result."""
    header = ["parameter [SI]", "free", *(f"{level.name}" for level in physical.levels)]
    rows = []
    for name, free in physical.free.items():
        cells = [name, f"{free.value:.5g}"]
        for level in physical.levels:
            value = level.estimates[name].value
            cells.append(f"{value:.5g} ({100 * (value / free.value - 1):+.2f} %)")
        rows.append(cells)
    level = physical.levels[physical.returned]
    more = physical.levels[physical.returned + 1 :]
    why = f"; '{more[0].name}' is rejected by the data" if more else ""
    return f"{table(header, rows)}\nresult: '{level.name}'{why}"
