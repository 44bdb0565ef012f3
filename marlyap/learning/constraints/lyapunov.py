"""The Lyapunov stability constraint of section 3.2, as an object that MASAC is given.

    paper                       here                                    where
    L_psi(s, a)                 net(features, action)                   below (14)
    L_target, T                 target, horizon                         below (14)
    beta in [0, 1] before dL    weight, or learnt as exp(log_weight)    (14)
    beta before c               decrease                                below (14)
    l_L l_f                     slope                                   Theorem 1, (13)
    Delta L                     rise(...)                               below (14)

The paper prints one beta for the weight and for the share of the cost by which L must fall; here
they are two. As printed, Delta L has a gradient through ||a_phi - a|| alone, which clones the
actions in the memory, so it needs an interpretation. There are five, called readings; in all of
them a is from the memory unless said otherwise:

    han      L(s', a') - L(s, a) + decrease c, with a' drawn from the current policy (Han et al.
             2020); the default
    literal  the same without gradient, plus slope ||a_phi - a||. The paper has a' from the memory;
             transitions hold no next action, so here too it is drawn from the current policy
    hinge    max(0, L(s', a') - L(s, a) + decrease c + slope ||a_phi - a||), only where
             L(s', a') - L(s, a) + decrease c <= 0: imitate what worked (Theorem 1 holds for any
             tuple)
    score    raise the likelihood of actions after which the state function L fell, and lower it of
             those after which it rose, with a clipped ratio (as in proximal policy optimisation)
    critic   L(s, a) itself, with a from the current policy: no Lyapunov condition at all, but the
             same sum of the next T costs; the control that shows what the condition adds

What the condition does not say:

* It is asked of the mean of a batch: one weight, raised while that mean is positive, penalises all
  states alike. At single states it holds only as far as it is measured (certificate `decrease`).
* The weight follows L(s', a') - L(s, a) + decrease c. For `literal` and `hinge` the margin
  slope ||a_phi - a|| is part of the penalty and not of what the weight follows.
* J_L is fitted to the whole replay memory, random warm-up included: L is the T-step cost sum of
  a mixture of old policies, not of the current one.
* L is a sum of squares of features and not zero on the target set by construction; with function
  `norm` it is.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.learning.constraint import AbstractConstraint
from marlyap.learning.constraints.readings import READINGS, Terms, mean_over, rise
from marlyap.learning.optimiser import TrainState, polyak
from marlyap.learning.source import CostWindow
from marlyap.nets.nets import LyapunovNet, NormNet, Sample
from marlyap.types import Action, Scalar, Transition


class LearnedLyapunov(eqx.Module):
    """What the constraint has learnt."""

    net: TrainState[LyapunovNet | NormNet]
    net_bar: LyapunovNet | NormNet  # slow copy, for targets that bootstrap
    log_weight: TrainState[Scalar]
    gradient: Scalar  # the 95 % quantile over a batch of |grad L| by features, a running mean
    scale: Scalar  # running mean square of the fall of L, for `score`


class Lyapunov(AbstractConstraint):
    """Algorithm 2's term `weight * Delta L` in J_pi, with L learnt beside it.

    Raises UserError for values out of range and for readings and functions that do not fit.
    """

    traced = (
        "discount",
        "decrease",
        "weight",
        "weight_start",
        "floor",
        "input_gain",
        "clip",
        "rate_L",
        "rate_weight",
        "tau",
    )

    reading: str = "han"  # how Delta L is read; one of han, literal, hinge, score, critic
    function: Literal["squares", "norm"] = "squares"  # L(s, a) sum of squares, or V(s) norm-like
    horizon: int = 10  # T of L_target, in steps
    target: Literal["rollout", "hold_last", "bootstrap", "discounted"] = "rollout"  # what L learns
    discount: float = 0.95  # of the target `discounted`
    decrease: float = 0.1  # L must fall by this share of the cost
    weight: float | None = None  # of Delta L in J_pi; None: learnt, in [floor, 1]
    weight_start: float = 1.0  # the learnt weight to begin with
    floor: float = 1e-3  # smallest learnt weight
    ball: float = 0.0  # the constraint holds only where the team's cost exceeds this (m)
    agents: tuple[int, ...] = ()  # whose costs and actions it is about; empty: everybody's
    slope: float | Literal["empirical", "spectral"] = 0.0  # l_L l_f, or how l_L is estimated
    input_gain: float = 0.505  # l_f per unit of action: 0.101 for the unicycle at 0.1 s, times 5
    clip: float = 0.2  # the ratio of `score` stays within 1 -+ this
    normalise: bool = False  # LayerNorm in L
    rate_L: float = 3e-3  # learning rate of L
    rate_weight: float = 3e-4  # learning rate of the weight, on its logarithm
    tau: float = 0.005  # how fast the slow copy of L follows

    def __check_init__(self):
        if self.reading not in READINGS:
            names = ", ".join(READINGS)
            raise UserError(f"reading: '{self.reading}' is unknown; take one of {names}.")
        fit = READINGS[self.reading].functions
        if self.function == "norm" not in fit:
            others = [name for name, r in READINGS.items() if "norm" in r.functions]
            raise UserError(
                "function: 'norm' is a function of the state alone, which gives the reading "
                f"'{self.reading}' no gradient; take function squares or a reading among "
                f"{', '.join(others)}."
            )
        if self.function not in fit:
            raise UserError(f"reading: '{self.reading}' needs function {' or '.join(fit)}.")
        if self.function == "squares" and self.slope == "spectral":
            raise UserError("slope: 'spectral' needs function norm.")
        check_range("horizon", self.horizon, 1, 10_000)
        for name in ("discount", "decrease", "tau"):
            check_range(name, getattr(self, name), 0, 1, open=name == "tau")
        for name in ("weight_start", "floor", "input_gain"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("ball", "clip", "rate_L", "rate_weight", "weight", "slope"):
            if isinstance(value := getattr(self, name), float | int):
                check_range(name, value, 0, 1e6)
        if len(set(self.agents)) != len(self.agents):
            raise UserError(f"agents: {self.agents} names an agent twice.")

    @property
    def cost_window(self):
        return CostWindow(self.horizon, beyond=self.target == "rollout")

    def fits(self, agents):
        for i in self.agents:
            check_range("--algorithm.constraint.agents", i, 0, agents - 1)

    def paper(self):
        """The weight of Delta L is learnt; the paper does not have the reading `critic`."""
        learnt = READINGS[self.reading].condition
        return dataclasses.replace(self, weight=None) if learnt else self

    def init(self, shape, key):
        make = LyapunovNet if self.function == "squares" else NormNet
        net = make(shape, self.normalise, key=key)
        one = jnp.ones((), jnp.float32)
        log_weight = jnp.log(self.weight_start * one)
        return LearnedLyapunov(TrainState.of(net), net, TrainState.of(log_weight), one, one)

    def lyapunov(self, L):
        return L.net.value

    def penalty(self, L, b, now, nxt):
        """weight * Delta L of one transition, eq. (14), in the chosen reading.

        The action in the memory is b.action; `now` and `nxt` are drawn from the current policy at s
        and s'.
        """
        terms = Terms(
            L=L.net.value,
            b=b,
            now=self.held(now),
            nxt=self.held(nxt),
            due=self.due(b),
            slope=self.lipschitz(L),
            scale=L.scale,
            clip=self.clip,
            agents=self.agents,
        )
        term = READINGS[self.reading](terms)
        return self.multiplier(L) * jnp.where(self.applies(b), term, 0.0)

    def rise(self, L: LearnedLyapunov, b: Transition, next_action: Action) -> Scalar:
        """L(s', a') - L(s, a) + decrease c, without the margin slope ||a_phi - a|| of Theorem 1."""
        return rise(L.net.value, b, next_action, self.due(b))

    def due(self, b: Transition) -> Scalar:
        """decrease c: L must fall by so much."""
        return self.decrease * self.team(b.cost)

    def J_L(self, net, b: Transition, nxt: Sample, L: LearnedLyapunov) -> Scalar:
        """J_L = 1/2 (L(s, a) - L_target)^2, below (14)."""
        return 0.5 * (net(b.features, b.action) - self.L_target(L, b, nxt)) ** 2

    def L_target(self, L: LearnedLyapunov, b: Transition, nxt: Sample) -> Scalar:
        """The sum of the next T costs: as rolled out, or bootstrapped from c and the slow L."""
        now, ahead = self.team(b.cost), self.team(b.cost_ahead)
        if self.target == "bootstrap":
            return now - ahead + L.net_bar(b.next_features, nxt.action)
        if self.target == "discounted":
            return now + self.discount * L.net_bar(b.next_features, nxt.action)
        return self.team(b.cost_to_go)

    def update(self, L, b, now, nxt, decay):
        """psi <- psi - iota_L grad J_L, and the dual step: the weight follows the mean rise."""
        J_L = lambda net, b, nxt: self.J_L(net, b, nxt, L)
        net, loss = L.net.descend(J_L, b, nxt, rate=decay * self.rate_L)

        rises = jax.vmap(lambda b, a: self.rise(L, b, a))(b, nxt.action)
        asked = jax.vmap(self.applies)(b)
        surplus = jnp.sum(jnp.where(asked, rises, 0.0)) / jnp.maximum(jnp.sum(asked), 1)
        log_weight = L.log_weight.step(-surplus, decay * self.rate_weight)
        bounded = jnp.clip(log_weight.value, jnp.log(self.floor), 0.0)
        log_weight = eqx.tree_at(lambda w: w.value, log_weight, bounded)

        info = {"J_L": loss, "weight": self.multiplier(L), "rise": surplus}
        learned = LearnedLyapunov(
            net,
            polyak(net.value, L.net_bar, self.tau),
            log_weight,
            self.steepness(L, b) if self.slope == "empirical" else L.gradient,
            0.99 * L.scale + 0.01 * jnp.mean((rises - jnp.mean(rises)) ** 2),
        )
        return learned, info

    def multiplier(self, L: LearnedLyapunov) -> Scalar:
        """The weight of Delta L; no gradient reaches it through J_pi."""
        if self.weight is not None:
            return jnp.asarray(self.weight)
        return jax.lax.stop_gradient(jnp.exp(L.log_weight.value))

    def applies(self, b: Transition) -> Array:
        """Whether the constraint applies here: outside the ball."""
        return self.team(b.cost) > self.ball if self.ball > 0 else jnp.asarray(True)

    def team(self, per_agent: Float[Array, "agent"]) -> Scalar:
        """The mean over the agents that the constraint is about."""
        return mean_over(self.agents, per_agent)

    def held(self, drawn: Sample) -> Sample:
        """The drawn actions, with a gradient only for the agents that the constraint is about."""
        if not self.agents:
            return drawn
        everyone = jnp.arange(drawn.action.shape[0])
        mine = jnp.isin(everyone, jnp.array(self.agents))[:, None]
        action = jnp.where(mine, drawn.action, jax.lax.stop_gradient(drawn.action))
        return drawn._replace(action=action)

    def lipschitz(self, L: LearnedLyapunov) -> Scalar:
        """l_L l_f, the change of L per unit of action."""
        if self.slope == "empirical":
            return L.gradient * self.input_gain
        if self.slope == "spectral" and isinstance(L.net.value, NormNet):
            return L.net.value.lipschitz() * self.input_gain
        return jnp.asarray(self.slope)

    def steepness(self, L: LearnedLyapunov, b: Transition) -> Scalar:
        """The running 95 % quantile of |grad L| by the critic's features.

        Not l_L of Theorem 1, which is a bound (not a quantile) by the state s (not its features).
        """
        total = lambda features: jnp.sum(jax.vmap(L.net.value)(features, b.action))
        size = jnp.sqrt(jnp.sum(jax.grad(total)(b.features) ** 2, axis=(1, 2)))
        return 0.99 * L.gradient + 0.01 * jnp.quantile(size, 0.95)
