"""What `evaluate`, `report` and `watch` do with runs on games outside JAX."""

import json
import shlex
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

from rich.console import Console

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.errors import UserError
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.report.data import MARK
from marlyap.report.hosted import gather_hosted, words
from marlyap.runs import config
from marlyap.runs.hosted import evaluate_hosted, frames
from marlyap.runs.run import Run, expand, one_run
from marlyap.storage import store


def evaluate(args: Namespace, overrides: Overrides) -> Result:
    """The runs on episodes that they were not trained on."""
    runs, seed = opened(args.runs, args, overrides), starts_of(args.seed)
    rows = [measured(run, args.episodes, seed, args.confidence) for run in runs]
    result: dict[str, Any] = {"start_seed": seed, "runs": rows}
    if args.out is not None:
        store.write_text_atomic(args.out, json.dumps(result, indent=1) + "\n")
    if not args.json:
        console = Console()
        for row in rows:
            rate = row.get("success_rate")
            more = f"; success {100 * rate:.1f} %" if rate is not None else ""
            console.print(f"{row['name']}: {words([row])}{more}", highlight=False, markup=False)
        if len(rows) > 1:
            console.print(words(rows), highlight=False, markup=False)
    return result, 0


def report(args: Namespace, overrides: Overrides) -> Result:
    """One page about the runs: curves and figures, and a film beside it where one can be made."""
    from marlyap.report.gif import frames_gif
    from marlyap.report.page import html
    from marlyap.report.png import learning_curves_png

    runs, seed = opened(args.runs, args, overrides), starts_of(args.seed)
    default = runs[0].directory / "report.html" if len(runs) == 1 else Path("report.html")
    out = args.out or default
    if out.exists() and MARK.encode() not in out.read_bytes():
        raise UserError(f"out: {out} exists and is not a report of marlyap; choose another file.")
    rows = [measured(run, args.episodes, seed, 0.95) for run in runs]
    page = gather_hosted(runs, rows, seed, shlex.join(["marlyap", *sys.argv[1:]]))
    store.write_text_atomic(out, html(page))
    pictures = [out.with_name(f"{out.stem}-learning.png")]
    learning_curves_png(page.runs, pictures[0])
    try:
        frames_gif(frames(runs[0], seed), out.with_name(f"{out.stem}-film.gif"))
        pictures.append(out.with_name(f"{out.stem}-film.gif"))
    except UserError as error:
        say(f"There is no film: {error}")
    say(f"Report: {out.resolve()}")
    return {"start_seed": seed, "runs": rows} | {
        "report": str(out),
        "pictures": [str(p) for p in pictures],
    }, 0


def watch(args: Namespace, overrides: Overrides) -> Result:
    """One episode as the environment draws it, as a GIF."""
    from marlyap.report.gif import frames_gif

    run = opened([one_run(Path(args.run))], args, overrides)[0]
    place, seed = args.out or run.directory, starts_of(args.seed)
    if not place.is_dir():
        raise UserError(f"out: there is no directory {place}.")
    gif = place / "film.gif"
    frames_gif(frames(run, seed, args.episode), gif)
    say(f"Film: {gif.resolve()}")
    return {"gif": str(gif), "start_seed": seed}, 0


def opened(words: Any, args: Namespace, overrides: Overrides) -> list[Run]:
    """The runs; --task may name a file of the user's own that plays them."""
    for path in overrides:
        raise UserError(
            f"--{path}: a game outside JAX is measured as it was trained; leave it out."
        )
    game = config.load_task(args.task) if args.task else None
    rule = config.load(args.algorithm, AbstractAlgorithm) if args.algorithm else None
    runs = [Run.open(place, game, rule) for place in expand(words)]
    for run in runs:
        if args.task and args.task != run.trainer.game.source:
            raise UserError(
                f"task: {run.directory} was trained on {run.trainer.game.source} outside JAX, and "
                "is measured on that alone; leave --task out."
            )
        for warning in run.warnings:
            say(f"warning: {warning}")
    return runs


def measured(run: Run, episodes: int, seed: int, confidence: float) -> dict[str, Any]:
    """One run's figures, which are also left in it."""
    row = {"name": str(run.directory), "seed": run.seed, "start_seed": seed}
    row |= evaluate_hosted(run, episodes, seed).summary(confidence)
    try:
        store.write_text_atomic(run.directory / "evaluation.json", json.dumps(row, indent=1) + "\n")
    except UserError as error:
        say(f"evaluation.json was not written: {error}")
    return row
