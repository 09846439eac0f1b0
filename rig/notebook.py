"""Functions for notebooks and scripts: `from rig import notebook as bench`.

Reading, identification, validation and trace are the functions of the command line, collected here.
This module adds tables, plots, changes of a protocol's step, and runs. Nothing here prints.

Glossary: a *run* is a folder's content, a *record* one repeat of one step (`rig.model.records`).
"""

from __future__ import annotations

import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from analysis.identify.identify import identify
from analysis.report.plots.style import figure, style, thin
from analysis.simulation.model import load_model, save_model
from analysis.simulation.validate import RecordValidation, validate
from analysis.trace.engine import trace
from protocols.files.library import load as load_protocol
from protocols.files.plan import Overrides, mapped, resolve
from protocols.files.schema import Protocol, every_step
from protocols.files.writer import protocol_text
from protocols.steps.base import StepKind
from rig.cli.execution.protocol_run import ProtocolJob, run_protocol
from rig.cli.proof.proofs import PlanProof, proved
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.model.parse import InputError, first_problem
from rig.model.records import Record, Run
from rig.runs.files import replace_bytes, write_text
from rig.runs.rigs import load_bench, load_rig
from rig.runs.store import load_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame  # type: ignore[import-untyped]

__all__ = [
    "Overrides", "Plot", "changed", "check", "frame", "identify", "load_model", "load_protocol",
    "load_rig", "load_run", "plot", "plot_validation", "record", "save_model", "simulated_bench",
    "take", "trace", "units", "validate",
]  # fmt: skip

log = logging.getLogger(__name__)
_PANEL = 1.1  # [in] of height for one channel


@dataclass(frozen=True)
class Plot:
    """A figure that a notebook displays; `figure` is Matplotlib's, to change further."""

    figure: Figure

    def _repr_svg_(self) -> str:
        text = io.StringIO()
        self.figure.savefig(text, format="svg")
        return text.getvalue()

    def save(self, path: str | Path) -> Path:
        """Write it in the format of the path's ending; return the path.

        An old file is replaced when the new one is complete. Raises OSError.
        """
        file, content = Path(path), io.BytesIO()
        self.figure.savefig(content, format=file.suffix.removeprefix(".") or None)
        replace_bytes(file, content.getvalue())
        return file


def record(run: Run, name: str) -> Record:
    """Return the record of a run by its name, such as `step1_r2`; raises InputError naming all."""
    for candidate in run.records:
        if candidate.name == name:
            return candidate
    known = " ".join(candidate.name for candidate in run.records)
    raise InputError(f"{run.source or 'the run'}: has no record {name!r}; it has: {known}")


def units(run: Run) -> dict[str, str]:
    """Return the SI unit of every channel of a run, by name."""
    names = dict.fromkeys(name for one in run.records for name in one.channels)
    return {name: run.rig.unit_of(name) for name in names}


def frame(run: Run, name: str) -> DataFrame:
    """Return a record as a table: a row per sample, indexed by the time [s] since the run began.

    Columns are channels in SI; `attrs` holds `units` and the record's attributes. Raises InputError
    for an unknown record, or where pandas (`pip install 'bramah[export]'`) is missing.
    """
    try:
        import pandas  # noqa: PLC0415 - needed here only
    except ImportError as error:
        raise InputError("a table needs pandas: pip install 'bramah[export]'") from error
    taken = record(run, name)
    index = pandas.Index(taken.start + taken.time, name="time")
    made = pandas.DataFrame(dict(taken.channels), index=index)
    made.attrs = {"units": units(run), **taken.attributes}
    return made


def plot(run: Run, name: str, channels: Sequence[str] | None = None) -> Plot:
    """Draw channels of a record over its time, one panel each; all of them by default."""
    taken = record(run, name)
    chosen = list(channels or taken.channels)
    unknown = [channel for channel in chosen if channel not in taken.channels]
    if unknown:
        known = " ".join(taken.channels)
        raise InputError(f"record {name!r} has no channel {unknown[0]!r}; it has: {known}")
    series = {
        f"{channel} [{run.rig.unit_of(channel)}]": [taken.channels[channel]] for channel in chosen
    }
    return _panels(taken.time, series, name)


def plot_validation(result: RecordValidation) -> Plot:
    """Draw the measured channels of a record with the model's free run."""
    simulated = result.simulation.channels()
    series = {
        f"{channel} [{result.units.get(channel, 'SI')}], FIT {fit:.1f} %": [
            result.measured[channel], simulated[channel][: len(result.time)]
        ]
        for channel, fit in result.fit.items()
    }  # fmt: skip
    return _panels(result.time, series, f"{result.record}: measured, and the model over it")


def _panels(time: Any, series: Mapping[str, Sequence[Any]], title: str) -> Plot:
    with style():
        made = figure(_PANEL * len(series) + 0.6)
        grid = made.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, lines) in zip(grid, series.items(), strict=True):
            for number, values in enumerate(lines):
                axes.plot(*thin(time[: len(values)], values), linewidth=1.6 if not number else 0.8)
            axes.set_title(label, loc="left", fontsize="small")
        grid[-1].set_xlabel("time [s]")
        made.suptitle(title)
        made.tight_layout()
    return Plot(made)


def changed(protocol: Protocol, step: str, changes: Mapping[str, Any]) -> Protocol:
    """Return a protocol with one step changed, checked as a file is.

    `changes` maps keys of the step, as in error messages, to values with units: ``{"repeats": 2,
    "excite.0.signal.amplitude": "0.6 V"}``. Raises InputError naming step and key.
    """
    names = [part.name for part in every_step(protocol.steps) if part.name]
    if step not in names:
        raise InputError(
            f"protocol {protocol.name!r} has no step {step!r}; it has: {' '.join(names)}"
        )

    def change(part: StepKind) -> StepKind:
        if part.name != step:
            return part
        data = part.model_dump()
        for path, value in changes.items():
            _put(data, path, value, step)
        try:
            return type(part).model_validate(data)
        except ValidationError as error:
            raise InputError(f"step {step!r}: {first_problem(error)}") from error

    return protocol.model_copy(update={"steps": mapped(protocol.steps, change)})


def _put(data: Any, path: str, value: Any, step: str) -> None:
    """Set one key of nested plain data; raises InputError for a missing one."""
    *way, last = path.split(".")
    for key in way:
        data = _at(data, key, path, step)
    _at(data, last, path, step)
    data[int(last) if isinstance(data, list | tuple) else last] = value


def _at(data: Any, key: str, path: str, step: str) -> Any:
    try:
        return data[int(key)] if isinstance(data, list | tuple) else data[key]
    except (KeyError, IndexError, ValueError, TypeError) as error:
        known = list(data) if isinstance(data, dict) else f"0 to {len(data) - 1}"
        raise InputError(
            f"step {step!r}: {path}: no key {key!r} here; expected one of: {known}"
        ) from error


def check(protocol: str | Protocol, rig: str, overrides: Overrides | None = None) -> PlanProof:
    """Prove a protocol on the twin and predict its standard errors; nothing moves.

    `report.ok` states whether every limit is kept, `report.refused` which are not, `text` the
    predicted errors. Raises InputError for a protocol that does not fit the rig.
    """
    how = overrides or Overrides()
    made = load_protocol(protocol, how.parameters) if isinstance(protocol, str) else protocol
    bench = load_bench(rig)
    return proved(resolve(made, bench, how), bench, predict=True)


def take(
    protocol: str | Protocol,
    rig: str,
    out: str | Path,
    endpoint: str | None = None,
    overrides: Overrides | None = None,
) -> Run:
    """Run a protocol on a bench into the folder `out`, unattended, and return what was recorded.

    As `bramah run`: proved first, every sample guarded, the outputs zeroed at any end. A changed
    protocol is written next to the run, as OUT.yaml, so that it can be run again. Progress goes to
    this module's logger. Raises what `bramah run` ends with: InputError, SafetyTrip, DeviceError,
    OperatorStop.
    """
    folder = Path(out)
    if isinstance(protocol, Protocol):
        file = folder.with_name(f"{folder.name}.yaml")
        write_text(file, protocol_text(protocol, "Made in a notebook."))
        protocol = str(file)
    job = ProtocolJob(protocol, rig, folder, endpoint, overrides or Overrides())
    return load_run(run_protocol(job, log.info))
