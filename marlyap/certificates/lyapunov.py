"""The functions V that certificates judge by: each zero on the target set, or in a ball around it.

The first two need no network and serve any controller, the hand-written too.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.games.sensing import near
from marlyap.nets.nets import NormNet
from marlyap.simulation.rollout import Controller, rollout
from marlyap.types import Scalar, State, Trajectory


def measured(distance: float, unit: str, digits: int = 6) -> str:
    """A distance with its unit, such as "0.1 m" or "2 tolerances"."""
    plural = "s" if unit == "tolerance" and distance != 1.0 else ""
    return f"{distance:.{digits}g} {unit}{plural}"


class AbstractLyapunov(eqx.Module):
    """V(s) >= 0. It has to fall by a share of c_rho(s), the mean of max(0, distance_i - rho)."""

    ball: eqx.AbstractVar[float]  # rho, in the unit of the distance

    @property
    def meaning(self) -> str:
        """What V is, in words: "V, <meaning>" stands in the claims about it."""
        return f"as {type(self).__name__} defines it"

    @property
    @abc.abstractmethod
    def beyond(self) -> int:
        """How many steps past a state `along` has to see."""

    @abc.abstractmethod
    def value(self, game: AbstractRegulation, state: State) -> Scalar:
        """V(s)."""

    @abc.abstractmethod
    def along(
        self, game: AbstractRegulation, trajectory: Trajectory, time: int
    ) -> Float[Array, "{time}"]:
        """V of the first `time` states of a rollout with at least `beyond` states after them."""

    def cost(self, game: AbstractRegulation, state: State) -> Scalar:
        """c_rho(s)."""
        return jnp.mean(jax.nn.relu(game.distance(state) - self.ball))


class CostSum(AbstractLyapunov):
    """V(s) = sum_{k<T} c_rho(s_k) along the closed loop from s: the T-step cost sum, network-free.

    Along a rollout of the same controller V(s_{t+1}) - V(s_t) = c_rho(s_{t+T}) - c_rho(s_t).
    """

    controller: Controller  # deterministic, without memory
    T: int = 20  # steps
    ball: float = 0.0  # rho
    unit: str = "m"  # of rho

    @property
    def meaning(self):
        return f"the sum of the next {self.T} costs beyond {measured(self.ball, self.unit)}"

    @property
    def beyond(self):
        return self.T

    def value(self, game, state):
        seen = rollout(game, self.controller, state, jax.random.key(0), self.T)
        return self.along(game, seen, 1)[0]

    def along(self, game, trajectory, time):
        cost = jax.vmap(lambda s: self.cost(game, s))(trajectory.state)
        window = jnp.arange(time)[:, None] + jnp.arange(self.T)[None, :]
        return jnp.sum(cost[window], axis=1)


class Quadratic(AbstractLyapunov):
    """V(s) = sum_i e_i' P e_i, with e_i zero exactly on the target set (`game.errors`)."""

    P: Float[Array, "error error"]
    ball: float = 0.0

    @property
    def meaning(self):
        return "a quadratic form in the errors"

    @property
    def beyond(self):
        return 0

    def value(self, game, state):
        e = game.errors(state)
        return jnp.sum((e @ self.P) * e)

    def along(self, game, trajectory, time):
        return pointwise(self, game, trajectory, time)


class Approach(AbstractLyapunov):
    """V(s) = sum_i (1 + m) |e_i| - m e_i.h_i + |(g_v (v_i - v_d), g_w (w_i - w_d), eps)| - eps.

    For unicycles, with e_i the way to the goal, h_i the heading, n_i its left normal, and

        v_d = (k + k_near / (|e| + radius)) e.h,    w_d = k_turn e.n / (|e| + radius)

    the speeds it would like. V is 0 exactly on the target set, at least |e_i| elsewhere, and
    Lipschitz with a constant that its fields bound. By the second term an agent beside its goal has
    something to gain from turning, without which V could not fall in every single step.
    """

    m: Scalar
    k: Scalar  # 1/s
    k_near: Scalar  # m/s
    k_turn: Scalar  # rad/s
    g_v: Scalar  # s
    g_w: Scalar  # m s/rad
    eps: Scalar  # m
    ball: float = 0.0

    @property
    def meaning(self):
        return "the distances and headings to the goal and the gaps to the desired speeds"

    @property
    def beyond(self):
        return 0

    def value(self, game, state):
        return jnp.sum(jax.vmap(lambda e: self.of(e, game.edge))(game.errors(state)))

    def along(self, game, trajectory, time):
        return pointwise(self, game, trajectory, time)

    def of(self, errors: Float[Array, "4"], radius: float) -> Scalar:
        """V of one agent with errors (e.h, e.n, v, w)."""
        e, rates = errors[:2], errors[2:]
        gap = jnp.stack([self.g_v, self.g_w]) * (rates - self.desired(e, radius))
        slack = jnp.sqrt(jnp.sum(gap * gap) + self.eps**2) - self.eps
        return (1 + self.m) * jnp.linalg.norm(e) - self.m * e[0] + slack

    def desired(self, e: Float[Array, "2"], radius: float) -> Float[Array, "2"]:
        """v_d (m/s) and w_d (rad/s)."""
        towards = near(e, radius)
        return jnp.stack([self.k * e[0] + self.k_near * towards[0], self.k_turn * towards[1]])


class Norm(AbstractLyapunov):
    """V(s) of a trained `NormNet`: zero on the target set, positive elsewhere by construction."""

    net: NormNet
    ball: float = 0.0

    @property
    def meaning(self):
        return "a trained network that is zero on the target set"

    @property
    def beyond(self):
        return 0

    def value(self, game, state):
        return self.net(game.features(state))

    def along(self, game, trajectory, time):
        return pointwise(self, game, trajectory, time)


def pointwise(
    V: AbstractLyapunov, game: AbstractRegulation, trajectory: Trajectory, time: int
) -> Float[Array, "{time}"]:
    """V of each of the first `time` states on its own."""
    states = jax.tree.map(lambda leaf: leaf[:time], trajectory.state)
    return jax.vmap(lambda s: V.value(game, s))(states)


@eqx.filter_jit
def _values(V: AbstractLyapunov, game: AbstractRegulation, keys: Array) -> tuple[Array, Array]:
    starts = jax.vmap(game.reset)(keys)
    value = jax.vmap(lambda s: V.value(game, s))
    return value(jax.vmap(lambda s: game.at_target(s))(starts)), value(starts)


def require_zero(game: AbstractRegulation, V: AbstractLyapunov, key: Array) -> None:
    """Raise UserError unless V is 0 on the target set, to 1e-5 of what it is at the starts."""
    there, starts = _values(V, game, jax.random.split(key, 64))
    worst, usual = float(jnp.max(jnp.abs(there))), float(jnp.median(jnp.abs(starts)))
    if not worst <= 1e-5 * max(usual, 1e-12):
        raise UserError(
            f"V, {V.meaning}, is {worst:.3g} on the target set, where it must be 0 (it is "
            f"{usual:.3g} at a usual start); take a V that is 0 there, or certificates "
            "that do not ask for one, such as reach."
        )


def cost_sum(game: AbstractRegulation, controller: Controller, key: Array) -> CostSum:
    """The T-step cost sum outside the smallest ball that the controller keeps from the target.

    Learnt policies keep moving a little there: what counts is leaving the ball. Its radius is the
    edge of success, or two or four times that; for a controller that drifts further the first, and
    `require_zero` refuses that V.
    """
    V = CostSum(controller=controller, ball=game.edge, unit=game.unit)
    drift = float(_furthest(V, game, jax.random.split(key, 64)))
    balls = [game.edge * 2**k for k in range(3)]
    return eqx.tree_at(lambda v: v.ball, V, next((b for b in balls if drift <= b), balls[0]))


@eqx.filter_jit
def _furthest(V: CostSum, game: AbstractRegulation, keys: Array) -> Scalar:
    """How far any agent gets from its goal within T steps from the target set."""

    def one(key: Array) -> Scalar:
        start = game.at_target(game.reset(key))
        seen = rollout(game, V.controller, start, jax.random.key(0), V.T)
        return jnp.max(jax.vmap(game.distance)(seen.state))

    return jnp.max(jax.vmap(one)(keys))
