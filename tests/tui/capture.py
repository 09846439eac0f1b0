"""Writes the screen as text, as it looks on the recorded run; docs/screen.md is made of it:

python -m tests.tui.capture PAGE WIDTH HEIGHT [--trip]      python -m tests.tui.capture --docs
"""

from __future__ import annotations

import asyncio
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.tui.glass import Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, followed, past, run, snapshot, tripped

DOCS = Path(__file__).parents[2] / "docs" / "screen.md"
_PICTURE = re.compile(
    r"(<!-- python -m tests\.tui\.capture ([^\n]+?) -->\n```\n)(.*?\n)??(```\n)", re.DOTALL
)


def machine(*, trip: bool = False) -> Machine:
    """Return a machine with one recorded run of 8 s, tripped at its end or not."""
    bench = Bench(spike=7.997) if trip else Bench()
    record = Recorded(map(followed, run(bench, 7.95)))
    record.lately = past(bench, 1.0)
    if trip:
        record.waiting.append(tripped(followed(snapshot(bench, 160))))
    return Machine({endpoint(): record})


async def capture(page: str, width: int, height: int, trip: bool = False) -> str:
    """Return a page on a recorded run, trailing blanks cut, braille's blank as a space."""
    async with glass(machine(trip=trip), size=(width, height)) as shown:
        shown.app.open_page(page)
        await shown.watch()
        return "\n".join(line.replace("⠀", " ").rstrip() for line in shown.lines)


def arguments_of(words: Sequence[str]) -> tuple[str, int, int, bool]:
    """Read PAGE WIDTH HEIGHT [--trip]."""
    page, width, height = [word for word in words if word != "--trip"]
    return page, int(width), int(height), "--trip" in words


def main(words: list[str]) -> None:
    """Write a capture to stdout, or all of the page's into it."""
    if words != ["--docs"]:
        sys.stdout.write(asyncio.run(capture(*arguments_of(words))) + "\n")
        return
    text = DOCS.read_text(encoding="utf-8")
    for found in _PICTURE.finditer(text):
        made = asyncio.run(capture(*arguments_of(found[2].split())))
        text = text.replace(found[0], f"{found[1]}{made}\n{found[4]}")
    DOCS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
