"""Writes the screen as text, as it looks on the recorded run; docs/screen.md is made of it:

python -m tests.tui.capture [WIDTH HEIGHT] [--trip]
"""

from __future__ import annotations

import asyncio
import sys

from tests.tui.glass import Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, run, snapshot, tripped


async def capture(width: int, height: int, *, trip: bool = False) -> str:
    """Return the screen on a recorded run, trailing blanks cut, braille's blank as a space."""
    bench = Bench(spike=7.997) if trip else Bench()
    record = Recorded(run(bench, 7.95))
    if trip:
        record.waiting.append(tripped(snapshot(bench, 160)))
    async with glass(Machine({endpoint(): record}), size=(width, height)) as shown:
        return "\n".join(line.replace("⠀", " ").rstrip() for line in shown.lines)


def main(arguments: list[str]) -> None:
    """Write the capture to stdout."""
    trip = "--trip" in arguments
    numbers = [int(a) for a in arguments if a != "--trip"]
    width, height = numbers or (80, 24)
    sys.stdout.write(asyncio.run(capture(width, height, trip=trip)) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
