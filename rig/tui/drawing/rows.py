"""A row of the screen: pieces of text with their styles; immutable, so that rows compare quickly.

Pages are plain functions that return rows. Only rows that changed are drawn again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from textwrap import wrap

from rich.cells import cell_len as slow_cell_len
from rich.cells import set_cell_size
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip

from rig.tui.drawing.styles import DIM, PLAIN

Part = tuple[str, str]
Row = tuple[Part, ...]

BLANK: Row = ()

# Characters of two cells, and of none. Only text with one is measured by characters.
_NOT_ONE_CELL = re.compile(
    "[\u0300-\u036f\u1100-\u115f\u200b-\u200f\u2e80-\ua4cf\uac00-\ud7a3\uf900-\ufaff"
    "\ufe00-\ufe6f\uff00-\uff60\uffe0-\uffe6\U0001f000-\U0003fffd]"
)


def cell_len(text: str) -> int:
    """Return the width of a text [cells]."""
    if text.isascii() or _NOT_ONE_CELL.search(text) is None:
        return len(text)
    return slow_cell_len(text)


def row(*parts: str | Part) -> Row:
    """Return a row of parts; a bare string is plain."""
    return tuple((part, PLAIN) if isinstance(part, str) else part for part in parts)


class Fitted(tuple[Part, ...]):
    """A row of known width, which is not measured again when drawn."""

    cells: int


def fitted(parts: Iterable[Part], cells: int) -> Row:
    """Return parts of a total width of `cells` cells as a row of known width."""
    sized = Fitted(parts)
    sized.cells = cells
    return sized


def width_of(line: Row) -> int:
    """Return the width of a row [cells]."""
    if isinstance(line, Fitted):
        return line.cells
    total = 0
    for text, _ in line:
        total += cell_len(text)
    return total


def fit(line: Row, width: int, style: str = PLAIN) -> Row:
    """Return a row of exactly `width` cells: cut with an ellipsis, or filled up in a style."""
    if width <= 0:
        return BLANK
    used = width_of(line)
    if used <= width:
        filler = ((" " * (width - used), style),) if used < width else ()
        return line if isinstance(line, Fitted) and not filler else fitted((*line, *filler), width)
    fitting: list[Part] = []
    remaining = width - 1
    for text, part_style in line:
        size = cell_len(text)
        if size > remaining:
            fitting.append((set_cell_size(text, remaining) + "…", part_style))
            break
        fitting.append((text, part_style))
        remaining -= size
    return fit(tuple(fitting), width, style)


def ends(left: Row, right: Row, width: int) -> Row:
    """Return a row with a part at either end; the left one is cut if they do not fit."""
    room = width - width_of(right)
    if room <= 0:
        return fit(right, width)
    return (*fit(left, room), *right)


def window(rows: list[Row], at: int, height: int) -> list[Row]:
    """Return `height` of the rows with row `at` among them; the end rows count the hidden ones."""
    first = min(max(at - height // 2, 0), max(len(rows) - height, 0))
    shown, below = rows[first : first + height], len(rows) - first - height
    if height < 3:  # the marked row has no neighbours on both sides
        return shown
    if first > 0:
        shown[0] = _more("↑", first)
    if below > 0:
        shown[-1] = _more("↓", below)
    return shown


def _more(arrow: str, hidden: int) -> Row:
    """Return the row in place of one that is hidden with `hidden` others."""
    return row((f" {arrow} {hidden + 1} more lines", DIM))


def block(rows: Sequence[Row], width: int, height: int, style: str = PLAIN) -> list[Row]:
    """Return exactly `height` rows of `width` cells; the last one counts what does not fit."""
    if len(rows) > height > 0:
        rows = [*rows[: height - 1], _more("↓", len(rows) - height)]
    filled = [fit(line, width, style) for line in rows[: max(height, 0)]]
    if len(filled) < height:
        filled += [fit(BLANK, width, style)] * (height - len(filled))
    return filled


def hstack(blocks: Sequence[tuple[Sequence[Row], int]], height: int, gap: int = 1) -> list[Row]:
    """Return blocks of given widths side by side, each filled up to `height` rows."""
    filled = [block(rows, width, height) for rows, width in blocks]
    space: Row = ((" " * gap, PLAIN),) if gap else ()
    total = sum(width for _, width in blocks) + gap * (len(blocks) - 1)
    joined = []
    for parts in zip(*filled, strict=True):
        line: Row = parts[0]
        for part in parts[1:]:
            line = (*line, *space, *part)
        joined.append(fitted(line, total))
    return joined


def box(
    title: str, body: Sequence[Row], width: int, height: int, style: str = DIM, note: str = ""
) -> list[Row]:
    """Return a frame of `width` x `height` around rows, its title above, a note below right."""
    inner = width - 4
    if inner < 1 or height < 2:
        return block(body, width, height)
    head = f"─ {title} " if title else ""
    if cell_len(head) > width - 3:
        head = set_cell_size(head, width - 4) + "…"
    foot = f" {note} ─" if note else ""
    foot = foot if cell_len(foot) <= width - 3 else ""
    top = row((f"┌{head}{'─' * (width - 2 - cell_len(head))}┐", style))
    bottom = row((f"└{'─' * (width - 2 - cell_len(foot))}{foot}┘", style))
    left, right = ("│ ", style), (" │", style)
    rows = block(body, inner, height - 2)
    return [top, *(fitted((left, *line, right), width) for line in rows), bottom]


def wrapped(text: str, width: int, style: str = PLAIN) -> list[Row]:
    """Return a text as rows up to `width` wide, filled up if its style has a background."""
    lines = [part for line in text.splitlines() for part in wrap(line, max(width, 8)) or [""]]
    rows = [row((line, style)) for line in lines]
    return [fit(line, width, style) for line in rows] if " on " in style else rows


def marked(mark: Part, text: str, width: int, style: str = PLAIN) -> list[Row]:
    """Return a text as rows up to `width` wide behind a mark; further rows are indented."""
    sign, sign_style = mark
    lines = wrapped(text, max(width - len(sign), 1), style) or [row()]
    return [row((sign if k == 0 else " " * len(sign), sign_style), *line)
            for k, line in enumerate(lines)]  # fmt: skip


def grid(
    boxes: Sequence[Callable[[int, int], list[Row]]],
    across: int,
    least: int,
    width: int,
    height: int,
) -> tuple[list[Row], int]:
    """Return boxes drawn by (width, height) in rows of `across`, and how many are hidden.

    There are as many rows as fit, each of at least `least` lines, but one in any case.
    """
    down = max(min(-(-len(boxes) // across), height // least), 1)
    each = (width - (across - 1)) // across
    rows: list[Row] = []
    for k in range(down):
        share = (height - len(rows)) // (down - k)
        in_row = boxes[across * k : across * (k + 1)]
        rows += hstack([(draw(each, share), each) for draw in in_row], share)
    return rows, max(len(boxes) - across * down, 0)


def columns(rows: Iterable[Sequence[str | Part]], gap: int = 2) -> list[Row]:
    """Return cells as aligned columns; each as wide as its widest cell."""
    lines = [row(*cells) for cells in rows]
    count = max((len(line) for line in lines), default=0)
    widths = [
        max((cell_len(line[k][0]) for line in lines if k < len(line)), default=0)
        for k in range(count)
    ]
    return [
        tuple((text + " " * ((widths[k] - cell_len(text) + gap) * (k + 1 < len(line))), style)
              for k, (text, style) in enumerate(line))
        for line in lines
    ]  # fmt: skip


@lru_cache(maxsize=256)
def _style(text: str, background: Style) -> Style:
    return background + Style.parse(text) if text else background


def to_strip(line: Row, width: int, background: Style) -> Strip:
    """Return a row in the form of the terminal's driver."""
    segments = [Segment(text, _style(style, background)) for text, style in fit(line, width)]
    return Strip(segments, width)
