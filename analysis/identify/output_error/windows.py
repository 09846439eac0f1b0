"""Cut records into windows for output error, simulate and linearise them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import ordered
from analysis.identify.estimators import nuisance as nu
from analysis.identify.output_error.shooting import (
    SAMPLES_PER_STEP,
    parts_of,
    shoot,
)
from analysis.identify.settings import IDENTIFY
from analysis.regression.conditioned import condition_runs
from analysis.signals.conditioning import Mask, Signals
from analysis.signals.filters import channel_filter
from analysis.simulation.model import Model, as_loaded, model_of
from analysis.simulation.simulate import (
    Compiled,
    Effort,
    compiled,
    drive_of,
    hidden_paths,
    sensor_corrected,
)
from analysis.terms.base import Used, inverted
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.parts import converter_step
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedWindow:
    """A window: its record and part, first sample, outputs (points, 3 F) of F free joints."""

    record: int
    stratum: int
    repeat: int
    part: int
    first: int
    measured: Array


@dataclass(frozen=True)
class WindowSource:
    """One record: signals and inputs of the integrator, oil temperature above nominal [K].

    The signals are corrected for the model's sensor effects.
    """

    signals: Signals
    inputs: Array
    locked: Mask
    kelvin: float


@dataclass(frozen=True)
class ReducedWindow:
    """A linearised window, its start eliminated: score (k,), information (k, k), cost.

    `least_cost` is the cost at the best start; a step dtheta (k,) of the parameters changes that
    start by offset - back dtheta.
    """

    score: Array
    information: Array
    cost: float
    least_cost: float
    back: Array
    offset: Array
    residual: Array


@dataclass(frozen=True)
class PerturbedModel:
    """One record's model; `pars` (1 + k, parameters) unperturbed, then with each perturbed.

    `sizes` (k,) are the perturbations, `hidden` the terms' hidden states (n, h) along the record
    for each of `pars`.
    """

    ready: Compiled
    pars: Array
    sizes: Array
    hidden: tuple[Array, ...]


class Windows:
    """The data of one fit by windows, and their simulations.

    Parameters are the terms' coefficients and those of their shapes named in `shapes`. With `free`
    only those named there may change. At most `seconds` of data are used.
    """

    def __init__(
        self, rig: Rig, runs: Sequence[Run], terms: Sequence[Used], shapes: tuple[str, ...] = (),
        seconds: float = IDENTIFY.window_seconds, free: frozenset[str] | None = None,
    ) -> None:  # fmt: skip
        self.rig, self.terms, self.seconds, self.free = rig, ordered(terms), seconds, free
        self.shape_places = {
            name: (k, j)
            for k, used in enumerate(self.terms)
            for j, name in enumerate(used.term.shape_names())
            if name in shapes
        }
        names = (*(c.parameter for u in terms for c in u.term.coefficients(rig)), *shapes)
        self.with_temperature = (
            free is None
            and "b" in names
            and all(ch.TEMPERATURE in r.channels for run in runs for r in run.records)
        )
        self.names = (*names, nu.KAPPA) if self.with_temperature else names
        self.sources: list[WindowSource] = []
        self.placed: list[PlacedWindow] = []
        self._without_influence: dict[int, set[int]] = {}
        self._cut(runs)

    def _cut(self, runs: Sequence[Run]) -> None:
        records = condition_runs(self.rig, runs)
        strata = {s: k for k, s in enumerate(sorted({item.group for item in records}))}
        most = max(1, round(self.seconds / IDENTIFY.window) // len(records))
        for item in records:
            record, signals = item.record, sensor_corrected(self.rig, self.terms, item.signals)
            drive = drive_of(signals)
            kelvin = float(np.mean(signals.temperature)) - self.rig.oil.temperature
            self.sources.append(WindowSource(signals, drive.inputs, drive.locked, kelvin))
            free = ~drive.locked
            every = _steps_between_points(record.sample_rate)
            points = round(IDENTIFY.window * record.sample_rate) // (SAMPLES_PER_STEP * every)
            length = points * SAMPLES_PER_STEP * every
            # No sample of any joint may be lost: the locked ones drive the others.
            lost = signals.lost.any(axis=1)
            usable: Mask = np.asarray(signals.valid[:, free].all(axis=1) & ~lost)
            firsts = self._window_starts(usable, length)
            chosen = firsts[:: max(1, -(-len(firsts) // most))][:most]
            measured = np.column_stack(
                (signals.s[:, free], signals.p_cap[:, free], signals.p_rod[:, free])
            )
            for part, first in enumerate(chosen):
                at = first + SAMPLES_PER_STEP * every * np.arange(points)
                self.placed.append(
                    PlacedWindow(
                        len(self.sources) - 1, strata[item.group], record.repeat, part, first,
                        measured[at],
                    )
                )  # fmt: skip
        if not self.placed:
            raise InputError(
                f"no record holds {IDENTIFY.window:g} s without a clipped sensor or a lost sample: "
                "output error has nothing to simulate; use --estimator ls"
            )

    @staticmethod
    def _window_starts(usable: Mask, length: int) -> list[int]:
        """Return the first samples of windows that lie end to end within good samples."""
        firsts, first = [], 0
        unusable = np.flatnonzero(~usable)
        for stop in (*unusable.tolist(), len(usable)):
            while first + length < stop:
                firsts.append(first)
                first += length
            first = max(first, stop + 1)
        return firsts

    def sigma(self) -> dict[int, Array]:
        """Return the outputs' standard deviations (3 F,) by step: the sensors' after filtering."""
        sensors = self.rig.sensors
        outputs = (sensors.piston, sensors.chamber_pressure, sensors.chamber_pressure)
        steps = np.array([converter_step(s) for s in outputs])
        out = {}
        for window in self.placed:
            source = self.sources[window.record]
            gain = float(np.linalg.norm(channel_filter(source.signals.rate).taps[0]))
            noise = np.maximum(np.array([s.noise for s in outputs]) * gain, steps / np.sqrt(12))
            free = int((~source.locked).sum())
            out[window.stratum] = np.repeat(noise, free)
        return out

    def measured_start(self, window: PlacedWindow) -> Array:
        """Return a window's first state [q, q', p_cap, p_rod] as measured, (4 N,)."""
        source = self.sources[window.record]
        s, k = source.signals, window.first
        return np.concatenate((s.q[k], s.qd[k], s.p_cap[k], s.p_rod[k]))

    def _state_places(self, window: PlacedWindow) -> NDArray[np.int64]:
        locked = self.sources[window.record].locked
        free = np.flatnonzero(~locked)
        return np.concatenate([kind * len(locked) + free for kind in range(4)])

    def moved(self, window: PlacedWindow, start: Array, change: Array) -> Array:
        """Return a first state with `change` added to the states of the free joints."""
        moved = start.copy()
        moved[self._state_places(window)] += change
        return moved

    def _perturbed(self, theta: Array, source: WindowSource) -> PerturbedModel:
        """Compile the model with every parameter perturbed, and compute its hidden states."""
        sizes = IDENTIFY.sensitivity_step * np.where(theta == 0.0, 1.0, np.abs(theta))
        if self.with_temperature:
            b = abs(theta[self.names.index("b")])
            sizes[-1] = IDENTIFY.sensitivity_step * b
        rows = [theta, *(theta + n * e for n, e in zip(sizes, np.eye(len(theta)), strict=True))]
        loaded = source.signals.loaded
        models = [as_loaded(self.model(row, source.kelvin), loaded) for row in rows]
        ready = [compiled(model, Effort.FIT) for model in models]
        base = hidden_paths(models[0], source.signals)
        hidden = [
            hidden_paths(model, source.signals) if base.size and name in self.shape_places else base
            for model, name in zip(models, ("", *self.names), strict=True)
        ]
        return PerturbedModel(ready[0], np.array([r.par for r in ready]), sizes, tuple(hidden))

    def model(self, theta: Array, kelvin: float = 0.0) -> Model:
        """Return the model of parameters theta (k,), the oil `kelvin` above nominal."""
        values = dict(zip(self.names, theta.tolist(), strict=True))
        terms = list(self.terms)
        for name, (k, j) in self.shape_places.items():
            shape = list(terms[k].shape)
            shape[j] = values.pop(name)
            terms[k] = replace(terms[k], shape=tuple(shape))
        if self.with_temperature:
            values["b"] += kelvin * values.pop(nu.KAPPA)
        return model_of(self.rig, terms, inverted(self.rig, terms, values))

    def linearised(
        self, theta: Array, starts: Sequence[Array], sigma: Mapping[int, Array]
    ) -> list[ReducedWindow | None]:
        """Simulate every window with every perturbation; None for one that failed."""
        ready = [self._perturbed(theta, source) for source in self.sources]

        def reduced(k: int) -> ReducedWindow | None:
            window = self.placed[k]
            return self._window(window, starts[k], sigma[window.stratum], ready[window.record])

        # A record's first window shows which parameters have no influence in it; its other windows
        # then run in parallel.
        reductions = {}
        for k, window in enumerate(self.placed):
            if window.record not in self._without_influence:
                reductions[k] = reduced(k)
        remaining = [k for k in range(len(self.placed)) if k not in reductions]
        with ThreadPoolExecutor(IDENTIFY.window_workers) as pool:
            reductions |= zip(remaining, pool.map(reduced, remaining), strict=True)
        return [reductions[k] for k in range(len(self.placed))]

    def _window(
        self, window: PlacedWindow, start: Array, sigma: Array, perturbed: PerturbedModel
    ) -> ReducedWindow | None:
        """Simulate one window with every perturbation and eliminate its start."""
        ready, sizes = perturbed.ready, perturbed.sizes
        source = self.sources[window.record]
        places = self._state_places(window)
        free = len(places) // 4
        state_sizes = np.repeat(IDENTIFY.start_steps, free)
        active = self._active(window.record)
        y0 = np.zeros((1 + len(places) + len(active), len(start) + ready.hidden))
        y0[:, : len(start)] = start
        for row, (state_index, size) in enumerate(zip(places, state_sizes, strict=True), start=1):
            y0[row, state_index] += size
        selected = np.concatenate((np.zeros(1 + len(places), dtype=np.int64), 1 + active))
        if y0.shape[1] > len(start):
            y0[:, len(start) :] = [perturbed.hidden[k][window.first] for k in selected]
        states = shoot(
            ready, np.ascontiguousarray(perturbed.pars[selected]), y0, source.inputs,
            source.signals.rate, source.locked, window.first, len(window.measured),
            _steps_between_points(source.signals.rate), parts_of(self.terms, source.signals.rate),
        )  # fmt: skip
        if states is None:
            return None
        outputs = self._outputs(states, source.locked) / sigma
        residual = window.measured / sigma - outputs[0]
        change = (outputs[1:] - outputs[0]).reshape(len(outputs) - 1, -1)
        J_start = (change[: len(places)] / state_sizes[:, None]).T
        J = np.zeros((J_start.shape[0], len(sizes)))
        J[:, active] = (change[len(places) :] / sizes[active, None]).T
        if window.record not in self._without_influence:
            self._without_influence[window.record] = {int(k) for k in active if not J[:, k].any()}
        r = residual.ravel()
        # Project the window's start out by QR of its sensitivities.
        Q, R = np.linalg.qr(J_start)
        J_inside, r_inside = Q.T @ J, Q.T @ r
        J_out, r_out = J - Q @ J_inside, r - Q @ r_inside
        return ReducedWindow(
            J_out.T @ r_out, J_out.T @ J_out, float(r @ r), float(r_out @ r_out),
            np.linalg.solve(R, J_inside), np.linalg.solve(R, r_inside), residual,
        )  # fmt: skip

    def _active(self, record: int) -> NDArray[np.int64]:
        """Return the parameters with an influence in a record, as found from its first window."""
        locked = {str(i + 1) for i in np.flatnonzero(self.sources[record].locked)}
        without_influence = self._without_influence.get(record, set())
        return np.array(
            [
                k for k, name in enumerate(self.names)
                if k not in without_influence
                and (self.free is None or name in self.free)
                and not (name.startswith(("C_", "Fv")) and name[-1] in locked)
            ],
            dtype=np.int64,
        )  # fmt: skip

    def _outputs(self, states: Array, locked: Mask) -> Array:
        N = len(locked)
        free = np.flatnonzero(~locked)
        piston = [self.rig.joints[i].linkage.piston(states[..., i]) for i in map(int, free)]
        return np.concatenate(
            (np.stack(piston, axis=-1), states[..., 2 * N + free], states[..., 3 * N + free]),
            axis=-1,
        )


def _steps_between_points(rate: float) -> int:
    """Return the integrator's steps between two compared points, at a sample rate [Hz]."""
    return max(1, round(rate / IDENTIFY.point_rate / SAMPLES_PER_STEP))
