"""A sweep on a terminal: a table that is drawn again and again, or a line now and then."""

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from marlyap.sweeps.jobs import STATES, Status
from marlyap.sweeps.plan import Plan


QUIET = 30.0  # seconds without a line, at most, where there is no terminal
ROWS = 12  # of each kind that are shown
COLOURS = {"running": "cyan", "finished": "green", "failed": "red", "dropped": "yellow"}


def show(plan: Plan, seen: Iterable[Sequence[Status]]) -> list[Status]:
    """Draw what is seen until there is no more; returns the last of it."""
    console = Console(stderr=True)
    statuses: Sequence[Status] = []
    if not console.is_terminal:
        told = -QUIET
        for statuses in seen:
            if time.monotonic() - told > QUIET:
                told = time.monotonic()
                console.print(counts(statuses), highlight=False)
        console.print(counts(statuses), highlight=False)
        return list(statuses)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        for statuses in seen:
            live.update(drawn(plan, statuses, ROWS), refresh=True)
    console.print(drawn(plan, statuses, ROWS))
    return list(statuses)


def counts(statuses: Sequence[Status]) -> str:
    """How many jobs there are in each state, in one line."""
    many = Counter(status.state for status in statuses)
    told = [f"{many[state]} {state}" for state in STATES if many[state]]
    done = sum(status.share for status in statuses) / max(1, len(statuses))
    return f"{len(statuses)} jobs: {', '.join(told) or 'none yet'}; {100 * done:.0f} % of the work"


def drawn(plan: Plan, statuses: Sequence[Status], rows: int | None = None) -> Group:
    """The counts, and a row for each job: those that failed, those that run, the best."""
    failed = [s for s in statuses if s.state == "failed"]
    running = [s for s in statuses if s.state == "running"]
    rest = [s for s in statuses if s.state not in ("failed", "running")]
    rest.sort(key=lambda s: (not s.result, -(s.success or 0.0)))
    shown = [*failed[:rows], *running[:rows], *rest[:rows]]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("job", *plan.varied, "state", "done", "steps", "return", "success"):
        table.add_column(name, no_wrap=True, justify="right" if name == "done" else "left")
    for status in shown:
        table.add_row(*_cells(plan, status))
    parts: list[Any] = [Text(counts(statuses)), table]
    parts += [Text(f"{s.job.name}: {s.says}", style="red") for s in failed[:rows]]
    if len(shown) < len(statuses):
        parts.append(Text(f"and {len(statuses) - len(shown)} more"))
    return Group(*parts)


def _cells(plan: Plan, status: Status) -> list[Any]:
    figures = status.result or status.last
    steps, total = figures.get("steps"), figures.get("return")
    return [
        status.job.name,
        *(status.job.cell.set.get(name, "") for name in plan.varied),
        Text(status.state, style=COLOURS.get(status.state, "")),
        f"{100 * status.share:.0f} %",
        "" if steps is None else f"{steps:,}",
        "" if total is None else f"{total:.2f}",
        "" if status.success is None else f"{100 * status.success:.1f} %",
    ]
