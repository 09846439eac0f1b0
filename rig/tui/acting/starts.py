"""Verbs started from the page of runs, and manual operation: jog with a dead-man key, lock."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Final

from rig.runs.listing.summary import RunSummary
from rig.tui.acting.commands import CHOOSE_KEYS, Commands
from rig.tui.browse import TABS, BrowserState, read_disk
from rig.tui.jobs import VerbJob, begin, rig_of_run
from rig.tui.look import Dialog
from rig.tui.pages.levels import MANUAL
from rig.tui.recorded_run import STORED, RunLog, RunTrace, read_log, read_trace

REPORT: Final = "trace.html"
JOG_INTERVAL: Final = 0.08  # shortest time between two jogs of a held key [s]


def display_here() -> bool:
    """Return whether a graphical display is present; a text browser would take the terminal."""
    other = sys.platform in ("darwin", "win32")
    return other or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


class Starts(Commands):
    """Starting of verbs, each a process that outlives the screen; manual operation of joints."""

    browsed: BrowserState
    open_page: Callable[[str], None]
    is_web: bool
    jogged = -float("inf")  # when the newest jog was sent [monotonic s]
    deliver_binary: Callable[..., str | None]

    def read_folder(self) -> None:
        """Read the folder in the background."""
        if self.browsed.reading:
            return
        snapshot = self.link.frame.snapshot
        rig = self.browsed.rig or (snapshot.rig if snapshot is not None else "")
        self.browsed = replace(self.browsed, reading=True, rig=rig)

        def read() -> None:
            browsed = read_disk(self.browsed)
            # Keep what was started or opened meanwhile.
            now = self.browsed
            self.browsed = replace(
                now, protocols=browsed.protocols, runs=browsed.runs, queue=browsed.queue,
                paused=browsed.paused, trouble=browsed.trouble, reading=False,
            )  # fmt: skip

        self._in_background(read)

    def _in_background(self, read: Callable[[], None]) -> None:
        """Read from the disk in a thread, then draw."""

        def work() -> None:
            read()
            self.redraw()

        threading.Thread(target=work, name="bramah-read", daemon=True).start()

    def act_tab(self, step: int) -> None:
        """Open the next tab."""
        self.browsed = replace(self.browsed, tab=(self.browsed.tab + step) % len(TABS))
        self.look = replace(self.look, marked=0, offset=0)

    def act_enter(self) -> None:
        """Start a manual session on its page; on the page of runs offer what the line allows."""
        browsed, frame = self.browsed, self.link.frame
        if self.look.page == "manual" and (frame.snapshot is None or frame.over):
            self._with_rig(self._start_manual)
        if self.look.page != "runs" or not browsed.lines:
            return
        index = min(self.look.marked, browsed.lines - 1)
        if browsed.name == "protocols":
            name = browsed.protocols[index]
            self._offer(name, {
                "check on the twin": lambda: self._with_rig(
                    lambda rig: self._job(("check", name, "--rig", rig))
                ),
                "start on the bench": lambda: self._start_run(name),
            })  # fmt: skip
        elif browsed.name == "runs":
            self._offer_run(browsed.runs[index])
        else:
            item = browsed.queue[index]
            page = browsed.folder / "night.html"
            words = ("queue", "page", "--out", str(page))
            self._offer(f"item {item.id} {item.job.name}: {item.state} {item.reason}", {
                "write the page of the night": lambda: self._job(words),
                "open the page of the night": lambda: self._open(page),
            })  # fmt: skip

    def _offer(self, title: str, acts: dict[str, Callable[[], None]]) -> None:
        dialog = Dialog(title, choices=tuple(acts), keys=CHOOSE_KEYS)
        self.ask(dialog, lambda chosen: acts[chosen]())

    def _offer_run(self, run: RunSummary) -> None:
        path = str(run.path)
        others = [
            other for other in self.browsed.runs if other.path != run.path and other.records > 0
        ]
        report, stored = run.path / REPORT, run.path / STORED
        shared_report = run.path.parent / REPORT  # of a set of runs, as the demo writes it

        def choose_held_out() -> None:
            acts: dict[str, Callable[[], None]] = {}
            for other in others:
                words = ("trace", path, "--holdout", str(other.path), "--report", str(report),
                         "--json", str(stored))  # fmt: skip
                acts[other.path.name] = lambda words=words: self._job(words)  # type: ignore[misc]
            if acts:
                self._offer("trace: held-out records of", acts)
            else:
                self.remark = "trace: it needs a second run, of other records, to judge by."

        acts: dict[str, Callable[[], None]] = {
            "identify its parameters": lambda: self._job(("identify", path, "--json", "-")),
            "trace what its model lacks": choose_held_out,
            "open its report": lambda: self._open(
                report if report.is_file() or not shared_report.is_file() else shared_report
            ),
            "read its log": lambda: self._open_log(run.path),
            "before and after of its trace": lambda: self._open_trace(run.path),
        }
        if run.state == "interrupted":
            acts = {"recover what was recorded": lambda: self._job(("recover", path)), **acts}
        if run.state == "tripped":
            acts = {"reset the trip that it left": lambda: self._reset_run(run), **acts}
        self._offer(run.path.name, acts)

    def _open_log(self, folder: Path) -> None:
        """Show the log of a run, read in the background."""
        self.browsed = replace(self.browsed, log=RunLog(folder, reading=True))
        self.open_page("run log")

        def read() -> None:
            log = read_log(folder)  # slow: `browsed` may change meanwhile
            self.browsed = replace(self.browsed, log=log)

        self._in_background(read)

    def _open_trace(self, folder: Path) -> None:
        """Show the stored trace of a run."""
        self.browsed = replace(self.browsed, trace=RunTrace(folder, reading=True))
        self.open_page("run trace")
        self.look = replace(self.look, channel=0)

        def read() -> None:
            trace = read_trace(folder)  # slow: `browsed` may change meanwhile
            self.browsed = replace(self.browsed, trace=trace)

        self._in_background(read)

    def _reset_run(self, run: RunSummary) -> None:
        """Reset the bench that a run tripped, with a reason."""
        rig = rig_of_run(str(run.path), run.rig)

        self.ask_reason(
            run.message, lambda why: self._job(("reset", "--rig", rig, "--reason", why))
        )

    def _open(self, page: Path) -> None:
        if not page.is_file():
            self.remark = f"{page}: there is no such page yet; it is written by the line above."
            return
        if self.is_web:  # the browser that shows the screen, not one of the bench's computer
            self.deliver_binary(page, open_method="browser", mime_type="text/html")
            self.remark = f"opened {page} in another tab"
            return
        if not display_here():
            self.remark = f"no display here; the page is {page.absolute()}"
            return
        opened = webbrowser.open(page.absolute().as_uri())
        self.remark = f"opened {page}" if opened else f"no browser here; open {page.absolute()}"

    def _with_rig(self, act: Callable[[str], None]) -> None:
        """Run an action with the known rig, or ask for one."""
        if self.browsed.rig:
            act(self.browsed.rig)
            return

        def use_rig(text: str) -> None:
            self.browsed = replace(self.browsed, rig=text.strip())
            if text.strip():
                act(text.strip())

        body = ("The rig's shipped name, or the path of its file.",)
        self.ask(Dialog("rig", body, text="", keys="Enter takes it, Esc closes"), use_rig)

    def _start_run(self, protocol: str) -> None:
        frame = self.link.frame
        if frame.live and frame.snapshot is not None:
            self.remark = f"start: run {frame.snapshot.run} holds the bench; wait for its end."
            return
        self._with_rig(lambda rig: self._confirm_start(protocol, rig))

    def _confirm_start(self, protocol: str, rig: str) -> None:
        name = Path(protocol).name.removesuffix(".yaml").removesuffix(".protocol")
        out = self.browsed.folder / f"{name}-{datetime.now():%Y-%m-%d-%H%M%S}"
        words = ["run", protocol, "--rig", rig, "--out", str(out), "--unattended"]
        if self.browsed.endpoint is not None:
            words += ["--endpoint", self.browsed.endpoint]

        def start_run() -> None:
            self._job(tuple(words))
            self.remark = "start: proved on the twin first; this screen attaches as soon as it runs"

        text = f"THE BENCH MOVES, once {protocol} is proved on the twin of {rig}. Start?"
        self.confirmed("start", text, start_run)

    def _job(self, words: tuple[str, ...]) -> None:
        job = self.browsed.job
        if job is not None and job.code is None and words[0] != "run":
            self.remark = f"{words[0]}: wait for the end of `{job.title}`."
            return
        self.look = replace(self.look, offset=0)

        def changed(job: VerbJob) -> None:
            if words[0] in ("run", "manual"):
                self.link.expect(job.pid)
            self.browsed = replace(self.browsed, job=job)
            if job.code is not None:
                self.remark = f"{job.words[0]}: {job.ended}"
                self.read_folder()
            self.redraw()

        begin(words, changed)

    # Manual operation

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
        if key not in ("up", "down") or now - self.jogged < JOG_INTERVAL or not self._manual("jog"):
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
