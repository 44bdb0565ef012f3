"""What can be read into the Lyapunov term: form, with Q or without, horizon, decrease, weight.

A coarse grid: every reading at the default numbers, then the numbers one at a time for the reading
of Han et al. and for the control that has the same sum of costs but no Lyapunov condition.

    ./run python experiments/readings.py
    ./run python experiments/readings.py --only han --seeds 5 6 7 8 9
"""

from dataclasses import replace

from common import Case, experiment, options, schedule

from marlyap.learning.algorithms import MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.tasks import TASKS


HORIZONS, DECREASES, WEIGHTS = (1, 5, 20, 40), (0.0, 0.5), (0.1, 1.0)
PLAIN = Lyapunov()
# What each reading needs besides its name: a margin, or a function of the state alone.
READINGS = {
    "han": PLAIN,
    "literal": replace(PLAIN, reading="literal", slope="empirical"),
    "hinge": replace(PLAIN, reading="hinge", slope="empirical", function="norm"),
    "score": replace(PLAIN, reading="score", function="norm"),
    "critic": replace(PLAIN, reading="critic", weight=1.0),
}


def settings():
    """Each constraint once, and whether Q is kept; none first, to compare with."""
    yield None, True
    for use_Q in (True, False):
        for reading in READINGS.values():
            yield reading, use_Q
        for reading in (READINGS["han"], READINGS["critic"]):
            for horizon in HORIZONS:
                yield replace(reading, horizon=horizon), use_Q
        for decrease in DECREASES:
            yield replace(READINGS["han"], decrease=decrease), use_Q
        for weight in WEIGHTS:
            yield replace(READINGS["han"], weight=weight), use_Q
            yield replace(READINGS["score"], weight=weight), use_Q


def cases(args):
    for L, use_Q in settings():
        about = {"task": args.task, "reading": "none", "Q": "Q" if use_Q else "no-Q"}
        about |= {"horizon": "", "decrease": "", "weight": ""}
        algorithm = MASAC(use_Q=use_Q)
        if L is not None:
            weight = "learnt" if L.weight is None else L.weight
            about |= {"reading": L.reading, "horizon": f"T={L.horizon}"}
            about |= {"decrease": f"decrease={L.decrease:g}", "weight": f"weight={weight}"}
            algorithm = replace(algorithm, constraint=L)
        about["budget"] = args.steps
        yield Case(about, TASKS[args.task], algorithm, schedule(args))


if __name__ == "__main__":
    args = options(__doc__, seeds=range(3), steps=102_400)
    experiment("readings", list(cases(args)), args)
