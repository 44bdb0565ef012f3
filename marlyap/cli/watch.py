"""`marlyap watch`: one episode as a film."""

from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import SEED, SUBJECT, measured_on, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "film one episode of a run, as GIF and HTML"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap watch runs/demo/seed0 --episode 3
  marlyap watch runs/demo/seed0 --task.size 2 --out films"""


def options(p: ArgumentParser) -> None:
    p.add_argument("run", type=place, metavar="RUN", help="a run directory")
    p.add_argument("--episode", type=number, default=0, help="which of the evaluation starts")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    p.add_argument(
        "--out", type=place, default=None, help="where to put the film (default: the run)"
    )
    measured_on(p, "the task to measure on (default: that of each run)")


def run(args: Namespace, overrides: Overrides) -> Result:
    """Film one episode."""
    prepare()
    from marlyap.report.data import Page
    from marlyap.report.episodes import one
    from marlyap.report.gif import film_gif
    from marlyap.report.page import html
    from marlyap.runs import groups
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import subject
    from marlyap.storage import store

    run, game = subject(one_run(args.run), args.task, args.algorithm, overrides)
    place = args.out or run.directory
    if not place.is_dir():
        raise UserError(f"out: there is no directory {place}.")
    starts = starts_of(args.seed)
    shot = one(run, args.episode, starts, game=game)
    gif, page = place / "film.gif", place / "film.html"
    film_gif(shot, gif)
    title = f"One episode of {run.title}"
    about = f"start {args.episode} of the held-out starts of seed {starts}"
    if game is not run.game:
        about += f", on {groups.told(run.game, game, args.task or '')}"
    store.write_text_atomic(page, html(Page(title=title, subtitle=about, films=(shot,))))
    say(f"Film: {page.resolve()} and {gif.resolve()}")
    done = {"gif": str(gif), "html": str(page), "start_seed": starts}
    return done | {"success": bool(shot.success)}, 0
