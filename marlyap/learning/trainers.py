"""Which trainer trains on what; a further kind of game registers its own here."""

from functools import singledispatch
from typing import Any

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.host_trainer import HOSTED, HostTrainer
from marlyap.learning.hosted import Hosted
from marlyap.learning.schedule import Schedule
from marlyap.learning.trainer import Trainer, schedule_for
from marlyap.learning.training import AbstractTrainer


@singledispatch
def trainer_for(game: Any, algorithm: AbstractAlgorithm, schedule: Schedule) -> AbstractTrainer:
    """The trainer of this algorithm on this game, in JAX or outside."""
    raise UserError(f"task: a {type(game).__name__} is no game.")


@trainer_for.register
def _(game: AbstractGame, algorithm: AbstractAlgorithm, schedule: Schedule) -> AbstractTrainer:
    return Trainer(game, algorithm, schedule)


@trainer_for.register
def _(game: Hosted, algorithm: AbstractAlgorithm, schedule: Schedule) -> AbstractTrainer:
    return HostTrainer(game, algorithm, schedule)


@singledispatch
def usual_schedule(game: Any, algorithm: AbstractAlgorithm, preset: str = "tuned") -> Schedule:
    """The schedule where the user names none."""
    return schedule_for(algorithm, preset)


@usual_schedule.register
def _(game: Hosted, algorithm: AbstractAlgorithm, preset: str = "tuned") -> Schedule:
    return HOSTED


@singledispatch
def ready(game: Any) -> Any:
    """The game with all that is known of it only once it is opened."""
    return game


@ready.register
def _(game: Hosted) -> Hosted:
    return game.opened()
