"""What `certify` is asked about, and by which certificates."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from marlyap.certificates import CERTIFICATES
from marlyap.certificates.certificate import AbstractCertificate
from marlyap.certificates.safety import has_rules
from marlyap.cli.common import Overrides, say
from marlyap.controllers import names_a_controller
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.runs import config
from marlyap.runs.run import one_run
from marlyap.runs.subject import asked, subject
from marlyap.shields import split


SAMPLED = ("reach", "reach-and-stay", "decrease", "contraction", "basin", "quantiles")


def about(
    word: str,
    task: str | None,
    algorithm: str | None,
    overrides: Overrides,
    out: Path | None,
    shield: bool = False,
) -> tuple[Any, AbstractGame, Path]:
    """The controller, its game, and where the certificate goes.

    `word` is a run directory or the name of a controller. Raises UserError where something is
    missing.
    """
    if names_a_controller(word):
        if task is None or out is None:
            missing = "--task TASK" if task is None else "--out DIRECTORY"
            raise UserError(f"certify: {word} is a controller, not a run; add {missing}.")
        game = asked(task, overrides, shield)
        return config.load_controller(word, game), game, out
    place = one_run(word)
    run, game = subject(place, task, algorithm, overrides, shield)
    controller = run.controller(game)
    for note in run.warnings:
        say(note)
    if game is not run.game and out is None:
        raise UserError(
            f"out: this certificate is not about the task that {place} was trained on; say "
            "where it goes with --out DIRECTORY."
        )
    return controller, game, out or run.directory / "certificate"


def usual(game: AbstractGame) -> tuple[str, ...]:
    """The certificates to ask for where none is named.

    Robots in the plane mostly roll or turn, and then have no ellipsoid: it is asked for by name.
    """
    some = {"ellipsoid": game.sight() is None, "safe": has_rules(game)}
    some |= {"shielded": split(game)[1] is not None}
    return (*SAMPLED, "linearisation", *(name for name, is_so in some.items() if is_so))


def chosen(names: Iterable[str], rollouts: int | None) -> dict[str, AbstractCertificate]:
    """The certificates by name, those of several rollouts with that many if they are given."""
    found = {}
    for name in names:
        if name not in CERTIFICATES:
            hint = config.suggest(name, CERTIFICATES)
            raise UserError(f"certificates: there is none called '{name}'; {hint}")
        c = CERTIFICATES[name]
        several = rollouts is not None and "rollouts" in config.fields(c)
        found[name] = dataclasses.replace(c, rollouts=rollouts) if several else c  # pyright: ignore
    return found
