"""What every training offers to whoever runs it: a state that can be saved, and iterations."""

import abc
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm, Info, Watch, unwatched
from marlyap.learning.health import Health
from marlyap.learning.schedule import Schedule
from marlyap.learning.traced import with_arrays
from marlyap.nets.nets import Shape
from marlyap.simulation.rollout import Policy
from marlyap.types import Key, Scalar


class Carry(eqx.Module):
    """All that training is at one instant; saved whole, so that a resumed run is the same run."""

    learner: PyTree  # the algorithm's
    key: Key
    iteration: Int[Array, ""]
    best: Policy  # of those evaluated, the one with the highest score
    score: Scalar
    played: PyTree = None  # what a game outside JAX has played so far


class Told(NamedTuple):
    """What an iteration tells of every run: the arrays have a leading axis of runs."""

    log: dict[str, np.ndarray]
    health: Health

    def health_of(self, i: int) -> Health:
        return Health(*[at[i] for at in self.health])


class AbstractTrainer(eqx.Module):
    """One training: what is played, what learns from it, and how much of both."""

    game: eqx.AbstractVar[Any]  # as run.json holds it
    algorithm: eqx.AbstractVar[AbstractAlgorithm]
    schedule: eqx.AbstractVar[Schedule]
    side_by_side: ClassVar[bool] = True  # whether several runs can be trained in one program

    @property
    def agents(self) -> int:
        return self.game.agents

    @property
    @abc.abstractmethod
    def shape(self) -> Shape:
        """What the algorithm may know of the game."""

    @property
    @abc.abstractmethod
    def steps_per_iteration(self) -> int:
        """Environment steps, of all copies together."""

    @property
    @abc.abstractmethod
    def updates_per_iteration(self) -> int:
        """Gradient steps."""

    @property
    def iterations(self) -> int:
        """In all, as the schedule says."""
        return -(-self.schedule.steps // self.steps_per_iteration)

    @abc.abstractmethod
    def begin(self, key: Key) -> tuple[Carry, Health]:
        """A fresh carry, and the health of what was played to begin with; runs inside jit."""

    @abc.abstractmethod
    def advance(
        self, carry: Carry, stop: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[int, Carry, Told]]:
        """Iterate to the end or until `stop()`; yields (iterations done, carry, what it tells).

        The arrays of `carry` have a leading axis of runs where there are several, and so may those
        of the trainer (`stacked`); those of `Told` always have it. The carry that goes in is used
        up.
        """

    def iterate(self, carry: Carry, watch: Watch = unwatched) -> tuple[Carry, Info]:
        """One iteration; `watch` is asked about the networks after each update.

        Runs inside jit. Raises UserError where the game is played outside JAX.
        """
        raise UserError(f"task: iterations on a {type(self.game).__name__} do not run inside jit.")

    @abc.abstractmethod
    def model(self) -> AbstractGame:
        """The game in JAX. Raises UserError where it is played outside."""

    def diagnose(self, carry: Carry, iteration: int) -> str | None:
        """Where in training numbers stopped being finite, where that can be found out again."""
        return None

    def resumed(self) -> tuple[str, ...]:
        """What to tell whoever resumes a run."""
        return ()

    def decay(self, iteration: Int[Array, ""]) -> Scalar:
        """What the learning rates are multiplied by."""
        s = self.schedule
        span = s.decay_episodes or self.iterations * s.environments
        return s.decay ** (iteration * s.environments / span)


def stack(carries: list[Carry]) -> Carry:
    """A leading axis for several runs; one alone stays as it is, or XLA would copy its memory.

    The carries are used up: with several runs nobody keeps their replay memories twice.
    """
    if len(carries) == 1:
        return carries[0]

    def join(*xs):
        if not eqx.is_array(xs[0]):
            return xs[0]
        joined = jnp.stack(xs)
        for x in xs:
            x.delete()
        return joined

    return jax.tree.map(join, *carries)


def row(carry: Carry, i: int) -> Carry:
    """The carry of one run among those of several."""
    if carry.iteration.ndim == 0:
        return carry
    return jax.tree.map(lambda x: x[i] if eqx.is_array(x) else x, carry)


def stacked(trainers: "list[AbstractTrainer]") -> "AbstractTrainer":
    """One trainer for several runs: the numbers that differ between them have a leading axis.

    Raises UserError if they differ in more than the numbers that a program is given.
    """
    given = [with_arrays(trainer) for trainer in trainers]
    free = [eqx.filter(trainer, eqx.is_array, inverse=True) for trainer in given]
    if any(other != free[0] for other in free):
        raise UserError("runs: they differ in more than numbers; train them in processes.")
    if all(trainer == trainers[0] for trainer in trainers):
        return given[0]
    return jax.tree.map(lambda *xs: jnp.stack(xs) if eqx.is_array(xs[0]) else xs[0], *given)
