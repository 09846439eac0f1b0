"""The output error of a candidate set of parameters, for the search methods.

A candidate is a set of STEP1's parameters (the last joint's: inertia, friction, gravity, four
gains, and b: 8). Its model runs free over windows of a record, from the measured state and driven
by the measured spool. The other joints stand still, as in the paper's STEP1, so that their
parameters have no influence. Error of a candidate, over piston, cap and rod pressure and all
windows:

J = mean [ |y - yhat|^2 / |y - mean y|^2 ] (FIT = 100 (1 - sqrt J) for one channel)

Some candidates cannot be simulated: where a chamber's pressure leaves [0, p_s] an orifice's root is
complex, and a state may diverge (the paper's section II.B). They are counted by cause, and their
error is `failed_error` or more, worse than any that can be simulated, and grows with the number of
failed windows, so that the search still has a slope there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.regression.rows import Filtering
from analysis.signals.conditioning import Mask, aligned_channels, condition
from analysis.simulation.model import Model, model_of
from analysis.simulation.simulate import (
    DrivingInput,
    Effort,
    State,
    compiled,
    drive_of,
    simulate,
    state_at,
)
from analysis.simulation.validate import arrived, compared
from analysis.terms.base import Used
from rig.model.parameters import gain_names, inertia_names
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig

Array = NDArray[np.float64]

COMPLEX, DIVERGED = "pressure outside 0..supply", "state diverged"


@dataclass(frozen=True)
class SearchOptions:
    """Length, range and data of a search.

    `evaluations` candidates in generations of `population`; each parameter between its nominal
    value divided and multiplied by `factor`, searched in the logarithm; `windows` windows of
    `seconds` of one record.
    """

    evaluations: int = 2000
    population: int = 40
    factor: float = 10.0
    windows: int = 2
    seconds: float = 2.0

    def __post_init__(self) -> None:
        if self.evaluations < 4 or self.population < 4:
            raise InputError(
                f"a search of {self.evaluations} evaluations in generations of {self.population} "
                "is too short: expected at least 4 of each"
            )
        if not self.factor > 1.0 or self.windows < 1 or not self.seconds > 0.0:
            raise InputError(
                f"a search has factor {self.factor:g}, windows {self.windows}, seconds "
                f"{self.seconds:g}: expected above 1, at least 1, and above 0"
            )


@dataclass(frozen=True)
class SearchWindow:
    """A window of the record: first sample, state there, measured samples by channel.

    `valid` (samples,) is false where a sample was lost and nothing is compared.
    """

    first: int
    start: State
    measured: Mapping[str, Array]
    spread: Mapping[str, float]
    valid: Mask


@dataclass(frozen=True)
class SearchTask:
    """A search's task: the model to fill in, the names searched, their bounds, the data."""

    record: str
    model: Model
    names: tuple[str, ...]
    low: Array
    high: Array
    drive: DrivingInput
    windows: tuple[SearchWindow, ...]


@dataclass(frozen=True)
class Score:
    """A candidate's error, and the cause of a failed simulation ('' if it did not fail)."""

    error: float
    failure: str


def searched_names(rig: Rig) -> tuple[str, ...]:
    """Name STEP1's parameters: inertia, friction and gravity of the last joint, b, its gains."""
    N = len(rig.joints)
    inertia = inertia_names(N)
    inertia_of_last = "M2" if N == 2 else inertia[-1]
    return (inertia_of_last, f"Fv{N}", f"W{N}", "b", *gain_names(N))


def single_joint_record(runs: Sequence[Run]) -> Record:
    """Return the first record that moves the last joint alone; raises InputError without one."""
    for run in runs:
        N = len(run.rig.joints)
        for record in run.records:
            if set(record.locked) == set(range(1, N)):
                return record
    raise InputError(
        "a search needs a record that excites the last joint alone (the paper's STEP1), and the "
        "runs hold none; `bramah run lock-and-excite` records it"
    )


def make_task(
    rig: Rig, record: Record, terms: Sequence[Used], filtering: Filtering, options: SearchOptions
) -> SearchTask:
    """Prepare the search on one record; raises InputError for a rig without nominal values.

    Also for a record too short for a window, or with a gap of lost samples too long to bridge.
    """
    names = searched_names(rig)
    model = _template(rig, terms, names)
    nominal = np.array([rig.nominal[name] for name in names])
    signals = condition(rig, record, filtering.channels)
    drive = _with_locked_at_rest(drive_of(signals))
    length, reach = round(options.seconds * record.sample_rate), filtering.channels.reach
    spare = record.samples - 2 * reach - length
    if spare < 0:
        raise InputError(
            f"record {record.name!r} of {record.samples / record.sample_rate:g} s is too short "
            f"for a window of {options.seconds:g} s; take a longer one"
        )
    channels = compared(rig, aligned_channels(rig, record), signals)
    arrived_samples = arrived(rig, record)
    windows = []
    for first in np.unique(np.linspace(reach, reach + spare, options.windows).astype(int)):
        measured = {name: x[first : first + length] for name, x in channels.items()}
        valid = arrived_samples[first : first + length]
        spread = {n: float(valid.sum() * y[valid].var()) for n, y in measured.items()}
        start = state_at(signals, int(first))
        windows.append(SearchWindow(int(first), start, measured, spread, valid))
    return SearchTask(
        record.name, model, names, nominal / options.factor, nominal * options.factor,
        drive, tuple(windows),
    )  # fmt: skip


def _template(rig: Rig, terms: Sequence[Used], names: Sequence[str]) -> Model:
    """Return a model with the searched parameters at nominal; the others have no influence."""
    missing = [name for name in names if not rig.nominal.get(name, 0.0) > 0.0]
    if missing:
        raise InputError(
            f"rig {rig.name!r} has no positive nominal {' '.join(missing)}: a search starts "
            "there; add them under 'nominal' in the rig file"
        )
    known = [c.parameter for used in terms for c in used.term.coefficients(rig)]
    if set(names) - set(known):
        raise InputError("a search needs every term of the paper's model; identify without --with")
    return model_of(
        rig, terms, {name: rig.nominal.get(name, IDENTIFY.idle_value) for name in known}
    )


def _with_locked_at_rest(drive: DrivingInput) -> DrivingInput:
    """Hold the locked joints at their mean position at rest, as STEP1's equations assume."""
    held = np.where(drive.locked, drive.q.mean(axis=0), drive.q)
    moving = np.where(drive.locked, 0.0, 1.0)
    return replace(drive, q=held, qd=drive.qd * moving, qdd=drive.qdd * moving)


def with_values(model: Model, values: Mapping[str, float]) -> Model:
    """Return the model with some of its parameters' values replaced."""
    parameters = {
        name: replace(p, value=values.get(name, p.value)) for name, p in model.parameters.items()
    }
    return replace(model, parameters=parameters)


def score(task: SearchTask, values: Mapping[str, float]) -> Score:
    """Simulate a candidate over all windows and return its error and cause of failure."""
    ready = compiled(with_values(task.model, values), Effort.FIT)
    total, lost, samples, failure = 0.0, 0, 0, ""
    for window in task.windows:
        length = len(window.valid)
        samples += length
        if failure == DIVERGED:
            lost += length
            continue
        simulated = simulate(ready, task.drive, window.start, window.first, length)
        lost += simulated.outside + length - simulated.filled
        if simulated.failure:
            failure = DIVERGED
        elif simulated.outside:
            failure = failure or COMPLEX
        elif not failure:
            channels = simulated.channels()
            for name, y in window.measured.items():
                residual = (y - channels[name])[window.valid]
                total += float(np.sum(residual**2)) / window.spread[name]
    if failure:
        return Score(IDENTIFY.failed_error * (1.0 + lost / samples), failure)
    return Score(total / (len(task.windows) * len(task.windows[0].measured)), "")
