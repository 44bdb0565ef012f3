"""A learnt controller of one unicycle, proved: experiments/results/proof-*.

A network of two layers of 16 learns to imitate a smooth law, with weight decay. Branch and bound
then shows of the network itself, for every state of a region, that V falls in each step until the
target's ball is entered, and that the ball is not left again. The region is {V <= c} with

    near    the states close to the target
    all     every start that the game can draw, any speed on the way included

What is written is a certificate: `marlyap recheck experiments/results/proof-near` reads it.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from marlyap.certificates.certify import certify, save
from marlyap.certificates.lyapunov import Approach
from marlyap.certificates.proof import Proof, extents
from marlyap.games.planar import Goals
from marlyap.nets.nets import Actors, Greedy, Shape
from marlyap.runs.provenance import provenance
from marlyap.seeds import stream
from marlyap.simulation.rollout import Decentralised
from marlyap.storage.store import write_text_atomic
from marlyap.tasks.rendezvous import Rendezvous
from marlyap.types import State


RESULTS = Path(__file__).parent / "results"
GAME = Rendezvous(agents=1)
# V, the gains of the law that is imitated (1/s), and c, rho, inner and decay of the proof. V was
# tuned by descent on the largest V(f(x)) / V(x) over sampled states.
REGIONS = {
    "near": (
        {"m": 1.716, "k": 0.743, "k_near": 0.131, "k_turn": 3.284}
        | {"g_v": 1.076, "g_w": 0.439, "eps": 0.209},
        (6.25, 8.83),
        (1.0, 0.08, 0.1, 0.01),
    ),
    "all": (
        {"m": 1.401, "k": 0.5028, "k_near": 0.0307, "k_turn": 1.8659}
        | {"g_v": 7.516, "g_w": 9.4887, "eps": 22.77},
        (10.0, 10.0),
        (13.8, 0.09, 0.1, 0.005),
    ),
}


def seen(errors):
    """The one agent's state with these errors (e.h, e.n, v, w), up to a turn and a shift."""
    x = jnp.concatenate([jnp.zeros(3), errors[2:]])[None]
    return State(x=x, scenario=Goals(errors[None, :2]), t=jnp.asarray(0))


def law(V, gains, errors):
    """tanh(gain (v_d - v) / limit), and the same for the turn rate."""
    gap = V.desired(errors[:2], GAME.radius) - errors[2:]
    return jnp.tanh(jnp.asarray(gains) * gap / jnp.asarray(GAME.dynamics.limits))


def draw(V, c, key, count):
    """States of all levels up to c: the level log-uniform, its shares and directions random."""
    k_level, k_share, k_turn, k_gap = jax.random.split(key, 4)
    uniform = lambda k, high: jax.random.uniform(k, (count,), maxval=high)
    level = 1.05 * c * (0.01 / c) ** uniform(k_level, 1.0)
    share, turn, way = uniform(k_share, 1.0), *(uniform(k, 2 * jnp.pi) for k in (k_turn, k_gap))
    length = level * share / (1 + V.m - V.m * jnp.cos(turn))
    e = length[:, None] * jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=1)
    size = jnp.sqrt(level * (1 - share) * (level * (1 - share) + 2 * V.eps))
    gap = size[:, None] * jnp.stack([jnp.cos(way) / V.g_v, jnp.sin(way) / V.g_w], axis=1)
    rates = jax.vmap(lambda e: V.desired(e, GAME.radius))(e) + gap
    return jnp.concatenate([e, rates], axis=1)


def imitate(V, gains, c, width, seed, steps=2000):
    """A policy network that does as the law does on the states of {V <= c}."""
    key = stream(seed, "initialise")
    actors = Actors(Shape(1, 7, 6, 4, 2), width, key=key)
    adam = optax.adamw(optax.cosine_decay_schedule(3e-3, steps), weight_decay=1e-4)

    def loss(actors, key):
        x = draw(V, c, key, 2048)
        wrong = lambda x: actors.mode(GAME.observations(seen(x)))[0] - law(V, gains, x)
        return jnp.mean(jax.vmap(wrong)(x) ** 2)

    @eqx.filter_jit
    def step(actors, memory, key):
        key, k_draw = jax.random.split(key)
        value, slope = eqx.filter_value_and_grad(loss)(actors, k_draw)
        change, memory = adam.update(slope, memory, eqx.filter(actors, eqx.is_inexact_array))
        return eqx.apply_updates(actors, change), memory, key, value

    memory, value = adam.init(eqx.filter(actors, eqx.is_inexact_array)), jnp.inf
    for _ in range(steps):
        actors, memory, key, value = step(actors, memory, key)
    return Decentralised(Greedy(actors), GAME), float(value)


def sampled(controller, V, c, rho, count=400_000):
    """The largest V(f(x)) / V(x) over random states of the annulus, which no proof can beat."""

    @eqx.filter_jit
    def ratio(x):
        state = seen(x)
        after = GAME.step(state, controller(state, jax.random.key(0)))
        return V.value(GAME, after) / V.value(GAME, state)

    x = draw(V, c, stream(1, "certify"), count)
    level = jax.vmap(lambda x: V.of(x, GAME.radius))(x)
    return float(jnp.max(jnp.where((level >= rho) & (level <= c), jax.vmap(ratio)(x), 0.0)))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--region", choices=[*REGIONS], default="near")
    parser.add_argument("--width", type=int, default=16, help="of the policy network's layers")
    parser.add_argument("--most", type=int, default=20_000_000, help="boxes before giving up")
    parser.add_argument("--resume", help="a directory that keeps what is left to do")
    args = parser.parse_args()
    numbers, gains, (c, rho, inner, decay) = REGIONS[args.region]
    V = Approach(**{name: jnp.asarray(value) for name, value in numbers.items()})
    start = time.monotonic()
    controller, wrong = imitate(V, gains, c, args.width, seed=0)
    trained = time.monotonic()
    worst = sampled(controller, V, c, rho)
    print(f"imitated to {wrong:.2g} in {trained - start:.0f} s; sampled ratio {worst:.4f}")
    half = 1.2 * extents(V, np.array([c]), np.full(4, np.inf))[0]
    half[:2] = 1.02 * c, 1.02 * c / (1 + 2 * numbers["m"]) ** 0.5  # ahead of the goal, beside it
    half[2:] += [numbers["k"] * c, numbers["k_turn"]]
    proof = Proof(c=c, rho=rho, inner=inner, half=tuple(half.tolist()), eta=1e-5, decay=decay)
    proof = dataclasses.replace(proof, most=args.most, resume=args.resume, show=True)
    result = certify(GAME, controller, {"proof": proof}, seed=0, confidence=0.999, V=V)
    seconds = time.monotonic() - trained
    starts = jax.vmap(GAME.reset)(jax.random.split(stream(0, "certify"), 100_000))
    share = jnp.mean(jax.vmap(lambda s: V.value(GAME, s))(starts) <= c)
    verdict = result["verdicts"]["proof"]
    place = RESULTS / f"proof-{args.region}"
    save(place, result, GAME, controller, V, replace=True)
    summary = {
        "region": args.region,
        "V": numbers,
        "width": args.width,
        "mean_squared_error": wrong,
        "sampled_ratio": worst,
        "share_of_starts": float(share),
        "seconds": round(seconds, 1),
    }
    made = {"policy": result["policy"]} | provenance()
    text = json.dumps(summary | verdict | made, indent=1) + "\n"
    write_text_atomic(place.with_suffix(".json"), text)
    print(f"{verdict['claim']} ({verdict['figures']['boxes']} boxes, {seconds:.0f} s).")


if __name__ == "__main__":
    main()
