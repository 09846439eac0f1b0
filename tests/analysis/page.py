"""Reads a report the way a browser would: elements, ids, references, tables, text."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser


@dataclass
class Table:
    heading: str
    rows: list[list[str]] = field(default_factory=list)

    def row(self, first: str) -> list[str]:
        return next(row for row in self.rows if row and row[0] == first)


class Page(HTMLParser):
    """A parsed page; `tables` in order, each under the last heading before it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.tables: list[Table] = []
        self.words: list[str] = []
        self._heading, self._in_heading, self._cell = "", False, False
        self._skip = 0
        self.feed(text)
        self.close()

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def table(self, heading: str) -> Table:
        return next(t for t in self.tables if t.heading.startswith(heading))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name.rpartition(":")[2] in ("href", "src", "srcset", "action", "data"):
                self.references.append(value or "")
            if value and "url(" in value:
                self.references.append(value.split("url(")[1].split(")")[0])
            assert not name.startswith("on"), f"a handler {name} on <{tag}>"
        if tag in ("h1", "h2", "h3"):
            self._heading, self._in_heading = "", True
        elif tag == "table":
            self.tables.append(Table(self._heading))
        elif tag == "tr":
            self.tables[-1].rows.append([])
        elif tag in ("td", "th"):
            self.tables[-1].rows[-1].append("")
            self._cell = True
        elif tag == "style":
            self._skip += 1

    def handle_endtag(self, tag: str) -> None:
        if tag in ("h1", "h2", "h3"):
            self._in_heading = False
        elif tag in ("td", "th"):
            row = self.tables[-1].rows[-1]
            row[-1] = " ".join(row[-1].split())
            self._cell = False
        elif tag == "style":
            self._skip -= 1

    def handle_data(self, data: str) -> None:
        if self._skip:
            return
        self.words.append(data)
        if self._in_heading:
            self._heading += data
        if self._cell:
            self.tables[-1].rows[-1][-1] += data


def number(text: str) -> float:
    """Read a number as the report writes it."""
    text = text.replace("−", "-").replace("+", "").replace("±", "").strip()
    if "×10" in text:
        mantissa, exponent = text.split("×10")
        return float(mantissa) * 10.0 ** int(
            exponent.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
        )
    return float(text)
