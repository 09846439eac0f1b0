"""The page about the screen shows the screen as it is."""

from __future__ import annotations

import re

import pytest

from rig.tui.app import HELP
from tests.tui.capture import DOCS, PICTURE, arguments_of, capture, drawing

TEXT = re.compile(
    r"<!-- python -m tests\.tui\.capture (?P<words>.+?) -->\n```\n(?P<text>.*?)\n```\n", re.DOTALL
)
PICTURES = [
    pytest.param(found["words"], found["text"], id=found["words"])
    for found in TEXT.finditer(DOCS.read_text(encoding="utf-8"))
]


def test_the_page_has_a_picture_of_each_level_and_of_a_trip() -> None:
    names = " ".join(str(picture.id) for picture in PICTURES)
    levels = ("overview", "joint", "channel", "diagnostics", "alarms", "protocol", "estimates")
    for word in (*levels, "run trace", "--trip"):
        assert word in names


@pytest.mark.parametrize(("words", "text"), PICTURES)
async def test_the_pictures_in_the_page_are_what_the_command_above_them_makes(
    words: str, text: str
) -> None:
    made = await capture(*arguments_of(words.split()))
    assert made == text, (
        "docs/screen.md is not up to date: `python -m tests.tui.capture --docs` writes its pictures"
    )


def test_the_help_has_every_key_of_the_page() -> None:
    table = DOCS.read_text(encoding="utf-8").split("\n## Keys\n")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| ")][1:]
    keys = {k for cell in cells for k in re.findall(r"`(.)`", cell)} - {"?"}  # which opens it
    words = {word.rstrip(",") for line in HELP for word in line.split()}
    assert {k.replace("-", "−") for k in keys} <= words | {word.lower() for word in words}


async def test_the_readmes_picture_is_the_screen_as_it_is_and_loads_nothing() -> None:
    svg = await drawing()
    assert svg == PICTURE.read_text(encoding="utf-8"), (
        "not up to date: `python -m tests.tui.capture --docs` writes it"
    )
    addresses = set(re.findall(r"https?://[^\"' )]+", svg))
    assert addresses <= {"http://www.w3.org/2000/svg"}
    assert "url(http" not in svg
