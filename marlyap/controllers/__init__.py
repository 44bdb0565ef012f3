"""Controllers that are not learnt, to compare with: built in, or in a file of your own."""

import inspect
from pathlib import Path

from marlyap.controllers.cascade import Cascade as Cascade
from marlyap.controllers.controller import (
    AbstractController as AbstractController,
    as_action as as_action,
)
from marlyap.controllers.gradient import GradientConsensus as GradientConsensus
from marlyap.controllers.lin_francis_maggiore import LinFrancisMaggiore as LinFrancisMaggiore
from marlyap.controllers.optimal import OptimalControl as OptimalControl, Replayed as Replayed
from marlyap.controllers.point_offset import PointOffset as PointOffset
from marlyap.controllers.pursuit import TreePursuit as TreePursuit
from marlyap.controllers.reference import UniformlyRandom as UniformlyRandom, Zero as Zero
from marlyap.errors import UserError
from marlyap.game import AbstractGame


CONTROLLERS: dict[str, type[AbstractController]] = {
    "point-offset": PointOffset,
    "gradient-consensus": GradientConsensus,
    "lin-francis-maggiore": LinFrancisMaggiore,
    "tree-pursuit": TreePursuit,
    "optimal-control": OptimalControl,
    "zero": Zero,
    "uniform": UniformlyRandom,
}


def names_a_controller(word: str) -> bool:
    """Whether `load` is meant: a built-in name, or path/to/file.py:Name."""
    return word in CONTROLLERS or word.rpartition(":")[0].endswith(".py")


def load(word: str, game: AbstractGame) -> AbstractController:
    """The controller called `word`, or the one at `path/to/file.py:Name`, for this game.

    A file is executed: name your own. Raises UserError for an unknown name (with a suggestion), a
    file that cannot be loaded, a class that is no controller, and a game that it cannot drive.
    """
    from marlyap import config  # which may import controllers itself

    if word in CONTROLLERS:
        return CONTROLLERS[word](game)
    path, _, name = word.rpartition(":")
    if word.endswith(".py"):
        raise UserError(f"controller: '{word}' names no class; write {word}:Name.")
    if not path:
        hint = config.suggest(word, CONTROLLERS)
        raise UserError(f"controller: no controller is called '{word}'; {hint}")
    cls = getattr(config._module(Path(path), "controller"), name, None)
    if not (inspect.isclass(cls) and issubclass(cls, AbstractController)):
        raise UserError(
            f"controller: {path} defines no controller called '{name}'; write a class "
            f"{name}(AbstractController)."
        )
    try:
        return cls(game)
    except UserError:
        raise
    except Exception as error:  # whatever the constructor of a user's class may raise
        raise UserError(f"controller: {name} cannot be made from a game alone: {error}.") from error
