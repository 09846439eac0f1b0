"""Thresholds of the trace, each with its unit, meaning and origin; without unit: share or ratio.

Origins: *tuned* on benches of odd seeds of `python -m tests.studies foreign` and seeds below 100 of
`python -m tests.studies trace`, judged on others; *convention* of statistics; *contract* of what
users rely on; *arithmetic* of what a computer can resolve. A setting without origin limits effort
or length only.

"Energy" is the sum of squared whitened residuals, "energy above noise" that energy minus what noise
alone gives. "The baseline" is the model without effects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class TraceSettings:
    """Judgement of the effects found."""

    # Gates of an effect.
    least_removed: float = 0.5
    """Least share of the held-out energy above noise that an effect removes in the equations where
    it acts (convention: a cause removes most of it)."""
    least_removed_beside: float = 0.75
    """Least share of the repeatable energy that an effect removes in its own equations beside an
    unknown cause (tuned: a wrong effect removes half of it, such as a dead volume for a cross-talk
    of 0.7, on a plant written apart from the study's)."""
    p_limit: float = 0.01
    """Largest family-wise p over all candidates and shapes (convention)."""
    tie_ratio: float = 1.10
    """Held-out rms of a rival over that of the best set: a rival with less is tied (tuned). For an
    effect that removes less energy than remains, the ratio applies to what the effect removes."""
    tie_ratio_training: float = 1.25
    """Largest training rms of a tied rival over that of the best set: one that fits the training
    records worse is no alternative (tuned)."""
    tie_ratio_detailed: float = 1.03
    """The same ratio, held out and in training, of a rival with more details of form than the best
    set: they adapt to its residual (tuned: the lag of two poles beside a delay)."""
    decisive_ratio: float = 0.95
    """Held-out rms of a rival over that of the best set: a rival with less is tied whatever its
    training rms (tuned)."""
    harm_deviations: float = 4.0
    """Standard deviations of the noise's own energy by which an effect may increase the residual of
    an equation (convention; tuned on hoses that stiffen: a piston's gain of 1.1 was named)."""
    harm_share: float = 0.05
    """Share of the energy that a set removes elsewhere, which form errors may add to an equation
    (tuned)."""
    harm_ratio: float = 1.2
    """Largest energy above noise of an equation with an effect over that under the baseline, beyond
    which the effect is refused (tuned)."""
    viscosity_change: float = 0.3
    """Largest relative change of viscous friction between days (arithmetic: 7 K of an oil that
    loses 4 % of its viscosity a kelvin, as ISO VG 46 does at 40 degC)."""
    bulk_change: float = 0.05
    """Largest relative change of the bulk modulus between days (arithmetic: 7 K at 0.7 % a
    kelvin)."""
    # Residual that may remain.
    held_out_share: float = 0.05
    """Largest remaining share of an equation's held-out energy above noise under the baseline;
    held-out records may be quieter than training records (tuned)."""
    held_out_band: float = 1.5
    """Largest held-out rms of an equation over its noise floor (tuned: no clean bench is above)."""
    free_run_ratio: float = 3.0
    """Error of a held-out free run in short windows over that without the effects, from which they
    are refused (tuned: right answers of a foreign plant reach 1.5, wrong ones fail or reach 30)."""
    knot_margin: float = 0.05
    """Share of a free curve's range by which rows may lie beyond its outermost knots and still be
    compared with it (tuned)."""
    information_ratio: float = 10.0
    """Information of held-out rows over that of training rows on a direction of the baseline's
    coefficients: with more, the direction is fitted to the held-out rows (tuned: joints locked in
    turn, then moved together, give 20 to 50 for the coupling inertia, all others 0.3 to 6)."""
    cavitating_share: float = 0.2
    """Largest share of an equation's rows at which a model makes the oil cavitate: up to it these
    rows count neither for nor against the model (tuned: a gain of 5 % put 8 % of the rows below
    zero pressure, a cross-talk of 3 % 14 %)."""
    masked_share: float = 0.05
    """Share of an equation's rows that are left out, from which a note says so (tuned: an end
    cushion that shows only while its pressure is beyond its sensor left out 10 %)."""
    noted_ratio: float = 1.3
    """Held-out rms of an equation over its noise floor, from which a note beside an explanation
    states what remains (contract)."""
    narrower_bandwidth: float = 0.25
    """Bandwidth of records whose residual is unexplained, over the measured one, with which they
    are traced again: the noise of an acceleration grows with frequency and hides slow effects
    (tuned: a spring left 1.6 noise floors in rows up to 14 Hz, 4.7 in those up to 6 Hz)."""
    loud_ratio: float = 2.0
    """Noise floors in these rows from which a clean result is traced again there (tuned: effects
    that wide rows hide leave 2.6 to 3.8, sensors' errors of 0.1 % up to 1.5)."""
    wider_bandwidth: float = 10.0
    """Bandwidth [Hz] of the rows in which repeats of a clean result are searched for torques that
    do not follow the motion: rows up to 15 Hz (convention)."""
    quicker_motion: float = 1.5
    """Bandwidth of the held-out motion over the training's, from which a note says that what is
    quicker is not judged (convention)."""
    rest_speed: float = 0.02
    """Speed of a joint over its rms speed in a record, below which it counts as at rest."""
    motion_ratio: float = 0.65
    """Noise floors that a set leaves in motion over those that another leaves in all rows, up to
    which the law in motion is taken (tuned)."""
    breakaway_speed: float = 0.3
    """Speed of a joint over its rms speed, below which friction may be a breakaway; where one is
    found, samples have full weight from this speed on."""
    breakaway_rows: float = 0.02
    """Share of the rows near standstill that may exceed the stated friction there."""
    breakaway_ratio: float = 1.25
    """Friction near standstill over the level in motion, from which there is a breakaway (tuned: at
    most 1.2 for one level, 1.27 to 2.3 with a breakaway of twice the level and more above it)."""
    rest_share: float = 0.02
    """Share of a record's samples at rest, above which a joint rests beyond reversals: a Gaussian
    speed has 0.016 (tuned: joints that stick had 0.023 to 0.12, without friction at most 0.016)."""
    visible_deviations: float = 8.0
    """Energy above noise of an equation over the standard deviation of the noise's own energy, from
    which a further effect is searched for in it (tuned)."""
    suggested_deviations: float = 5.0
    """Standard deviations of its noise from which an effect too small to be named widens intervals
    (tuned: on 19 benches with nothing hidden the largest of all effects was at most 3.9)."""
    visible_share: float = 0.005
    """Remaining share of an equation's energy above noise under the baseline, from which a further
    effect is searched for in it (tuned: a friction beside a stiff spring left 1 %)."""
    clue_share: float = 0.1
    """Share of the remaining energy of all equations, below which an equation is not searched for
    clues (tuned)."""
    # Invariance.
    invariance_tolerance: float = 0.2
    """Relative difference of a size between parts of the rows that a catalogue's simpler form may
    cause (tuned)."""
    standard_errors: float = 3.5
    """Standard errors from which a size differs in a part of the rows, and standard deviations of
    noise from which a simpler name or a rival loses in held-out records (convention: probability 1
    in 2000, for some 10 parts)."""
    informative_share: float = 0.12
    """Least share of a column's energy, orthogonal to all other columns, in a part of the rows that
    is judged: one with less shows the tail of the form, not the size (tuned: tails of seals reach
    0.09, wrong names show from 0.2 on)."""
    separable_share: float = 0.01
    """Share of a column's energy that the effect's other columns cannot make: with less the whole
    effect is judged, not this number (convention: a variance inflation factor of 100)."""
    subset_error: float = 0.25
    """Relative standard error of a size in a part of the rows, beyond which that part is not judged
    (tuned)."""
    richer_name_share: float = 0.15
    """Share of the energy above noise left by the simpler of two names of one law, that the richer
    one must remove (tuned: it removed 0.5 to 8 % where a form was wrong, 27 % and more where two
    levels were true)."""
    near_tolerance: float = 2.5
    """Multiple of the form's tolerance up to which the richer of two names is close to the simpler:
    its further number must then remove more than the richer form itself leaves (tuned: Maxwell slip
    shows 13 % of difference)."""
    form_noise: float = 2.0
    """Energy by which noise alone may prefer one form of an effect to another (arithmetic: twice
    the mean of one number's)."""
    # Significance.
    sign_flips: int = 199
    """Number of sign flips; p is not below 0.005 (convention)."""
    enough_repeats: int = 8
    """Number of repeats from which whole records are flipped: 2^-7 is below `p_limit`
    (arithmetic)."""
    flip_block: float = 2.0
    """[s] Length of a block that is flipped as one: twenty times the row filter's memory
    (arithmetic)."""
    # Others.
    shooting_ratio: float = 0.99
    """Error of held-out windows with the shapes from shooting over that with the shapes from the
    rows: below it the shapes from shooting are used (tuned)."""
    shooting_cost: float = 1.02
    """Largest held-out rms of any equation's rows with the shapes from shooting over that with the
    shapes from the rows (tuned)."""
    rank_limit: float = 1e-4
    """Smallest singular value of unit columns over the largest, below which a direction counts as
    undetermined: the noise of a locked joint's position (10 um of 0.1 m, some thousand samples)
    makes 1e-6 to 1e-5 (arithmetic)."""
    least_rows: int = 40
    """Least number of rows of an equation in one step (arithmetic)."""
    most_rivals: int = 4
    """Largest number of rivals in a result; tied ones are all listed."""
    noted_shift: float = 0.01
    """Relative change of a parameter from which it matters: by an effect at its detection limit, by
    the fit to held-out rows, or by a rival in place of a named effect (tuned: with good excitation
    no detection limit reaches it)."""
    open_share: float = 0.02
    """Half-width of a parameter's 95 % interval under another name, over its value, from which that
    name is a rival (contract: the error that parameters may have)."""
    most_detection_limits: int = 3
    """Largest number of detection limits in the notes."""
    eigenvalue_ratio: float = 1e-10
    """Smallest eigenvalue of columns over the largest, below which the columns depend on each other
    (arithmetic)."""
    curve_seconds: float = 4.0
    """[s] Length of the free run that is kept to be drawn."""
    curve_points: int = 400
    """Approximate number of its points."""


@dataclass(frozen=True)
class DataSettings:
    """Preparation of the records: noise floor, judging blocks, shape grids, spectral lines."""

    judging_block: float = 1.0
    """[s] Length of a block of a held-out record, of which the second of every three only judges
    (arithmetic: ten times the row filter's memory, and a short record still has several)."""
    other_motion: float = 0.2
    """Rms difference of a joint's position between repeats over its standard deviation, from which
    they are no repeats of one motion (tuned: recordings that start 0.4 s apart made clean benches
    `unexplained` on a plant written apart from the study's)."""
    averaging_error: float = 0.1
    """Rms difference between the residual of averaged repeats and the average of their residuals,
    over their noise, from which rows are averaged in place of channels (tuned: at most 0.003 where
    the valves are driven alike, 4 to 7 in position loops that oscillate, which made clean benches
    `unexplained` on a plant written apart from the study's)."""
    seen_motion: float = 20.0
    """Least standard deviation of a position over its sensor's noise, to be compared between
    repeats (arithmetic)."""
    least_noise: float = 0.2
    """Smallest noise floor over the noise that the rig file states; a floor measured lower is set
    to it (tuned)."""
    least_rounding: float = 1e-3
    """Least share of a sensor's variance by rounding that repeats: below it noise dithers the
    converter (arithmetic)."""
    rounding_draws: int = 4
    """Number of draws of where the converters' steps lie (arithmetic)."""
    unrepeated_ratio: float = 5.0
    """Scatter between repeats over the scatter that the stated sensor noise makes, from which a
    note says that something else acts (tuned: clean benches stay below 2)."""
    passed_power: float = 0.01
    """Power of the noise at a frequency, over the largest one, from which a filter passes it."""
    smoothed_frequencies: int = 9
    """Number of neighbouring frequencies over which the power of one draw of noise is averaged."""
    broad_share: float = 0.8
    """Share of the frequencies, those of least power over the noise's, that count as noise: a hum
    and its harmonics take a few per cent."""
    coloured_ratio: float = 3.0
    """Noise of repeats in the rows' band over that in the octave above, both over the stated noise,
    up to which it counts as sensor noise that is not white (noise behind a pole at 5 to 60 Hz stays
    below 2.7)."""
    unstated_ratio: float = 2.5
    """What the model leaves over the stated noise, up to which it counts as noise where nothing
    repeats and it follows no variable of the records (convention: twice, and its scatter)."""
    steady_ratio: float = 10.0
    """The same of a residual that is as large at rest as in motion (convention: twice the stated
    noise behind a pole at 25 Hz is seven times the stated one in rows up to 15 Hz)."""
    motion_window: float = 0.5
    """Length [s] of the parts of records whose motion and residual are compared."""
    motion_ratio: float = 1.5
    """The rms of a residual in the third of these parts with most motion over that with least, up
    to which it does not follow the motion (noise alone: up to 1.3; other causes: 2 and more)."""
    motion_contrast: float = 2.0
    """The same ratio of the motion, below which a residual does not show whether it follows it."""
    least_windows: int = 12
    """Number of these parts below which they show nothing."""
    unstated_clue: float = 0.25
    """Share of that energy which a variable removes from held-out records, from which it is no
    noise (tuned: noise in the regressors alone makes 0.1)."""
    unrepeated_share: float = 0.5
    """Share of that scatter's energy at one frequency, from which the note states the frequency,
    and from which what differs between neighbouring states at it is no noise (convention)."""
    line_ratio: float = 2.0
    """Scatter between repeats over the scatter that the stated sensor noise makes, from which a
    torque at one frequency is looked for in it (tuned: clean benches stay below)."""
    least_turns: float = 5.0
    """Least number of turns that a frequency makes in a record: fewer are drift (tuned)."""
    line_step: float = 0.25
    """Step of the frequencies tried, over one turn in the record (convention)."""
    # Noise from neighbouring states.
    pair_time: float = 0.5
    """[s] Least time between the two rows of a pair: five times the row filter's memory."""
    pair_distance: float = 0.2
    """Largest distance between the states of a pair, in standard deviations of each state: farther
    apart, a residual that changes with the state passes for noise (tuned: EMPS 0.01, crane 0.1,
    multisines of one period 0.5)."""
    nearest_pair_share: float = 0.33
    """Share of the rows whose pairs, the nearest ones, are used (tuned)."""
    finer_noise: float = 0.5
    """Largest ratio of the noise by neighbouring states beside named effects to that without them,
    with which the effects are searched again (tuned)."""
    least_pairs: int = 40
    """Least number of pairs: noise from fewer is uncertain by more than a tenth (arithmetic)."""
    neighbours_asked: int = 64
    """Number of rows nearest to a row, among which one at least `pair_time` away is searched."""
    load_share: float = 0.5
    """Share of the torque rows' energy above noise that a load in some of the records must remove
    to be tried: other effects may hold the rest (tuned)."""
    load_rounds: int = 10
    """Largest number of alternating fits of a load and of the records that carry it: a few settle
    it."""
    temperature_span: float = 0.05
    """[K] Least span of the oil temperature over all records for a temperature column: less changes
    b by less than a fraction of 0.001 (arithmetic)."""
    grid_points: int = 24
    """Largest number of points of a candidate's shape grid: two shapes of about five points each,
    or one of many."""
    cached_row_bytes: float = 2e8
    """[byte] Largest total size of cached rows."""
    cached_signal_bytes: float = 5e7
    """[byte] Largest total size of cached signals."""
    cached_parts: int = 2000
    """Number of parts of rows that are cached: each holds the signals that it was made of."""
    cached_signal_sets: int = 4
    """Number of different signals for which a term's columns are cached."""
    # Spectral lines.
    line_band: float = 1.2
    """Highest line considered over the row filter's cutoff: the filter blocks all above
    (arithmetic)."""
    least_period_share: float = 0.7
    """Least share of a period's pairs of rows that must be present (tuned)."""
    lines_per_pair: float = 0.8
    """Largest number of lines per pair of rows: a pair gives two numbers and a line has two
    (arithmetic)."""
    line_ridge: float = 1e-2
    """Ridge of the line fit over a line's own weight, for lines that short gaps leave undetermined
    (arithmetic)."""
    line_deviations: float = 4.0
    """Power of a kind of lines over the standard deviation that noise alone gives it, below which
    the kind counts as empty (convention)."""
    asymmetric_share: float = 0.33
    """Share of the power on even lines from which an asymmetric nonlinearity is reported; also the
    share of the power off line 0 below which the residual counts as constant (tuned). Dry friction,
    which is symmetric, leaves up to 28 % on even lines: the baseline takes most of the others."""
    symmetric_share: float = 0.1
    """Share of the power on empty odd lines from which a symmetric nonlinearity is reported
    (tuned)."""
    noted_line_share: float = 0.005
    """Share of the power below which a kind of lines is not reported (tuned)."""
    velocity_ratio: float = 3.0
    """Share of the residual's power on even or empty odd lines over that of the joint's velocity,
    which has such lines without any nonlinearity: with less none is reported (tuned)."""


@dataclass(frozen=True)
class SearchSettings:
    """Search for the set of effects that explains the residual."""

    band: float = 0.7
    """Repeatable rms of an equation over its noise, up to which the residual counts as noise
    (tuned)."""
    residual_limit: float = 1.0
    """Repeatable rms of an equation over its noise that an explanation may leave (tuned)."""
    form_share: float = 0.02
    """Share of an equation's energy above noise under the baseline, by which the catalogue's form
    of an effect may differ from the real one (tuned)."""
    exact_trials: int = 3
    """Number of candidates that are refined of those tried by exact columns (tuned)."""
    negative_share: float = 0.1
    """Absolute value of a negative inertia or weight over its value in the baseline's fit, from
    which it is impossible (tuned: a spring in place of an inclination of 0.3 rad turned a weight of
    206 kg m into -243, on a plant written apart from the study's)."""
    add_share: float = 0.3
    """Least share of the remaining energy, in the equations where an effect acts, that the effect
    must remove to be added (tuned)."""
    further_share: float = 0.1
    """Largest share of tolerated remainders that a further effect may leave to be added although it
    cannot be separated from another (tuned: a dead volume beside a leak, of which 25 % stayed)."""
    simpler_ratio: float = 1.25
    """Largest remaining energy of a simpler set over that of the best one, as a product over
    equations, at which the simpler set is chosen (tuned)."""
    acting_share: float = 0.05
    """Energy that an effect removes from an equation over the most that it removes from any: with
    less it does not act there (tuned)."""
    least_log_gain: float = 0.1
    """Sum over equations of log ratios of remaining energy that a further effect must gain
    (tuned)."""
    far_log_gain: float = 2.3
    """Sum over equations of log ratios of remaining energy that another set must gain over one that
    is accepted by the tolerance for its forms (tuned: a tenth)."""
    number_price: float = 20.0
    """Energy that each further free number must remove: ten times what noise gives it (tuned)."""
    least_projected_length: float = 0.03
    """Length of a column orthogonal to the baseline's columns over its whole length, from which the
    first-order column of a signal change shows: less may be of second order (arithmetic)."""
    least_exact_length: float = 0.003
    """The same length for the column of a coefficient, which is exact: a torque offset on a joint
    that turns by 0.8 rad has 0.03 (arithmetic)."""
    size_ratio: float = 3.0
    """Largest fitted size over the size for which the first-order column of a signal change was
    computed; smaller sizes are closer to linear (tuned)."""
    # Effort.
    most_names: int = 3
    """Largest number of effects in a set; one that acts at several joints counts once."""
    pair_starts: int = 10
    """Number of single candidates from which pairs are tried."""
    full_fits: int = 40
    """Number of best candidates that are fitted together with the set."""
    shapes_fitted: int = 4
    """Number of shapes of one effect among them."""
    refined_singles: int = 14
    """Number of single candidates that are refined exactly, best first."""
    refined_pairs: int = 6
    """Number of pairs that are refined exactly."""
    refined_extensions: int = 6
    """Number of extensions of a set that are refined exactly."""
    replacements: int = 3
    """Number of candidates that are refined exactly in the place of an effect of a set (tuned)."""
    near_gain: float = 0.25
    """Energy that a single candidate removes over what the best one removes: one with less is not
    refined (tuned)."""
    other_starts: int = 3
    """Number of single effects from which a search begins again that has found no explanation."""
    shape_starts: int = 3
    """Number of points of an effect's shape grid from which a search for its shapes begins."""
    # Refinement.
    tolerance: float = 1e-4
    """Relative change of the energy at which a refinement ends (arithmetic)."""
    shape_tolerance: float = 1e-6
    """Step over the length of all shapes, each between 0 and 1, at which a refinement ends: an edge
    may be a thousandth of its range (arithmetic)."""
    steps: int = 20
    """Largest number of steps of a refinement."""
    start_shares: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
    """Shares of its size by first-order columns at one of which a new effect begins
    (arithmetic)."""
    first_steps: int = 3
    """Number of steps of a refinement, and of its continuation, after which an unpromising set is
    given up."""
    unpromising_ratio: float = 10.0
    """Energy of a set over that of the set that it may replace, above which it is unpromising."""
    unpromising_form: float = 1.5
    """Energy with an effect in another of its forms, beside the other effects as they are, over
    that in the form at hand, above which the form is not searched further."""
    promising_drop: float = 0.5
    """Energy after the continuation over that before, up to which a set stays promising (tuned:
    useless sets 0.7 to 1)."""
    shape_error: float = 0.25
    """Largest relative standard error of a shape beside the details of its effect's form (tuned:
    contacts that stiffen have 0.01 to 0.07, noise at rest that passes for one 0.4 to 1)."""
    detail_share: float = 0.05
    """Share of the remaining energy above noise that a detail of the form must remove (tuned)."""
    detail_starts: int = 2
    """Number of values of a detail, those that leave least, from which a search begins."""
    # Free forms.
    free_forms_judged: int = 4
    """Largest number of free forms that are put through the gates."""
    free_forms_extended: int = 6
    """Largest number of sets with a free form that are tried with a further effect."""
    free_form_ratio: float = 0.5
    """Largest remaining energy of a free form over that of the several named mechanisms which it
    replaces (tuned)."""
    free_form_ratio_alike: float = 0.25
    """Largest remaining energy of a free form over that of names of as many mechanisms that leave
    more than the tolerance for their forms (tuned: friction that changes by a third along the
    stroke leaves 0.01, on a plant written apart from the study's)."""
    altered_share: float = 0.1
    """Share of an equation's energy above noise that a set removes, from which a free form must
    explain that equation (tuned)."""
    most_deviations: float = 3.0
    """Largest deviation of a number of the rig file, in its standard uncertainties (convention)."""
    independent_rows: float = 0.1
    """Share of the rows with independent noise, since the row filter correlates it (tuned: with
    0.03 a gain cost less than the deviation of an area by one standard uncertainty)."""
    free_form_near: float = 2.0
    """Remaining energy over the least of all sets with a free form: of the sets with less, the
    simplest is judged first (tuned)."""


@dataclass(frozen=True)
class ClueSettings:
    """Clues to a residual that no effect explains."""

    knots: int = 9
    """Number of knots of a curve of the residual over a variable."""
    least_share: float = 0.05
    """Share of the held-out energy above noise below which a variable is no clue (tuned)."""
    by_balance_weight: float = 0.3
    """Weight, in the order of clues, of a variable that the equation's own balance makes follow any
    missing term (tuned)."""
    spool_weight: float = 0.6
    """Weight of the spool in a torque: it acts through the pressures (tuned)."""
    chamber_lead: float = 0.2
    """Share that one chamber's pressure must remove beyond the pressure difference to have full
    weight (tuned)."""
    product_gain: float = 0.05
    """Share that a product of two variables must remove beyond either of them (tuned)."""
    direction_speed: float = 0.1
    """Speed over its rms below which the direction of motion changes gradually."""
    direction_memory: float = 0.1
    """Travel over the joint's largest travel after which the direction with memory has changed."""
    # Formula.
    monomials: int = 3
    """Largest number of monomials of a formula."""
    leading_monomials: int = 2
    """Largest number of monomials of a formula that is listed before curves: three fit too much
    (tuned)."""
    leading_share: float = 0.9
    """Share of the energy above noise that a formula must remove to be listed before curves
    (tuned)."""
    monomial_gain: float = 0.05
    """Share of the energy above noise that one more monomial must remove (tuned)."""
    shown_share: float = 0.5
    """Share of the held-out energy above noise that a formula must remove to be shown (tuned)."""
    duplicate_correlation: float = 0.999
    """Correlation from which two columns count as the same (arithmetic)."""
    # Frequency.
    least_lines: int = 8
    """Least number of excited lines: with fewer, most of any power lies at one of them (tuned)."""
    side_lines: int = 1
    """Lines on either side of the highest that are added to it: a frequency between two lines shows
    in both (arithmetic)."""
    first_line: int = 5
    """Lowest line of a frequency clue: less than five turns in a period are drift (tuned)."""
    peak_share: float = 0.6
    """Least share of the power at one frequency (tuned)."""
    frequency_share: float = 0.5
    """Least share of the held-out energy above noise that a sine of the frequency removes
    (tuned)."""
    frequency_steps: int = 41
    """Number of frequencies tried within one line on either side."""


@dataclass(frozen=True)
class ExperimentSettings:
    """The next experiment: what it may do to the machine, and when it is worth doing."""

    fill: float = 0.9
    """Share of the tightest limit that an experiment uses on the twin."""
    plays: int = 4
    """Largest number of simulations on the twin to find the amplitude."""
    first_rms: float = 0.1
    """[V] Rms of the command in the first of them."""
    phase_draws: int = 40
    """Number of random sets of phases, of which the one with the smallest peak is used."""
    phase_rounds: int = 40
    """Number of rounds of the search for phases."""
    seed: int = 0
    """Seed of the phases."""
    end_distance: float = 2e-3
    """[m] Distance of a locked piston from its end, below which it counts as standing there."""
    closed_travel: float = 5e-3
    """[m] Largest motion of a joint behind a closed valve."""
    end_travel: float = 2e-3
    """[m] Largest motion of a joint at its end."""
    centring_offset: float = 4e-3
    """[m] Largest offset of a record's centre."""
    position_gain: float = 2.0
    """[V/m] Gain of the loop that centres the piston before a record."""
    repeats: int = 4
    """Number of repeats of each training record."""
    held_out_amplitude: float = 0.85
    """Amplitude of held-out over training records: some effects show near the limits only."""
    held_out_repeats: int = 3
    """Number of repeats of each held-out record."""
    line_ratio: float = 5.0
    """Least number of lines of a proposed excitation over that of the records."""
    shape_step: float = 0.02
    """Step of a numerical derivative over the shape's value, or over its range where the value is
    zero (arithmetic)."""
    least_gain: float = 1.3
    """Least separation, or range of a variable, that an experiment promises over that of the
    records (tuned)."""
    useful_separation: float = 3.0
    """Separation over the noise beyond which more adds no information (convention)."""
    steps: int = 3
    """Largest number of steps of an experiment."""
    least_step_gain: float = 0.3
    """Separation over the noise, summed over questions, that a further step must add (tuned)."""
    near_energy: float = 2.0
    """Remaining energy of a set over that of the best one, up to which the experiment is to
    separate the two (tuned)."""
    rivals: int = 3
    """Largest number of sets that an experiment is to separate from the best one."""
    parameter_ratio: float = 2.0
    """Largest ratio of an estimated parameter to its nominal value, and of the nominal value to it,
    at which the twin uses the estimate."""


TRACE: Final = TraceSettings()
DATA: Final = DataSettings()
SEARCH: Final = SearchSettings()
CLUES: Final = ClueSettings()
EXPERIMENT: Final = ExperimentSettings()
