"""Thresholds by which the trace judges: each with its unit, what it means and where it is from.

Origins: *tuned* on benches of odd seeds of `python -m tests.studies foreign` and seeds below 100 of
`python -m tests.studies trace`, judged on others; *convention* of statistics; *contract* of what
users rely on; *arithmetic* of what a computer can resolve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class TraceSettings:
    """Judging of the effects found; numbers without unit are shares or ratios."""

    # Gates of an effect.
    least_removed: float = 0.5
    """Of the held-out energy above noise in the equations it touches: a cause takes most."""
    p_limit: float = 0.01
    """Family-wise p over all candidates and shapes (convention)."""
    tie_ratio: float = 1.10
    """Held-out rms of a rival over the best's, below which they cannot be separated (tuned); of an
    effect that takes less than the noise, the same share of what it takes."""
    tie_ratio_training: float = 1.25
    """The same on training records; a rival that fits these worse has another size (tuned)."""
    clear_lead: float = 0.95
    """Held-out rms of a rival over the best's: with less, training records do not count (tuned)."""
    harm_ratio: float = 1.2
    """Energy above noise in an equation over that before: a cause makes none worse (tuned)."""
    # What may stay.
    training_share: float = 0.05
    """Of an equation's energy before: what a named form may miss of the real one (tuned: seals of
    LuGre's and Karnopp's law, turbulent leaks)."""
    held_out_share: float = 0.10
    """The same on held-out records, which may be quieter (tuned)."""
    held_out_band: float = 1.5
    """Held-out rms over the noise floor, by equation (tuned on clean benches: none is above)."""
    beyond_knots: float = 0.05
    """Of a free curve's range: so far beyond its outermost knots it is still compared (tuned)."""
    better_known: float = 10.0
    """Ratio of what held-out rows know of a direction of the baseline's coefficients to what the
    training rows know: from here on it is fitted to the held-out rows (tuned: joints locked in
    turn, then moved together, give 20 to 50 for the coupling inertia, all others 0.3 to 6)."""
    cavitating_share: float = 0.2
    """Of an equation's rows at which the oil cavitates under a model: up to here they speak neither
    way (tuned: a gain of 5 % put 8 % of the rows below zero pressure, a cross-talk of 3 % 14 %)."""
    masked_share: float = 0.05
    """Of an equation's rows: from here on a note says that they are left out (tuned: an end cushion
    that shows only while its pressure is beyond its sensor left out 10 %)."""
    noted_ratio: float = 1.3
    """The same, from which an explanation says what stays (contract)."""
    visible_deviations: float = 8.0
    """Standard deviations of the noise's own energy from which a rest is asked for a formula."""
    formula_least_energy: float = 0.005
    """Of an equation's energy before: less is not asked for a formula (tuned)."""
    formula_share: float = 0.7
    """Of the rest: from here on a formula holds it (tuned on hardening springs)."""
    unexplained_share: float = 0.5
    """Of an equation's energy before: where more is left no effect acts (tuned)."""
    clue_share: float = 0.1
    """Of all that is left: an equation with less asks for no clue (tuned)."""
    # Invariance.
    invariance_tolerance: float = 0.2
    """Relative disagreement that a catalogue's simpler form may cause (tuned)."""
    standard_errors: float = 3.5
    """Standard errors of a subset's own estimate, and of what held-out records lose by a simpler
    reading or a rival (convention: 1 in 2000, some 10 subsets)."""
    informative_share: float = 0.12
    """Of a column's energy off the others': a subset with less holds its form's tail, not its size
    (tuned: tails of seals reach 0.09, wrong names show from 0.2 on)."""
    separable_share: float = 0.01
    """Of a column's energy that the effect's others cannot make: with less the whole effect is
    judged, not this number (convention: a variance inflation factor of 100)."""
    subset_error: float = 0.25
    """Relative standard error beyond which a subset judges nothing (tuned)."""
    reading_share: float = 0.15
    """Of what a law leaves above noise: less does not earn it a further number (tuned: that took
    0.5 to 8 % where a form was wrong, 27 % and more where two levels were true)."""
    nearly: float = 2.5
    """Times the tolerance within which a richer reading is a simpler one: up to here its further
    number must take more than the form leaves (tuned: Maxwell slip shows 13 % of difference)."""
    # Chance.
    sign_flips: int = 199
    """Sign flips: p not below 0.005 (convention)."""
    enough_repeats: int = 8
    """Repeats from which whole records are flipped: 2^-7 is below `p_limit` (arithmetic)."""
    flip_block: float = 2.0
    """[s] of a block that is flipped as one: twenty times the row filter's memory (arithmetic)."""
    # Others.
    shooting_ratio: float = 0.99
    """Of what held-out windows leave: with less, shapes by shooting are taken (tuned)."""
    shooting_cost: float = 1.02
    """Times the held-out rms of any equation's rows that these may cost (tuned)."""
    rank_limit: float = 1e-4
    """Smallest over largest singular value of unit columns: the noise of where a locked joint
    stands (10 um of 0.1 m, some thousand samples) makes 1e-6 to 1e-5 (arithmetic)."""
    least_rows: int = 40
    """Rows of an equation in one record (arithmetic)."""
    most_rivals: int = 4
    """Rivals in a result."""
    visible_shift: float = 0.01
    """Of a parameter: an effect below its detection limit that changes one by more is noted
    (tuned: with good excitation none does)."""
    most_limits: int = 3
    """Detection limits that are noted."""
    normal_quantile: float = 1.96
    """Half-width of a 95 % interval over the standard error (convention)."""
    dependent_share: float = 1e-10
    """Of the largest eigenvalue: columns with a smaller one depend on each other (arithmetic)."""
    curve_seconds: float = 4.0
    """[s] of a free run that are kept to be drawn."""
    curve_points: int = 400
    """Of them, about."""


@dataclass(frozen=True)
class DataSettings:
    """What the records are weighed by, and which columns are offered."""

    judge_block: float = 1.0
    """[s] of a held-out record: every third such block judges only (arithmetic: ten times the row
    filter's memory, and a short record still has several)."""
    least_noise: float = 0.2
    """Of the noise that the rig file states: a floor measured lower is chance (tuned)."""
    unrepeated_ratio: float = 5.0
    """Scatter between repeats over what the stated sensor noise makes: more is no sensor's noise
    that a data sheet would state (tuned: clean benches stay below 2)."""
    unrepeated_share: float = 0.5
    """Of that scatter's energy: with more at one frequency, this is stated (convention)."""
    # Noise by neighbouring states.
    pair_apart: float = 0.5
    """[s] between the two rows of a pair: the row filter's memory is a tenth of a second."""
    pair_distance: float = 0.2
    """Between their states, in standard deviations of each: beyond it a residual that changes with
    the state passes for noise (tuned: EMPS 0.01, crane 0.1, multisines of one period 0.5)."""
    nearest_pairs: float = 0.33
    """Of the rows: the nearest pairs, whose differences count (tuned)."""
    least_pairs: int = 40
    """Pairs: a noise by fewer is uncertain by more than a tenth (arithmetic)."""
    neighbours_asked: int = 64
    """Rows nearest to a row, among which one far enough away in time is looked for."""
    temperature_span: float = 0.05
    """[K] between all records: less moves b by a fraction of 0.001 (arithmetic)."""
    grid_points: int = 24
    """Of a candidate's shape grid: two shapes of five points each, or one of many."""
    remembered_rows: float = 2e8
    """Bytes of rows that are kept since other models need them again."""
    remembered_signals: float = 5e7
    """Bytes of signals kept for the same."""
    remembered_readings: int = 4
    """Sets of columns that are kept of a term, each of other signals."""
    # Spectral lines.
    line_band: float = 1.2
    """Band over the row filter's cutoff, where that filter ends (arithmetic)."""
    period_present: float = 0.7
    """Of a period's pairs of rows that must be there (tuned)."""
    lines_per_pair: float = 0.8
    """A pair gives two numbers and a line has two: fewer lines than pairs (arithmetic)."""
    line_ridge: float = 1e-2
    """Of a line's own weight, against what short gaps leave undetermined (arithmetic)."""
    line_deviations: float = 4.0
    """Standard deviations of what noise alone puts into a kind of lines (convention)."""
    asymmetric: float = 0.25
    """Of the energy, from which an asymmetric nonlinearity is reported (tuned)."""
    symmetric: float = 0.1
    """The same of a symmetric one (tuned)."""
    noted_share: float = 0.005
    """Of the energy, below which a kind of lines is not reported (tuned)."""
    velocity_ratio: float = 3.0
    """Times the velocity's own share of even or odd lines, which no nonlinearity made (tuned)."""


@dataclass(frozen=True)
class SearchSettings:
    """Search for the set of effects that explains the residual."""

    band: float = 0.7
    """Repeatable rms over noise, below which there is nothing to explain (tuned)."""
    residual_limit: float = 1.0
    """Repeatable rms over noise that an explanation may leave (tuned)."""
    form_share: float = 0.02
    """Of the energy before: what the catalogue's form of an effect may miss of the real (tuned)."""
    add_share: float = 0.3
    """Of what is left in the equations an effect acts on: less does not earn a place (tuned)."""
    simpler_ratio: float = 1.25
    """What a simpler candidate may leave over the best, as a product over equations (tuned)."""
    touched: float = 0.05
    """Of the largest change that an effect makes to any equation: with less it does not act there
    (tuned)."""
    least_growth: float = 0.1
    """Sum over equations of log ratios of what is left: with less nothing was gained (tuned)."""
    far_less: float = 2.3
    """The same by which another pair must leave less than an effect that only the tolerance for its
    form lets pass (tuned: a tenth)."""
    number_price: float = 20.0
    """Energy that each further free number must take: ten times what noise gives it (tuned)."""
    visible: float = 0.03
    """Of a column's length that must stand out of the baseline's columns (arithmetic)."""
    size_ratio: float = 3.0
    """Largest size over that of a shape's column; smaller ones are nearer to linear (tuned)."""
    # How much is tried.
    largest_linear_set: int = 4
    """Effects in a set of the linear search."""
    largest_set: int = 3
    """Effects in a set found by extension."""
    pair_starts: int = 10
    """Single candidates from which pairs are tried."""
    full_fits: int = 40
    """Best entries that are fitted in full."""
    refined_singles: int = 14
    """Single candidates refined exactly, best first."""
    refined_pairs: int = 6
    """Pairs refined exactly."""
    refined_extensions: int = 6
    """Extensions of a set that are refined exactly."""
    near_gain: float = 0.25
    """Of the best gain: a single candidate with less is no rival (tuned)."""
    shape_starts: int = 3
    """Points of an effect's grid that a search for its shapes begins at."""
    # Refinement.
    tolerance: float = 1e-4
    """Relative change of cost and shapes at which a refinement ends (arithmetic)."""
    steps: int = 10
    """Of a refinement, at most."""
    shape_error: float = 0.25
    """Relative standard error of a shape beside its effect's details, at most (tuned: contacts that
    stiffen have 0.01 to 0.07, noise at rest that passes for one 0.4 to 1)."""
    detail_share: float = 0.05
    """Of what is left above noise: less does not earn a detail of the form (tuned)."""
    # Free forms.
    free_tried: int = 4
    """Free forms that are put through the gates."""
    free_energy: float = 0.5
    """Of what several named mechanisms leave: the most that one in their place may (tuned)."""
    free_near: float = 2.0
    """Times the least energy left: of sets within it the simplest goes first (tuned)."""


@dataclass(frozen=True)
class ClueSettings:
    """What is said of a residual that no effect explains."""

    knots: int = 9
    """Of a curve of the residual over a variable."""
    least_share: float = 0.05
    """Of the held-out energy, below which a variable is no clue (tuned)."""
    answer_weight: float = 0.3
    """Weight of a variable that an equation's own balance makes follow what it lacks (tuned)."""
    spool_weight: float = 0.6
    """Weight of the spool in a torque: it acts through the pressures (tuned)."""
    chamber_lead: float = 0.2
    """By which one chamber's pressure must beat the difference to be no answer (tuned)."""
    product_gain: float = 0.05
    """That a product of two variables must take beyond either of them (tuned)."""
    slow: float = 0.1
    """Of the rms speed: below it the direction of motion turns gradually."""
    memory: float = 0.1
    """Of the largest travel: how far a motion goes before its direction counts."""
    # Formula.
    monomials: int = 3
    """Of a formula, at most."""
    few_monomials: int = 2
    """Of a formula that goes before free curves: three bend to much (tuned)."""
    sure: float = 0.9
    """Of the energy, from which a formula goes before free curves (tuned)."""
    monomial_gain: float = 0.05
    """Of the held-out energy above noise that one more monomial must take (tuned)."""
    offered: float = 0.5
    """Of it that a formula must take to be worth reading (tuned)."""
    alike: float = 0.999
    """Correlation from which two columns are one (arithmetic)."""
    # Frequency.
    many_lines: int = 8
    """Excited lines: of fewer, most of anything stands in one place (tuned)."""
    side_lines: int = 1
    """On either side of the highest: a frequency between two lines stands in both (arithmetic)."""
    first_line: int = 5
    """Fewer turns in a period are drift (tuned)."""
    peak: float = 0.6
    """Of the power that stands at one frequency (tuned)."""
    frequency_share: float = 0.5
    """Of the held-out energy that a sine of it must take (tuned)."""
    frequency_steps: int = 41
    """Of the search, over one line on either side."""


@dataclass(frozen=True)
class ExperimentSettings:
    """The next experiment: what it may do to the machine, and when it is worth doing."""

    fill: float = 0.9
    """Of the tightest limit that an experiment uses on the twin."""
    plays: int = 4
    """On the twin, to find the amplitude."""
    first_rms: float = 0.1
    """[V] of the first of them."""
    phase_draws: int = 40
    """Sets of random phases, of which the flattest is taken."""
    phase_rounds: int = 40
    """Of the search for phases."""
    seed: int = 0
    """Of the phases."""
    at_end: float = 2e-3
    """[m] from its end: a locked piston so near stands at it."""
    closed_travel: float = 5e-3
    """[m] that a joint behind a closed valve may move."""
    end_travel: float = 2e-3
    """[m] that a joint at its end may move."""
    centring_offset: float = 4e-3
    """[m] that a record's centre may be off."""
    position_gain: float = 2.0
    """[V/m] of the loop that centres before the records."""
    repeats: int = 4
    """Of each training record."""
    held_out_amplitude: float = 0.85
    """Of the training amplitude: what shows at the limits is soon gone below."""
    held_out_repeats: int = 3
    """Of each held-out record."""
    line_ratio: float = 5.0
    """Lines over those that the records hold."""
    shape_step: float = 0.02
    """Of a shape's value, or of its range where it is zero, to differentiate by (arithmetic)."""
    more: float = 1.3
    """Times what the records hold already: less is no progress (tuned)."""
    enough: float = 3.0
    """Times the noise: more shows no more (convention)."""
    steps: int = 3
    """Of an experiment, at most."""
    worth: float = 0.3
    """That a further step must add to the sum over questions (tuned)."""
    near_energy: float = 2.0
    """Times the energy that the best set leaves: another is still in question (tuned)."""
    rivals: int = 3
    """Sets in question."""
    likely: float = 2.0
    """Times its nominal value that a parameter may be."""


TRACE: Final = TraceSettings()
DATA: Final = DataSettings()
SEARCH: Final = SearchSettings()
CLUES: Final = ClueSettings()
EXPERIMENT: Final = ExperimentSettings()
