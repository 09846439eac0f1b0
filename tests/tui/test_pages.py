"""Each level at three sizes, as text; `python -m tests.tui.test_pages` writes the files."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.tui.capture import capture

KEPT = Path(__file__).parent / "pictures"
SIZES = ((80, 24), (120, 40), (200, 60))
LEVELS = (
    "overview",
    "joint",
    "channel",
    "diagnostics",
    "alarms",
    "protocol",
    "estimates",
    "run log",
    "run trace",
)
ALWAYS = ("EXCITING", "age 0.01 s", "t 0:07", "SPACE STOP", "0 lost", "left 0:32", "q quit")


def path(page: str, size: tuple[int, int]) -> Path:
    return KEPT / f"{page.replace(' ', '-')}-{size[0]}x{size[1]}.txt"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("page", LEVELS)
async def test_a_level_looks_as_it_was_kept(page: str, size: tuple[int, int]) -> None:
    made = await capture(page, *size)
    lines = made.splitlines()
    assert len(lines) == size[1]
    assert max(map(len, lines)) <= size[0]
    for word in ALWAYS:
        assert word in made
    assert made == path(page, size).read_text(encoding="utf-8").rstrip("\n"), (
        "the page has changed: look at it, then `python -m tests.tui.test_pages` keeps it"
    )


def write() -> None:
    """Keep every level at every size as it looks now."""
    KEPT.mkdir(exist_ok=True)
    for page in LEVELS:
        for size in SIZES:
            made = asyncio.run(capture(page, *size))
            path(page, size).write_text(made + "\n", encoding="utf-8")


if __name__ == "__main__":
    write()
