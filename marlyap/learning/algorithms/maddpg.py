"""Multi-agent deterministic policy gradient (MADDPG), and its twin-delayed form (MATD3).

    paper                       here                                   where
    mu_1 ... mu_N               pi, by its mode                        Lowe et al. 2017, 4.1
    Q_i(x, a_1 ... a_N)         Q, head i                              the same, (6)
    mu', Q'                     pi_bar, Q_bar                          the same, (6)
    N_t                         noise                                  the same, algorithm 1
    Q'_1, Q'_2                  critics = 2                            Fujimoto et al. 2018, 4.2
    sigma-tilde, c              smoothing, smoothing_clip              the same, 5.3
    d                           delay                                  the same, 5.2

Networks, normalisation, heads and averaged policy are those of `MASAC`, so that the two can be
compared. Two things differ from Lowe et al.: each agent improves the mean of
all agents' values and not its own alone, for the game is cooperative; and in that step the other
agents' actions come from their current policies and not from the memory.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from marlyap.errors import check_range
from marlyap.learning.algorithms.masac import PLAIN
from marlyap.learning.off_policy import AbstractOffPolicy
from marlyap.learning.optimiser import TrainState, polyak
from marlyap.learning.source import CostWindow
from marlyap.nets.nets import Actors, Critic, Greedy, Noisy
from marlyap.types import Action, Scalar, Transition


class Networks(eqx.Module):
    pi: TrainState[Actors]
    pi_bar: Actors
    pi_mean: Actors  # running mean of pi: the policy that is deployed
    Q: TrainState[Critic]
    Q_bar: Critic
    updates: Int[Array, ""]


class MADDPG(AbstractOffPolicy):
    """One central critic, one deterministic actor per agent on its own observation."""

    traced = (
        "gamma",
        "tau",
        "rate_pi",
        "rate_Q",
        "reward_scale",
        "ema_rate",
        "smoothing",
        "smoothing_clip",
    )

    gamma: float = 0.95  # discount
    tau: float = 0.005  # how fast the targets follow
    rate_pi: float = 3e-4  # actor learning rate
    rate_Q: float = 3e-3  # critic learning rate
    noise: float = 0.1  # standard deviation of the exploration noise
    batch: int = 256  # transitions per update
    n_step: int = 1  # steps summed in the critic's target
    reward_scale: float = 2.0  # factor on the reward
    actor_width: int = 64  # units in each of two hidden layers
    critic_width: int = 64  # units in each of two hidden layers
    normalise: bool = True  # LayerNorm in the critics
    heads: Literal["team", "agent"] = "agent"  # a value for the team, or one for each agent's cost
    shared: bool = False  # one set of actor weights for all agents of a kind
    ema_rate: float = 1e-3  # how fast the deployed policy follows the actor; 1 is the actor itself
    critics: int = 1  # with 2 the smaller value is the target
    smoothing: float = 0.0  # standard deviation of the noise on the target's actions
    smoothing_clip: float = 0.5  # largest noise on the target's actions
    delay: int = 1  # critic updates for one of the actors and targets

    def __check_init__(self):
        for name in ("gamma", "tau", "ema_rate"):
            check_range(name, getattr(self, name), 0, 1, open=name != "gamma")
        for name in ("rate_pi", "rate_Q"):
            check_range(name, getattr(self, name), 0, 1)
        for name in ("noise", "reward_scale"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("smoothing", "smoothing_clip"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("batch", "n_step", "actor_width", "critic_width", "delay"):
            check_range(name, getattr(self, name), 1, 1_000_000)
        check_range("critics", self.critics, 1, 2)

    @property
    def cost_window(self):
        return CostWindow()

    def paper(self):
        """Plain networks and one value for the team, as in section 4 of the paper."""
        return dataclasses.replace(self, **PLAIN)

    def init(self, shape, key):
        k_pi, k_Q = jax.random.split(key)
        pi = Actors(shape, self.actor_width, self.shared, key=k_pi)
        heads = shape.agents if self.heads == "agent" else 1
        Q = Critic(shape, self.critic_width, heads, self.normalise, self.critics, key=k_Q)
        return Networks(TrainState.of(pi), pi, pi, TrainState.of(Q), Q, jnp.asarray(0))

    def J_Q(self, Q: Critic, l: Networks, b: Transition, next_action: Action) -> Scalar:
        """(6) of Lowe et al., for every critic; the smaller target where there are two."""
        Q_next = jnp.min(l.Q_bar(b.next_features, next_action), axis=0)
        y = self.reward_scale * self.team(b.reward) + self.team(b.discount) * Q_next
        return 0.5 * jnp.sum(jnp.mean((Q(b.features, b.action) - y[None]) ** 2, axis=1))

    def J_pi(self, pi: Actors, Q: Critic, b: Transition) -> Scalar:
        """Minus the team's value of the current policies' actions, by the first critic."""
        return -jnp.mean(Q(b.features, pi.mode(b.obs))[0])

    def update(self, networks, b, decay):
        """Algorithm 1 of Lowe et al., with the three changes of Fujimoto et al. in it."""
        l = networks

        # a' = mu'(o') + clip(eps, -c, c)
        eps = self.smoothing * b.noise[:, :, 0]
        eps = jnp.clip(eps, -self.smoothing_clip, self.smoothing_clip)
        next_action = jnp.clip(jax.vmap(l.pi_bar.mode)(b.next_obs) + eps, -1.0, 1.0)
        next_action = jax.vmap(l.pi_bar.within)(next_action)

        # theta <- theta - rate grad J_Q
        J_Q = lambda Q, b, a: self.J_Q(Q, l, b, a)
        Q, loss_Q = l.Q.descend(J_Q, b, next_action, rate=decay * self.rate_Q)

        # phi <- phi - rate grad J_pi
        J_pi = lambda pi, b: self.J_pi(pi, Q.value, b)
        pi, loss_pi = l.pi.descend(J_pi, b, rate=decay * self.rate_pi)

        # the targets follow; all but the critic moves at every `delay`-th update only
        follow = lambda new, old: polyak(new, old, self.tau)
        pi_bar, Q_bar = follow(pi.value, l.pi_bar), follow(Q.value, l.Q_bar)
        moved = (pi, pi_bar, polyak(pi.value, l.pi_mean, self.ema_rate), Q_bar)
        due = (l.updates + 1) % self.delay == 0
        keep = lambda new, old: jnp.where(due, new, old) if eqx.is_array(new) else new
        stayed = (l.pi, l.pi_bar, l.pi_mean, l.Q_bar)
        pi, pi_bar, pi_mean, Q_bar = jax.tree.map(keep, moved, stayed)

        info = {"J_Q": loss_Q, "J_pi": loss_pi}
        return Networks(pi, pi_bar, pi_mean, Q, Q_bar, l.updates + 1), info

    def explore(self, networks):
        return Noisy(networks.pi.value, self.noise)

    def policy(self, networks):
        return Greedy(networks.pi_mean)

    def lyapunov(self, networks):
        return None

    def team(self, per_agent):
        """What the critics' heads stand for: the team's mean, or each agent."""
        return per_agent if self.heads == "agent" else jnp.mean(per_agent, keepdims=True)
