"""Whether what was played and learnt in an iteration is sound, and what to say where it is not."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from marlyap.learning.replay import Episode
from marlyap.simulation.rollout import first_fault


class Health(NamedTuple):
    """Where the first unsound number of each kind is: step * agents + agent, or -1.

    Every number has to be finite, and no cost may be negative.
    """

    obs: Int[Array, "*runs"]
    features: Int[Array, "*runs"]
    reward: Int[Array, "*runs"]
    cost: Int[Array, "*runs"]
    negative: Int[Array, "*runs"]  # the first negative cost
    action: Int[Array, "*runs"]
    networks: Int[Array, "*runs"]  # how many numbers of the learner are not finite

    @classmethod
    def sound(cls) -> "Health":
        """Nothing is wrong, or nothing was checked."""
        return cls(*[jnp.asarray(-1)] * 6, networks=jnp.asarray(0))

    @classmethod
    def of(cls, played: Episode) -> "Health":
        """What episodes (leading axis `episode`) tell."""
        names = ("obs", "features", "reward", "cost", "action")
        found = {name: first_fault(getattr(played, name)) for name in names}
        return cls.sound()._replace(**found, negative=first_negative(played.cost))

    def with_networks(self, networks: PyTree) -> "Health":
        """The same, and how many of these numbers are not finite."""
        numbers = jax.tree.leaves(eqx.filter(networks, eqx.is_inexact_array))
        bad = jnp.stack([jnp.sum(~jnp.isfinite(x)) for x in numbers])
        return self._replace(networks=jnp.sum(bad))

    def by_task(self, agents: int) -> "TaskFault | None":
        """The first fault that the task answers for; on the host, of one run."""
        for name in ("obs", "features", "reward", "cost", "negative"):
            if (at := int(getattr(self, name))) >= 0:
                return TaskFault(name, *divmod(at, agents))
        return None

    def by_training(self) -> str | None:
        """The first fault that training answers for; on the host, of one run."""
        if int(self.action) >= 0:
            return "action"
        return "networks" if int(self.networks) > 0 else None


class TaskFault(NamedTuple):
    """A number that no task may return."""

    name: str
    step: int
    agent: int

    def says(self, when: str) -> str:
        """The fault and its remedy; `when` it was found comes in the middle."""
        negative = self.name == "negative"
        what = "a negative number" if negative else "a number that is not finite"
        return (
            f"{'cost' if negative else self.name}: the task returned {what} {when}, first for "
            f"agent {self.agent} at step {self.step}; correct the task"
        )


def first_negative(cost: Float[Array, "episode time agent"]) -> Int[Array, ""]:
    """step * agents + agent of the first cost below 0, beyond rounding; -1 where there is none."""
    return first_fault(jnp.where(cost < -1e-6, jnp.nan, 0.0))
