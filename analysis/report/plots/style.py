"""Common parts of all figures: palette, fonts, thinning of traces, inline SVG.

Figures contain no text of a user's (names are in the page, escaped), no date, no reference to
anything outside, and equal input results in equal bytes.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from analysis.report.settings import REPORT

Array = NDArray[np.float64]

# Okabe and Ito's palette, distinguishable with every common kind of colour vision; the model is a
# brighter vermillion, near the paper's red and distinct from black.
INK: Final = "#1c1f23"
MODEL: Final = "#f0512c"
BLUE: Final = "#0072b2"
SKY: Final = "#56b4e9"
GREEN: Final = "#009e73"
ORANGE: Final = "#e69f00"
GREY: Final = "#8a9099"
PALE: Final = "#d5d9de"
JOINT_COLOURS: Final = (BLUE, GREEN, ORANGE, "#cc79a7", SKY)

CARD: Final = 4.6  # [in] width of a figure: two side by side on a desktop, one on a phone

_STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "bramah",
    "text.parse_math": False,
    "text.usetex": False,
    "axes.unicode_minus": True,
    "font.family": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 3.5,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.grid": True,
    "grid.color": "#e8eaed",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
}


@contextmanager
def style() -> Iterator[None]:
    """Apply the figures' style within a block and restore the caller's afterwards."""
    with mpl.rc_context(_STYLE):
        yield


def figure(height: float, width: float = CARD) -> Figure:
    """Return an empty figure of the given size [in], not registered with pyplot."""
    canvas = Figure(figsize=(width, height))
    FigureCanvasSVG(canvas)
    return canvas


def thin(x: Array, y: Array, points: int = REPORT.line_points) -> tuple[Array, Array]:
    """Return at most about `points` of the trace (n,), (n,): minimum and maximum of each stretch.

    Keeping both extremes in order shows spikes and noise that decimation would lose.
    """
    n = len(y)
    if n <= points:
        return x, y
    edges = np.linspace(0, n, points // 2 + 1).astype(int)
    extremes: list[int] = [0]
    for start, stop in itertools.pairwise(edges.tolist()):
        stretch = np.nan_to_num(y[start:stop])
        extremes += sorted((start + int(stretch.argmin()), start + int(stretch.argmax())))
    index = np.unique([*extremes, n - 1, *np.flatnonzero(np.isnan(y))])
    return x[index], y[index]


_PROLOGUE = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_METADATA = re.compile(r"<metadata>.*?</metadata>", re.DOTALL)
_STAR_STYLE = re.compile(r"<defs>\s*<style type=\"text/css\">\*\{.*?</style>\s*</defs>", re.DOTALL)
_OPENING = re.compile(r"<svg[^>]*?viewBox=\"([^\"]+)\"[^>]*>", re.DOTALL)
_PATH = re.compile(r" d=\"([^\"]*)\"")
_LONG = re.compile(r"-?\d+\.\d{3,}")
_FONT = re.compile(r"font:\s*(?:(\d+)\s+)?([\d.]+)px '[^;\"]*'")


def svg(canvas: Figure, key: str, label: str) -> Markup:
    """Return the figure as inline <svg>: `key` makes ids unique, `label` is for screen readers."""
    buffer = io.StringIO()
    canvas.savefig(
        buffer, format="svg",
        metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
    )  # fmt: skip
    text = _PROLOGUE.sub("", buffer.getvalue())
    text = _STAR_STYLE.sub("", _METADATA.sub("", text))
    text = _PATH.sub(lambda m: f' d="{_LONG.sub(_short, m[1])}"'.replace(" \n", " "), text)
    text = re.sub(r'\bid="', f'id="{key}-', text)
    text = text.replace("url(#", f"url(#{key}-").replace('xlink:href="#', f'href="#{key}-')
    text = _FONT.sub(
        lambda m: f"font-size: {m[2]}px" + (f"; font-weight: {m[1]}" if m[1] else ""), text
    )
    opening = Markup('<svg viewBox="{}" role="img" aria-label="{}" preserveAspectRatio="xMidYMid">')
    return Markup(_OPENING.sub(lambda m: str(opening.format(m[1], label)), text, count=1).strip())


def _short(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


def gapped(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the trace with a NaN wherever samples are missing, so that no line bridges a gap."""
    step = np.diff(x)
    if not len(step):
        return x, y
    gaps = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    return np.insert(x, gaps, x[gaps - 1]), np.insert(y, gaps, np.nan)


def plain_log(axis: Any) -> None:
    """Mark the decades of a logarithmic axis with plain numbers, without slow minor ticks."""
    axis.set_major_formatter(lambda v, _: f"{v:g}")
    axis.set_minor_locator(NullLocator())


def note(axes: Any, x: float, y: float, text: str, colour: str = INK, **more: Any) -> None:
    """Write a label at axes fractions, on a white background over the lines."""
    more = {"ha": "right", "va": "top", "fontsize": 7.0} | more
    axes.text(
        x, y, text, color=colour, transform=axes.transAxes,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}, **more,
    )  # fmt: skip
