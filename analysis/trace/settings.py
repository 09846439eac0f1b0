"""Thresholds by which the trace judges: each with its unit, what it means and where it is from.

Origins: *tuned* on benches of odd seeds of `python -m tests.studies foreign` and seeds below 100 of
`python -m tests.studies trace`, judged on others; *convention* of statistics; *contract* of what
users rely on; *arithmetic* of what a computer can tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class TraceSettings:
    """Numbers without unit are shares or ratios."""

    # Gates of an effect.
    removed: float = 0.5
    """Of the held-out energy above noise in the equations it touches: a cause takes most."""
    chosen: float = 0.9
    """Of half-samples of the repeats in which an effect is chosen (convention)."""
    rival: float = 0.5
    """Of the half-samples that choose otherwise: what they choose is a rival (tuned)."""
    p_limit: float = 0.01
    """Family-wise p over all candidates and shapes (convention)."""
    tie: float = 1.10
    """Held-out rms of a rival over the best's, below which nothing tells them apart (tuned); of an
    effect that takes less than the noise, the same share of what it takes."""
    tie_training: float = 1.25
    """The same on training records; a rival that fits these worse has another size (tuned)."""
    ahead: float = 0.95
    """Held-out rms of a rival over the best's: with less, training records do not count (tuned)."""
    harm: float = 1.2
    """Energy above noise in an equation over that before: a cause makes none worse (tuned)."""
    # What may stay.
    missed: float = 0.05
    """Of an equation's energy before: what a named form may miss of the real one (tuned: seals of
    LuGre's and Karnopp's law, turbulent leaks)."""
    missed_held: float = 0.10
    """The same on held-out records, which may be quieter (tuned)."""
    held_band: float = 1.5
    """Held-out rms over the noise floor, by equation (tuned on clean benches: none is above)."""
    noted: float = 1.3
    """The same, from which an explanation says what stays (contract)."""
    seen: float = 8.0
    """Standard deviations of the noise's own energy from which a rest is asked for a formula."""
    share: float = 0.005
    """Of an equation's energy before: less is not asked for a formula (tuned)."""
    formula: float = 0.7
    """Of the rest: from here on a formula holds it (tuned on hardening springs)."""
    acted: float = 0.5
    """Of an equation's energy before: where more is left no effect acts (tuned)."""
    clue: float = 0.1
    """Of all that is left: an equation with less asks for no clue (tuned)."""
    # Invariance.
    tolerance: float = 0.2
    """Relative disagreement that a catalogue's simpler form may cause (tuned)."""
    deviations: float = 3.5
    """Standard errors of a subset's own estimate, and of what held-out records lose by a simpler
    reading or a rival (convention: 1 in 2000, some 10 subsets)."""
    tells: float = 0.12
    """Of a column's energy off the others': a subset with less holds its form's tail, not its size
    (tuned: tails of seals reach 0.09, wrong names show from 0.2 on)."""
    own: float = 0.01
    """Of a column's energy that the effect's others cannot make: with less the whole effect is
    judged, not this number (convention: a variance inflation factor of 100)."""
    power: float = 0.25
    """Relative standard error beyond which a subset judges nothing (tuned)."""
    # Chance.
    flips: int = 199
    """Sign flips: p not below 0.005 (convention)."""
    halves: int = 40
    """Half-samples (convention)."""
    enough_repeats: int = 8
    """Repeats from which whole records are flipped: 2^-7 is below `p_limit` (arithmetic)."""
    block: float = 2.0
    """[s] of a block that is flipped as one: twenty times the row filter's memory (arithmetic)."""
    about_two: float = 1.9
    """Periods that a record must hold to be halved by them: the last may be cut short."""
    edge: float = 1e-3
    """Of its range: a shape nearer to its bound is at it (arithmetic)."""
    # Others.
    closer: float = 0.99
    """Of what held-out windows leave: with less, shapes by shooting are taken (tuned)."""
    no_worse: float = 1.02
    """Times the held-out rms of any equation's rows that these may cost (tuned)."""
    visible: float = 1e-4
    """Smallest over largest singular value of unit columns: the noise of where a locked joint
    stands (10 um of 0.1 m, some thousand samples) makes 1e-6 to 1e-5 (arithmetic)."""
    least_rows: int = 40
    """Rows of an equation in one record (arithmetic)."""
    rivals: int = 4
    """Rivals in a result."""


TRACE: Final = TraceSettings()
