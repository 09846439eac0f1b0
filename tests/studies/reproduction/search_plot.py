"""A search's way: the best error so far, and how many of each generation lost their state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from analysis.report.plots.style import INK, MODEL, figure, plain_log, style, svg

_COLOURS = (INK, MODEL)


def convergence(searches: Mapping[str, Mapping[str, Any]], key: str) -> Markup:
    """Draw both over candidates, one line per search (its `extra["search"]`)."""
    with style():
        made = figure(3.0)
        upper, lower = made.subplots(
            2, 1, sharex=True,
            gridspec_kw={"left": 0.13, "right": 0.975, "top": 0.93, "bottom": 0.14,
                         "hspace": 0.45},
        )  # fmt: skip
        for colour, (method, data) in zip(_COLOURS, searches.items(), strict=False):
            count = np.cumsum(data["generation_sizes"])
            best = [np.nan if e is None else e for e in data["error_by_generation"]]
            gone = np.asarray(data["lost_by_generation"]) / np.asarray(data["generation_sizes"])
            upper.plot(count, best, color=colour, label=method.upper())
            lower.plot(count, 100.0 * gone, color=colour)
        upper.set_yscale("log")
        plain_log(upper.yaxis)
        upper.set_title("best relative output error so far")
        upper.legend(frameon=False, fontsize=7.0)
        lower.set_title("candidates of the generation without a state [%]")
        lower.set_ylim(0, 100)
        lower.set_xlabel("candidates simulated", labelpad=1)
        return svg(made, key, "Best error and lost candidates of the searches")
