"""C10: a team behind a credit shield comes to rest, whatever its policy does."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from marlyap.certificates.certificate import (
    AbstractCertificate,
    Draw,
    Evidence,
    Judgement,
    Verdict,
    judged,
    limits,
    worst_of,
)
from marlyap.errors import UserError
from marlyap.seeds import stream
from marlyap.shields import Plan, Shield, Shielded as Game, split
from marlyap.types import Key


STATES = 1_000  # random states at which the model, the terminal set and the plans are tested
MODEL, STOPS, SUMS = 1e-5, 1e-6, 1e-3  # how far each may be off in float32


def claim(n: int, share: float, rho: float, broken: list[str]) -> str:
    """In words; `broken` are the conditions that do not hold."""
    if broken:
        return f"the theorem does not apply: {'; '.join(broken)}"
    return (
        "by construction: whatever the policy does, every agent comes to rest for good, one that "
        f"is k hops from a leader within (k + 1) {rho:g} m of its place; from the starts drawn a "
        f"leader is on its way for at most {n} steps, and no leader pays more than {share:g} times "
        "what the base law would"
    )


class Shielded(AbstractCertificate):
    """A team behind a credit shield comes to rest in finite time, for any policy.

    C10. Theorems 1 and 2 of docs/stability.md: with exact models, goals that rest, and a path of
    parents from a leader to every agent, and where the base law reaches Omega(q),

        sum_{k<t} c(x_k;q) <= (1 + sigma) J(x_0;q)      for a leader, and so
        it is outside Omega for at most n_0 = (1 + sigma) J(x_0;q) / tau steps,
        |p_i - p*_i| <= (hops_i + 1) rho                for every agent, at rest from some step on.

    The conditions are tested by name: `model` and `terminal set` at random states, `sums` (that J
    falls by c along the base law), `tree` by the graph, `goals` and `plans` (that they arrive)
    along rollouts. That plans arrive is thereby seen, not proved, which the scope says. In the
    same rollouts the bounds are held against what happened, and what was admitted is counted.
    """

    rollouts: int = 100
    confidence: float = 1.0
    evidence: ClassVar[Evidence] = "observed"

    def refuse(self, loop):
        shield = split(loop.game)[1]
        if shield is None or not shield.on:
            raise UserError(
                "shielded: the game has no shield that is on; add --shield, or leave it out."
            )

    def check(self, loop, seed):
        self.refuse(loop)
        game: Any = loop.game
        shield: Shield = game.shield
        steps = 10 * game.horizon
        found = judged(self.judge, loop, Draw(seed, "certify", self.rollouts), steps)
        off = {k: float(v) for k, v in inexact(game, stream(seed, "calibrate")).items()}
        sums = {k: np.asarray(v, float) for k, v in found.figures.items()}
        n = int(np.max(np.ceil((1 + shield.sigma) * sums["first"] / shield.tau - 1e-4)))
        broken = faults(game, off, sums)
        holds, k = not broken and bool(found.holds.all()), int(found.holds.sum())
        asked = max(float(np.sum(sums["asked"])), 1.0)
        figures = {
            "sigma": shield.sigma,
            "rho": shield.rho,
            "tau": shield.tau,
            "plan_steps": shield.steps,
            "window": shield.window_of(int(game.hops.max())),
            "broken": broken,
            "J_0": float(np.max(sums["first"])),
            "steps_of_a_leader": int(np.max(sums["steps"])),
            "paid_over_bound": float(np.max(sums["paid"])),
            "admitted": float(np.sum(sums["admitted"]) / asked),
            "delta_mean": float(np.mean(sums["delta"])),
            "last_moving": int(np.max(sums["moving"])),
        }
        return Verdict(
            name="shielded",
            claim=claim(n, 1 + shield.sigma, shield.rho, broken),
            evidence=self.evidence,
            holds=holds,
            bound=float(n),
            confidence=None,
            scope=limits(game, steps) | {"provided": "plans arrive, as in all states visited here"},
            trials=self.rollouts,
            successes=k,
            worst=worst_of(game, seed, "certify", found),
            figures=figures,
        )

    def judge(self, game, V, trajectory, key):
        m = jax.tree.map(lambda leaf: leaf[-1], trajectory.state.memory)
        last = jax.tree.map(lambda leaf: leaf[-1], trajectory.state)
        leads, hops = jnp.asarray(game.leads), jnp.asarray(game.hops)
        bound = (1 + game.shield.sigma) * m["first"]
        paid = jnp.max(jnp.where(leads & (bound > 0), m["paid"] / bound, 0.0))
        x = trajectory.state.x
        moving = jnp.max(
            jnp.where(jnp.any(x[1:] != x[:-1], axis=(1, 2)), jnp.arange(len(x) - 1), -1)
        )
        within = game.distance(last) <= (hops + 1) * game.shield.rho + 1e-5
        rests = jnp.all(jnp.abs(jax.vmap(game.dynamics.rates)(last.x)) < 1e-6)
        goals = jax.vmap(game.goals)(trajectory.state)
        figures = {
            "first": jnp.max(jnp.where(leads, m["first"], 0.0)),
            "steps": jnp.max(jnp.where(leads, m["asked"], 0.0)),
            "paid": paid,
            "admitted": jnp.sum(m["admitted"]),
            "asked": jnp.sum(m["asked"]),
            "delta": jnp.sum(m["others"]),
            "moving": moving.astype(float),
            "late": jnp.sum(m["late"]),
            "goals": jnp.max(jnp.abs(goals - goals[:1])),
        }
        return Judgement(jnp.all(within) & rests & (paid <= 1 + 1e-3), paid, figures)


def faults(game: Game, off: dict[str, float], sums: dict[str, np.ndarray]) -> list[str]:
    """The conditions that do not hold, in words."""
    said = {
        f"model: an agent moves otherwise than it plans, by {off['model']:.2g} in a step": (
            off["model"] > MODEL
        ),
        f"terminal set: an agent that brakes there still moves, by {off['stops']:.2g}": (
            off["stops"] > STOPS
        ),
        f"sums: J does not fall by c along the base law but by {off['sums']:.2g} more or less": (
            off["sums"] > SUMS
        ),
        "tree: no path leads from a leader to every agent": bool((game.hops < 0).any()),
        "goals: they move during an episode": bool(sums["goals"].max() > 0),
        f"plans: {int(sums['late'].sum())} did not arrive within {game.shield.steps} steps": bool(
            sums["late"].sum() > 0
        ),
    }
    return [text for text, wrong in said.items() if wrong]


@eqx.filter_jit
def inexact(game: Game, key: Key) -> dict[str, Array]:
    """The largest faults of model, terminal set and sums at random states."""
    plan: Plan = game.plan
    k_start, k_rates, k_act, k_place = jax.random.split(key, 4)
    states = jax.vmap(game.reset)(jax.random.split(k_start, STATES))
    rates = jnp.array(game.dynamics.blocks[0])
    noise = jax.random.normal(k_rates, (STATES, game.agents, len(rates)))
    x = states.x.at[..., rates].add(noise)
    actions = jax.random.uniform(k_act, (STATES, game.agents, game.du), minval=-1.0)
    moved = eqx.tree_at(lambda s: s.x, states, x)
    real = jax.vmap(lambda s, a: game.inner.step(game.inside(s), a).x)(moved, actions)
    model = jnp.max(jnp.abs(real - jax.vmap(jax.vmap(plan.after))(x, actions)))

    def alone(x, q):
        now, law = plan.worth(x, q), plan.law(x, q)
        then = plan.worth(plan.after(x, law), q)
        off = jnp.abs(now.cost - plan.cost(x, q) - then.cost)
        return jnp.where(now.steps < plan.steps, off, 0.0)

    q = jax.vmap(game.goals)(states)
    sums = jnp.max(jax.vmap(alone)(x[:, 0], q[:, 0]))
    slow = x[:, 0].at[..., rates].multiply(0.1)
    side = jax.random.uniform(k_place, (STATES, 2), minval=-1.0) * plan.rho
    at = jax.vmap(game.dynamics.position)(slow)

    def stop(x, q):
        after = plan.after(x, plan.law(x, q))
        rest = jnp.max(jnp.abs(game.dynamics.rates(after)), initial=0.0)
        gone = jnp.max(jnp.abs(game.dynamics.position(after) - game.dynamics.position(x)))
        return jnp.where(plan.arrived(x, q), jnp.maximum(rest, gone), 0.0)

    stops = jnp.max(jax.vmap(stop)(slow, at + side))
    return {"model": model, "stops": stops, "sums": sums}
