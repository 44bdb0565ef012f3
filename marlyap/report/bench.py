"""The page of a bench: a table for each game, its controllers by what a step costs."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

from marlyap.report.page import page_of
from marlyap.report.words import interval, percent


Row = dict[str, Any]  # a line of the CSV


def merged(rows: Iterable[Row]) -> list[tuple[str, list[list[Row]]]]:
    """For each game, the rows of each controller (one for each horizon), the cheapest first."""
    by_game = lambda row: row["game"]
    found = []
    for game, those in groupby(rows, by_game):
        each: dict[str, list[Row]] = {}
        for row in those:
            each.setdefault(row["controller"], []).append(row)
        found.append((game, sorted(each.values(), key=lambda own: own[0]["cost"])))
    return found


def heads(rows: Sequence[Row]) -> list[str]:
    """The heads of the table: the controller, and four for each horizon."""
    horizons = dict.fromkeys(row["horizons"] for row in rows)
    times = ["" if k == 1 else f" at {k} horizons" for k in horizons]
    return [
        "controller",
        *(f"{w}{t}" for t in times for w in ("cost", "success", "95 %", "failed")),
    ]


def cells(own: Sequence[Row]) -> list[str]:
    """The cells of one controller's line."""
    found = [own[0]["controller"]]
    for row in own:
        rate, failed = percent(row["success"]), percent(row["failed"])
        found += [f"{row['cost']:.4g}", rate, interval((row["low"], row["high"])), failed]
    return found


def html(rows: Sequence[Row], starts: int, seed: int) -> str:
    """The page as the text of one HTML file."""
    tables = [(game, [cells(own) for own in those]) for game, those in merged(rows)]
    return page_of("bench.html", tables=tables, heads=heads(rows), starts=starts, seed=seed)
