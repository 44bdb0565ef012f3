"""`marlyap bag`: an episode as an MCAP file, for Foxglove and ROS 2 tools."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import OWN_TASK, SUBJECT, measured_on, number, place


SUMMARY = "write one episode of a run as an MCAP file with ROS 2 messages"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap bag runs/demo/seed0 --episode 0 --out episode.mcap"""


def options(p: ArgumentParser) -> None:
    p.add_argument("run", metavar="RUN", help="a run directory")
    p.add_argument("--episode", type=number, default=0, help="which of the evaluation starts")
    p.add_argument("--seed", type=number, default=0, help="of the starts (default 0)")
    p.add_argument("--out", type=place, required=True, help="the file to make")
    measured_on(p, OWN_TASK)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Play the episode and write it."""
    prepare()
    from marlyap.deploy import bag
    from marlyap.runs.run import one_run
    from marlyap.runs.subject import subject

    opened, game = subject(one_run(Path(args.run)), args.task, args.algorithm, overrides)
    count = bag.write(opened, args.out, args.episode, args.seed, game)
    say(f"{count} messages: {args.out.resolve()}")
    return {"mcap": str(args.out), "messages": count}, 0
