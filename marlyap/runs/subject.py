"""What a command is asked to measure: a run's policy, on the run's own game or on another."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.hosted import Hosted
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.shields import Shield, behind, split


def subject(
    directory: Path | str,
    task: str | None = None,
    algorithm: str | None = None,
    overrides: Mapping[str, str] | None = None,
    shield: bool = False,
) -> tuple[Run, AbstractGame]:
    """Open a run, and the game that its policy is to be measured on.

    `task` and `algorithm` are what the user typed after --task and --algorithm. A task is the
    game to measure on. Where the run's game is of the user's own class, the name of that class,
    or the one it was trained under, supplies its code: the game is then the run's own, with the
    values that run.json holds. `overrides` ("task.agents": "5") change fields of either. With
    `shield` the game is measured behind one; a run that was trained behind a shield always is.

    The game is `run.game` itself where nothing differs from it. Whether the policy fits it is for
    `run.controller(game)` to say. Raises UserError for what cannot be done.
    """
    overrides = overrides or {}
    refuse_all_but_task(overrides)
    given = config.load(task, AbstractGame) if task else None
    rule = config.load(algorithm, AbstractAlgorithm) if algorithm else None
    run = Run.open(Path(directory), given, rule)
    if rule is not None and not config.own_classes(run.trainer.algorithm):
        raise UserError(
            f"algorithm: {directory} was trained by {run.labels['algorithm']}, which is part of "
            "marlyap; leave --algorithm out."
        )
    game = run.game
    if task and given is not None and not supplies(task, given, run):
        game = behind(given, split(run.game)[1])
    game = changed(game, overrides, shield)
    same = type(game) is type(run.game) and config.record(game) == config.record(run.game)
    return run, run.game if same else game


def asked(
    task: str, overrides: Mapping[str, str] | None = None, shield: bool = False
) -> AbstractGame:
    """The task that was named, with some fields set anew: what a controller is measured on."""
    return changed(config.load(task, AbstractGame), overrides or {}, shield)


def changed(game: AbstractGame, overrides: Mapping[str, str], shield: bool = False) -> AbstractGame:
    """The game with some fields set anew, as by {"task.agents": "5", "shield.sigma": "0"}.

    With `shield` it is behind one; a game that is keeps its own.
    """
    refuse_all_but_task(overrides)
    parts = config.override_all(unfolded(game, shield, overrides), overrides)
    return behind(parts["task"], parts.get("shield"))


def unfolded(
    game: AbstractGame | Hosted, shield: bool, overrides: Mapping[str, str]
) -> dict[str, Any]:
    """What `overrides` may set: the task, and its shield where it has one or is to have one."""
    inner, own = split(game)
    if own is None and not shield:
        for path in overrides:
            if path.partition(".")[0] == "shield":
                raise UserError(f"--{path}: there is no shield to set it of; add --shield.")
        return {"task": inner}
    return {"task": inner, "shield": own or Shield()}


def refuse_all_but_task(overrides: Mapping[str, str]) -> None:
    """Raise UserError for what only a training can set."""
    for path in overrides:
        if path.partition(".")[0] not in ("task", "shield"):
            raise UserError(f"--{path}: only a training sets it; here --task.FIELD can be set.")


def supplies(task: str, given: AbstractGame | Hosted, run: Run) -> bool:
    """Whether the named task is the code of the run's own game."""
    name = task.rpartition(":")[2]
    there = split(run.trainer.game)[0]
    own = type(given) is type(there) and bool(config.code_of(given, task))
    return own and name in (type(there).__name__, run.labels["task"])
