"""Writes the screen as text, as it looks on the recorded run; docs/screen.md is made of it:

python -m tests.tui.capture PAGE WIDTH HEIGHT [--trip]      python -m tests.tui.capture --docs
"""

from __future__ import annotations

import asyncio
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rig.tui.browse import BrowserState
from rig.tui.recorded_run import read_log, read_trace
from tests.tui.glass import Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, followed, past, run, snapshot, tripped
from tests.tui.stored import run_folder

DOCS = Path(__file__).parents[2] / "docs" / "screen.md"
PICTURE = DOCS.parent / "images" / "screen.svg"
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


def recorded_run() -> BrowserState:
    """Return what was read of a run that is over: its log and its trace."""
    with tempfile.TemporaryDirectory() as folder:
        path = run_folder(Path(folder) / "run")
        log, trace = read_log(path), read_trace(path)
    run = Path("runs/2024-05-17-lock-and-excite")
    return BrowserState(
        log=replace(log, folder=run), trace=replace(trace, folder=run, path=run / "trace.json")
    )


async def drawing() -> str:
    """Return the overview as an SVG that loads nothing: the reader's own fixed-width font."""
    async with glass(machine(), size=(120, 36)) as shown:
        await shown.watch()
        svg = shown.app.export_screenshot(title="bramah monitor")
    plain = re.sub(r"\s*(@font-face \{.*?\}|<!--.*?-->)", "", svg, flags=re.DOTALL)
    return plain.replace("Fira Code", "DejaVu Sans Mono")


async def capture(page: str, width: int, height: int, trip: bool = False) -> str:
    """Return a page on a recorded run, trailing blanks cut, braille's blank as a space."""
    async with glass(machine(trip=trip), size=(width, height)) as shown:
        shown.app.browsed = recorded_run()
        shown.app.open_page(page)
        await shown.watch()
        return "\n".join(line.replace("⠀", " ").rstrip() for line in shown.lines)


def arguments_of(words: Sequence[str]) -> tuple[str, int, int, bool]:
    """Read PAGE WIDTH HEIGHT [--trip]."""
    *page, width, height = [word for word in words if word != "--trip"]
    return " ".join(page), int(width), int(height), "--trip" in words


def main(words: list[str]) -> None:
    """Write a capture to stdout, or all of the page's into it and the README's picture."""
    if words != ["--docs"]:
        sys.stdout.write(asyncio.run(capture(*arguments_of(words))) + "\n")
        return
    text = DOCS.read_text(encoding="utf-8")
    for found in _PICTURE.finditer(text):
        made = asyncio.run(capture(*arguments_of(found[2].split())))
        text = text.replace(found[0], f"{found[1]}{made}\n{found[4]}")
    DOCS.write_text(text, encoding="utf-8")
    PICTURE.write_text(asyncio.run(drawing()), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
