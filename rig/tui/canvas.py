"""The screen's one widget: shows rows, and redraws only those that changed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.style import Style
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from rig.tui.drawing.rows import BLANK, Row, to_strip


class Canvas(Widget):
    """Rows of the whole terminal."""

    DEFAULT_CSS = "Canvas { width: 100%; height: 100%; }"
    can_focus = True

    def __init__(self) -> None:
        super().__init__()
        self.rows: tuple[Row, ...] = ()
        self._background = Style.null()

    def show(self, rows: Sequence[Row]) -> None:
        """Show these rows."""
        previous, self.rows = self.rows, tuple(rows)
        self._background = self.rich_style
        padded = [*previous, *[BLANK] * (len(rows) - len(previous))]
        changed = [y for y, line in enumerate(self.rows) if line != padded[y]]
        if len(previous) != len(rows):
            self.refresh()
        elif changed:
            # Neighbouring rows make one region: each has its cost in the compositor.
            runs = groupby(enumerate(changed), key=lambda pair: pair[1] - pair[0])
            regions = []
            for _, members in runs:
                lines = [y for _, y in members]
                regions.append(Region(0, lines[0], self.size.width, len(lines)))
            self.refresh(*regions)

    def render_line(self, y: int) -> Strip:
        """Return one line of the terminal."""
        line = self.rows[y] if y < len(self.rows) else BLANK
        return to_strip(line, self.size.width, self._background)
