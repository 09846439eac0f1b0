"""Large letters of half blocks, three rows high, legible from two metres."""

from __future__ import annotations

from typing import Final

from rig.tui.drawing.rows import Row, row

ROWS: Final = 3
_DOTS: Final = 5  # high; the sixth of three rows stays empty

# Five rows of dots, separated by slashes.
_FONT: Final = {
    "A": ".#./#.#/###/#.#/#.#", "B": "##./#.#/##./#.#/##.", "C": ".##/#../#../#../.##",
    "D": "##./#.#/#.#/#.#/##.", "E": "###/#../##./#../###", "F": "###/#../##./#../#..",
    "G": ".###/#.../#.##/#..#/.###", "H": "#.#/#.#/###/#.#/#.#", "I": "#/#/#/#/#",
    "J": "..#/..#/..#/#.#/.#.", "K": "#..#/#.#./##../#.#./#..#", "L": "#../#../#../#../###",
    "M": "#...#/##.##/#.#.#/#...#/#...#", "N": "#..#/##.#/#.##/#..#/#..#",
    "O": ".##./#..#/#..#/#..#/.##.", "P": "##./#.#/##./#../#..", "Q": ".##./#..#/#..#/#.##/.###",
    "R": "##./#.#/##./#.#/#.#", "S": ".##/#../.#./..#/##.", "T": "###/.#./.#./.#./.#.",
    "U": "#.#/#.#/#.#/#.#/###", "V": "#.#/#.#/#.#/#.#/.#.", "W": "#...#/#...#/#.#.#/##.##/#...#",
    "X": "#.#/#.#/.#./#.#/#.#", "Y": "#.#/#.#/.#./.#./.#.", "Z": "###/..#/.#./#../###",
    "0": "###/#.#/#.#/#.#/###", "1": ".#./##./.#./.#./###", "2": "###/..#/###/#../###",
    "3": "###/..#/.##/..#/###", "4": "#.#/#.#/###/..#/..#", "5": "###/#../###/..#/###",
    "6": "###/#../###/#.#/###", "7": "###/..#/.#./.#./.#.", "8": "###/#.#/###/#.#/###",
    "9": "###/#.#/###/..#/###", ":": "./#/./#/.", ".": "./././#/#", "-": ".../.../###/.../...",
    "–": ".../.../###/.../...", "%": "#.#/..#/.#./#../#.#", "?": "##./..#/.#./.../.#.",
    "<": "..#/.#./#../.#./..#", " ": "../../../../..",
}  # fmt: skip
_HALVES: Final = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}


def _bitmap(text: str) -> list[str]:
    letters = [_FONT.get(letter, _FONT["?"]).split("/") for letter in text.upper()]
    return [".".join(letter[k] for letter in letters) for k in range(_DOTS)]


def large_width(text: str, scale: int = 1) -> int:
    """Return the width of a text in large letters [cells]."""
    return scale * len(_bitmap(text)[0]) if text else 0


def large(text: str, style: str, scale: int) -> list[Row]:
    """Return a text in letters of 3 `scale` rows; an unknown character becomes a question mark."""
    if not text:
        return [()] * (ROWS * scale)
    dots = [line for line in _bitmap(text) for _ in range(scale)]
    dots += ["." * len(dots[0])] * (2 * ROWS * scale - len(dots))
    rows = []
    for upper, lower in zip(dots[::2], dots[1::2], strict=True):
        pairs = zip(upper, lower, strict=True)
        cells = "".join(scale * _HALVES[a == "#", b == "#"] for a, b in pairs)
        rows.append(row((cells, style)))
    return rows
