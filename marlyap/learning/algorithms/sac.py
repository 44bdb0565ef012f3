"""Soft actor-critic at the two ends of what agents may know: each alone, and all as one.

Both wrap a `MASAC`, so that networks and hyperparameters are the same; only its inputs differ.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from marlyap.errors import UserError
from marlyap.learning.algorithms.masac import MASAC
from marlyap.learning.constraint import Unconstrained
from marlyap.learning.off_policy import AbstractOffPolicy
from marlyap.nets.nets import Actors, Greedy, Sampled
from marlyap.simulation.rollout import AbstractExplorer, Policy
from marlyap.types import Action, Key, Obs, Transition


class AbstractWrapped(AbstractOffPolicy):
    """A `MASAC` that is shown something else: what it is, the wrapper is too."""

    sac: eqx.AbstractVar[MASAC]

    @property
    def gamma(self):
        return self.sac.gamma

    @property
    def batch(self):
        return self.sac.batch

    @property
    def n_step(self):
        return self.sac.n_step

    @property
    def cost_window(self):
        return self.sac.cost_window

    def fits(self, agents):
        self.sac.fits(agents)

    def paper(self):
        return dataclasses.replace(self, sac=self.sac.paper())

    def lyapunov(self, networks):
        return self.sac.lyapunov(networks)


class DecentralisedSAC(AbstractWrapped):
    """Each agent learns alone, from what it observes, its own action and its own reward.

    To each, the game has one agent, and the others are part of the world: it has a critic and a
    temperature of its own. Its networks have a leading axis `agent`.
    """

    sac: MASAC = MASAC()  # of each agent

    def __check_init__(self):
        if self.sac.shared:
            raise UserError(
                "sac.shared: agents that learn alone share no weights; set it to false."
            )
        if self.sac.constraint != Unconstrained():
            raise UserError(
                "sac.constraint: agents that learn alone have no common L; set it to none."
            )

    def init(self, shape, key):
        if shape.inputs:
            raise UserError(
                "algorithm: agents that learn alone must decide equally many numbers each; use "
                "masac, which pads."
            )
        one = shape._replace(agents=1, features=shape.obs)
        keys = jax.random.split(key, shape.agents)
        return eqx.filter_vmap(lambda k: self.sac.init(one, k))(keys)

    def update(self, networks, b, decay):
        """A step of every agent's own learning; the log has the mean over agents."""
        agents = jnp.arange(b.action.shape[1])

        def step(l, i):
            return self.sac.update(l, jax.vmap(lambda b: alone(b, i))(b), decay)

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
    discount = jnp.broadcast_to(b.discount, b.reward.shape)[i]
    return Transition(**{k: x[i][None] for k, x in own.items()}, discount=discount)


def team(actors: Actors) -> Actors:
    """Many teams of one agent as one team."""
    return jax.tree.map(lambda x: x[:, 0] if eqx.is_array(x) else x, actors)


class CentralisedSAC(AbstractWrapped):
    """One policy over what all agents observe together: centralised, a bound on what can be learnt.

    Each agent's network sees the observations of all. Its policy is not a decentralised
    controller, though it is rolled out and evaluated like one.
    """

    sac: MASAC = MASAC()  # of the joint observation

    def __check_init__(self):
        if self.sac.shared:
            raise UserError(
                "sac.shared: agents with equal inputs and weights all act alike; set it to false."
            )

    def init(self, shape, key):
        return self.sac.init(shape._replace(obs=shape.agents * shape.obs), key)

    def update(self, networks, b, decay):
        """The step of MASAC, where everyone observes everything."""

        def widened(b: Transition) -> Transition:
            return dataclasses.replace(b, obs=joint(b.obs), next_obs=joint(b.next_obs))

        return self.sac.update(networks, jax.vmap(widened)(b), decay)

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
