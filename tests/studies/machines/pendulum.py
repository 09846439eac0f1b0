"""The `pendulum` verb's work: read the measured double pendulum, compare two sets of parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from rig.cli.text.output import table
from rig.model.parameters import mechanical_names, parameter_unit
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.studies.machines.bodies import Body, chain_parameters
from tests.studies.machines.free_chain import (
    Scale,
    Swing,
    identify_free,
    refine_free,
    window_error,
    windows,
)

DATA = "DoublePendulumDataForParameterEstimation.mat"
AUTHORS = "EstimatedParameters_DoublePendulum.mat"
WINDOWS = (0.25, 0.5, 1.0, 2.4)  # [s]; the segments are 2.67 s, the filter takes their edges
SCALE = "W1"  # the parameter fixed at the authors' value
AUTHORS_WAY, ROWS, REPORTED = "authors", "rows alone", "fitted"
NEW = "Y_vad"  # the segments that served no fit
Say = Callable[[str], None]


@dataclass(frozen=True)
class Pendulum:
    """The measured segments, the authors' parameters by our names, and a rig with their gravity."""

    rig: Rig
    fitted: tuple[Swing, ...]
    judged: tuple[Swing, ...]
    authors: Mapping[str, float]


@dataclass(frozen=True)
class Compared:
    """Parameters by way of finding them, and RMS angle error [rad] by way, segments and window.

    `REPORTED` is the way that counts: output error, begun at the rows. `ROWS` shows what the rows
    alone would have given.
    """

    parameters: Mapping[str, Mapping[str, float]]
    errors: Mapping[str, Mapping[str, Mapping[float, float]]]

    def over_authors(self, way: str = REPORTED) -> float:
        """Return the largest ratio of a way's error to the authors' over new data's windows."""
        known = self.errors[AUTHORS_WAY][NEW]
        return max(error / known[s] for s, error in self.errors[way][NEW].items())


def read_pendulum(folder: Path) -> Pendulum:
    """Read both files; raises InputError naming what is missing or of another form."""
    data, known = _mat(folder / DATA), _mat(folder / AUTHORS)
    try:
        rate = 1.0 / float(data["dt"].item())
        # Their angles are absolute, with pi hanging straight down.
        fitted, judged = (
            tuple(Swing(rate, np.ascontiguousarray(cell[:2].T) - np.pi) for cell in cells.ravel())
            for cells in (data["Y_id"], data["Y_vad"])
        )
        values = [float(value) for value in known["EstimatedParameters"].ravel()]
        m1, m2, a1, a2, length, inertia1, inertia2, friction1, friction2, gravity = values
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(
            f"{folder}: not the double pendulum's data ({type(error).__name__}: {error}); expected "
            "Y_id, Y_vad, dt and ten EstimatedParameters"
        ) from error
    # The second link ends nowhere: its length enters nothing.
    bodies = (Body(length, m1, a1, inertia1), Body(length, m2, a2, inertia2))
    authors = chain_parameters(bodies) | {"Fv1": friction1, "Fv2": friction2}
    # Of the rig only two joints, gravity and the sample rate are used.
    lent = load_rig("shinshu-2dof").model_copy(update={"gravity": gravity, "sample_rate": rate})
    return Pendulum(lent, fitted, judged, authors)


def _mat(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(
            f"{path} is not there; expected the folder of the two MATLAB files {DATA} and {AUTHORS}"
        )
    try:
        found: dict[str, Any] = loadmat(path)
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{path} is not a MATLAB file that can be read: {error}") from error
    return found


def compare(what: Pendulum, say: Say) -> Compared:
    """Identify from the fitted segments and simulate every segment, beside the authors' values."""
    scale = Scale(SCALE, what.authors[SCALE])
    say(f"rows of {len(what.fitted)} segments")
    by_rows = identify_free(what.rig, what.fitted, scale)
    say(f"output error over windows of {WINDOWS[-1]:g} s, started from the rows")
    refined, _ = refine_free(what.rig, by_rows, windows(what.fitted, WINDOWS[-1]), scale)
    ways = {AUTHORS_WAY: dict(what.authors), REPORTED: refined, ROWS: by_rows}
    errors: dict[str, dict[str, dict[float, float]]] = {}
    for name, swings in ((NEW, what.judged), ("Y_id", what.fitted)):
        cuts = {seconds: windows(swings, seconds) for seconds in WINDOWS}
        for way, values in ways.items():
            say(f"simulating {name} with the parameters of: {way}")
            errors.setdefault(way, {})[name] = {
                seconds: window_error(what.rig, values, cut) for seconds, cut in cuts.items()
            }
    return Compared(ways, errors)


def compared_text(found: Compared) -> str:
    """Return both tables: parameters, then errors by window."""
    ways = list(found.parameters)
    names = mechanical_names(2)
    rows = [
        [name, *(f"{found.parameters[way][name]:.5g}" for way in ways),
         parameter_unit(name).replace("*", "·").replace("^2", "²")]
        for name in names
    ]  # fmt: skip
    parameters = table(["parameter", *ways, "unit"], rows)
    lines = [
        [
            f"{cells}, {seconds:g} s",
            *(f"{1e3 * found.errors[way][cells][seconds]:.3f}" for way in ways),
        ]
        for cells in (NEW, "Y_id")
        for seconds in WINDOWS
    ]
    errors = table(["RMS angle error [mrad]", *ways], lines)
    ratio = found.over_authors()
    verdict = "at the authors' error or better" if ratio <= 1.0 else "worse than the authors"
    return (
        f"{parameters}\n\n{SCALE} is fixed: without torque the scale is free.\n\n{errors}\n\n"
        f"{REPORTED}, on {NEW}: {verdict} in every window (largest ratio {ratio:.3f}; "
        f"{ROWS} {found.over_authors(ROWS):.3f})"
    )


def compared_json(found: Compared) -> dict[str, Any]:
    """Return the comparison as plain data, SI."""
    return {
        "fixed": SCALE,
        "reported": REPORTED,
        "largest_ratio_to_authors": {
            way: found.over_authors(way) for way in found.parameters if way != AUTHORS_WAY
        },
        "parameters": {way: dict(values) for way, values in found.parameters.items()},
        "rms_angle_error": {
            way: {cells: {f"{s:g} s": e for s, e in one.items()} for cells, one in cells_of.items()}
            for way, cells_of in found.errors.items()
        },
    }
