"""`marlyap watch`: one episode as a film, by one controller or by several from the same start."""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import OWN_TASK, SEED, SUBJECT, measured_on, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "film one episode of a run or a hand-written controller, as GIF, MP4 and HTML"
EPILOG = (
    SUBJECT
    + """
A training is followed in a browser by its TensorBoard files: tensorboard --logdir RUN
"""
)
EXAMPLES = """
  marlyap watch runs/demo/seed0 --episode 3
  marlyap watch runs/demo/seed0 --compare tree-pursuit --format gif mp4
  marlyap watch runs/demo/seed0 --task.size 2 --out films
  marlyap watch cart-feedback --task cartpoles --compare zero --out films"""
FORMATS = ("gif", "mp4", "html")
MOST = 4  # films side by side


def options(p: ArgumentParser) -> None:
    p.add_argument("run", metavar="RUN", help="a run directory or the name of a controller")
    beside = "runs or controllers to film from the same start, side by side"
    p.add_argument("--compare", nargs="+", metavar="OTHER", default=[], help=beside)
    p.add_argument("--episode", type=number, default=0, help="which of the evaluation starts")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    kinds = "what to write (default: gif html); mp4 needs ffmpeg"
    p.add_argument("--format", nargs="+", choices=FORMATS, default=["gif", "html"], help=kinds)
    p.add_argument(
        "--out", type=place, default=None, help="where to put the film (default: the run, or here)"
    )
    measured_on(p, OWN_TASK)


@dataclass(frozen=True)
class Subject:
    """What is filmed first: its game decides what the others drive."""

    game: Any
    film: Any  # of `one` or `driven`, called without arguments
    title: str
    place: Path
    about: str = ""


def run(args: Namespace, overrides: Overrides) -> Result:
    """Film one episode."""
    prepare()
    from marlyap.report.data import Page
    from marlyap.report.gif import films_gif
    from marlyap.report.mp4 import encoder, films_mp4
    from marlyap.report.page import html
    from marlyap.runs.hosted import outside
    from marlyap.storage import store

    if outside([args.run]):
        from marlyap.cli import hosted

        return hosted.watch(args, overrides)
    if "mp4" in args.format:
        encoder()
    if len(args.compare) >= MOST:
        raise UserError(f"compare: at most {MOST - 1} others fit beside the first; name fewer.")
    starts = starts_of(args.seed)
    first = subject(args, overrides, starts)
    if not first.place.is_dir():
        raise UserError(f"out: there is no directory {first.place}.")
    others = [other(word, first.game, args, starts) for word in args.compare]
    shots = named([first.film(), *(film() for film in others)])
    about = f"start {args.episode} of the held-out starts of seed {starts}{first.about}"
    files = {kind: first.place / f"film.{kind}" for kind in FORMATS if kind in args.format}
    if "gif" in files:
        films_gif(shots, files["gif"])
    if "mp4" in files:
        films_mp4(shots, files["mp4"])
    if "html" in files:
        page = Page(title=first.title, subtitle=about, films=tuple(shots))
        store.write_text_atomic(files["html"], html(page))
    say(f"Film: {' and '.join(str(path.resolve()) for path in files.values())}")
    done = {kind: str(path) for kind, path in files.items()} | {"start_seed": starts}
    ends = {"films": [{"who": s.run or s.label, "success": bool(s.success)} for s in shots]}
    return done | {"success": bool(shots[0].success)} | (ends if args.compare else {}), 0


def subject(args: Namespace, overrides: Overrides, starts: int) -> Subject:
    """The run or controller that was named first."""
    from marlyap.controllers import names_a_controller
    from marlyap.report.episodes import driven, one
    from marlyap.runs import config, groups
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import asked, subject as opened

    if names_a_controller(args.run):
        if args.task is None:
            raise UserError(f"task: {args.run} needs --task, the task it is to drive.")
        game = asked(args.task, overrides)
        law = lambda: config.load_controller(args.run, game)
        film = lambda: replace(driven(game, law(), args.episode, starts), run=short(args.run))
        title = f"One episode of {args.run} on {args.task}"
        return Subject(game, film, title, args.out or Path())
    run, game = opened(one_run(Path(args.run)), args.task, args.algorithm, overrides)
    about = ""
    if game is not run.game:
        about = f", on {groups.told(run.game, game, args.task or '')}"
    film = lambda: one(run, args.episode, starts, game=game, whose=run.labels["algorithm"])
    place, title = args.out or run.directory, f"One episode of {run.title}"
    return Subject(game, film, title, place, about)


def other(word: str, game: Any, args: Namespace, starts: int) -> Any:
    """What films another run or controller on this game, when it is called."""
    from marlyap.controllers import CONTROLLERS, names_a_controller
    from marlyap.report.episodes import driven, one
    from marlyap.runs import config
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import subject as opened

    if names_a_controller(word):
        law = config.load_controller(word, game)
        return lambda: replace(driven(game, law, args.episode, starts), run=short(word))
    if not Path(word).exists():
        hint = config.suggest(word, CONTROLLERS)
        raise UserError(f"compare: there is no run or controller '{word}'; {hint}")
    run, _ = opened(one_run(Path(word)), args.task, args.algorithm)
    run.controller(game)  # says in one sentence where the policy does not fit
    return lambda: one(run, args.episode, starts, game=game, whose=run.labels["algorithm"])


def short(word: str) -> str:
    return word.rpartition(":")[2]


def named(shots: Sequence[Any]) -> list[Any]:
    """Films of one start, called by who drives where there are several."""
    if len(shots) == 1:
        return list(shots)
    names, start = [shot.run for shot in shots], shots[0].label
    twice = lambda k, name: f"{name} ({names[:k].count(name) + 1})"
    whose = [n if names.count(n) == 1 else twice(k, n) for k, n in enumerate(names)]
    return [
        replace(shot, run=name, label=name, shot="one start", title=start)
        for shot, name in zip(shots, whose, strict=True)
    ]
