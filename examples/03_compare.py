"""Compare a learnt policy with hand-written controllers on the same fresh starts."""

import argparse

from marlyap import MASAC, Rendezvous, Schedule, compare, evaluate, train
from marlyap.controllers import CONTROLLERS


def main(steps: int, episodes: int = 500, **smaller: int):
    game = Rendezvous(agents=3, leaders=(0,), graph="path")
    trained = train(game, MASAC(), Schedule(steps=steps, **smaller))
    learnt = evaluate(game, trained.controller, episodes)
    print(f"{'masac':20} {100 * learnt.success_rate:5.1f} %")

    found = {}
    for name in ("tree-pursuit", "gradient-consensus", "point-offset"):
        other = evaluate(game, CONTROLLERS[name](game), episodes)  # the same seed, the same starts
        found[name] = compare(learnt, other)
        print(f"{name:20} {100 * other.success_rate:5.1f} %  {found[name]}")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=204_800, help="environment steps")
    main(parser.parse_args().steps)
