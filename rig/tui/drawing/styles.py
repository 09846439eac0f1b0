"""Colours of the screen: grey while all is normal, one saturated colour for one meaning.

Each meaning also has a word and a symbol, so that nothing is lost without colours.
"""

from __future__ import annotations

from typing import Final

PLAIN: Final = ""
STRONG: Final = "bold"
DIM: Final = "bright_black"
NORMAL: Final = "reverse"  # a state that needs no action
ALARM: Final = "bold bright_white on red"  # a limit was exceeded, or the state is unknown
ALARM_TEXT: Final = "bold red"
# Black is not bold: many terminals draw bold black as grey, illegible on yellow and cyan.
WARN: Final = "black on yellow"  # close to a limit, old, or ended early
WARN_TEXT: Final = "bold yellow"
ASK: Final = "black on cyan"  # waits for the operator
ASK_TEXT: Final = "bold cyan"
STALE: Final = "italic bright_black"
TRIP_LINE: Final = "red"
WARN_LINE: Final = "yellow"

SYMBOLS: Final = {"normal": "●", "ended": "□", "ask": "?", "warn": "▲", "alarm": "■"}
LEVELS: Final = {"normal": NORMAL, "ended": NORMAL, "ask": ASK, "warn": WARN, "alarm": ALARM}
