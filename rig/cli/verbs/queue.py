"""The `queue` verbs: a queue of runs on disk, and the process that runs them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli import options as opt
from rig.cli.text.output import print_result, progress, table

if TYPE_CHECKING:
    from rig.queue.items import Item, QueueJob
    from rig.queue.store import QueueStore

QueueOption = Annotated[
    Path | None,
    typer.Option("--queue", help="The queue's file.  [default: queue.sqlite in BRAMAH_STATE]"),
]
PROOF_KEYS = ("protocol", "rig", "seconds", "ok", "twin", "model", "warning")  # kept of a proof
WAIT_HOURS = 12  # longest wait [h] for --when without --not-after
ItemArgument = Annotated[int, typer.Argument(help="The item's number.")]


def _user() -> str:
    from rig.runs.runstate import user_name

    return user_name()


def _path(queue: Path | None) -> Path:
    from rig.bench.latch import state_folder

    return (queue or state_folder() / "queue.sqlite").absolute()


def _open_queue(queue: Path | None, *, create: bool = False) -> QueueStore:
    from rig.queue.store import QueueStore

    return QueueStore(_path(queue), create=create)


def _print_item(item: Item, json: Path | None, outcome: str) -> None:
    print_result(json, item.as_dict(), f"item {item.id} {item.job.name}: {outcome}")


def _absolute(name: str, shipped: tuple[str, ...]) -> str:
    """Return a shipped name, or a file's absolute path: the runner starts in another folder."""
    return name if name in shipped else str(Path(name).expanduser().absolute())


def _arguments(*options: tuple[str, object]) -> tuple[str, ...]:
    return tuple(
        str(part) for name, value in options if value is not None for part in (name, value)
    )


def queue_group() -> None:
    """Keep a queue of runs on disk and run it, one item at a time.

    Example: bramah queue list
    """


def add(
    context: typer.Context,
    protocol: opt.ProtocolArgument,
    rig: opt.RigOption,
    out: Annotated[
        Path | None, typer.Option(help="The run folder.  [default: runs/NUMBER-PROTOCOL here]")
    ] = None,
    endpoint: opt.EndpointOption = None,
    repeats: opt.RepeatsOption = None,
    duration: opt.DurationOption = None,
    amplitude_scale: opt.ScaleOption = 1.0,
    wave_seed: opt.WaveSeedOption = None,
    step: opt.StepOption = None,
    priority: Annotated[
        int, typer.Option(min=-100, max=100, help="Items of higher priority start first.")
    ] = 0,
    not_before: Annotated[
        str | None, typer.Option(help="Earliest start: 22:30 (the next one) or 2026-03-01T22:30.")
    ] = None,
    not_after: Annotated[
        str | None,
        typer.Option(
            help=f"Latest start; then it expires.  [default: with --when, {WAIT_HOURS} h later]"
        ),
    ] = None,
    after: Annotated[
        int | None, typer.Option(help="Start only after this earlier item has ended.")
    ] = None,
    wanted: Annotated[
        str | None,
        typer.Option(
            "--if",
            help="Condition on the item of --after: a state (done, failed, ..., ended: any) or an "
            "identified value, such as 'b.rsd < 0.5 %'.  [default: done]",
        ),
    ] = None,
    when: Annotated[
        str | None,
        typer.Option(help="Wait for a measured condition, such as 'oil_temperature > 40 degC'."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the item in lists.", callback=opt.one_line)
    ] = None,
    operator: Annotated[
        str | None, typer.Option(help="Name written into the run.", callback=opt.one_line)
    ] = None,
    model: opt.ModelOption = None,
    nominal: opt.NominalOption = False,
    identify: Annotated[bool, typer.Option(help="Identify from the run when it is done.")] = True,
    queue: QueueOption = None,
    json: opt.JsonOption = None,
) -> None:
    """Prove an item on the twin and queue it; further options of `bramah check` follow after `--`.

    Example: bramah queue add lock-and-excite --rig shinshu-2dof --repeats 2 --not-before 22:00
    """
    from protocols.files.library import shipped_names
    from rig.cli.execution.device import bench_at
    from rig.model.parse import InputError
    from rig.queue.items import DONE, QueueJob, channel_condition
    from rig.runs.rigs import shipped_rigs
    from rig.runs.store import refuse_occupied

    changed = _arguments(
        ("--repeats", repeats), ("--duration", duration), ("--wave-seed", wave_seed),
        ("--amplitude-scale", None if amplitude_scale == 1.0 else amplitude_scale),
        *(("--step", step_name) for step_name in step or ()),
        ("--model", None if model is None else model.absolute()),
    )  # fmt: skip
    changed += ("--nominal",) if nominal else ()
    if wanted is not None and after is None:
        raise InputError(
            "--if is a condition on an earlier item: expected --after NUMBER beside it"
        )
    bench = bench_at(rig, endpoint)
    if when is not None:
        channel_condition(when, {name: bench.range_of(name) for name in bench.channels})
    times = _times(not_before, not_after, when, datetime.now(UTC))
    with _open_queue(queue, create=True) as store:
        title = name or Path(protocol).stem
        folder = (out or Path("runs", f"{store.next_number():03d}-{title}")).absolute()
        refuse_occupied(folder)
        job = QueueJob(
            protocol=_absolute(protocol, shipped_names()),
            rig=_absolute(rig, shipped_rigs()),
            out=str(folder),
            name=title,
            endpoint=endpoint or "",
            options=(*changed, *context.args),
            run_options=("--operator", operator or _user()),
            after=after,
            wanted=wanted or DONE,
            when=when or "",
            identify=identify,
            **times,
        )
        if after is not None:
            _refuse_condition(store.item(after), wanted or DONE)
        progress(f"checking {title} on the twin")
        item = store.add(job, priority, _proof(job))
    seconds = item.proof.get("seconds")
    length = "" if seconds is None else f", about {seconds / 60.0:.1f} min of the device's time"
    if item.proof.get("warning"):
        progress(f"WARNING: {item.proof['warning']}")
    elif "twin" in item.proof:
        progress(f"the twin uses {item.proof['twin']}")
    _print_item(item, json, f"queued{length}; it will run into {item.job.out}")


def _proof(job: QueueJob) -> dict[str, Any]:
    """Return what the queue keeps of a `bramah check`; raises InputError or WorkError."""
    from rig.cli.errors import BAD_INPUT, WorkError
    from rig.model.parse import InputError
    from rig.queue.processes import BRAMAH, call
    from rig.queue.runner import QueueSettings

    answer = call(BRAMAH, job.check_words(), QueueSettings().check_seconds)
    if answer.code == BAD_INPUT:
        raise InputError(f"not queued: {answer.reason}")
    if answer.code != 0:
        raise WorkError(f"not queued: {answer.reason}")
    proof = answer.as_json()
    return {key: proof[key] for key in PROOF_KEYS if isinstance(proof, dict) and key in proof}


def _times(
    not_before: str | None, not_after: str | None, when: str | None, now: datetime
) -> dict[str, str]:
    """Return when an item may start, as ISO 8601; raises InputError if it never could."""
    from rig.model.parse import InputError
    from rig.queue.items import parse_time

    begin = parse_time(not_before, now, "--not-before") if not_before else None
    end = parse_time(not_after, now, "--not-after") if not_after else None
    earliest = max(begin or now, now)
    if end is not None and end <= earliest:
        raise InputError(
            f"--not-after {not_after}: is {_local(end.isoformat())}, but the item cannot start "
            f"before {_local(earliest.isoformat())}; name a later time, such as 2026-03-01T22:30"
        )
    if end is None and when is not None:  # an item whose condition is never met expires
        end = (begin or now) + timedelta(hours=WAIT_HOURS)
    return {
        "not_before": begin.isoformat() if begin else "",
        "not_after": end.isoformat() if end else "",
    }


def _refuse_condition(earlier: Item, wanted: str) -> None:
    """Raise InputError for a condition `wanted` that an earlier item can never meet."""
    from rig.model.parameters import parameter_names
    from rig.model.parse import InputError
    from rig.queue.items import ENDED, OVER, check_wanted
    from rig.runs.rigs import load_bench

    if wanted in (ENDED, *OVER):
        return
    check_wanted(wanted, parameter_names(len(load_bench(earlier.job.rig).joints)))
    if not earlier.job.identify:
        raise InputError(
            f"--if {wanted!r}: item {earlier.id} was added with --no-identify, so that no "
            "parameter is known after it; give --if a state, such as done"
        )


def _line(item: Item) -> tuple[str, ...]:
    waits = [f"not before {_local(item.job.not_before)}"] if item.job.not_before else []
    waits += [f"after {item.job.after} if {item.job.wanted}"] if item.job.after else []
    waits += [f"when {item.job.when}"] if item.job.when else []
    waits += [f"not after {_local(item.job.not_after)}"] if item.job.not_after else []
    reason = item.reason if item.over or not waits else "; ".join(waits)
    seconds = item.proof.get("seconds")
    length = "" if seconds is None else f"{seconds / 60.0:.1f}"
    state = f"{item.state} (ending)" if item.cancel and not item.over else item.state
    return str(item.id), str(item.priority), state, item.job.name, length, reason


def _local(time: str) -> str:
    return datetime.fromisoformat(time).astimezone().strftime("%d %b %H:%M") if time else ""


def list_items(
    state: Annotated[
        list[str] | None, typer.Option("--state", help="Only items in this state; repeatable.")
    ] = None,
    queue: QueueOption = None,
    json: opt.JsonOption = None,
) -> None:
    """List the items in the order in which they start.

    Example: bramah queue list --state queued
    """
    from rig.model.parse import InputError
    from rig.queue.items import STATES
    from rig.queue.runner import runner_of

    unknown = [word for word in state or () if word not in STATES]
    if unknown:
        raise InputError(f"--state {unknown[0]}: expected one of: {', '.join(STATES)}")
    with _open_queue(queue) as store:
        paused, items = store.paused, store.items()
    shown = [item for item in items if not state or item.state in state]
    pid = runner_of(_path(queue))
    document = {"paused": paused, "runner": pid, "items": [item.as_dict() for item in shown]}
    header = ("item", "priority", "state", "name", "min", "reason or condition")
    rows = [_line(item) for item in shown]
    left = ("name", "state", "reason or condition")
    lines = [table(header, rows, left)] if shown else []
    pending = [item for item in items if not item.over]
    minutes = sum(item.proof.get("seconds") or 0.0 for item in pending) / 60.0
    runner = f"run by process {pid}" if pid else "no process runs the queue"
    lines.append(
        f"{len(pending)} of {len(items)} items have not ended, about {minutes:.0f} min of the "
        f"device's time; {paused or runner}"
    )
    print_result(json, document, "\n".join(lines))


def show(item: ItemArgument, queue: QueueOption = None, json: opt.JsonOption = None) -> None:
    """Show one item with its history and the end of its log.

    Example: bramah queue show 3
    """
    from dataclasses import asdict

    from rig.queue.runner import log_of

    with _open_queue(queue) as store:
        entry, history = store.item(item), store.history(item)
    log = log_of(_path(queue), entry)
    document: dict[str, Any] = entry.as_dict()
    document |= {"history": [asdict(line) for line in history], "log": str(log)}
    job = entry.job
    lines = [f"item {entry.id} {job.name}: {entry.state}"]
    fields = {
        "reason": entry.reason, "protocol": job.protocol, "rig": job.rig,
        "endpoint": job.endpoint, "options": " ".join(job.options), "run": entry.run or job.out,
        "log": str(log) if log.exists() else "",
    }  # fmt: skip
    lines += [f"  {key:9s} {value}" for key, value in fields.items() if value]
    lines += [
        f"  {_local(line.time)}  {line.event}{': ' if line.reason else ''}{line.reason}"
        for line in history
    ]
    if entry.results.get("parameters"):
        rows = [
            (name, f"{p['value']:.5g}", f"{p['std']:.2g}" if p.get("std") else "—", p["unit"])
            for name, p in entry.results["parameters"].items()
            if p.get("value") is not None
        ]
        lines.append(table(("parameter", "value", "std", "unit"), rows))
    print_result(json, document, "\n".join(lines))


def run(
    serve: Annotated[
        bool, typer.Option("--serve", help="Keep waiting for further items, as a service.")
    ] = False,
    notify: Annotated[
        str | None,
        typer.Option(
            help="Command that receives JSON on standard input at a trip, a failure and the end."
        ),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(
            help="Write the page of the night here when the queue ends.", callback=opt.writable_file
        ),
    ] = None,
    queue: QueueOption = None,
    json: opt.JsonOption = None,
) -> None:
    """Run the queue, one item at a time; Ctrl-C zeroes the outputs, then ends the current item.

    Exits 0 when all items are done, 1 when one has failed, 3 on a trip, 4 on a lost device.

    Example: bramah queue run --notify 'mail -s bench me@example.org'
    """
    from rig.model.parse import InputError
    from rig.queue.hook import Hook, parse_command
    from rig.queue.runner import Runner, folder_of

    command = parse_command(notify) if notify is not None else ()
    with _open_queue(queue, create=serve) as store:
        if store.paused and not serve:
            raise InputError(
                f"the queue is {store.paused}; continue it with `bramah queue pause --off`"
            )
        hook = Hook(command, folder_of(store.path) / "hook.log")
        start = datetime.now(UTC)
        with Runner(store, progress, hook, serve=serve) as runner:
            report = runner.run()
        if page is not None:
            from rig.cli.text.night import write_page

            try:
                write_page(page, store, start)
            except InputError as error:  # the exit code is the queue's, not that of its page
                progress(f"bramah: {error}")
    document = {
        "code": report.code,
        "reason": report.reason,
        "ended": [item.as_dict() for item in report.ended],
    }
    done = sum(item.state == "done" for item in report.ended)
    print_result(json, document, f"{done} of {len(report.ended)} items done; {report.reason}")
    if report.code > 1:
        progress(f"bramah: {report.reason}")
    raise typer.Exit(report.code)


def write_night_page(
    out: Annotated[
        Path, typer.Option(help="The HTML file to write.", callback=opt.writable_file)
    ] = Path("night.html"),
    since: Annotated[
        str | None, typer.Option(help="Only since 2026-03-01T22:00, or 12h ago.")
    ] = None,
    queue: QueueOption = None,
) -> None:
    """Write a report of the queue: items run, parameters identified, trips, drift of parameters.

    Example: bramah queue page --out night.html --since 12h
    """
    from rig.cli.text.night import write_page

    begin = opt.time_since(since)
    with _open_queue(queue) as store:
        write_page(out, store, begin)
    typer.echo(str(out))


def pause(
    off: Annotated[bool, typer.Option("--off", help="Continue the queue.")] = False,
    queue: QueueOption = None,
    json: opt.JsonOption = None,
) -> None:
    """Start no further item; the current one runs to its end. --off continues the queue.

    Example: bramah queue pause
    """
    with _open_queue(queue) as store:
        if off:
            store.resume(_user())
        else:
            store.pause(_user())
        active = [item.id for item in store.items() if item.state in ("checking", "running")]
    ending = f"; item {active[0]} runs to its end" if active and not off else ""
    text = "the queue continues" if off else f"paused{ending}"
    print_result(json, {"paused": not off, "active": active}, text)


def cancel(item: ItemArgument, queue: QueueOption = None, json: opt.JsonOption = None) -> None:
    """Cancel an item; a running one is ended safely, its outputs zeroed first.

    Example: bramah queue cancel 3
    """
    from rig.queue.runner import end_orphan, runner_of

    with _open_queue(queue) as store:
        cancelled = store.cancel(item, _user())
        if not cancelled.over and runner_of(store.path) is None:
            end_orphan(store.path, cancelled)
    result = "cancelled" if cancelled.over else "asked to end; `bramah queue show` says how it ends"
    _print_item(cancelled, json, result)


def move(
    item: ItemArgument,
    before: Annotated[int | None, typer.Option(help="Place it before this item.")] = None,
    last: Annotated[bool, typer.Option("--last", help="Place it last of its priority.")] = False,
    priority: Annotated[
        int | None, typer.Option(min=-100, max=100, help="Change its priority to this.")
    ] = None,
    queue: QueueOption = None,
    json: opt.JsonOption = None,
) -> None:
    """Move a queued item: before another, or first (or --last) of its priority.

    Example: bramah queue move 5 --before 2
    """
    from rig.model.parse import InputError

    if before is not None and (last or priority is not None):
        raise InputError(
            "--before sets the priority too: expected no --last or --priority beside it"
        )
    with _open_queue(queue) as store:
        moved = store.move(item, before=before, last=last, priority=priority)
    _print_item(moved, json, f"priority {moved.priority}, place {moved.place:g}")


def retry(item: ItemArgument, queue: QueueOption = None, json: opt.JsonOption = None) -> None:
    """Queue an ended item again; it keeps its place and runs into a new folder.

    Example: bramah queue retry 3
    """
    with _open_queue(queue) as store:
        retried = store.retry(item, _user())
    _print_item(retried, json, f"queued again; it will run into {retried.next_folder()}")


queue = typer.Typer(no_args_is_help=True, rich_markup_mode=None, callback=queue_group)
queue.command(context_settings={"allow_extra_args": True})(add)
queue.command("list")(list_items)
queue.command("page")(write_night_page)
for verb in (show, run, pause, cancel, move, retry):
    queue.command()(verb)
