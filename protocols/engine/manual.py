"""Manual operation: a person moves one joint at a time, and only while a key is held.

A jog lasts `ENGINE.jog_hold` seconds of wall time after the newest press; a terminal repeats a held
key faster than that, so that releasing it, a broken link or a crashed screen closes the valve. The
device's own position law drives towards a point inside the joint's limits and slows down before it:
it does not pass them even if this process dies. A locked joint is held at its position, and the
guard trips if it moves by more than the tolerance. While a protocol runs, the device is busy and
this session cannot begin.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from drivers.base import OFF, OutputLaw
from protocols.engine.locking import position_law
from protocols.engine.settings import ENGINE
from protocols.steps.parts import Place
from rig.bench.guard import FREE, JOGGED, JointRole
from rig.bench.screens.commands import Command
from rig.bench.session import Bench
from rig.model import channels as ch
from rig.model.rig import Rig

log = logging.getLogger(__name__)

KIND: Final = "manual"  # of the session, as screens see it


class Manual:
    """One manual session: the moving joint, the locked joints, and the end of the jog."""

    def __init__(
        self,
        bench: Bench,
        rig: Rig,
        clock: Callable[[], float] = time.monotonic,
        *,
        volts: float = ENGINE.jog_volts,
        idle_after: float = ENGINE.manual_idle,
    ) -> None:
        self._bench, self._rig, self._clock = bench, rig, clock
        self._place = Place()
        self._jogging = Place().model_copy(update={"limit": volts})
        self._idle_after = idle_after
        self._locked: dict[int, float] = {}  # joint (0-based): where [m]
        self._jog: tuple[int, float] | None = None  # joint (0-based) and where to [m]
        self._until = -float("inf")
        self._last_command = clock()
        self._over = False
        self._laws: tuple[OutputLaw, ...] = ()
        self._piston = np.full(len(rig.joints), np.nan)
        self._columns = [
            rig.recorded.index(ch.channel(ch.PISTON, j + 1)) for j in range(len(rig.joints))
        ]

    # Commands of a person

    def accept(self, command: Command) -> str | None:
        """Accept a command; return None, or in one line why it is refused."""
        self._last_command = self._clock()
        if command.word == "abort":
            self._over = True
            return None
        handler = {"jog": self._take_jog, "lock": self._lock, "unlock": self._unlock}.get(
            command.word
        )
        if handler is None:
            return f"{command.word}: this is a manual session; expected jog, lock, unlock or abort"
        words = command.value.split()
        count = len(self._rig.joints)
        if not words or not words[0].isdecimal() or not 1 <= int(words[0]) <= count:
            return f"{command.word}: expected a joint from 1 to {count}, not {command.value!r}"
        return handler(int(words[0]) - 1, words[1:])

    def _take_jog(self, joint: int, words: list[str]) -> str | None:
        if words not in (["+"], ["-"]):
            return f"jog: expected '+' (extend) or '-' (retract), not {' '.join(words)!r}"
        if joint in self._locked:
            return f"jog: joint {joint + 1} is locked; unlock it first"
        low, high = self._rig.joints[joint].limits.piston
        margin = ENGINE.jog_margin * (high - low)
        target = high - margin if words == ["+"] else low + margin
        piston = self._piston[joint]
        if np.isfinite(piston) and (piston >= target if words == ["+"] else piston <= target):
            return (
                f"jog: joint {joint + 1} stands at {1e3 * piston:.1f} mm; a jog this way ends at "
                f"{1e3 * target:.1f} mm"
            )
        self._jog, self._until = (joint, target), self._clock() + ENGINE.jog_hold
        return None

    def _lock(self, joint: int, words: list[str]) -> str | None:
        piston = float(self._piston[joint])
        if not np.isfinite(piston):
            return f"lock: the piston position of joint {joint + 1} is not known"
        if self._jog is not None and self._jog[0] == joint:
            self._jog = None
        self._locked[joint] = piston
        return None

    def _unlock(self, joint: int, words: list[str]) -> str | None:
        if self._locked.pop(joint, None) is None:
            return f"unlock: joint {joint + 1} is not locked"
        return None

    # Actions on the bench

    def run(self) -> None:
        """Serve until a person ends the session, or no command comes for a time; raises as Bench.

        The bench zeroes the outputs at any end.
        """
        bench = self._bench
        bench.listen(self.accept)
        bench.guard([FREE] * len(self._rig.joints))
        bench.status(kind=KIND, engine=KIND, step="manual", message="manual operation")
        while not self._over:
            block = bench.exchange()
            self._piston = block.data[-1, self._columns]
            if self._clock() >= self._until:
                self._jog = None
            self._put_out()
            if self._clock() - self._last_command > self._idle_after:
                log.info("no command for %g s; the manual session ends", self._idle_after)
                break
        bench.zero_outputs()

    def _put_out(self) -> None:
        """Apply laws and roles if they have changed."""
        laws, roles = [], []
        for joint in range(len(self._rig.joints)):
            position = self._locked.get(joint)
            if position is not None:
                laws.append(position_law(self._place, position, 0.0))
                roles.append(JointRole(locked_at=position, tolerance=ENGINE.manual_tolerance))
                continue
            moving = self._jog is not None and self._jog[0] == joint
            law = position_law(self._jogging, self._jog[1], 0.0) if moving and self._jog else OFF
            laws.append(law)
            roles.append(JOGGED if moving else FREE)
        if tuple(laws) == self._laws:
            return
        self._laws = tuple(laws)
        self._bench.guard(roles)
        self._bench.apply(self._laws)
        words = [f"joint {joint + 1} locked" for joint in sorted(self._locked)]
        if self._jog is not None:
            words.insert(0, f"joint {self._jog[0] + 1} jogs to {1e3 * self._jog[1]:.1f} mm")
        message = ", ".join(words) or "every valve is closed"
        self._bench.status(phase="jog" if self._jog else "hold", message=message)
        self._bench.event("manual", self._bench.tick, message=message)
