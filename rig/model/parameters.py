"""Names and units of the parameters of the model (docs/method.md, docs/n-joints.md).

A planar chain has R_ii, R_ij (i<j), W_i, Fv_i; for two joints
M1 = R11 + R22, M2 = R22, for one M1 = R11.
"""

from __future__ import annotations

MAX_JOINTS = 9  # R_ij is written with two digits
GAIN_SIGNS = ("pp", "pm", "mp", "mm")


def inertia_names(joints: int) -> tuple[str, ...]:
    """Name the inertia parameters of a planar chain of `joints` links."""
    if joints == 1:
        return ("M1",)
    if joints == 2:
        return ("M1", "M2", "R12")
    return tuple(f"R{i}{j}" for i in range(1, joints + 1) for j in range(i, joints + 1))


def mechanical_names(joints: int) -> tuple[str, ...]:
    """Name the mechanical parameters: inertia, then Fv_i, then W_i."""
    each = range(1, joints + 1)
    return (*inertia_names(joints), *(f"Fv{i}" for i in each), *(f"W{i}" for i in each))


def gain_names(joint: int) -> tuple[str, ...]:
    """Name the four flow gains of joint `joint` (1-based): chamber p|m, then spool sign p|m."""
    return tuple(f"C_{signs}_{joint}" for signs in GAIN_SIGNS)


def fluid_names(joints: int) -> tuple[str, ...]:
    """Name the fluid parameters: b, then four gains per joint."""
    return ("b", *(name for i in range(1, joints + 1) for name in gain_names(i)))


def parameter_names(joints: int) -> tuple[str, ...]:
    """Name all parameters of the baseline model; raises ValueError beyond nine joints."""
    if not 1 <= joints <= MAX_JOINTS:
        raise ValueError(f"a rig has 1 to {MAX_JOINTS} joints, not {joints}")
    return (*mechanical_names(joints), *fluid_names(joints))


def is_positive(name: str) -> bool:
    """Return whether a baseline parameter is above 0 in every machine: b, gains, M_i, R_ii."""
    return name[0] in "bCM" or (name[0] == "R" and name[1] == name[2])


def parameter_unit(name: str) -> str:
    """Return the SI unit of a baseline parameter, in the form pint reads."""
    if name == "b":
        return "Pa"
    if name.startswith("C_"):
        return "m^3/(s*V*Pa^0.5)"
    if name.startswith("Fv"):
        return "N*m*s/rad"
    return "kg*m" if name.startswith("W") else "kg*m^2"
