"""Multi-agent soft actor-critic: Algorithm 1, and Algorithm 2 when given a Lyapunov constraint.

    paper                          here                                      equation
    s_t, a_t, r, s_{t+1}           b.features, b.action, b.reward, b.next_features
    s_i (local)                    b.obs[i], b.next_obs[i]                   section 2.1
    pi_phi_1 ... pi_phi_N          pi                                        (5)
    a, a_{t+1} ~ pi_phi            now.action, nxt.action
    (Gaussian noise of both draws) b.noise[:, 0], b.noise[:, 1]              (11)
    Q_theta^1, Q_theta^2           Q, returns both                           (6)
    Q_theta-bar                    Q_bar
    alpha, H-bar                   exp(log_alpha), agents * entropy          (12)
    L_psi, Delta L                 L, constraint.penalty                     (14)
    gamma, tau                     gamma, tau
    iota_Q, iota_pi, iota_alpha    rate_Q, rate_pi, rate_alpha

Numbers count the paper's displayed equations: (1)-(4) values and Bellman operator, (5) joint
entropy, (6)-(8) J_Q, its gradient and delta_Q, (9)-(11) policy improvement, (12) temperature,
(13) Theorem 1, (14) the objective with Delta L. Where the printed equation is wrong the method
says what was corrected.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from marlyap.errors import check_range
from marlyap.learning.constraint import AbstractConstraint, Unconstrained
from marlyap.learning.off_policy import AbstractOffPolicy
from marlyap.learning.optimiser import TrainState, in_parts, parts, polyak
from marlyap.nets.nets import Actors, Critic, Greedy, MeanFieldCritic, Sample, Sampled
from marlyap.simulation.rollout import AbstractExplorer, Policy
from marlyap.types import Scalar, Transition


# What section 4 of the paper has otherwise than we do.
PLAIN = {"normalise": False, "heads": "team", "ema_rate": 1.0, "reward_scale": 1.0}


class Networks(eqx.Module):
    pi: TrainState[Actors]
    pi_mean: Actors  # running mean of pi: the policy that is deployed
    Q: TrainState[Critic | MeanFieldCritic]
    Q_bar: Critic | MeanFieldCritic
    log_alpha: TrainState[Scalar]
    L: PyTree  # the constraint's


class MASAC(AbstractOffPolicy):
    """One central twin critic, one Gaussian actor per agent on its own observation."""

    traced = (
        "gamma",
        "tau",
        "rate_pi",
        "rate_Q",
        "rate_alpha",
        "alpha",
        "entropy",
        "reward_scale",
        "ema_rate",
    )

    gamma: float = 0.95  # discount
    tau: float = 0.005  # how fast the target critics follow
    rate_pi: float = 3e-4  # actor learning rate
    rate_Q: float = 3e-3  # critic learning rate
    rate_alpha: float = 3e-4  # temperature learning rate, on its logarithm
    alpha: float = 0.1  # temperature to begin with
    entropy: float = -2.0  # target entropy per agent (nats)
    batch: int = 256  # transitions per update
    n_step: int = 1  # steps summed in the critic's target, without the entropies between
    reward_scale: float = 2.0  # factor on the reward
    actor_width: int = 64  # units in each of two hidden layers
    critic_width: int = 64  # units in each of two hidden layers
    normalise: bool = True  # LayerNorm in the critics
    heads: Literal["team", "agent"] = "agent"  # a value for the team, or one for each agent's cost
    shared: bool = False  # one set of actor weights for all agents of a kind
    critic: Literal["joint", "mean-field"] = "joint"  # of everyone, or of one and the others' mean
    ema_rate: float = 1e-3  # how fast the deployed policy follows the actor; 1 is the actor itself
    use_Q: bool = True  # false drops Q from the policy objective (Han et al. 2020)
    constraint: AbstractConstraint = Unconstrained()  # the Lyapunov condition, if any

    def __check_init__(self):
        for name in ("gamma", "tau", "ema_rate"):
            check_range(name, getattr(self, name), 0, 1, open=name != "gamma")
        for name in ("rate_pi", "rate_Q", "rate_alpha"):
            check_range(name, getattr(self, name), 0, 1)
        for name in ("alpha", "reward_scale"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("batch", "n_step", "actor_width", "critic_width"):
            check_range(name, getattr(self, name), 1, 1_000_000)

    @property
    def cost_window(self):
        return self.constraint.cost_window

    def fits(self, agents):
        self.constraint.fits(agents)

    def paper(self):
        """Section 4: plain networks, one value for the team, the weight of Delta L learnt."""
        return dataclasses.replace(self, **PLAIN, constraint=self.constraint.paper())

    def init(self, shape, key):
        k_pi, k_Q, k_L = jax.random.split(key, 3)
        pi = Actors(shape, self.actor_width, self.shared, key=k_pi)
        if self.critic == "mean-field":
            team = self.heads == "team"
            Q = MeanFieldCritic(shape, self.critic_width, team, self.normalise, key=k_Q)
        else:
            heads = shape.agents if self.heads == "agent" else 1
            Q = Critic(shape, self.critic_width, heads, self.normalise, key=k_Q)
        log_alpha = jnp.log(jnp.full((), self.alpha, jnp.float32))
        L = self.constraint.init(shape, k_L)
        return Networks(TrainState.of(pi), pi, TrainState.of(Q), Q, TrainState.of(log_alpha), L)

    def J_Q(self, Q: Critic | MeanFieldCritic, l: Networks, b: Transition, nxt: Sample) -> Scalar:
        """Eq. (6), the soft Bellman residual of both critics.

        The printed target adds the entropy to a V that already has it; here it enters once,
        at s_{t+1}, with the smaller target twin. With n_step > 1 the entropies of the steps between
        are left out, so the backup is biased.
        """
        alpha = jnp.exp(l.log_alpha.value)
        Q_next = jnp.min(l.Q_bar(b.next_features, nxt.action), axis=0)
        V_next = Q_next - alpha * jnp.sum(nxt.log_prob)
        y = self.reward_scale * self.team(b.reward) + self.team(b.discount) * V_next
        return 0.5 * jnp.sum(jnp.mean((Q(b.features, b.action) - y[None]) ** 2, axis=1))

    def J_pi(self, now: Sample, nxt: Sample, l: Networks, b: Transition) -> Scalar:
        """Eq. (10) as a function of the drawn actions; (14) when there is a constraint.

        All actions come from the current policies; the smaller twin is used here too.
        """
        alpha = jnp.exp(l.log_alpha.value)
        Q = jnp.mean(jnp.min(l.Q.value(b.features, now.action), axis=0))
        beta_Delta_L = self.constraint.penalty(l.L, b, now, nxt)
        return alpha * jnp.sum(now.log_prob) - self.use_Q * Q + beta_Delta_L

    def J_alpha(self, log_alpha: Scalar, now: Sample) -> Scalar:
        """Eq. (12), with one temperature and the joint entropy."""
        surplus = jnp.sum(now.log_prob + self.entropy)
        return -jnp.exp(log_alpha) * surplus

    def update(self, networks, b, decay):
        """The assignments of Algorithm 2 in its order; without a constraint, of Algorithm 1."""
        l = networks
        n = parts(*b.obs.shape[:2])  # of the batch, one after the other: 1 for small teams

        # a ~ pi_phi(. | s_t) and a_{t+1} ~ pi_phi(. | s_{t+1}): the same for every objective
        draw = lambda pi, b: (
            pi.sample(b.obs, b.noise[:, 0], b.action),
            pi.sample(b.next_obs, b.noise[:, 1], b.action),
        )
        now, nxt = in_parts(lambda b: draw(l.pi.value, b), b, n)

        # theta <- theta - iota_Q grad J_Q
        J_Q = lambda Q, b, nxt: self.J_Q(Q, l, b, nxt)
        Q, loss_Q = l.Q.descend(J_Q, b, nxt, rate=decay * self.rate_Q, parts=n)
        l = eqx.tree_at(lambda l: l.Q, l, Q)

        # phi <- phi - iota_pi grad J_pi, eq. (11); XLA merges this drawing with the one above
        J_pi = lambda pi, b: self.J_pi(*draw(pi, b), l, b)
        pi, loss_pi = l.pi.descend(J_pi, b, rate=decay * self.rate_pi, parts=n)

        # alpha <- alpha - iota_alpha grad J_alpha
        log_alpha, _ = l.log_alpha.descend(self.J_alpha, now, rate=decay * self.rate_alpha)

        # theta-bar <- tau theta + (1 - tau) theta-bar, and psi <- psi - iota_L grad J_L
        Q_bar = polyak(Q.value, l.Q_bar, self.tau)
        L, info = self.constraint.update(l.L, b, now, nxt, decay)

        pi_mean = polyak(pi.value, l.pi_mean, self.ema_rate)
        info |= {
            "J_Q": loss_Q,
            "J_pi": loss_pi,
            "alpha": jnp.exp(log_alpha.value),
            "entropy": -jnp.mean(jnp.sum(now.log_prob, axis=1)),
        }
        return Networks(pi, pi_mean, Q, Q_bar, log_alpha, L), info

    def explore(self, networks) -> AbstractExplorer:
        return Sampled(networks.pi.value)

    def policy(self, networks) -> Policy:
        return Greedy(networks.pi_mean)

    def lyapunov(self, networks):
        return self.constraint.lyapunov(networks.L)

    def team(self, per_agent):
        """What the critics' heads stand for: the team's mean, or each agent."""
        return per_agent if self.heads == "agent" else jnp.mean(per_agent, keepdims=True)
