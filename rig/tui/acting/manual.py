"""Manual operation from the screen: jog with a dead-man key, lock, unlock, depressurise."""

from __future__ import annotations

from typing import Final

from rig.tui.acting.starts import Starts
from rig.tui.pages.manual import MANUAL

AGAIN: Final = 0.08  # shortest time between two jogs of a held key [s]


class ByHand(Starts):
    """Manual operation of joints; a separate session holds the device."""

    ACTS = Starts.ACTS | {"l": "lock", "u": "unlock", "d": "depressurise"}
    jogged = -float("inf")  # when the newest jog was sent [monotonic s]

    def _manual(self, word: str) -> bool:
        """Return whether the attached session takes jogs; else show why not."""
        frame = self.link.frame
        if frame.snapshot is None or frame.over:
            self.remark = f"{word}: no manual session; Enter on page 9 starts one."
        elif frame.snapshot.kind != MANUAL:
            self.remark = f"{word}: refused while a protocol runs."
        elif self.look.page != "manual":
            self.remark = f"{word}: on page 9 only."
        else:
            return True
        return False

    def act_jog(self, key: str) -> None:
        """Move the chosen joint for a short time; a held key repeats this."""
        now = self.clock()
        if key not in ("up", "down") or now - self.jogged < AGAIN or not self._manual("jog"):
            return
        self.jogged = now
        self.command("jog", f"{self.look.joint} {'+' if key == 'up' else '-'}")

    def act_lock(self) -> None:
        """Hold the chosen joint at its position."""
        if self._manual("lock"):
            self.command("lock", str(self.look.joint), f"joint {self.look.joint} is held")

    def act_unlock(self) -> None:
        """Release the chosen joint."""
        if self._manual("unlock"):
            self.command("unlock", str(self.look.joint), f"joint {self.look.joint} is free")

    def act_enter(self) -> None:
        """Start a manual session on its page; elsewhere open the marked line."""
        frame = self.link.frame
        if self.look.page != "manual":
            super().act_enter()
        elif frame.snapshot is None or frame.over:
            self._with_rig(self._start_manual)

    def _start_manual(self, rig: str) -> None:
        text = f"Nothing moves until a key is held. Take the device of {rig} for manual operation?"
        self.confirmed("manual", text, lambda: self._job(self._words("manual", rig)))

    def act_depressurise(self) -> None:
        """Let the pressure out where the rig can, after confirmation; not during a session."""
        frame = self.link.frame
        if frame.snapshot is not None and not frame.over:
            self.remark = "depressurise: end the session that holds the bench first."
            return
        text = "Outputs to zero, then the pressure out where the rig can. Go on?"
        self._with_rig(lambda rig: self.confirmed(
            "depressurise", text, lambda: self._job(self._words("depressurise", rig))
        ))  # fmt: skip

    def _words(self, verb: str, rig: str) -> tuple[str, ...]:
        endpoint = self.browsed.endpoint
        return (verb, "--rig", rig, *(() if endpoint is None else ("--endpoint", endpoint)))
