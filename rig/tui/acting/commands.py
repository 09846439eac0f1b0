"""The operator's actions on a run: stop, command, acknowledge, reset."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Final

from rig.bench.screens.sockets import Endpoint, Snapshot
from rig.model.alarms.states import Alarm, AlarmState
from rig.model.trips import RecordingFailed
from rig.runs.runstate import EventLog
from rig.tui.following.link import Link, LinkStage
from rig.tui.jobs import VerbJob, begin, rig_of_run
from rig.tui.look import Dialog, PlotView, ScreenStyle
from rig.tui.pages.operation import in_order
from rig.tui.words import Stop, StopAnswer

CHOOSE_KEYS: Final = "↑ ↓ and Enter choose, Esc closes, SPACE stops"
MOVING: Final = ("homing", "locked", "exciting")  # states in which an abort needs no confirmation


class Commands:
    """The operator's actions on a run; each shows its result in one line."""

    ACTS: ClassVar = {
        "?": "help", "h": "hold", "z": "zoom", "+": "longer", "-": "shorter", "=": "automatic",
        "f": "filter", "/": "search", "e": "end", "c": "choose", "q": "quit",
        "t": "command", "p": "pause", "n": "skip", "x": "abort", "a": "answer",
        "k": "acknowledge", "r": "reset", "l": "lock", "u": "unlock", "d": "depressurise",
    }  # fmt: skip

    link: Link
    look: ScreenStyle
    me: str
    remark: str
    clock: Callable[[], float]
    stop_asked: Stop | None
    marked_session: Endpoint | None
    seen_alarms: frozenset[tuple[int, str]]
    reset_alarms: frozenset[tuple[int, str]]
    ask: Callable[..., None]
    view: Callable[[], PlotView]
    redraw: Callable[[], None]

    def act_stop(self) -> None:
        """Zero the outputs of the run shown, of the one marked in the list, or of the only one."""
        frame = self.link.frame
        choosing = frame.stage is LinkStage.CHOOSING
        endpoint = self.marked_session if choosing else frame.endpoint
        self.stop_asked = stop = Stop(self.clock(), endpoint)

        def answered(where: Endpoint | None, taken: bool) -> None:
            # Called by the sending thread: replacing one attribute needs no lock.
            not_taken = StopAnswer.NOWHERE if where is None else StopAnswer.NONE
            asked = replace(stop, endpoint=where, answer=StopAnswer.TAKEN if taken else not_taken)
            if self.stop_asked is stop:
                self.stop_asked = asked
                self.redraw()
            if not taken and where == frame.endpoint and frame.snapshot is not None:
                self._stop_device(asked, frame.snapshot)

        self.link.stop(endpoint, answered)
        if choosing:
            self.link.choose(endpoint)

    def _stop_device(self, asked: Stop, snapshot: Snapshot) -> None:
        """Zero the outputs of the bench of a run that does not answer, by the verb `stop`."""
        if not snapshot.wire:
            return

        def changed(job: VerbJob) -> None:
            if self.stop_asked is None or self.stop_asked.at != asked.at:
                return  # another stop was asked since
            ended = StopAnswer.FAILED if job.code else StopAnswer.ZEROED
            answer = StopAnswer.DEVICE if job.code is None else ended
            self.stop_asked = replace(asked, answer=answer, reason=job.ended)
            self.redraw()

        rig = rig_of_run(snapshot.run, snapshot.rig)
        begin(("stop", "--rig", rig, "--endpoint", snapshot.wire), changed)

    # Commands

    def command(self, word: str, value: str = "", done: str = "") -> None:
        """Send a command to the run, or show why none can be sent."""
        endpoint = self.link.frame.endpoint
        if self._may_command(word) and endpoint is not None:
            self.remark = f"{word}: asking ..."
            self.link.ask(endpoint, word, value, lambda no: self._show_answer(word, done, no))

    def _may_command(self, word: str) -> bool:
        """Return whether a run is attached that this screen may command; else show why not."""
        frame = self.link.frame
        if frame.endpoint is None or frame.snapshot is None:
            self.remark = f"{word}: no run is attached."
        elif frame.over:
            self.remark = f"{word}: the run is over ({frame.snapshot.state})."
        elif frame.snapshot.holder not in ("", self.me) and word not in ("take", "acknowledge"):
            self.remark = f"{word}: read-only, {frame.snapshot.holder} is in command; t takes over."
        else:
            return True
        return False

    def _show_answer(self, word: str, done: str, refusal: str | None) -> None:
        answer = done or "taken" if refusal is None else refusal.removeprefix(f"{word}: ")
        self.remark = f"{word}: {answer}"
        self.redraw()

    def commanded(self, word: str, text: str) -> None:
        """Send a command after confirmation; show why if it cannot be sent."""
        if self._may_command(word):
            self.confirmed(word, text, lambda: self.command(word))

    def confirmed(self, title: str, text: str, act: Callable[[], None]) -> None:
        """Run an action after confirmation."""

        def chosen(answer: str) -> None:
            if answer == "yes":
                act()

        self.ask(Dialog(title, (text,), choices=("no", "yes"), keys=CHOOSE_KEYS), chosen)

    def act_command(self) -> None:
        """Take the controls, or release them; from another screen only after confirmation."""
        snapshot = self.link.frame.snapshot
        holder = snapshot.holder if snapshot is not None else ""
        if holder == self.me:
            self.command("release", done="this screen is read-only now")
        elif holder:
            text = f"{holder} is in command. Take the controls? It will see that you did."
            self.confirmed("take the controls", text, self._take)
        else:
            self._take()

    def _take(self) -> None:
        self.command("take", done="this screen is in command")

    def act_pause(self) -> None:
        """Pause at the next safe point, or resume after confirmation, since the bench will move."""
        snapshot = self.link.frame.snapshot
        if snapshot is not None and snapshot.engine == "paused":
            text = "The bench will move: places and locks are made anew. Resume?"
            self.commanded("resume", text)
        else:
            self.command("pause", done="taken; it comes at the end of the record")

    def act_skip(self) -> None:
        """Skip the present step after confirmation."""
        snapshot = self.link.frame.snapshot
        step = snapshot.step if snapshot is not None else ""
        text = f"Leave step {step!r} and go on with the next one?"
        self.commanded("skip", text)

    def act_abort(self) -> None:
        """End the run: at once where the bench moves, after confirmation at rest."""
        snapshot = self.link.frame.snapshot
        if snapshot is None or snapshot.engine in MOVING:
            self.command("abort")
        else:
            text = "Outputs are at zero. End the run for good? What was measured is kept."
            self.commanded("abort", text)

    def act_answer(self) -> None:
        """Answer the protocol's question."""
        snapshot = self.link.frame.snapshot
        if snapshot is None or not snapshot.prompt or self.link.frame.over:
            self.remark = "answer: nothing is asked now."
            return
        choices = tuple(snapshot.answers)
        dialog = Dialog("answer", (snapshot.prompt,), choices=choices, keys=CHOOSE_KEYS)
        self.ask(dialog, lambda answer: self.command("answer", answer, f"{answer!r} taken"))

    # Alarms

    def _marked_alarm(self) -> Alarm | None:
        """Return the alarm marked on the alarm page; elsewhere the most urgent one."""
        listed = [alarm for alarm, _ in in_order(self.view())]
        if not listed:
            return None
        at = self.look.marked if self.look.page == "alarms" else 0
        return listed[min(at, len(listed) - 1)]

    def act_acknowledge(self) -> None:
        """Acknowledge an alarm."""
        alarm, frame = self._marked_alarm(), self.link.frame
        if alarm is None or frame.snapshot is None:
            self.remark = "acknowledge: no alarm stands."
        elif alarm.acknowledged:
            self.remark = f"acknowledge: {alarm.key} is acknowledged already."
        elif not frame.over:
            self.command("acknowledge", alarm.key, alarm.key)
        else:
            # The run takes no more commands: record it in this screen and in the run's log.
            self.seen_alarms |= {(frame.snapshot.pid, alarm.key)}
            self._note("alarm acknowledged", alarm)
            self.remark = f"acknowledge: {alarm.key}"

    def _note(self, event: str, alarm: Alarm) -> None:
        snapshot = self.link.frame.snapshot
        folder = Path(snapshot.run) if snapshot is not None and snapshot.run else None
        if folder is None or not folder.is_dir():
            return
        with suppress(RecordingFailed):
            log = EventLog(folder)
            log.append(event, alarm.tick, {"alarm": alarm.key, "by": self.me})
            log.close()

    def act_reset(self) -> None:
        """Reset a latched alarm, separately from its acknowledgement and with a reason."""
        alarm, frame = self._marked_alarm(), self.link.frame
        snapshot = frame.snapshot
        if alarm is None or snapshot is None or alarm.state is not AlarmState.LATCHED:
            self.remark = "reset: the marked alarm is not latched; it ends by itself."
        elif not alarm.acknowledged:
            self.remark = f"reset: acknowledge {alarm.key} first (k); to reset is another act."
        elif not frame.over:
            self.remark = "reset: the run still holds the bench; wait for its end."
        else:
            # Of the run that is shown now: another may be attached before the reason is given.
            self.ask_reason(alarm.sentence, lambda why: self._reset(snapshot, alarm, why))

    def ask_reason(self, question: str, reset: Callable[[str], None]) -> None:
        """Ask what was found and done at a trip, then reset with that reason."""

        def answered(reason: str) -> None:
            if reason.strip():
                reset(reason.strip())
            else:
                self.remark = "reset: a reset needs a reason; nothing was reset."

        body = (question, "", "What was found and done? It is kept with the trip.")
        keys = "Enter resets device and bench, Esc closes"
        self.ask(Dialog("reset", body, text="", keys=keys), answered)

    def _reset(self, snapshot: Snapshot, alarm: Alarm, reason: str) -> None:
        rig, pid = rig_of_run(snapshot.run, snapshot.rig), snapshot.pid
        self.remark = "reset: asking the device ..."

        def changed(job: VerbJob) -> None:
            if job.code == 0:
                self.reset_alarms |= {(pid, alarm.key)}
                self.remark = f"reset: {job.output.strip()}"
            elif job.code is not None:
                self.remark = f"reset: {job.ended}"
            self.redraw()

        wire = ("--endpoint", snapshot.wire) if snapshot.wire else ()
        begin(("reset", "--rig", rig, *wire, "--reason", reason), changed)
