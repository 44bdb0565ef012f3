"""The world of a certificate once more, in NumPy and float64: starts, steps, sights, networks, V.

Written apart from the game, the rollout and the networks, so that a mistake in those shows.
"""

import zlib
from typing import Any

import numpy as np

from marlyap import graph as graphs
from marlyap.errors import UserError
from marlyap.threefry import fold, normal, uniform


# Numbers in a state, and those of them that an input drives.
KNOWN = {
    "Unicycle": (5, slice(3, 5)),
    "LateUnicycle": (7, slice(3, 5)),
    "DoubleIntegrator": (4, slice(2, 4)),
    "SingleIntegrator": (2, slice(0, 2)),
}
MOST = 5 * 10**7  # agent-steps of the longest set of rollouts that is played: 2 GB


class Rejected(UserError):
    """The file does not say what its own starts and arrays give."""


def agree(what: str, found: Any, said: Any) -> None:
    if found != said:
        raise Rejected(f"certificate: {what} is {found}, not {said} as the file says.")


class Replica:
    """The closed loop of a rendezvous, with a change to the game where one is asked for."""

    def __init__(self, meta: dict[str, Any], arrays: dict[str, np.ndarray]):
        self.game, self.controller, self.V = meta["game"], meta["controller"], meta["V"]
        self.arrays, self.cache, self.seed = arrays, {}, meta["seed"]
        model = self.game.get("dynamics", {})
        self.kind, self.limits = model.get("kind"), np.array(model.get("limits", []))
        self.turns = "Unicycle" in str(self.kind)
        world = self.game["kind"], self.controller["kind"], model.get("integrator")
        world += self.kind in KNOWN and self.controller["policy"]["kind"], self.game["graph"][:4]
        if world[:4] != ("Rendezvous", "Decentralised", "euler", "Greedy") or world[4] == "disk":
            known = "rendezvous on a fixed graph by Euler steps with a trained policy's mean"
            raise UserError(f"recheck: only {known} is known, not {world} of {self.kind}.")
        agree("the game that the policy sees", self.controller["game"], self.game)
        agree("the policy in V", self.V.get("controller", self.controller), self.controller)
        self.linked = graphs.adjacency(self.game["graph"], self.game["agents"])
        self.slots = graphs.neighbours(self.linked, graphs.room(self.game["graph"]))
        self.leads = np.isin(np.arange(len(self.slots)), self.game["leaders"])

    def keys(self, episodes: Any) -> tuple[np.ndarray, np.ndarray]:
        """One stream per episode of those that certify."""
        seed = np.zeros(1, np.uint32), np.array([self.seed], np.uint32)
        return fold(fold(seed, zlib.crc32(b"certify")), np.atleast_1d(episodes))

    def starts(self, episodes: Any) -> tuple[np.ndarray, np.ndarray, Any]:
        """States [episode, agent, .], goals, and the stream of each episode's disturbances."""
        key, size = fold(self.keys(episodes), 0), self.game["size"]
        draw = lambda i, *shape: 2.0 * uniform(fold(key, i), *shape) - 1
        x = np.zeros((len(key[0]), len(self.slots), KNOWN[self.kind][0]))
        x[..., :2] = size * draw(0, len(self.slots), 2)
        if self.turns:
            x[..., 2] = np.pi * draw(1, len(self.slots))
        goal = np.repeat(size * draw(2, 2)[:, None], len(self.slots), axis=1)
        return x, goal, fold(key, zlib.crc32(b"perturb"))

    def roll(self, n: int, steps: int, change: dict[str, Any]) -> dict[str, Any]:
        """States [n, steps + 1, agent, .] and distances, from the first n starts."""
        if (name := (n, steps, repr(change))) not in self.cache:
            self.bounded(n, steps)
            self.cache = {name: self.drive(*self.starts(np.arange(n)), steps, change)}
        return self.cache[name]

    def bounded(self, n: int, steps: int) -> None:
        """Raise Rejected if so many rollouts would fill the memory."""
        if not 0 <= max(n, 1) * max(steps, 1) * len(self.slots) <= MOST:
            raise Rejected(f"certificate: {n} rollouts of {steps} steps are too many to check.")

    def drive(self, x: Any, goal: Any, key: Any, steps: int, change: Any) -> dict[str, Any]:
        """As `roll`, from states [episode, agent, .] and goals [episode, agent, 2] (m, rad, s)."""
        x[..., :2] *= change.get("spread", 1.0)
        noise, drop = change.get("noise", 0.0), np.float32(change.get("drop", 0.0))
        self.bounded(len(x), steps + change.get("delay", 0))
        linked, present = self.linked.copy(), np.ones(x.shape[1], bool)
        present[list(change.get("gone", []))] = False
        linked &= present[:, None] & present[None, :]
        for a, b in change.get("cut", []):
            linked[[a, b], [b, a]] = False
        shape = x.shape[1], len(self.limits)
        queue, seen = [np.zeros((len(x), *shape))] * change.get("delay", 0), [x]
        limits = change.get("gain", 1.0) * self.limits
        with np.errstate(all="ignore"):
            for t in range(steps):
                lost = drop > 0 and uniform(fold(fold(key, 1), t), *linked.shape) < drop
                queue.append(self.act(x, goal, linked & ~np.asarray(lost)))
                u = queue.pop(0)
                u = u + noise * normal(fold(fold(key, 2), t), *shape) if noise else u
                x = self.step(x, limits * np.clip(u, -1, 1))
                seen.append(x)
        states = np.stack(seen, axis=1)
        distance = np.linalg.norm(states[..., :2] - goal[:, None], axis=-1) * present
        sound = np.isfinite(states).all(axis=(1, 2, 3))
        return {"x": states, "goal": goal, "distance": distance, "sound": sound}

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        dt, x = self.game["dt"], x.copy()
        if self.kind == "LateUnicycle":
            u, x[..., 5:] = x[..., 5:].copy(), u
        x[..., KNOWN[self.kind][1]] += dt * u
        if self.turns:
            x[..., 2] += dt * x[..., 4]
        x[..., :2] += dt * self.motion(x)[0]
        return x

    def heading(self, x: np.ndarray) -> np.ndarray:
        if self.turns:
            return np.stack([np.cos(x[..., 2]), np.sin(x[..., 2])], axis=-1)
        return np.broadcast_to([1.0, 0.0], (*x.shape[:-1], 2))

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of the position in the world, and what the agent feels of its motion."""
        if self.turns:
            return x[..., 3:4] * self.heading(x), x[..., 3:]
        return (x[..., 2:], x[..., 2:]) if x.shape[-1] == 4 else (0 * x, x[..., :0])

    def observe(self, x: np.ndarray, goal: np.ndarray, linked: np.ndarray) -> np.ndarray:
        h, (v, rates), p, rows = self.heading(x), self.motion(x), x[..., :2], []
        for i, slots in enumerate(self.slots):
            flag = np.full((len(x), 1), float(self.leads[i]))
            to_goal = flag * frame(h[:, i], goal[:, i] - p[:, i])
            row = [rates[:, i], flag, to_goal, magnified(to_goal, self.game["radius"])]
            for j in slots:
                gap, there = frame(h[:, i], p[:, j] - p[:, i]), (j >= 0) * linked[..., i, j, None]
                sight = [1 + 0 * flag, gap, magnified(gap, self.game["radius"])]
                sight += [frame(h[:, i], of[:, j]) for of in (v, h)[: 1 + self.game["headings"]]]
                row += [there * part for part in sight]
            rows.append(np.concatenate(row, axis=1))
        return np.stack(rows, axis=1)

    def act(self, x: np.ndarray, goal: np.ndarray, linked: np.ndarray) -> np.ndarray:
        obs, layers = self.observe(x, goal, linked), self.layers("controller/policy.pi.net")
        shared = self.controller["policy"]["pi"]["shared"]
        pick = lambda i: [{k: w if shared else w[i] for k, w in l.items()} for l in layers]
        out = np.stack([forward(pick(i), obs[:, i]) for i in range(x.shape[1])], axis=1)
        return np.tanh(out[..., : out.shape[-1] // 2])

    def layers(self, prefix: str) -> list[dict[str, np.ndarray]]:
        names = {"W": "weight", "b": "bias", "gain": "norm.0", "offset": "norm.1"}
        held = [{k: f"{prefix}.layers.{i}.{v}" for k, v in names.items()} for i in range(9)]
        get = lambda l: {k: self.arrays[v].astype(float) for k, v in l.items() if v in self.arrays}
        return [get(layer) for layer in held if layer["W"] in self.arrays]

    def values(self, seen: dict[str, np.ndarray], time: int) -> np.ndarray:
        """V of the first `time` states of every rollout."""
        kind, rho = self.V["kind"], self.V["ball"]
        if kind == "CostSum":
            cost = np.maximum(seen["distance"] - rho, 0).mean(axis=2)
            return sum(cost[:, k : k + time] for k in range(self.V["T"]))  # pyright: ignore
        x, h = seen["x"][:, :time], self.heading(seen["x"][:, :time])
        e = np.concatenate([frame(h, seen["goal"][:, None] - x[..., :2]), self.motion(x)[1]], -1)
        if kind == "Quadratic":
            return np.einsum("...i,ij,...j", e, self.arrays["V/P"].astype(float), e).sum(-1)
        if kind != "Norm":
            raise UserError(f"recheck: V of kind {kind} is not known.")
        e, layers = e.reshape(*e.shape[:2], -1), self.layers("V/net.net")
        change = forward(layers, e) - forward(layers, np.zeros(e.shape[-1]))
        return np.linalg.norm(change, axis=-1) + self.V["net"]["slope"] * np.linalg.norm(e, axis=-1)


def frame(h: np.ndarray, v: np.ndarray) -> np.ndarray:
    along = v[..., 0] * h[..., 0] + v[..., 1] * h[..., 1]
    return np.stack([along, v[..., 1] * h[..., 0] - v[..., 0] * h[..., 1]], axis=-1)


def magnified(v: np.ndarray, scale: float) -> np.ndarray:
    return v / (np.sqrt((v * v).sum(-1, keepdims=True) + 1e-12) + scale)


def forward(layers: list[dict[str, np.ndarray]], x: np.ndarray) -> np.ndarray:
    for i, l in enumerate(layers):
        x = x @ l["W"].T + l["b"]
        if "gain" in l:
            x = x - x.mean(-1, keepdims=True)
            x = x / np.sqrt((x * x).mean(-1, keepdims=True) + 1e-5) * l["gain"] + l["offset"]
        x = np.maximum(x, 0) if i + 1 < len(layers) else x
    return x
