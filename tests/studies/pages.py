"""A page of words, tables and figures, written as Markdown or as text for a terminal."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rig.cli.text import output
from rig.model.parse import InputError

WIDTH = 100


@dataclass(frozen=True)
class Table:
    """A caption, a header and rows of ready cells."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """A figure: the file's name, its <svg> as a report would hold it, its caption."""

    file: str
    svg: str
    caption: str


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it, in order; a string is a paragraph."""

    title: str
    parts: Sequence[str | Table | Picture]


def text(sections: Sequence[Section]) -> str:
    """Return the page for a terminal: tables in columns, figures left out."""
    lines: list[str] = []
    for section in sections:
        lines += [section.title, "=" * len(section.title), ""]
        for part in section.parts:
            if isinstance(part, Table):
                lines += [part.caption, "", output.table(part.header, part.rows), ""]
            elif isinstance(part, str):
                lines += [textwrap.fill(part.replace("**", ""), WIDTH), ""]
    return "\n".join(lines).rstrip()


def markdown(title: str, sections: Sequence[Section], figures: str) -> str:
    """Return the page as Markdown; figures are looked for in the folder `figures` beside it."""
    lines = [f"# {title}", ""]
    for section in sections:
        if section.title:
            lines += [f"## {section.title}", ""]
        for part in section.parts:
            if isinstance(part, Table):
                rows = markdown_table(part.header, part.rows, numbers=True)
                lines += [f"**{part.caption}**", "", *rows, ""]
            elif isinstance(part, Picture):
                lines += [f"![{part.caption}]({figures}/{part.file})", "", f"*{part.caption}*", ""]
            else:
                lines += [part, ""]
    return "\n".join(lines).rstrip() + "\n"


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = False
) -> list[str]:
    """Return the lines of a Markdown table; `numbers`: all but the first column to the right."""

    def row(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    plain, right = ("|:--", "|--:") if numbers else ("|---", "|---")
    return [row(header), plain + right * (len(header) - 1) + "|", *map(row, rows)]


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write the Markdown and, in a folder named after it, its figures."""
    folder = path.parent / path.stem
    for section in sections:
        for part in section.parts:
            if isinstance(part, Picture):
                folder.mkdir(parents=True, exist_ok=True)
                (folder / part.file).write_text(standalone(part.svg), encoding="utf-8")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(markdown(title, sections, path.stem), encoding="utf-8")


def replace_section(path: Path, name: str, body: str) -> None:
    """Put `body` between the lines `<!-- NAME -->` and `<!-- end of NAME -->` of a page.

    Raises InputError where the page is not there or has no such lines.
    """
    first, last = f"<!-- {name} -->", f"<!-- end of {name} -->"
    old = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, found, rest = old.partition(first)
    _, ended, after = rest.partition(last)
    if not (found and ended):
        raise InputError(f"{path}: expected a page with the lines {first} and {last}")
    path.write_text(f"{before}{first}\n{body.strip()}\n{last}{after}", encoding="utf-8")


_STYLE = (
    "<style>*{stroke-linejoin:round;stroke-linecap:butt}"
    "text{font-family:Helvetica,Arial,sans-serif}</style>"
    '<rect width="100%" height="100%" fill="#ffffff"/>'
)


def standalone(svg: str) -> str:
    """Return an <svg> made to stand within a page as a file of its own."""
    opening = '<svg xmlns="http://www.w3.org/2000/svg"'
    return re.sub(r"<svg([^>]*)>", rf"{opening}\1>{_STYLE}", svg, count=1) + "\n"
