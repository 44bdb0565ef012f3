"""`marlyap bench`: controllers and runs on many games, in one table."""

import csv
import io
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import SEED, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "measure every controller on many games, in one table"
EPILOG = ""
EXAMPLES = """
  marlyap bench
  marlyap bench cartpoles microgrid --controllers zero cart-feedback grid-feedback
  marlyap bench cartpoles --runs runs/mine --out runs/bench"""


def options(p: ArgumentParser) -> None:
    p.add_argument("games", nargs="*", metavar="GAME", help="names of tasks (default: all)")
    p.add_argument("--controllers", nargs="+", default=None, help="names (default: all that fit)")
    p.add_argument("--runs", type=place, nargs="+", default=[], help="run directories")
    p.add_argument("--episodes", type=number, default=1_000, help="held-out starts (default 1000)")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    longer = "how many horizons the second measurement takes (default 10)"
    p.add_argument("--longer", type=number, default=10, help=longer)
    p.add_argument(
        "--quick", action="store_true", help="at most 20 starts and 2 horizons, to try it out"
    )
    out = "directory for the figures, the CSV and the page (default runs/bench)"
    p.add_argument("--out", type=place, default=Path("runs/bench"), help=out)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Measure what is not measured yet, and write the table, `bench.csv` and `bench.html`."""
    if overrides:
        raise UserError(f"--{next(iter(overrides))}: the bench measures the games as they are.")
    prepare()
    from marlyap.controllers import CONTROLLERS
    from marlyap.games.game import AbstractGame
    from marlyap.report.bench import html
    from marlyap.runs import bench, config
    from marlyap.runs.run import Run, expand
    from marlyap.storage import store
    from marlyap.tasks import TASKS

    games = {name: config.load(name, AbstractGame) for name in args.games or TASKS}
    for name in args.controllers or ():
        if name not in CONTROLLERS:
            hint = config.suggest(name, CONTROLLERS)
            raise UserError(f"controllers: there is none called '{name}'; {hint}")
    seed = starts_of(args.seed)
    few = bench.Plan(min(args.episodes, 20), seed, min(args.longer, 2))
    plan = few if args.quick else bench.Plan(args.episodes, seed, args.longer)
    runs = [Run.open(directory) for directory in expand(args.runs)]
    asked = bench.cells(games, args.controllers, runs, plan)
    rows: list[dict[str, Any]] = []
    for row in bench.bench(asked, plan, args.out):
        rows.append(row)
        many = f"{row['horizons']} horizon{'s' * (row['horizons'] > 1)}"
        what = f"{row['game']}, {row['controller']}, {many}: {100 * row['success']:.1f} %"
        say(f"{len(rows)} of {len(asked)}: {what}")
    store.write_text_atomic(args.out / "bench.csv", as_csv(rows, bench.COLUMNS))
    store.write_text_atomic(args.out / "bench.html", html(rows, plan.episodes, seed))
    if not args.json:
        show(rows)
        print(f"Page: {args.out / 'bench.html'}; figures: {args.out / 'bench.csv'}")
    return {"rows": rows, "page": str(args.out / "bench.html")}, 0


def show(rows: list[dict[str, Any]]) -> None:
    """One table for all games on standard output."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from marlyap.report.bench import cells, heads, merged

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for k, head in enumerate(["game", *heads(rows)]):
        table.add_column(head, justify="left" if k < 2 else "right", overflow="fold")
    for game, those in merged(rows):
        for own in those:
            table.add_row(game, *cells(own))
        table.add_section()
    console = Console()
    console = console if console.is_terminal else Console(width=max(console.width, 130))
    console.print(table)


def as_csv(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> str:
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()
