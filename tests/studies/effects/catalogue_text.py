"""The catalogue as text: one table of all effects, one page per family, made from the classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Final

from analysis.effects.base import Effect
from analysis.terms import known
from rig.model.parameters import gain_names
from rig.model.rig import Rig
from tests.studies.pages import markdown_table

FAMILIES: Final[Mapping[str, str]] = {
    "friction": "Friction of a cylinder's seals: a force at the piston, so that its torque is "
    "proportional to the cylinder's Jacobian G.",
    "mechanics": "Effects on the arm and its load.",
    "valve": "Effects between the spool's LVDT and the metering edges.",
    "fluid": "Leakage, port pressures and the oil's stiffness.",
    "measurement": "Errors of sensors. They transform the data, not the model; a simulation is "
    "compared with corrected channels.",
}
OTHERS: Final = re.compile(r"joint ([2-9]|1\d)")  # joints that the table leaves out
_CODE: Final = re.compile(r"`[^`]*`|[^`]+")


def catalogue() -> dict[str, type[Effect]]:
    """Return every effect class by name, family by family."""
    kinds = {name: kind for name, kind in known().items() if issubclass(kind, Effect)}
    order = list(FAMILIES)
    return dict(sorted(kinds.items(), key=lambda item: order.index(item[1].family)))


def examples(kind: type[Effect], rig: Rig) -> list[Effect]:
    """Return the effect at every place of joint 1 and of the bench."""
    return [kind(place) for place in kind.places(rig) if not OTHERS.match(place)]


def parameter_rows(rig: Rig) -> list[tuple[str, str, str, str, str]]:
    """Return (effect, where, parameter, unit, bounds or kind) of every parameter at joint 1."""
    rows = []
    gains = {name for i in range(len(rig.joints)) for name in gain_names(i + 1)}
    for name, kind in catalogue().items():
        for effect in examples(kind, rig):
            for c in effect.coefficients(rig):
                kept = "the orifice's gain" if c.parameter in gains else "coefficient"
                rows.append((name, effect.place, c.parameter, c.unit or "-", kept))
            for s in effect.shapes(rig):
                if s.fixed:  # a knot of a curve, where the data are
                    continue
                text = f"shape, {s.low:.3g} to {s.high:.3g}"
                rows.append((name, effect.place, s.parameter, s.unit or "-", text))
    return rows


def table(rig: Rig) -> str:
    """Return the Markdown table of names, places, parameters (of joint 1), bounds."""
    head = ("effect", "where", "parameter", "unit", "found as")
    rows = (_quoted(row) for row in parameter_rows(rig))
    return "\n".join(markdown_table(head, rows)) + "\n"


def _quoted(row: tuple[str, ...]) -> tuple[str, ...]:
    return (f"`{row[0]}`", f"`{row[1]}`", f"`{row[2]}`", *row[3:])


def overview(rig: Rig) -> str:
    """Return the page of the whole catalogue for a rig."""
    parts = [
        "# Effects\n",
        "Physical effects that the baseline model may lack. Each effect is one class of "
        "`analysis/effects`; this page and those of the families are generated from the classes "
        "by\n",
        "    python -m tests.studies effects --docs docs/\n",
        f"The table lists the parameters of joint 1 and of the bench, with bounds for the rig "
        f"`{rig.name}`. A *coefficient* is found by least squares, a *shape* by a search within "
        "its bounds. Bounds of spools, forces and volumes scale with the rig. An effect whose name "
        "ends in `_curve`, and `position_force`, is a free form: a curve by its values at knots, "
        "tried only where no named effect explains the records.\n",
        table(rig),
        "\n## Families\n",
        *(f"- [{family}](effects-{family}.md): {text}" for family, text in FAMILIES.items()),
        "\n## What no data can separate\n",
        *hidden_from_data(rig),
        "\n## Adding an effect\n",
        "Add a module in `analysis/effects` with one frozen dataclass derived from `Effect`, and "
        "name it in the module's `TERMS`. Rows, simulation, trace, model files and this page then "
        "use it. `tests/analysis/effects/test_catalogue.py` checks that rows, simulation kernel "
        "and limits agree.",
    ]
    return "\n".join(parts) + "\n"


def hidden_from_data(rig: Rig) -> list[str]:
    """Return a line for each effect that the baseline absorbs, or that has a twin."""
    lines = []
    for name, kind in catalogue().items():
        for effect in examples(kind, rig):
            if effect.absorbed(rig):
                at = effect.where if effect.where == effect.place else effect.where.split()[-1]
                lines.append(f"- `{name}` ({at}): {effect.absorbed(rig)}.")
            lines += [
                f"- `{name}` and `{other}` of the same spool: the same to the data; reported "
                f"as `{name}`."
                for other, _ in effect.inseparable()
            ]
    return lines


def family_page(family: str) -> str:
    """Return the page of one family: equations, confounders, separating excitation, picture."""
    parts = [f"# Effects: {family}\n", FAMILIES[family] + "\n"]
    kinds = [kind for kind in catalogue().values() if kind.family == family]
    modules = dict.fromkeys(inspect.getmodule(kind) for kind in kinds)
    for module in modules:
        parts.append(_plain(inspect.getdoc(module) or "") + "\n")
    parts.append(f"\n![signatures](images/effects-{family}.svg)\n")
    parts.append(
        "Residual of the baseline against each effect's variable, on simulated benches that have "
        "the effect: grey without the effect in the model (mean over bins), red with it. The "
        "simulator's code is separate, and the form of an effect may differ there. Made by "
        "`python -m tests.studies effects --docs docs/`.\n"
    )
    for kind in kinds:
        rivals = ", ".join(f"`{name}`" for name in kind.confounders) or "none"
        parts.append(f"## `{kind.name}`\n")
        parts.append(_plain(inspect.getdoc(kind) or "") + "\n")
        parts.append(f"- Depends on: {kind.variable}.")
        parts.append(f"- Resembles: {rivals}.")
        parts.append(f"- Separated by: {kind.separated_by}.\n")
    return "\n".join(parts) + "\n"


def _plain(text: str) -> str:
    """Return a docstring as Markdown: formulas' stars and underscores guarded, code left alone."""
    return "\n".join(
        line if line.startswith("    ") else _CODE.sub(_guarded, line) for line in text.split("\n")
    )


def _guarded(part: re.Match[str]) -> str:
    return part[0] if part[0].startswith("`") else re.sub(r"([*_|<>])", r"\\\1", part[0])


def pages(rig: Rig) -> dict[str, str]:
    """Return every page by file name."""
    families = {f"effects-{family}.md": family_page(family) for family in FAMILIES}
    return {"effects.md": overview(rig), **families}
