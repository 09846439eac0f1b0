"""The generated part of a mock-up unit: sizes, constants and terms of one model as C (model.h)."""

from __future__ import annotations

from collections.abc import Iterable

from analysis.simulation import simulate as sim
from analysis.simulation.fmu.kernel_source import KERNEL_KINDS, KernelLibrary
from analysis.simulation.fmu.variables import UnitVariables
from analysis.simulation.model import Model
from analysis.simulation.settings import SIMULATION
from analysis.terms import base

_ENUMERATIONS = (
    ("PREPARE", "CONTRIBUTE"),
    ("TIME", "P_S", "P_TANK", "TEMPERATURE"),
    ("Q", "QD", "THETA", "G", "S", "SD", "U", "P_CAP", "P_ROD", "V_CAP", "V_ROD"),
    ("TORQUE", "FLOW_CAP", "FLOW_ROD", "COMP_CAP", "COMP_ROD"),
)
_GEOMETRY = "PIN_A PIN_C MID OFFSET AREA_CAP AREA_ROD DEAD_CAP DEAD_ROD STROKE GAIN"


def model_header(model: Model, variables: UnitVariables, token: str) -> str:
    """Return model.h of a model whose every parameter is identified.

    `token` is what the model description and the library must agree on. Raises InputError where a
    parameter is not identified, UntranslatableKernelError where a term has no translation.
    """
    ready = sim.compiled(model)
    joints, hidden = len(model.rig.joints), 0
    library = KernelLibrary()
    calls, packs = [], []
    for m, used in enumerate(model.terms):
        par = used.term.pack(model.rig, model.values, used.shape)
        function = library.add(used.term.kernel.function, KERNEL_KINDS)
        state, hidden = hidden, hidden + used.term.hidden(model.rig)
        condition = "" if used.term.prepares else "if (phase == CONTRIBUTE) "
        packs.append(f"static double par{m}[] = {_braces(par)}; /* {used.term.name} */")
        arguments = f"phase, bench, x, z + {state}, par{m}, out, M, dz + {state}"
        calls.append(f"    {condition}{function}({arguments});")
    sizes = {
        "N": joints,
        "HIDDEN": hidden,
        "INPUTS": 2 + joints,
        "X_ROWS": base.X_ROWS,
        "OUT_ROWS": base.OUT_ROWS,
        "OUTPUTS_PER_JOINT": 4,
        "CONSTANTS": len(variables.constants),
    }
    numbers = {
        "RTOL": SIMULATION.relative_tolerance,
        "ATOL_ANGLE": SIMULATION.angle_tolerance,
        "ATOL_RATE": ready.rate_tolerance,
        "ATOL_PRESSURE": SIMULATION.pressure_tolerance,
        "ATOL_HIDDEN": SIMULATION.state_tolerance,
        "FIRST_STEP": 0.2 / model.rig.sample_rate,
    }
    lines = [
        "/* Generated from a model file: do not edit. SI units. */",
        f'#define TOKEN "{token}"',
        *(f"#define {name} {value}" for name, value in sizes.items()),
        *(f"#define {name} {_number(value)}" for name, value in numbers.items()),
        *(
            "enum { " + ", ".join(f"{n} = {getattr(base, n)}" for n in names) + " };"
            for names in _ENUMERATIONS
        ),
        "enum { " + ", ".join(_GEOMETRY.split()) + " };",
        "struct tuple2 { double v[2]; };",
        "struct tuple3 { double v[3]; };",
        f"static const double GEOMETRY[N][{len(_GEOMETRY.split())}] = {_rows(ready.geometry)};",
        f"static const double DEFAULT_INPUT[INPUTS] = {_braces(variables.default_inputs)};",
        f"static const double DEFAULT_START[N][4] = {_rows(variables.default_start)};",
        "static const double CONSTANT[CONSTANTS + 1] = "
        f"{_braces([c.start for c in variables.constants] or [0.0])};",
        "",
        library.source,
        *packs,
        "",
        "static void contribute(int phase, double *bench, double *x, double *z, double *out,",
        "                       double *M, double *dz)",
        "{",
        *calls,
        "}",
        "",
    ]
    return "\n".join(lines)


def _number(value: float) -> str:
    return repr(float(value))


def _braces(values: Iterable[float]) -> str:
    return "{" + (", ".join(map(_number, values)) or "0.0") + "}"


def _rows(table: Iterable[Iterable[float]]) -> str:
    return "{" + ", ".join(_braces(row) for row in table) + "}"
