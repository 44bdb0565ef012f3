"""Write docs/gallery.md and its pictures: an episode of each game under the best law by hand.

./run python docs/make_gallery.py            # the page, and the pictures that are missing
./run python docs/make_gallery.py ring quads-space   # these pictures anew
"""

import sys
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import jax

from marlyap.controllers import CONTROLLERS
from marlyap.report.episodes import driven
from marlyap.report.filming import reference
from marlyap.report.gif import films_gif
from marlyap.tasks import TASKS


FOLDER = Path(__file__).parent
PICTURES, PAGE = FOLDER / "gallery", FOLDER / "gallery.md"
START, SEED = 3, 0  # which of the held-out starts
DPI, FRAMES = 62, 40

HEAD = """# Gallery

One game of each file, an episode each, driven by the hand-written controller whose steps cost least
on sixteen starts. Where there is no map, the signals are shown. Every picture is start 3 of the
held-out starts of seed 0, made by `./run python docs/make_gallery.py`. The same film with its
controls: `./run marlyap watch CONTROLLER --task GAME --episode 3`.
"""


def shown() -> dict[str, str]:
    """The first game of each file, with the file."""
    spec = spec_from_file_location("make_games", FOLDER / "make_games.py")
    games = module_from_spec(spec)
    spec.loader.exec_module(games)
    return {names[0]: module for module, names in games.grouped().items()}


def page() -> str:
    """All games, two in a row of the table."""
    cells = []
    for name, module in shown().items():
        first = " ".join((type(TASKS[name]).__doc__ or "").split("\n\n")[0].split())
        cells.append(f"[{name}](games/{module}.md)<br>![{name}](gallery/{name}.gif)<br>{first}")
    cells += [""] * (len(cells) % 2)
    rows = [f"| {a} | {b} |" for a, b in zip(cells[::2], cells[1::2], strict=True)]
    return "\n".join([HEAD, "| | |", "|---|---|", *rows, ""])


def picture(name: str) -> None:
    game = TASKS[name]
    law = reference(game, SEED) or "zero"
    film = driven(game, CONTROLLERS[law](game), START, SEED)
    film = replace(film, label=f"{name}, {law}", run=law)
    films_gif([film], PICTURES / f"{name}.gif", fps=8, dpi=DPI, most=FRAMES)
    jax.clear_caches()


def main(asked: list[str]) -> None:
    PICTURES.mkdir(exist_ok=True)
    for name in shown():
        if name in asked or not (PICTURES / f"{name}.gif").exists():
            print(name, flush=True)
            picture(name)
    PAGE.write_text(page())


if __name__ == "__main__":
    main(sys.argv[1:])
