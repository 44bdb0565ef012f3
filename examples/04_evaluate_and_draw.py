"""Open a run, evaluate it, and draw it: paths as PNG, an episode as GIF, a report as HTML.

Make the run first: marlyap train rendezvous masac-lyapunov --out runs/mine
"""

import sys
from pathlib import Path

from marlyap import Run, evaluate
from marlyap.report.contents import gather
from marlyap.report.data import Group
from marlyap.report.episodes import one
from marlyap.report.gif import film_gif
from marlyap.report.page import html
from marlyap.report.png import trajectories_png


def main(directory: Path, out: Path) -> Group:
    run = Run.open(directory)
    result = evaluate(run.game, run.controller(), episodes=500)
    for row in result.summary()["radii"]:
        print(f"within {row['radius']} m: {100 * row['success_rate']:.1f} %")

    page = gather([run], episodes=500, seed=0, command="examples/04_evaluate_and_draw.py")
    (out / "report.html").write_text(html(page))
    trajectories_png(page.films, out / "starts.png")
    film_gif(one(run, 0, seed=0), out / "film.gif")
    print(f"Drawn: {out}/report.html, starts.png, film.gif")
    return page.groups[0]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "."))
