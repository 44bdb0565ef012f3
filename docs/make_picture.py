"""Draw the README's picture: one policy on unstable agents, without and with the credit shield.

./run python experiments/shield.py --only "runaway residual" --seeds 0 --keep
./run python docs/make_picture.py runs/experiments/shield/runaway/residual/seed0
"""

import sys
from dataclasses import replace
from pathlib import Path

from marlyap.report.episodes import driven
from marlyap.report.gif import films_gif
from marlyap.runs.run import Run
from marlyap.shields import behind, split


PICTURE = Path(__file__).parent / "shield.gif"
SIZE, START, SEED = 4.0, 1, 0  # starts in a square four times as wide as in training
STEPS, HORIZON, FRAMES, DPI = 80, 80, 60, 76


def main(run: Run) -> None:
    task, shield = split(run.game)
    films = []
    for on, label in ((False, "the policy as it is"), (True, "the same behind the shield")):
        wide = replace(task, size=SIZE, horizon=HORIZON)
        game = behind(wide, replace(shield, on=on, steps=STEPS))
        film = driven(game, run.controller(game), START, SEED)
        films.append(replace(film, label=label, run=label))
    films_gif(films, PICTURE, fps=8, dpi=DPI, most=FRAMES)


if __name__ == "__main__":
    main(Run.open(Path(sys.argv[1])))
