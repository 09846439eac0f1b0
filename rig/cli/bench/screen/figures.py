"""All figures of the screen: processor load, delay of a stop, age of values, effect on the run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rig.cli.bench.figure import Figure
from rig.cli.bench.screen.arrival import arrival_figures
from rig.cli.bench.screen.cost import cost_figures
from rig.cli.bench.screen.stops import stop_figures

STOPS: Final = 200
QUICK_STOPS: Final = 10
QUICK_SECONDS: Final = 4.0


def screen_figures(say: Callable[[str], None], seconds: float, *, quick: bool) -> list[Figure]:
    """Measure the screen, `seconds` per part; `quick` measures fewer parts and repetitions."""
    # A socket's address holds about 100 bytes: the folder's name must be short.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        runtime = Path(folder)
        spent = min(seconds, QUICK_SECONDS) if quick else seconds
        return [
            *cost_figures(runtime, say, spent),
            *stop_figures(runtime, say, QUICK_STOPS if quick else STOPS),
            *arrival_figures(runtime, say, spent),
        ]
