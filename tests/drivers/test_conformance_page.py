"""The page of the checks is that of the code: ``python -m tests.drivers.test_conformance_page``."""

from __future__ import annotations

import re
from pathlib import Path

from drivers.conformance import all_checks

PAGE = Path(__file__).parents[2] / "docs" / "conformance.md"
_PART = re.compile(r"(<!-- checks -->\n).*?(<!-- end -->)", re.S)


def page() -> str:
    """The page with the table as the checks' docstrings make it."""
    rows = ["| check | | what the driver must do | needs |", "|---|---|---|---|"]
    for check in all_checks():
        needs = ", ".join(need for need in dict.fromkeys(check.needs) if need != "outputs")
        rows.append(f"| `{check.name}` | {'●' if check.moves else ''} | {check.says} | {needs} |")
    table = "\n".join(rows)
    return _PART.sub(lambda found: f"{found[1]}{table}\n{found[2]}", PAGE.read_text("utf-8"))


def test_the_page_lists_the_checks_as_they_are() -> None:
    assert PAGE.read_text("utf-8") == page()


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
