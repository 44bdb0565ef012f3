"""Train a team in memory and measure its success on fresh starts, with a 95 % interval."""

import argparse

from marlyap import MASAC, Lyapunov, Rendezvous, Schedule, evaluate, train


def main(steps: int, **smaller: int):
    game = Rendezvous(agents=3, leaders=(0,), graph="complete")
    algorithm = MASAC(constraint=Lyapunov(reading="han", horizon=10))

    def show(line):
        if "success" in line:
            print(f"{line['steps']:>8,} steps: success {100 * line['success']:.1f} %")

    trained = train(game, algorithm, Schedule(steps=steps, **smaller), on_iteration=show)
    result = evaluate(game, trained.controller, episodes=500).summary()
    low, high = result["interval"]
    print(f"{result['successes']} of 500 fresh starts, 95 % interval {low:.3f} to {high:.3f}")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=204_800, help="environment steps")
    main(parser.parse_args().steps)
