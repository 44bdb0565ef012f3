"""Optimal control with full knowledge: how well anyone could do (baseline B6).

Needs casadi, the extra `marlyap[optimal-control]`. Ipopt cannot run inside jit, so the plans are
made first and then replayed:

    actions = plan(game, states)
    jax.vmap(lambda a, s, k: rollout(game, Replayed(a), s, k))(actions, states, keys)
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from marlyap.controllers.controller import AbstractController, Robots
from marlyap.errors import UserError
from marlyap.games.dynamics import Unicycle
from marlyap.simulation.rollout import AbstractPlanner
from marlyap.types import Action, Key, State


class Replayed(eqx.Module):
    """Open loop: the action at step t is row t, and the last row once the plan has ended."""

    actions: Float[Array, "*episode time agent du"]  # the axis `episode` in a batch of plans

    def __call__(self, state: State, key: Key) -> Action:
        return self.actions[jnp.clip(state.t, 0, self.actions.shape[0] - 1)]


class OptimalControl(AbstractPlanner, AbstractController):
    """Each agent minimises miss |p_T - p*|^2 + effort sum |u|^2, ending at rest at the horizon T.

    Every agent knows its goal, so this bounds from above what a decentralised law can reach. The
    problem is solved in multiple shooting from two guesses, forwards and in reverse, by ipopt
    (Waechter and Biegler, Math. Programming 106, 2006) through casadi.
    """

    drives = (Unicycle,)

    game: Robots
    miss: float = 1e2  # weight of the final distance (1/m^2)
    effort: float = 1e-4  # weight of the inputs (s^4/m^2 and s^4/rad^2)

    def __call__(self, state, key):
        raise UserError(
            "controller: optimal-control plans before the episode, so it can be evaluated alone; "
            "choose another controller."
        )

    def plan(self, states: State) -> Replayed:
        """Open-loop inputs for a batch of starts (leaves with a leading axis episode).

        Raises UserError when casadi is missing. An agent whose two problems both fail is sent
        with the better of ipopt's last iterates.
        """
        solve = _solver(self)
        starts, goals = (
            np.asarray(states.x, float),
            np.asarray(jax.vmap(self.game.goals)(states), float),
        )
        each = [
            [solve(x, goal) for x, goal in zip(team, targets, strict=True)]
            for team, targets in zip(starts, goals, strict=True)
        ]
        actions = np.asarray(each, np.float32) / np.asarray(self.game.dynamics.limits, np.float32)
        return Replayed(jnp.asarray(np.clip(np.moveaxis(actions, 1, 2), -1.0, 1.0)))


def _solver(problem: OptimalControl):
    """A function from the start and the goal of one agent to its inputs, time by du."""
    try:
        import casadi  # pyright: ignore[reportMissingImports] -- an extra
    except ImportError:
        raise UserError(
            "controller: optimal-control needs casadi; install it with "
            "pip install 'marlyap[optimal-control]'."
        ) from None
    game = problem.game
    T, limits = game.horizon, np.asarray(game.dynamics.limits)
    X, U = casadi.SX.sym("x", 5, T + 1), casadi.SX.sym("u", 2, T)
    goal = casadi.SX.sym("goal", 2)
    ends = [_step(casadi, game, X[:, k], U[:, k]) for k in range(T)]
    defects = casadi.vec(X[:, 1:] - casadi.horzcat(*ends))
    cost = problem.miss * casadi.sumsqr(X[:2, T] - goal) + problem.effort * casadi.sumsqr(U)
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500}}
    variables = casadi.vertcat(casadi.vec(X), casadi.vec(U))
    nlp = {"x": variables, "p": goal, "f": cost, "g": defects}
    ipopt = casadi.nlpsol("optimal_control", "ipopt", nlp, options)

    def solve(x, target):
        low = np.full((T + 1, 5), -np.inf)
        low[0], low[T, 3:] = x, 0.0  # the start, and rest at the end
        high = np.where(np.isfinite(low), low, np.inf)
        most = np.tile(limits, T)
        answers = []
        for reverse in (False, True):
            guess = np.concatenate([_guess(x, target, T, game.dt, reverse).ravel(), 0 * most])
            low_all, high_all = np.append(low, -most), np.append(high, most)
            answer = ipopt(x0=guess, p=target, lbx=low_all, ubx=high_all, lbg=0, ubg=0)
            worth = float(answer["f"]) if ipopt.stats()["success"] else math.inf
            answers.append((worth, np.asarray(answer["x"])[5 * (T + 1) :].reshape(T, 2)))
        return min(answers, key=lambda a: a[0])[1]

    return solve


def _guess(x, target, T, dt, reverse):
    """The straight line to the target, facing it or facing away."""
    line = target - x[:2]
    facing = math.atan2(line[1], line[0]) + (math.pi if reverse else 0.0)
    turn = (facing - x[2] + math.pi) % (2 * math.pi) - math.pi
    share = np.linspace(0, 1, T + 1)[:, None]
    guess = np.zeros((T + 1, 5))
    guess[:, :2] = x[:2] + share * line
    guess[:, 2] = x[2] + np.minimum(4 * share[:, 0], 1) * turn
    guess[1:T, 3] = np.linalg.norm(line) / (T * dt) * (-1 if reverse else 1)
    return guess


def _step(casadi, game, x, u):
    """`dynamics.step` of the unicycle in casadi's symbols; a test holds the two together."""
    field = lambda x: casadi.vertcat(x[3] * casadi.cos(x[2]), x[3] * casadi.sin(x[2]), x[4], u)
    dt = game.dt
    if game.dynamics.integrator == "euler":
        rates = x[3:] + dt * u
        psi = x[2] + dt * rates[1]
        along = casadi.vertcat(casadi.cos(psi), casadi.sin(psi))
        return casadi.vertcat(x[:2] + dt * rates[0] * along, psi, rates)
    k1 = field(x)
    k2 = field(x + dt / 2 * k1)
    k3 = field(x + dt / 2 * k2)
    k4 = field(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
