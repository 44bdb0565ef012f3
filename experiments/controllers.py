"""How often the hand-written controllers succeed: experiments/results/controllers.csv.

Each row is success at the last step with its exact 95 % interval. The gains were tuned on starts
of other keys. Without --quick it needs casadi.
"""

import argparse
import csv
import io
from pathlib import Path

from common import after

from marlyap.controllers import CONTROLLERS, Cascade, OptimalControl
from marlyap.games.dynamics import Unicycle
from marlyap.runs.provenance import provenance
from marlyap.simulation.evaluation import evaluate, share
from marlyap.storage.hashing import policy_hash
from marlyap.storage.store import write_text_atomic
from marlyap.tasks.rendezvous import Rendezvous


SEED = 0
RESULTS = Path(__file__).parent / "results" / "controllers.csv"
PLAIN = Cascade(near=0.57, near_angle=0.25, k_a=5.0, k_r=6.1, braking=0.88, alignment=0.0)
PLAIN_MEAN = Cascade(near=0.065, near_angle=1.65, k_r=6.4, braking=0.68, alignment=0.0)
# The laws with their default gains, and as the literature has them: cos(theta)^0, equal weights.
VARIANTS = {
    "tree-pursuit": {},
    "tree-pursuit, plain law": {"margin": 1.4, "cascade": PLAIN},
    "gradient-consensus": {},
    "gradient-consensus, plain law, b=1": {"leader_gain": 1.0, "cascade": PLAIN_MEAN},
    "point-offset": {},
    "point-offset, b=1": {"leader_gain": 1.0, "offset": 0.019},
    "lin-francis-maggiore": {},
}
# agents, graph, leaders, limit of a (m/s^2) and r (rad/s^2), steps
SETTINGS = [
    *[(3, graph, 1, limit, 40) for graph in ("complete", "path") for limit in (1.0, 2.0, 5.0)],
    *[(5, graph, 1, limit, 40) for graph in ("complete", "path") for limit in (2.0, 5.0)],
    (3, "complete", 3, 5.0, 40),
    (3, "complete", 1, 5.0, 100),
    (5, "path", 1, 5.0, 100),
]
COLUMNS = "controller agents graph leaders limit horizon radius episodes successes rate low high"
AFTER = "seed at_rest stayed speed spin policy machine cpu commit"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two settings, 200 episodes, printed")
    quick = parser.parse_args().quick
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*COLUMNS.split(), *AFTER.split()])
    for n, graph, leaders, limit, horizon in SETTINGS[2::7] if quick else SETTINGS:
        team = {"agents": n, "graph": graph, "leaders": tuple(range(leaders)), "horizon": horizon}
        game, final = Rendezvous(**team, dynamics=Unicycle(limits=(limit, limit))), {}
        for name, gains in VARIANTS.items():
            controller = CONTROLLERS[name.split(",")[0]](game, **gains)
            final[name] = evaluate(game, controller, 200 if quick else 4000, SEED), controller
        if (n, graph, leaders, horizon) == (3, "complete", 1, 40) and not quick:
            planner = OptimalControl(game)
            final["optimal-control"] = evaluate(game, planner, 50, SEED), planner
        for name, radius in ((n, r) for n, (found, _) in final.items() for r in found.radii):
            found, controller = final[name]
            s = share(found.final <= radius, 0.95)
            counts = (s["episodes"], s["successes"], s["success_rate"])
            ends = (round(x, 4) for x in s["interval"])
            about = (name, n, graph, leaders, limit, horizon, radius)
            made = (policy_hash(controller), *provenance().values())
            table.writerow((*about, *counts, *ends, SEED, *after(found).values(), *made))
    if quick:
        print(text.getvalue(), end="")
    else:
        write_text_atomic(RESULTS, text.getvalue())


if __name__ == "__main__":
    main()
