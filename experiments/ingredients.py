"""What the tuned setting owes to its ingredients: one taken away, or one added to the paper's.

The tuned setting and its neighbours have the budget --steps. The paper's has an eighth of it, with
one update for each step, so that it makes the same number of updates.

    ./run python experiments/ingredients.py
"""

from dataclasses import replace

from common import Case, experiment, options, schedule

from marlyap.learning.algorithms import MASAC
from marlyap.learning.trainer import SCHEDULES
from marlyap.tasks import TASKS


TUNED, PAPER = MASAC(), MASAC().paper()
# Fields of the algorithm, and of the schedule.
WITHOUT = {
    "tuned": ({}, {}),
    "without decay": ({}, {"decay": 1.0}),
    "without LayerNorm": ({"normalise": False}, {}),
    "without a head for each agent": ({"heads": "team"}, {}),
    "without averaged weights": ({"ema_rate": 1.0}, {}),
    "without the doubled reward": ({"reward_scale": 1.0}, {}),
    "16 environments": ({}, {"environments": 16}),
    "1 environment": ({}, {"environments": 1, "select_every": 512}),
    "update every 2 steps": ({}, {"steps_per_update": 2}),
    "update every 32 steps": ({}, {"steps_per_update": 32}),
    "critic 256 wide": ({"critic_width": 256}, {}),
    "one shared actor": ({"shared": True}, {}),
}
WITH = {
    "paper": ({}, {}),
    "paper and LayerNorm": ({"normalise": True}, {}),
    "paper and a head for each agent": ({"heads": "agent"}, {}),
    "paper and averaged weights": ({"ema_rate": TUNED.ema_rate}, {}),
    "paper and 64 environments": ({}, {"environments": 64, "select_every": 4}),
}


def cases(args):
    about = {"task": args.task}
    for name, (rule, plan) in WITHOUT.items():
        case = about | {"ingredient": name, "budget": args.steps}
        yield Case(case, TASKS[args.task], replace(TUNED, **rule), schedule(args, **plan))
    steps = args.steps // SCHEDULES["tuned"].steps_per_update
    for name, (rule, plan) in WITH.items():
        case = about | {"ingredient": name, "budget": steps}
        plan = replace(SCHEDULES["paper"], **{"steps": steps} | plan)
        yield Case(case, TASKS[args.task], replace(PAPER, **rule), plan)


if __name__ == "__main__":
    args = options(__doc__)
    experiment("ingredients", list(cases(args)), args)
