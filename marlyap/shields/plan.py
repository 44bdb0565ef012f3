"""The base law of one agent simulated ahead: what it costs, and when it is at rest."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from marlyap.controllers.controller import Robots
from marlyap.controllers.drives import AbstractDrive, Point, X
from marlyap.types import Action, Scalar


class Worth(NamedTuple):
    """What the plan from a state is worth."""

    cost: Scalar  # J, the sum of the next T costs; exact where the plan arrives
    steps: Int[Array, ""]  # spent outside the terminal set; T + 1 where the plan does not arrive


class Plan(eqx.Module):
    """kappa, Omega, c and J of section 2 in docs/stability.md, for one agent and a point q.

        Omega(q)   = { |p - q| <= rho, and a single step of braking meets no limit }
        kappa(x;q) = the base law outside Omega, and braking inside
        c(x;q)     = 0 in Omega, else tau + max(|p - q| - rho, 0) + weight |v|
        J(x;q)     = c summed along x+ = f(x, kappa(x;q)), over T steps

    With semi-implicit Euler an agent in Omega rests after one step, where it is, so that Omega is
    invariant and J is exact once the plan has arrived.
    """

    game: Robots  # the model: nominal dynamics and dt
    drive: AbstractDrive
    rho: float  # m
    tau: float  # cost of every step outside Omega (m)
    weight: float  # of the speed in the cost (s)
    steps: int  # T

    def arrived(self, x: X, q: Point) -> Bool[Array, ""]:
        """Whether x is in Omega(q)."""
        near = jnp.sum((self.game.dynamics.position(x) - q) ** 2) <= self.rho**2
        return near & self.drive.slow(self.game, x)

    def law(self, x: X, q: Point) -> Float[Array, "du"]:
        """kappa(x;q) as an action in [-1, 1]."""
        there = self.arrived(x, q)
        # Where both are at one place the base law has no derivative: it is not asked there.
        aside = jnp.where(there, self.game.dynamics.position(x) + 1.0, q)
        u = jnp.where(there, self.drive.brake(self.game, x), self.drive.drive(self.game, x, aside))
        return jnp.clip(u / jnp.asarray(self.game.dynamics.limits), -1.0, 1.0)

    def after(self, x: X, action: Float[Array, "du"]) -> X:
        """f(x, u): the agent's own equations of motion."""
        dynamics = self.game.dynamics
        return dynamics.step(x, dynamics.inputs_of(action), self.game.dt)

    def cost(self, x: X, q: Point) -> Scalar:
        """c(x;q) (m)."""
        d = self.game.dynamics
        off = jnp.sqrt(jnp.sum((d.position(x) - q) ** 2) + 1e-18)
        speed = jnp.sqrt(jnp.sum(d.velocity(x) ** 2) + 1e-18)
        out = self.tau + jnp.maximum(off - self.rho, 0.0) + self.weight * speed
        return jnp.where(self.arrived(x, q), 0.0, out)

    def worth(self, x: X, q: Point) -> Worth:
        """J(x;q), and how many steps the plan takes."""

        def tick(x, _):
            return self.after(x, self.law(x, q)), (self.cost(x, q), ~self.arrived(x, q))

        last, (costs, outside) = jax.lax.scan(tick, x, length=self.steps)
        steps = jnp.sum(outside) + ~self.arrived(last, q)
        return Worth(jnp.sum(costs), jnp.where(self.arrived(last, q), steps, self.steps + 1))

    def foreseen(self, x: X, underway: Float[Array, "delay du"]) -> X:
        """The state in which the next action begins to act."""
        for action in underway:
            x = self.after(x, action)
        return x


def foreseen(
    plan: Plan, x: Float[Array, "agent dx"], underway: Float[Array, "delay agent du"]
) -> Float[Array, "agent dx"]:
    """The same for every agent, each by its own actions under way."""
    return jax.vmap(plan.foreseen, in_axes=(0, 1))(x, underway)


def laws(plan: Plan, x: Float[Array, "agent dx"], q: Float[Array, "agent 2"]) -> Action:
    """kappa of every agent, each towards its own point."""
    return jax.vmap(plan.law)(x, q)


def worths(plan: Plan, x: Float[Array, "many dx"], q: Float[Array, "many 2"]) -> Worth:
    """The plans of many agents, or of states that one may come to."""
    return jax.vmap(plan.worth)(x, q)
