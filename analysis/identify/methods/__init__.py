"""The ways to identify that the paper compares its own with: one module each.

 sequential    step after step, E1 (use one step's value further on) and E2 (average the steps')
 simultaneous  only records that excite every joint at once
 pso, ga       search by simulation for the last joint's parameters (the paper's STEP1)

Each returns the same `Identification` as the coupled method, null where it has no number to give,
with what it could not do among the checks and its own figures under `extra`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from analysis.identify.methods.search import SearchOptions
from analysis.identify.methods.sequential import sequential
from analysis.identify.methods.simultaneous import simultaneous
from analysis.identify.methods.swarm import search
from analysis.identify.result import Identification
from analysis.regression.rows import Filtering
from analysis.terms.base import Used
from rig.model.records import Record, Run

__all__ = ["SearchOptions", "identify_by"]

SEARCHES = ("pso", "ga")


def identify_by(
    method: str,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    reject_noise: bool,
    rng: np.random.Generator | None,
    options: SearchOptions | None,
) -> Identification:
    """Identify by another method than the coupled one; `rng` and `options` are the searches'.

    Raises InputError where the runs hold no record of the kind that the method needs.
    """
    if method in SEARCHES:
        # Without a generator of the caller's, the search is the same every time.
        rng = np.random.default_rng(0) if rng is None else rng
        return search(method, runs, terms, filtering, rng, options or SearchOptions())
    if method == "simultaneous":
        return simultaneous(runs, terms, filtering, reject_noise)
    return sequential(runs, terms, filtering, reject_noise)
