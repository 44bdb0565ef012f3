"""The progress of trainings, drawn on a terminal or in a notebook."""

import time
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from marlyap.runs import events


QUIET = 30.0  # seconds without a line, at most, where there is no terminal


def show(happening: Iterable[events.Event], plain: bool = True) -> None:
    """A bar for each run: steps, speed, return, success, time left.

    Where there is no terminal or notebook: with `plain`, a line at each evaluation and at least
    every QUIET seconds; else nothing.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(compact=True),
    )
    console = Console(stderr=True)
    bar = console.is_terminal or console.is_jupyter
    with Progress(*columns, console=console, disable=not bar) as progress:
        seen: dict[tuple[str, int], _Shown] = {}
        for event in happening:
            who = event.run, event.seed
            if who not in seen:
                names = {one.name for one in seen.values()}
                name = f"seed {event.seed}"
                name = event.run if name in names else name  # several runs of one seed
                seen[who] = _Shown(name, progress.add_task(name, total=None, text="compiling"))
            shown = seen[who]
            match event:
                case events.Warned() | events.Diverged():
                    text, aloud = event.says, True
                case events.Started():
                    text, aloud = "compiling", plain and not bar
                case events.Progress():
                    text = shown.text(event.line)
                    done, total = event.line["iteration"], event.iterations
                    progress.update(shown.bar, total=total, completed=done, text=text)
                    due = "success" in event.line or time.monotonic() - shown.told > QUIET
                    aloud = plain and not bar and due
                case _:
                    continue
            if aloud:
                shown.told = time.monotonic()
                console.print(f"{shown.name}: {text}", highlight=False, soft_wrap=True)


class _Shown:
    """What was shown of one run: its bar, and the last line about it."""

    def __init__(self, name: str, bar: TaskID):
        self.name, self.bar, self.told = name, bar, time.monotonic()
        self.first: dict[str, Any] = {}
        self.success: float | None = None

    def text(self, line: dict[str, Any]) -> str:
        """Steps, speed since the first line, return and the last success."""
        self.first = self.first or line
        self.success = line.get("success", self.success)
        seconds = line["seconds"] - self.first["seconds"]
        speed = (line["steps"] - self.first["steps"]) / seconds if seconds > 0 else 0.0
        text = f"{line['steps']:,} steps  "
        text += f"{speed:,.0f}/s  " if speed > 0 else ""
        text += f"return {line['return']:.2f}"
        return text + (f"  success {100 * self.success:.1f} %" if self.success is not None else "")
