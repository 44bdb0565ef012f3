"""What a training shows while it runs."""

import time
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


QUIET = 30.0  # seconds without a line, at most, where there is no terminal


def show(events: Iterable[dict[str, Any]], seeds: Iterable[int], plain: bool = True) -> None:
    """A bar for each seed: steps, speed, return, success, time left.

    Where there is no terminal or notebook: with `plain`, a line at each judgement and at least
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
    tell = lambda seed, text: console.print(f"seed {seed}: {text}", highlight=False, soft_wrap=True)
    with Progress(*columns, console=console, disable=not bar) as progress:
        bars, told = {}, {}
        for seed in seeds:
            bars[seed] = progress.add_task(f"seed {seed}", total=None, text="compiling")
            told[seed] = time.monotonic()
            if plain and not bar:
                tell(seed, "compiling")
        seen: dict[int, dict[str, Any]] = {}
        for e in events:
            if "warning" in e or "diverged" in e:
                what = e.get("warning") or e["says"]
                tell(e["seed"], what)
                continue
            first = seen.setdefault(e["seed"], e)
            if e["steps"] < first["steps"]:  # another run of the same seed
                first = seen[e["seed"]] = e
            seconds = e["seconds"] - first["seconds"]
            speed = f"{(e['steps'] - first['steps']) / seconds:,.0f}/s  " if seconds > 0 else ""
            success = e.get("success", first.get("last"))
            first["last"] = success
            text = f"{e['steps']:,} steps  {speed}return {e['return']:.2f}"
            text += f"  success {100 * success:.1f} %" if success is not None else ""
            progress.update(
                bars[e["seed"]], total=e["iterations"], completed=e["iteration"], text=text
            )
            quiet = time.monotonic() - told[e["seed"]]
            if plain and not bar and ("success" in e or quiet > QUIET):
                told[e["seed"]] = time.monotonic()
                tell(e["seed"], text)
