"""Numbers and names as text: significant digits that fit the interval, display units, meanings.

A value is written to the decimal that its 95 % interval allows, with at least three significant
digits; a missing value is a dash, an unbounded one the sign of infinity.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import PurePosixPath

from analysis.report.settings import REPORT
from rig.model import units
from rig.model.parameters import GAIN_SIGNS
from rig.model.units import DisplayUnit, typeset

DASH = "—"
MINUS = "−"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def display_unit(si: str) -> DisplayUnit:
    """Return the display unit of an SI unit as pint writes it; an unknown one unchanged."""
    shown = units.display_unit(si, units.RESULTS)
    return replace(shown, text=typeset(shown.text))


def _tidy(text: str) -> str:
    """Set a typographic minus, and none before a zero."""
    if text.startswith("-") and not any(c in "123456789" for c in text):
        text = text[1:]
    return text.replace("-", MINUS)


def significant(value: float | None, digits: int = 3, scale: float = 1.0) -> str:
    """Write scale * value with `digits` significant digits; in powers of ten if large or small."""
    if value is None or math.isnan(value):
        return DASH
    value *= scale
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    if not -4 <= exponent < 6:
        mantissa = f"{value:.{digits - 1}e}".partition("e")[0]
        return f"{_tidy(mantissa)}×10{str(exponent).translate(_SUPERSCRIPT)}"
    return _tidy(f"{round(value, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}")


def percent(value: float | None, digits: int = 2, *, signed: bool = False) -> str:
    """Write a percentage without the % sign; with `signed`, a plus is written out."""
    text = significant(value, digits)
    return f"+{text}" if signed and value is not None and value > 0 and text != DASH else text


def column_percent(value: float | None, *, signed: bool = False) -> str:
    """Write a percentage for a column: three decimals below one, two below a hundred."""
    if value is None or not math.isfinite(value) or abs(value) >= 100:
        return percent(value, 3, signed=signed)
    text = fixed(value, 3 if abs(value) < 1 else 2)
    return f"+{text}" if signed and value > 0 and text.strip("0.") else text


def fit(value: float | None) -> str:
    """Write a FIT ratio as the paper does, one decimal; beyond 10 000 two digits suffice."""
    if value is None or not math.isfinite(value):
        return DASH
    return significant(value, 2) if abs(value) >= 9999.5 else _tidy(f"{value:.1f}")


def decimals(value: float, half_width: float) -> int:
    """Return the number of decimals for a value with this half interval (3 to 6 digits in all)."""
    if value == 0 or not math.isfinite(value):
        return 2
    leading = math.floor(math.log10(abs(value)))
    least, most = 2 - leading, REPORT.most_digits - 1 - leading
    if not math.isfinite(half_width) or half_width <= 0:
        return max(least, 0)
    exponent = math.floor(math.log10(half_width))
    # Two digits of an interval that begins with 1 or 2, where rounding to one would be coarse.
    needed = -exponent + (1 if half_width / 10.0**exponent < 3 else 0)
    return max(min(max(needed, least), most), 0)


def fixed(value: float | None, places: int, scale: float = 1.0) -> str:
    """Write scale * value with `places` decimals; dash and infinity as in `significant`."""
    if value is None or not math.isfinite(value):
        return significant(value)
    return _tidy(f"{scale * value:.{places}f}")


def constant(value: float) -> str:
    """Write a constant without trailing zeros."""
    return f"{value:.6g}".replace("-", MINUS)


def half_width(half: float, places: int) -> str:
    """Write half an interval to the value's decimals, in powers of ten if those show only zeros."""
    if not math.isfinite(half) or round(half, places) == 0:
        return significant(half, 1)
    return fixed(half, places)


def count(number: int, noun: str, plural: str = "") -> str:
    """Write ``1 record`` or ``30 records``."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}".replace(",", " ")


def folder_name(source: str) -> str:
    """Return the last part of a path of either kind, so that a report shows no directories."""
    name = PurePosixPath(source.replace("\\", "/")).name
    return name or source


_GAIN = re.compile(rf"^C_({'|'.join(GAIN_SIGNS)})_(\d+)$")
_SIDE = {"p": "cap side", "m": "rod side"}
_SPOOL = {"p": "spool +", "m": f"spool {MINUS}"}


def meaning(name: str, joints: int) -> str:
    """Return a parameter's meaning in a few words; '' for one that is not of the baseline."""
    if name == "b":
        return "bulk modulus of the oil, all joints"
    if gain := _GAIN.match(name):
        chamber, spool = gain[1][0], gain[1][1]
        return f"flow gain, joint {gain[2]}, {_SIDE[chamber]}, {_SPOOL[spool]}"
    match = re.match(r"^(M|R|W|Fv)(\d)(\d?)$", name)
    if match is None or (match[1] == "M" and joints > 2):
        return ""
    kind, i, j = match[1], match[2], match[3]
    texts = {
        "M": f"inertia about joint {i}",
        "R": f"inertia of link {i}" if i == j else f"inertia coupling, links {i} and {j}",
        "W": f"gravity, link {i} and the links beyond",
        "Fv": f"viscous friction, joint {i}",
    }
    return texts[kind]
