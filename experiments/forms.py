"""Forms of the Lyapunov condition that keep their say, beside the paper's and the control.

The learnt weight of Delta L fades once the condition holds on average. Each case changes one thing:
the weight may not fall below a floor, or is fixed; the condition holds only outside the ball, or is
about the followers alone; L is learnt from its own slow copy and not from whole rollouts; or L must
fall by half of the cost.

    ./run python experiments/forms.py --steps 51200
    ./run python experiments/forms.py --task rendezvous-path5
    ./run python experiments/forms.py --only followers --seeds 0 1 2 3 4 5 6 7 8 9
    ./run python experiments/forms.py --steps 409600 --only weight-1 --seeds 0 1 2 3 4 5 6 7 8 9
"""

from dataclasses import replace

from common import Case, at_budget, experiment, options, schedule

from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraints import Lyapunov, Unconstrained
from marlyap.tasks import TASKS


HAN = Lyapunov()
FORMS = {
    "none": Unconstrained(),
    "han": HAN,
    "floor-0.3": replace(HAN, floor=0.3),
    "weight-1": replace(HAN, weight=1.0),
    "outside-the-ball": replace(HAN, ball=0.05, floor=0.3),
    "bootstrapped": replace(HAN, target="bootstrap", weight=1.0),
    "strict": replace(HAN, decrease=0.5),
    "strict-floor-0.3": replace(HAN, decrease=0.5, floor=0.3),
    "critic": replace(HAN, reading="critic", weight=1.0),
}


def cases(args):
    game = TASKS[args.task]
    followers = tuple(i for i in range(game.agents) if i not in game.leaders)
    forms = FORMS | {"followers": replace(HAN, agents=followers, weight=1.0)}
    for name, L in forms.items():
        about = {"task": args.task, "form": name, "budget": args.steps}
        yield Case(about, game, MASAC(constraint=L), schedule(args))


if __name__ == "__main__":
    args = options(__doc__)
    experiment(at_budget("forms", args), list(cases(args)), args, plain="none")
