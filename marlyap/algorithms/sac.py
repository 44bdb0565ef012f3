"""Soft actor-critic at the two ends of what agents may know: each alone, and all as one.

Both are `MASAC` with the same networks and hyperparameters; only its inputs differ.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from marlyap.algorithms.masac import MASAC
from marlyap.constraint import Unconstrained
from marlyap.errors import UserError
from marlyap.nets import Actors, Greedy, Sampled
from marlyap.rollout import AbstractExplorer, Policy
from marlyap.types import Action, Key, Obs, Transition


class DecentralisedSAC(MASAC):
    """Each agent learns alone, from what it observes, its own action and its own reward.

    To each, the game has one agent, and the others are part of the world: it has a critic and a
    temperature of its own. Its networks have a leading axis `agent`.
    """

    def __check_init__(self):
        if self.shared:
            raise UserError("shared: agents that learn alone share no weights; set it to false.")
        if not isinstance(self.constraint, Unconstrained):
            raise UserError("constraint: agents that learn alone have no common L; set it to none.")

    def init(self, shape, key):
        one = shape._replace(agents=1, features=shape.obs)
        return eqx.filter_vmap(lambda k: MASAC.init(self, one, k))(
            jax.random.split(key, shape.agents)
        )

    def update(self, networks, b, decay):
        """A step of every agent's own learning; the log has the mean over agents."""
        agents = jnp.arange(b.action.shape[1])

        def step(l, i):
            return MASAC.update(self, l, jax.vmap(lambda b: alone(b, i))(b), decay)

        networks, info = eqx.filter_vmap(step)(networks, agents)
        return networks, jax.tree.map(jnp.mean, info)

    def explore(self, networks):
        return Sampled(team(networks.pi.value))

    def policy(self, networks):
        return Greedy(team(networks.pi_mean))


def alone(b: Transition, i: Int[Array, ""]) -> Transition:
    """One transition as agent i has it: a game of one agent, whose state is what it observes."""
    own = {f.name: getattr(b, f.name) for f in dataclasses.fields(b) if f.name != "discount"}
    own |= {"features": b.obs, "next_features": b.next_obs}
    return Transition(**{k: x[i][None] for k, x in own.items()}, discount=b.discount)


def team(actors: Actors) -> Actors:
    """Many teams of one agent as one team."""
    return jax.tree.map(lambda x: x[:, 0] if eqx.is_array(x) else x, actors)


class CentralisedSAC(MASAC):
    """One policy over what all agents observe together: centralised, a bound on what can be learnt.

    Each agent's network sees the observations of all. Its policy is not a decentralised
    controller, though it is rolled out and evaluated like one.
    """

    def __check_init__(self):
        if self.shared:
            raise UserError(
                "shared: agents with equal inputs and weights all act alike; set it to false."
            )

    def init(self, shape, key):
        return MASAC.init(self, shape._replace(obs=shape.agents * shape.obs), key)

    def update(self, networks, b, decay):
        """The step of MASAC, where everyone observes everything."""

        def widened(b: Transition) -> Transition:
            return dataclasses.replace(b, obs=joint(b.obs), next_obs=joint(b.next_obs))

        return MASAC.update(self, networks, jax.vmap(widened)(b), decay)

    def explore(self, networks) -> AbstractExplorer:
        return JointExplorer(Sampled(networks.pi.value))

    def policy(self, networks) -> Policy:
        return Joint(Greedy(networks.pi_mean))


def joint(obs: Obs) -> Float[Array, "agent agent*obs"]:
    """Everyone's observations, shown to everyone."""
    return jnp.broadcast_to(obs.ravel(), (obs.shape[0], obs.size))


class Joint(eqx.Module):
    """A policy that lets each agent see what all observe: not decentralised."""

    policy: Policy

    def __call__(self, obs: Obs, key: Key) -> Action:
        return self.policy(joint(obs), key)


class JointExplorer(AbstractExplorer):
    """The same, for the policy that collects data."""

    policy: AbstractExplorer

    def __call__(self, obs, key):
        return self.policy(joint(obs), key)

    def log_prob(self, obs, action):
        return self.policy.log_prob(joint(obs), action)
