"""`marlyap watch`: one episode as a film."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from marlyap.cli.common import Overrides, Result, say, starts_of
from marlyap.cli.environment import prepare
from marlyap.cli.options import OWN_TASK, SEED, SUBJECT, measured_on, number, place, seed_of_starts
from marlyap.errors import UserError


SUMMARY = "film one episode of a run or a hand-written controller, as GIF and HTML"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap watch runs/demo/seed0 --episode 3
  marlyap watch runs/demo/seed0 --task.size 2 --out films
  marlyap watch cart-feedback --task cartpoles --out films"""


def options(p: ArgumentParser) -> None:
    p.add_argument("run", metavar="RUN", help="a run directory or the name of a controller")
    p.add_argument("--episode", type=number, default=0, help="which of the evaluation starts")
    p.add_argument("--seed", type=seed_of_starts, default=0, help=SEED)
    p.add_argument(
        "--out", type=place, default=None, help="where to put the film (default: the run, or here)"
    )
    measured_on(p, OWN_TASK)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Film one episode."""
    prepare()
    from marlyap.controllers import names_a_controller
    from marlyap.report.data import Page
    from marlyap.report.episodes import driven, one
    from marlyap.report.gif import film_gif
    from marlyap.report.page import html
    from marlyap.runs import config, groups
    from marlyap.runs.hosted import outside
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import asked, subject
    from marlyap.storage import store

    if outside([args.run]):
        from marlyap.cli import hosted

        return hosted.watch(args, overrides)
    starts = starts_of(args.seed)
    about = f"start {args.episode} of the held-out starts of seed {starts}"
    if names_a_controller(args.run):
        if args.task is None:
            raise UserError(f"task: {args.run} needs --task, the task it is to drive.")
        game = asked(args.task, overrides)
        place, title = args.out or Path(), f"One episode of {args.run} on {args.task}"
        film = lambda: driven(game, config.load_controller(args.run, game), args.episode, starts)
    else:
        run, game = subject(one_run(Path(args.run)), args.task, args.algorithm, overrides)
        place, title = args.out or run.directory, f"One episode of {run.title}"
        film = lambda: one(run, args.episode, starts, game=game)
        if game is not run.game:
            about += f", on {groups.told(run.game, game, args.task or '')}"
    if not place.is_dir():
        raise UserError(f"out: there is no directory {place}.")
    shot = film()
    gif, page = place / "film.gif", place / "film.html"
    film_gif(shot, gif)
    store.write_text_atomic(page, html(Page(title=title, subtitle=about, films=(shot,))))
    say(f"Film: {page.resolve()} and {gif.resolve()}")
    done = {"gif": str(gif), "html": str(page), "start_seed": starts}
    return done | {"success": bool(shot.success)}, 0
