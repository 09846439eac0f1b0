"""What an effect is: a term plus what the trace must know to name it, or to refuse to.

An effect is one more term (`analysis.terms.base`): it may change the signals that all terms see
(`prepare`), add columns to rows, and contribute in simulation. Linear coefficients come from least
squares; at most two shape parameters are searched within physical bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from analysis.signals import Signals
from analysis.terms.base import Term
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """A shape parameter: its parameter name, SI unit, physical bounds and points of first look."""

    parameter: str
    unit: str
    low: float
    high: float
    grid: tuple[float, ...]


@dataclass(frozen=True)
class Effect(Term):
    """A candidate of the trace at one place (`where`); a subclass overrides what it needs.

    `variable` names in plain words what the effect's contribution moves with; `confounders` are
    effects whose columns look alike on poor excitation, `separated_by` the excitation that tells
    them apart.
    """

    variable: ClassVar[str] = ""
    confounders: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""

    @classmethod
    def places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every `where` this effect can be at on a rig."""
        return tuple(f"joint {i}" for i in range(1, len(rig.joints) + 1))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the shape parameters, none by default."""
        return ()

    def shape_names(self) -> tuple[str, ...]:
        """Name the shape parameters; their number does not depend on the rig."""
        return ()

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Say why sign or size of the fitted parameters is not physical ('' if it is).

        `values` holds the effect's own linear coefficients and the model's other parameters.
        """
        return ""

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return, by equation, the variable (n,) to plot that equation's residual against."""
        raise NotImplementedError
