"""Which episodes a report films: a few starts of every game, each driven by several controllers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marlyap.controllers import CONTROLLERS
from marlyap.games.game import AbstractGame
from marlyap.report.data import Film
from marlyap.report.episodes import costs, driven, one
from marlyap.runs import config
from marlyap.runs.bench import suited
from marlyap.runs.groups import Measured, same_game
from marlyap.runs.run import Run


NONE = "none"  # said by a user who wants no reference
FLOOR = ("zero", "hold", "uniform")  # controllers that are no reference
TRIED = 16  # starts on which references are compared
ROOM = 250_000  # numbers of all films of one game; a start more is filmed while there is room


@dataclass(frozen=True)
class Lead:
    """A run that is filmed, for its configuration."""

    run: Run
    measured: Measured
    name: str  # as the page says it


def filmed(leads: Sequence[Lead], beside: str = "") -> list[Film]:
    """Films of the same starts for all leads of a game, and a hand-written controller beside them.

    `beside` names that controller; by default it is the one whose steps cost least, "none" stands
    for no such film.
    """
    games: list[list[Lead]] = []
    for lead in leads:
        own = (g for g in games if same_game(g[0].measured.game, lead.measured.game))
        if (those := next(own, None)) is None:
            games.append([lead])
        else:
            those.append(lead)
    several = len(games) > 1
    return [film for k, those in enumerate(games) for film in _of_game(k, those, beside, several)]


def _of_game(number: int, leads: Sequence[Lead], beside: str, several: bool) -> Iterator[Film]:
    first = leads[0].measured
    game, starts, room = first.game, first.starts, float(ROOM)
    name = _chosen(game, starts, beside)
    for title, index in _starts(leads, several).items():
        if room < 0:
            return
        episodes = len(first.evaluation.final)
        said = {"shot": f"game {number}, start {index}", "title": title}
        for lead in leads:
            shot = one(lead.run, index, starts, title, episodes, game, lead.name)
            room -= _size(shot)
            yield replace(shot, **said)
        if name:
            law = config.load_controller(name, game)
            shot = driven(game, law, index, starts, episodes)
            yield replace(shot, run=name.rpartition(":")[2], label=title, **said)


def _starts(leads: Sequence[Lead], several: bool) -> dict[str, int]:
    """Best, median and worst of the first lead by final distance, the worst of every other."""
    found: dict[str, int] = {}
    for k, lead in enumerate(leads):
        final = lead.measured.evaluation.final
        order = np.argsort(np.where(np.isfinite(final), final, np.inf), kind="stable")
        picks = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
        for what, index in picks.items() if k == 0 else [("worst", order[-1])]:
            title = f"{what} of {lead.name}" if len(leads) > 1 or several else what
            if int(index) not in found.values():
                found[title] = int(index)
    return found


def _chosen(game: AbstractGame, starts: int, beside: str) -> str:
    return "" if beside == NONE else beside or reference(game, starts) or ""


def reference(game: AbstractGame, starts: int) -> str | None:
    """The hand-written controller whose steps cost least on a few starts; None where none fits."""
    names = [name for name in suited(game) if name not in FLOOR]
    if len(names) < 2:
        return next(iter(names), None)
    mean = lambda name: costs(game, CONTROLLERS[name](game), starts, TRIED).mean()
    return min(names, key=lambda name: np.nan_to_num(mean(name), nan=np.inf))


def _size(film: Film) -> int:
    """About how many numbers a film is, as the page keeps it."""
    frames = film.frames
    places = 0 if frames.positions is None else frames.positions[0].size
    values = sum(v[0].size for v in frames.signals.values())
    links = np.mean([2 * len(pairs) for pairs in frames.links]) if len(frames.links) > 1 else 0
    return int(min(len(frames.times), 300) * (1.5 * places + values + links + 2))
