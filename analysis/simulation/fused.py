"""A right-hand side for one set of terms, generated from the terms' kernels and compiled once.

The source has no loop and no array: every term's kernel is specialised for its joint
(`analysis.terms.specialise`), and the statements follow one another between those of
`analysis.simulation.interpreted`. Operations and their order are the same as there, so both results
agree to the last bit. Compiled code is cached on disk (`analysis.simulation.compiled_sources`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.simulation import equations as eq
from analysis.terms.base import (
    COMP_CAP,
    COMP_ROD,
    CONTRIBUTE,
    FLOW_CAP,
    FLOW_ROD,
    OUT_ROWS,
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    PREPARE,
    QD,
    SD,
    TEMPERATURE,
    THETA,
    TIME,
    TORQUE,
    V_CAP,
    V_ROD,
    X_ROWS,
    G,
    Q,
    S,
    Term,
    U,
    Used,
)
from analysis.terms.sine_cosine import sine_cosine
from analysis.terms.specialise import Helpers, ScalarArray, specialised

Array = NDArray[np.float64]

_HEAD: Final = '''"""Right-hand side of {names}: generated from these terms."""
import math
import numpy as np
from numba import cfunc, njit, types

D = types.CPointer(types.float64)
SIGNATURE = types.int64(
    types.float64, D, D, D, types.int64, types.float64,
    types.CPointer(types.uint8), D, D, types.CPointer(types.int64), D,
)
'''
_DEFINITION: Final = """
@cfunc(SIGNATURE, cache=True, error_model="numpy")
def rates(t, y, dy, inputs, n, rate, locked, geometry, par, context, work):
"""


@dataclass(frozen=True)
class GeneratedSource:
    """The text, and the elements of `par` (by index) that it uses as constant array indices."""

    text: str
    places: Mapping[int, int]


@functools.lru_cache(maxsize=256)
def _cached_sources(
    terms: tuple[Term, ...], lengths: tuple[int, ...], hidden: tuple[int, ...],
    electric: tuple[bool, ...],
) -> list[GeneratedSource]:  # fmt: skip
    """Return the cached list of sources of a set of terms, which `source_of` extends."""
    return []


def source_of(
    terms: Sequence[Used], packed: Sequence[Array], hidden: Sequence[int], electric: Sequence[bool]
) -> str:
    """Return the source of the terms' right-hand side (see `_generated`), cached per process."""
    sources = _cached_sources(
        tuple(used.term for used in terms), tuple(map(len, packed)), tuple(hidden), tuple(electric)
    )
    par = np.concatenate(packed)
    for source in sources:
        if all(par[k] == value for k, value in source.places.items()):
            return source.text
    sources.append(_generated(terms, packed, hidden, electric))
    return sources[-1].text


def _generated(
    terms: Sequence[Used], packed: Sequence[Array], hidden: Sequence[int], electric: Sequence[bool]
) -> GeneratedSource:
    """Return the source of the terms' right-hand side, with one joint for each of `electric`.

    `packed` are the packed values of each term, `hidden` its number of hidden states. Raises
    `analysis.terms.specialise.NotSpecialisable` where a kernel cannot be specialised.
    """
    N = len(electric)
    helpers, body = Helpers(), _Lines()
    p_first = np.cumsum([0, *map(len, packed)])
    z_first = 4 * N + np.cumsum([0, *hidden])
    phases: list[list[str]] = []
    read: set[str] = set()
    places: dict[int, int] = {}
    for phase in (PREPARE, CONTRIBUTE):
        for m, used in enumerate(terms):
            if phase == PREPARE and not used.term.prepares:
                continue
            arrays = {
                "bench": ScalarArray("bench", (4,)),
                "x": ScalarArray("x", (X_ROWS, N)),
                "z": ScalarArray("y", (hidden[m],), int(z_first[m])),
                "par": ScalarArray("p", (len(packed[m]),), int(p_first[m]), tuple(packed[m])),
                "out": ScalarArray("out", (OUT_ROWS, N)),
                "M": ScalarArray("M", (N, N)),
                "dz": ScalarArray("dy", (hidden[m],), int(z_first[m])),
            }
            kernel = specialised(
                used.term.kernel.function, {"phase": phase}, arrays, f"t{m}_{phase}_", helpers
            )
            read |= kernel.read
            places |= {int(name[1:]): place for name, place in kernel.places.items()}
            phases.append([f"# {used.term.name} at {used.term.where}", *kernel.lines])
    for k in sorted(int(name[1:]) for name in read if name[0] == "p" and name[1:].isdecimal()):
        body.add(f"p{k} = par[{k}]")
    for k in range(4 * N, 4 * N + sum(hidden)):
        body.add(f"y{k} = y[{k}]", f"dy{k} = 0.0")
    _observe(body, electric, helpers.copy(sine_cosine, {}, {})[0])
    for row in range(OUT_ROWS):
        for i in range(N):
            body.add(f"out{row}_{i} = 0.0")
    for i in range(N):
        for j in range(N):
            body.add(f"M{i}_{j} = 0.0")
    for lines in phases:
        body.add(*lines)
    _balance(body, electric)
    for k in range(4 * N, 4 * N + sum(hidden)):
        body.add(f"dy[{k}] = dy{k}")
    body.add(f"return {eq.OK}")
    names = ", ".join(f"{used.term.name} at {used.term.where}" for used in terms)
    parts = [_HEAD.format(names=names), *helpers.texts.values(), _DEFINITION + body.text()]
    return GeneratedSource("\n".join(parts), places)


class _Lines:
    """Lines of a function's body."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, *lines: str) -> None:
        self.lines += lines

    def text(self) -> str:
        return "".join(f"    {line}\n" for line in self.lines)


def _observe(body: _Lines, electric: Sequence[bool], sine_cosine: str) -> None:
    """Write what all terms read: inputs at t, the joints' geometry, chambers, volumes."""
    N = len(electric)
    width = 3 + 4 * N
    body.add(
        "place = min(max(t * rate, 0.0), n - 1.0)",
        "low = min(int(place), n - 2)",
        "w = place - low",
        f"a = low * {width}",
        f"b = a + {width}",
        f"bench{TIME} = inputs[{width - 1}] + t",
        f"bench{P_S} = inputs[a] + w * (inputs[b] - inputs[a])",
        f"bench{P_TANK} = 0.0",
        f"bench{TEMPERATURE} = inputs[a + 1] + w * (inputs[b + 1] - inputs[a + 1])",
        "inside = True",
        "angle = 0.0",
    )

    def interpolated(column: int) -> str:
        return f"inputs[a + {column}] + w * (inputs[b + {column}] - inputs[a + {column}])"

    for i, drive in enumerate(electric):
        g = i * eq.COLUMNS
        body.add(
            f"x{U}_{i} = {interpolated(2 + i)}",
            f"held{i} = locked[{i}] != 0",
            f"if held{i}:",
            f"    x{Q}_{i} = {interpolated(2 + N + i)}",
            f"    x{QD}_{i} = {interpolated(2 + 2 * N + i)}",
            f"    qdd{i} = {interpolated(2 + 3 * N + i)}",
            "else:",
            f"    x{Q}_{i} = y[{i}]",
            f"    x{QD}_{i} = y[{N + i}]",
            f"    qdd{i} = 0.0",
            f"angle += x{Q}_{i}",
        )
        if drive:
            body.add(
                f"angle += geometry[{g + eq.OFFSET}]",
                f"x{THETA}_{i} = angle",
                f"x{G}_{i} = 1.0",
                f"x{S}_{i} = x{Q}_{i}",
                f"x{SD}_{i} = x{QD}_{i}",
                *(f"x{row}_{i} = 0.0" for row in (P_CAP, P_ROD, V_CAP, V_ROD)),
            )
            continue
        body.add(
            f"x{THETA}_{i} = angle",
            f"pin_a = geometry[{g + eq.PIN_A}]",
            f"pin_c = geometry[{g + eq.PIN_C}]",
            f"beta = x{Q}_{i} + geometry[{g + eq.OFFSET}]",
            f"sine, cosine = {sine_cosine}(beta)",
            "length = math.sqrt(pin_a * pin_a + pin_c * pin_c - 2.0 * pin_a * pin_c * cosine)",
            f"x{G}_{i} = pin_a * pin_c * sine / length",
            f"x{S}_{i} = length - geometry[{g + eq.MID}]",
            f"x{SD}_{i} = x{G}_{i} * x{QD}_{i}",
            f"x{P_CAP}_{i} = y[{2 * N + i}]",
            f"x{P_ROD}_{i} = y[{3 * N + i}]",
            f"half = 0.5 * geometry[{g + eq.STROKE}]",
            f"area_cap{i} = geometry[{g + eq.AREA_CAP}]",
            f"area_rod{i} = geometry[{g + eq.AREA_ROD}]",
            f"x{V_CAP}_{i} = geometry[{g + eq.DEAD_CAP}] + (half + x{S}_{i}) * area_cap{i}",
            f"x{V_ROD}_{i} = geometry[{g + eq.DEAD_ROD}] + (half - x{S}_{i}) * area_rod{i}",
            f"if not abs(x{S}_{i}) < 2.0 * half or x{V_CAP}_{i} <= 0.0 or x{V_ROD}_{i} <= 0.0:",
            "    inside = False",
        )
    body.add("if not inside:", f"    return {eq.LEFT_STROKE}")


def _balance(body: _Lines, electric: Sequence[bool]) -> None:
    """Write the cylinders' torques, the accelerations and the chambers."""
    N = len(electric)
    for i, drive in enumerate(electric):
        torque = f"out{TORQUE}_{i}"
        if drive:
            body.add(f"{torque} += geometry[{i * eq.COLUMNS + eq.GAIN}] * x{U}_{i}")
        else:
            body.add(
                f"force = area_cap{i} * x{P_CAP}_{i} - area_rod{i} * x{P_ROD}_{i}",
                f"{torque} += x{G}_{i} * force",
            )
    _solve(body, N)
    for i, drive in enumerate(electric):
        states = [i, N + i, 2 * N + i, 3 * N + i]
        body.add(f"if held{i}:", *(f"    dy[{k}] = 0.0" for k in states), "else:")
        body.add(f"    dy[{states[0]}] = x{QD}_{i}", f"    dy[{states[1]}] = qdd{i}")
        if drive:
            body.add(*(f"    dy[{k}] = 0.0" for k in states[2:]))
            continue
        cap, rod = f"out{COMP_CAP}_{i}", f"out{COMP_ROD}_{i}"
        body.add(
            f"    dy[{states[2]}] = (out{FLOW_CAP}_{i} - area_cap{i} * x{SD}_{i}) / {cap}",
            f"    dy[{states[3]}] = (out{FLOW_ROD}_{i} + area_rod{i} * x{SD}_{i}) / {rod}",
        )


def _solve(body: _Lines, N: int) -> None:
    """Write M q'' = torques by L D L', locked joints' rows replaced by their given q''."""
    for i in range(N):
        body.add(f"if held{i}:")
        for j in range(N):
            body.add(f"    out{TORQUE}_{j} -= M{j}_{i} * qdd{i}", f"    M{i}_{j} = 0.0")
            body.add(f"    M{j}_{i} = 0.0")
        body.add(f"    M{i}_{i} = 1.0", f"    out{TORQUE}_{i} = qdd{i}")
    for i in range(N):
        for j in range(i):
            total = f"M{i}_{j}" + "".join(f" - v{k} * L{j}_{k}" for k in range(j))
            body.add(f"v{j} = {total}", f"L{i}_{j} = v{j} * inverse{j}")
        body.add(f"pivot = M{i}_{i}" + "".join(f" - v{k} * L{i}_{k}" for k in range(i)))
        body.add("if not pivot > 0.0:", f"    return {eq.BAD_INERTIA}")
        body.add(f"inverse{i} = 1.0 / pivot")
    for i in range(N):
        total = f"out{TORQUE}_{i}" + "".join(f" - L{i}_{k} * qdd{k}" for k in range(i))
        body.add(f"qdd{i} = {total}")
    for i in range(N - 1, -1, -1):
        total = f"qdd{i} * inverse{i}" + "".join(f" - L{k}_{i} * qdd{k}" for k in range(i + 1, N))
        body.add(f"qdd{i} = {total}")
