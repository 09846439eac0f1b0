"""The page about the screen shows the screen as it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tui.capture import capture

PAGE = Path(__file__).parents[2] / "docs" / "screen.md"


@pytest.mark.parametrize("trip", [False, True])
async def test_the_pictures_in_the_page_are_what_the_command_above_them_makes(trip: bool) -> None:
    command = f"python -m tests.tui.capture 80 24{' --trip' if trip else ''}"
    made = await capture(80, 24, trip=trip)
    assert f"<!-- {command} -->\n```\n{made}\n```\n" in PAGE.read_text(encoding="utf-8"), (
        f"docs/screen.md is not up to date: put in what {command} writes"
    )
