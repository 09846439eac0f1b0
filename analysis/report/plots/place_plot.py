"""A schematic of the machine with the places of named effects marked.

For each joint one column: cylinder with cap and rod chamber, valve, sensors (u spool, s piston, p
pressure), the joint that it moves; below all of them supply and return line. Electric: drive and
joint, with their sensors. Marks have the number of their line in the list.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Final

from markupsafe import Markup
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle

from analysis.effects.base import Effect
from analysis.report.plots.style import CARD, GREY, INK, MODEL, ORANGE, PALE, figure, style, svg
from analysis.terms import known
from analysis.trace.result import Trace
from rig.model.channels import place_in_words
from rig.model.rig import Rig

Line = tuple[str, str, tuple[str, ...], str]  # effect, place, names of its parameters, colour
Box = tuple[float, float, float, float]  # left, bottom, right, top in units of the drawing

WIDTH: Final = 10.5  # of a joint's column
CHAMBERS: Final = ("cap", "rod")
SENSORS: Final = ("cap sensor", "rod sensor", "piston sensor", "spool sensor")
ELECTRIC_SENSORS: Final = ("position sensor", "drive sensor")
# Positions of the elements in a column; names without a number belong to the bench.
HYDRAULIC: Final[dict[str, Box]] = {
    "cap": (1.2, 6.0, 3.6, 7.4), "piston": (3.6, 5.9, 4.1, 7.5), "rod": (4.1, 6.0, 7.0, 7.4),
    "joint": (8.2, 6.2, 9.2, 7.2), "valve": (2.6, 3.0, 5.6, 4.2),
    "cap sensor": (0.3, 4.7, 1.1, 5.5), "rod sensor": (7.1, 4.7, 7.9, 5.5),
    "piston sensor": (3.45, 8.1, 4.25, 8.9), "spool sensor": (1.2, 3.2, 2.0, 4.0),
}  # fmt: skip
ELECTRIC: Final[dict[str, Box]] = {
    "drive": (1.6, 2.6, 4.2, 4.2), "joint": (6.4, 2.9, 7.4, 3.9),
    "position sensor": (6.5, 4.6, 7.3, 5.4), "drive sensor": (2.5, 4.9, 3.3, 5.7),
}  # fmt: skip
SUPPLY: Final[Box] = (-2.6, 1.5, -1.4, 2.7)
TANK: Final[Box] = (-2.6, -0.2, -1.4, 0.8)
SUPPLY_SENSOR: Final[Box] = (-0.9, 2.6, -0.1, 3.4)
LETTERS: Final = {
    "cap sensor": "p", "rod sensor": "p", "piston sensor": "s", "spool sensor": "u",
    "position sensor": "q", "drive sensor": "i", "supply sensor": "p",
}  # fmt: skip
OF_BENCH: Final = ("base", "load", "supply", "tank")  # elements of the bench


def elements(rig: Rig) -> dict[str, Box]:
    """Return the name of every element that can be marked, with the joint's number."""
    table = ELECTRIC if rig.electric else HYDRAULIC
    out = {
        f"{name} {i + 1}": (left + WIDTH * i, bottom, right + WIDTH * i, top)
        for i in range(len(rig.joints))
        for name, (left, bottom, right, top) in table.items()
    }
    tip = out[f"joint {len(rig.joints)}"]
    out["load"] = (tip[2] + 0.6, tip[1] - 0.1, tip[2] + 1.6, tip[3] + 0.1)
    root = out["drive 1" if rig.electric else "cap 1"]
    out["base"] = (root[0] - 1.0, root[1], root[0] - 0.5, root[3])
    if not rig.electric:
        out |= {"supply": SUPPLY, "tank": TANK, "supply sensor": SUPPLY_SENSOR}
    return out


def marked(rig: Rig, name: str, where: str, parameters: Collection[str] = ()) -> tuple[str, ...]:
    """Return the elements at which an effect acts.

    The names in `parameters` state which sensor a sensor effect acts on.
    """
    kind = known().get(name)
    element = kind.element if kind is not None and issubclass(kind, Effect) else "joint"
    if element in OF_BENCH:
        return (element,)
    words = where.split()
    joints = words[1:2] if words[0] == "joint" else [str(i + 1) for i in range(len(rig.joints))]
    if kind is not None and element == "sensor":
        return _sensors(rig, kind, where, joints, " ".join((*parameters, *words[2:])))
    if words[-1] in CHAMBERS:
        return (f"{words[-1]} {joints[0]}",)
    if element == "chamber":
        return tuple(f"{chamber} {i}" for i in joints for chamber in CHAMBERS)
    return tuple(f"{'joint' if rig.electric else element} {i}" for i in joints)


def _sensors(
    rig: Rig, kind: type[Any], where: str, joints: Sequence[str], words: str
) -> tuple[str, ...]:
    """Return the sensors at a place that an effect can act on; those that `words` name, if any."""
    sensors = ELECTRIC_SENSORS if rig.electric else SENSORS
    known_sides = ("supply", *(sensor.split()[0] for sensor in sensors), "pressure")
    stated = [side for side in known_sides if side in words]
    candidates = [place.split() for place in kind.places(rig) if kind(place).place == where]
    sides = stated[:1] or ["supply" if place == ["bench"] else place[-1] for place in candidates]
    if "supply" in sides:
        return ("supply sensor",)
    if "pressure" in sides:
        sides += CHAMBERS
    return tuple(f"{s} {i}" for i in joints for s in sensors if s.split()[0] in sides)


def places(result: Trace) -> Markup | None:
    """Draw the machine with the named effects' places, and their rivals'; None without any."""
    lines = lines_of(result)
    return drawn(result.model_before.rig, lines) if lines else None


def lines_of(result: Trace) -> list[Line]:
    """Return the effects to mark, then those that the records cannot separate from them."""
    return [(e.name, e.at or e.where, tuple(e.parameters), MODEL) for e in result.effects] + [
        (name, where, (), ORANGE) for name, where in result.tied_at
    ]


def drawn(rig: Rig, lines: Sequence[Line]) -> Markup:
    """Draw the machine and mark the effects (name, place, parameters' names, colour)."""
    boxes = elements(rig)
    left = -1.4 if rig.electric else -3.2
    right = WIDTH * len(rig.joints) + 1.0
    low, high = (1.8, 6.7) if rig.electric else (-0.5, 9.7)
    with style():
        canvas = figure(0.3 * len(lines) + (CARD * 2) * min((high - low) / (right - left), 0.5),
                      CARD * 2)  # fmt: skip
        share = 0.3 * len(lines) / canvas.get_figheight()
        axes = canvas.add_axes((0.01, share, 0.98, 0.99 - share))
        axes.set_xlim(left, right)
        axes.set_ylim(low, high)
        axes.set_aspect("equal")
        axes.axis("off")
        for i in range(len(rig.joints)):
            (_electric if rig.electric else _hydraulic)(axes, WIDTH * i, i + 1)
        _bench(axes, rig, boxes)
        marks: dict[str, int] = {}
        for k, (name, where, parameters, colour) in enumerate(lines):
            for element in marked(rig, name, where, parameters):
                earlier = marks.get(element, 0)
                _mark(axes, boxes[element], k + 1, colour, earlier, element)
                marks[element] = earlier + 1
            words = f"{k + 1}  {name.replace('_', ' ')} at {place_in_words(where)}"
            if colour == ORANGE:
                words += ", which these records cannot separate from it"
            canvas.text(
                0.02, share - 0.3 * (k + 0.7) / canvas.get_figheight(), words,
                color=INK, fontsize=9,
                bbox={"facecolor": colour, "alpha": 0.25, "edgecolor": "none", "pad": 2.0},
            )  # fmt: skip
        return svg(
            canvas, "places", "Schematic of the machine with the places of the effects marked"
        )


def _line(axes: Any, *points: tuple[float, float]) -> None:
    axes.plot([p[0] for p in points], [p[1] for p in points], color=GREY, lw=1.2, zorder=1)


def _sensor(axes: Any, box: Box, letter: str) -> None:
    middle = (0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3]))
    axes.add_patch(Circle(middle, 0.5 * (box[2] - box[0]), fc="white", ec=INK, lw=0.8, zorder=3))
    axes.text(*middle, letter, ha="center", va="center", fontsize=8, style="italic", zorder=4)


def _block(axes: Any, box: Box, words: str, colour: str = "white") -> None:
    size = (box[2] - box[0], box[3] - box[1])
    axes.add_patch(Rectangle(box[:2], *size, fc=colour, ec=INK, lw=1.0, zorder=2))
    axes.text(
        0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3]), words, ha="center", va="center",
        fontsize=8, zorder=4,
    )  # fmt: skip


def _pin(axes: Any, box: Box, number: int, label: float = 0.3) -> None:
    """Draw a joint, its name `label` above it."""
    middle = (0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3]))
    axes.add_patch(Circle(middle, 0.5, fc="white", ec=INK, lw=1.4, zorder=3))
    axes.text(box[2] - 0.05, box[3] + label, f"joint {number}", ha="right", va="bottom", fontsize=8)


def _hydraulic(axes: Any, x: float, number: int) -> None:
    boxes = {n: (b[0] + x, b[1], b[2] + x, b[3]) for n, b in HYDRAULIC.items()}
    _line(axes, (x + 1.7, 6.0), (x + 1.7, 5.1), (x + 3.2, 5.1), (x + 3.2, 4.2))
    _line(axes, (x + 6.5, 6.0), (x + 6.5, 5.1), (x + 5.0, 5.1), (x + 5.0, 4.2))
    _line(axes, (x + 1.1, 5.1), (x + 1.7, 5.1))
    _line(axes, (x + 7.1, 5.1), (x + 6.5, 5.1))
    _line(axes, (x + 2.0, 3.6), (x + 2.6, 3.6))
    _line(axes, (x + 3.85, 7.5), (x + 3.85, 8.1))
    _line(axes, (x + 3.2, 3.0), (x + 3.2, 2.1))
    _line(axes, (x + 5.0, 3.0), (x + 5.0, 0.9))
    for end, y in ((x + 3.2, 2.1), (x + 5.0, 0.9)):
        axes.plot(end, y, "o", color=GREY, ms=3)
    _block(axes, boxes["cap"], "cap", "#eef1f4")
    _block(axes, boxes["rod"], "rod", "#eef1f4")
    _block(axes, boxes["piston"], "", PALE)
    axes.add_patch(Rectangle((x + 7.0, 6.55), 1.2, 0.3, fc="white", ec=INK, lw=1.0, zorder=2))
    axes.plot([x + 4.1, x + 7.0], [6.7, 6.7], color=PALE, lw=5, zorder=2.5, solid_capstyle="butt")
    _block(axes, boxes["valve"], f"valve {number}")
    _pin(axes, boxes["joint"], number)
    for name in SENSORS:
        _sensor(axes, boxes[name], LETTERS[name])


def _electric(axes: Any, x: float, number: int) -> None:
    boxes = {n: (b[0] + x, b[1], b[2] + x, b[3]) for n, b in ELECTRIC.items()}
    _line(axes, (x + 4.2, 3.4), (x + 6.4, 3.4))
    _line(axes, (x + 2.9, 4.2), (x + 2.9, 4.9))
    _line(axes, (x + 6.9, 3.9), (x + 6.9, 4.6))
    _block(axes, boxes["drive"], f"drive {number}")
    _pin(axes, boxes["joint"], number, label=-1.6)  # the sensor is above
    for name in ELECTRIC_SENSORS:
        _sensor(axes, boxes[name], LETTERS[name])


def _bench(axes: Any, rig: Rig, boxes: dict[str, Box]) -> None:
    """Draw base, load, supply and tank."""
    base, load = boxes["base"], boxes["load"]
    for k in range(5):
        y = base[1] + (base[3] - base[1]) * k / 5
        axes.plot([base[0], base[2]], [y, y + 0.3], color=INK, lw=0.6)
    axes.plot([base[2], base[2]], [base[1], base[3]], color=INK, lw=1.4)
    _line(axes, (base[2], 0.5 * (base[1] + base[3])), (base[2] + 0.5, 0.5 * (base[1] + base[3])))
    axes.text(base[0] - 0.3, 0.5 * (base[1] + base[3]), "base", fontsize=8, ha="right", va="center")
    _line(axes, (load[0] - 0.6, load[1] + 0.6), (load[0], load[1] + 0.6))
    _block(axes, load, "load", PALE)
    if rig.electric:
        return
    end = WIDTH * (len(rig.joints) - 1)
    for box, y, reach, words in ((SUPPLY, 2.1, 3.2, "supply"), (TANK, 0.9, 5.0, "tank")):
        _line(axes, (box[2] if words == "supply" else -2.0, y), (end + reach, y))
        axes.text(0.2, y + 0.1, words, va="bottom", fontsize=8)
    axes.add_patch(Circle((-2.0, 2.1), 0.6, fc="white", ec=INK, lw=1.0, zorder=2))
    axes.add_patch(
        Polygon([(-1.8, 2.35), (-1.8, 1.85), (-1.4, 2.1)], closed=True, fc=INK, zorder=3)
    )
    _line(axes, (-2.0, 0.9), (-2.0, 0.2))
    axes.plot([-2.6, -2.6, -1.4, -1.4], [0.6, -0.1, -0.1, 0.6], color=INK, lw=1.2)
    _line(axes, (-0.5, 2.1), (-0.5, 2.6))
    _sensor(axes, SUPPLY_SENSOR, LETTERS["supply sensor"])


def _mark(axes: Any, box: Box, number: int, colour: str, earlier: int, element: str) -> None:
    """Outline an element and put the number at its corner, next to `earlier` numbers."""
    pad = 0.18 + 0.12 * earlier
    axes.add_patch(
        FancyBboxPatch(
            box[:2], box[2] - box[0], box[3] - box[1], boxstyle=f"round,pad={pad}", zorder=5,
            fc=colour, alpha=0.18, ec="none",
        )
    )  # fmt: skip
    axes.add_patch(
        FancyBboxPatch(
            box[:2], box[2] - box[0], box[3] - box[1], boxstyle=f"round,pad={pad}", zorder=5,
            fc="none", ec=colour, lw=2.0, gid=f"mark-{number}-{element.replace(' ', '-')}",
        )
    )  # fmt: skip
    centre = (box[2] + 0.2 - 0.75 * earlier, box[3] + 0.25)
    axes.add_patch(Circle(centre, 0.34, fc=colour, ec="white", lw=0.8, zorder=6))
    axes.text(*centre, str(number), color="white", ha="center", va="center", fontsize=8, zorder=7)
