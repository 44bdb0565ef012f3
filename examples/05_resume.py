"""Train on disk, stop halfway and resume: the result equals an uninterrupted run bit for bit."""

import argparse
from itertools import count
from pathlib import Path

from marlyap import MASAC, Lyapunov, Rendezvous, Run, Schedule, Trainer, launch
from marlyap.runs.events import Progress


def main(place: Path, steps: int, **smaller: int):
    trainer = Trainer(Rendezvous(), MASAC(constraint=Lyapunov()), Schedule(steps=steps, **smaller))
    names = {"task": "rendezvous", "algorithm": "masac-lyapunov", "preset": "tuned"}
    run = Run.create(place / "seed0", trainer, seed=0, names=names)

    half = -(-trainer.iterations // 2)
    for _ in range(2):
        asked = count()  # `stop` is called before every iteration
        for event in launch([run], stop=lambda asked=asked: next(asked) >= half):
            match event:
                case Progress(line=line):
                    print(line["iteration"], round(line["return"], 2))
        run = Run.open(place / "seed0")  # as another process would, tomorrow
        print(f"On disk: {run.steps_done:,} steps, finished: {run.finished}")
    return run


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("place", type=Path, help="directory of the run")
    parser.add_argument("--steps", type=int, default=51_200, help="environment steps")
    main(**vars(parser.parse_args()))
