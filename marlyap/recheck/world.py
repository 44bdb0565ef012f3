"""The world of a certificate once more, in NumPy and float64: starts, steps, sights, networks, V.

Written apart from the game, the graph, the rollout and the networks, so that a mistake in those
shows.
"""

import json
import math
import zlib
from typing import Any

import numpy as np

from marlyap.errors import UserError
from marlyap.recheck.reader import Arrays, Rejected, agree, record
from marlyap.threefry import fold, normal, uniform


# Numbers in a state, and those of them that an input drives.
KNOWN = {
    "Unicycle": (5, slice(3, 5)),
    "LateUnicycle": (7, slice(3, 5)),
    "DoubleIntegrator": (4, slice(2, 4)),
    "SingleIntegrator": (2, slice(0, 2)),
}
MOST = 5 * 10**7  # agent-steps of the longest set of rollouts that is played: 2 GB
WHOLE, NUMBER, FLAG, TEXT, LIST, OBJECT = (int,), (int, float), (bool,), (str,), (list,), (dict,)
GAME = dict(kind=TEXT, agents=WHOLE, leaders=LIST, graph=TEXT, radius=NUMBER, size=NUMBER)
GAME |= dict(headings=FLAG, rest_weight=NUMBER, dt=NUMBER, horizon=WHOLE, dynamics=OBJECT)
DYNAMICS = dict(kind=TEXT, limits=LIST, integrator=TEXT)
NORM = dict(kind=TEXT, net=OBJECT, errors=WHOLE, slope=NUMBER)
LAYER = {"kind": "Layer", "weight": None, "bias": None}
V_KEYS = {
    "CostSum": dict(kind=TEXT, controller=OBJECT, T=WHOLE, ball=NUMBER, unit=TEXT),
    "Quadratic": dict(kind=TEXT, P=(type(None),), ball=NUMBER),
    "Norm": dict(kind=TEXT, net=OBJECT, ball=NUMBER),
}


def unknown(game: dict[str, Any], controller: dict[str, Any]) -> str | None:
    """The first thing in a closed loop that no model here covers; None where all is covered."""
    model, policy = game.get("dynamics", {}), controller.get("policy", {})
    for what, name, those in (
        ("game", game.get("kind"), ("Rendezvous",)),
        ("dynamics", model.get("kind"), (*KNOWN,)),
        ("integrator", model.get("integrator"), ("euler",)),
        ("controller", controller.get("kind"), ("Decentralised",)),
        ("policy", policy.get("kind") if isinstance(policy, dict) else None, ("Greedy",)),
    ):
        if name not in those:
            return f"the {what} {name}"
    graph = str(game.get("graph"))
    return f"the graph {graph}" if graph.startswith("disk") else None


class World:
    """The closed loop of a rendezvous, with a change to the game where one is asked for."""

    def __init__(self, meta: dict[str, Any], arrays: Arrays):
        self.game, self.controller, self.V = meta["game"], meta["controller"], meta["V"]
        if self.game["kind"] == "Shielded":
            self.game = self.game["inner"]
        self.arrays, self.seed, self.cache = arrays, meta["seed"], {}
        self.used = {"controller/words"}
        record("the game", self.game, GAME)
        if not 1 <= self.game["agents"] <= 4096 or not self.game["horizon"] >= 1:
            raise Rejected("certificate: its number of agents or its horizon is impossible.")
        model = self.game["dynamics"]
        record("the dynamics", model, DYNAMICS)
        self.kind, self.limits = model["kind"], np.array(model["limits"], float)
        self.turns = "Unicycle" in self.kind
        self.linked = adjacency(self.game["graph"], self.game["agents"])
        self.slots = places(self.linked, self.game["graph"])
        self.leads = np.isin(np.arange(len(self.slots)), self.game["leaders"])
        pi = self.controller["policy"]["pi"]
        self.layers, self.shared = self.network("controller/policy.pi.net", pi["net"]), pi["shared"]
        pi = {"kind": "Actors", "net": pi["net"], "shared": self.shared is True}
        pi |= {"du": len(self.limits)}
        whole = {
            "kind": "Decentralised",
            "policy": {"kind": "Greedy", "pi": pi},
            "game": meta["game"],
        }
        agree("what the controller is made of", whole, self.controller)
        text = json.dumps(self.controller, sort_keys=True).encode()
        if arrays["controller/words"].tobytes() != text:
            raise Rejected("certificate: the policy that was hashed is another than the one named.")
        self.lyapunov()
        for name in sorted(arrays.keys() - self.used):
            raise Rejected(f"certificate: the array {name!r} belongs to nothing in it.")

    def lyapunov(self) -> None:
        """Check what V is made of; one that is not known may not be asked about (`values`)."""
        kind, alike = self.V.get("kind"), {}
        if kind in V_KEYS:
            record("V", self.V, V_KEYS[kind])
        if kind == "CostSum":
            agree("the policy in V", self.controller, self.V["controller"])
            alike = {k.replace("/", "/controller.", 1): k for k in self.used - {"controller/words"}}
            alike = {k.replace("controller/", "V/", 1): v for k, v in alike.items()}
        elif kind == "Quadratic":
            self.used |= {"V/P"}
        elif kind == "Norm":
            self.net = self.network("V/net.net", self.V["net"]["net"])
            rates = self.motion(np.zeros((1, KNOWN[self.kind][0])))[1].shape[-1]
            about = {"kind": "NormNet", "errors": 2 + rates}
            agree("what V is made of", self.V["net"] | about, self.V["net"])
            record("the network in V", self.V["net"], NORM)
        else:
            self.used |= {name for name in self.arrays if name.startswith("V/")}
        for copy, name in alike.items():
            if self.arrays[copy].tobytes() != self.arrays[name].tobytes():
                raise Rejected("certificate: V is of another policy than the one it certifies.")
        self.used |= {*alike}

    def asked(self) -> None:
        """Raise UserError if V, which a certificate is about, is not known."""
        if self.V["kind"] not in V_KEYS:
            raise UserError(
                f"recheck: V of kind {self.V['kind']} is unknown to it; certify by another V."
            )

    def network(self, prefix: str, said: dict[str, Any]) -> list[dict[str, np.ndarray]]:
        """The layers in float64, of a network that is described as the file has it."""
        norms = [layer["norm"] for layer in said["layers"]]
        whole = [LAYER | {"norm": None if norm is None else [None, None]} for norm in norms]
        agree(f"what {prefix} is made of", {"kind": "MLP", "layers": whole}, said)
        layers = []
        for i, norm in enumerate(norms):
            names = {"W": "weight", "b": "bias"}
            names |= {} if norm is None else {"gain": "norm.0", "offset": "norm.1"}
            names = {k: f"{prefix}.layers.{i}.{name}" for k, name in names.items()}
            self.used |= {*names.values()}
            layers.append({k: self.arrays[name].astype(float) for k, name in names.items()})
        return layers

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """The stream of the seed itself."""
        return np.zeros(1, np.uint32), np.array([self.seed], np.uint32)

    def keys(self, episodes: Any, purpose: str = "certify") -> tuple[np.ndarray, np.ndarray]:
        """One stream per episode of those for a purpose."""
        return fold(fold(self.root, zlib.crc32(purpose.encode())), np.atleast_1d(episodes))

    def starts(self, key: Any, draws: Any = uniform) -> tuple[np.ndarray, np.ndarray, Any]:
        """States [episode, agent, .], goals, and streams of disturbances, from those of starts."""
        size = self.game["size"]
        draw = lambda i, *shape: 2.0 * draws(fold(key, i), *shape) - 1
        x = np.zeros((len(key[0]), len(self.slots), KNOWN[self.kind][0]))
        x[..., :2] = size * draw(0, len(self.slots), 2)
        if self.turns:
            x[..., 2] = np.pi * draw(1, len(self.slots))
        goal = np.repeat(size * draw(2, 2)[:, None], len(self.slots), axis=1)
        return x, goal, fold(key, zlib.crc32(b"perturb"))

    def targets(self, key: Any, draws: Any = uniform) -> tuple[np.ndarray, np.ndarray]:
        """As `starts`, with every agent at rest on its goal, and headings as they were."""
        x, goal, _ = self.starts(key, draws)
        x[..., :2] = goal
        return x, goal

    def errors(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Way to the goal in the agent's frame, and its rates [..., agent, .]: 0 on the target."""
        return np.concatenate([frame(self.heading(x), goal - x[..., :2]), self.motion(x)[1]], -1)

    def roll(
        self, n: int, steps: int, change: dict[str, Any] | None = None, purpose: str = "certify"
    ) -> dict[str, Any]:
        """States [n, steps + 1, agent, .] and distances, from the first n starts.

        Whole horizons are played and kept, so that several certificates share them.
        """
        change, H = change or {}, self.game["horizon"]
        long = math.ceil(steps / H) * H
        self.bounded(n, long)
        seen = self.cache.get(purpose) if not change else None
        if seen is None or seen["x"].shape[0] < n or seen["x"].shape[1] <= steps:
            begin = self.starts(fold(self.keys(np.arange(n), purpose), 0))
            seen = self.drive(*begin, long, change)
            self.cache |= {} if change else {purpose: seen}
        cut = lambda a: a[:n, : steps + 1]
        found = {k: cut(v) for k, v in seen.items() if k != "goal"} | {"goal": seen["goal"][:n]}
        return found | {"sound": found["sound"][:, -1]}

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
        sound = np.logical_and.accumulate(np.isfinite(states).all(axis=(2, 3)), axis=1)
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
        obs = self.observe(x, goal, linked)
        pick = lambda i: [
            {k: w if self.shared else w[i] for k, w in l.items()} for l in self.layers
        ]
        out = np.stack([forward(pick(i), obs[:, i]) for i in range(x.shape[1])], axis=1)
        return np.tanh(out[..., : out.shape[-1] // 2])

    def cost(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        """The team's cost [rollout, state], with the weight on its motion."""
        still = (self.motion(seen["x"])[1] ** 2).sum(axis=-1)
        return (seen["distance"] + self.game["rest_weight"] * still).mean(axis=2)

    @property
    def beyond(self) -> int:
        """How many states V looks ahead."""
        return self.V["T"] if self.V["kind"] == "CostSum" else 0

    def value(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """V of states [episode, agent, .], each with its own goals."""
        none = np.zeros(1, np.uint32), np.zeros(1, np.uint32)
        return self.values(self.drive(x.copy(), goal, none, self.beyond, {}), 1)[:, 0]

    def gradient(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """dV/dx of one state [agent, .], by central differences."""
        move = 1e-5 * np.eye(x.size).reshape(x.size, *x.shape)
        goals = np.broadcast_to(goal, (x.size, *goal.shape))
        return (self.value(x + move, goals) - self.value(x - move, goals)) / 2e-5

    def lipschitz(self) -> float:
        """A bound on how fast V, a network, changes with the errors."""
        stretch = lambda l: np.abs(l["gain"]).max() / math.sqrt(1e-5) if "gain" in l else 1.0
        bounds = [np.linalg.norm(l["W"], 2) * stretch(l) for l in self.net]
        return float(np.prod(bounds)) + self.V["net"]["slope"]

    def values(self, seen: dict[str, np.ndarray], time: int) -> np.ndarray:
        """V of the first `time` states of every rollout."""
        kind, rho = self.V["kind"], self.V["ball"]
        if kind == "CostSum":
            cost = np.maximum(seen["distance"] - rho, 0).mean(axis=2)
            return sum(cost[:, k : k + time] for k in range(self.V["T"]))  # pyright: ignore
        e = self.errors(seen["x"][:, :time], seen["goal"][:, None])
        if kind == "Quadratic":
            return np.einsum("...i,ij,...j", e, self.arrays["V/P"].astype(float), e).sum(-1)
        e = e.reshape(*e.shape[:2], -1)
        change = forward(self.net, e) - forward(self.net, np.zeros(e.shape[-1]))
        return np.linalg.norm(change, axis=-1) + self.V["net"]["slope"] * np.linalg.norm(e, axis=-1)


def adjacency(graph: str, n: int) -> np.ndarray:
    """Which pairs of n agents are joined by a fixed graph, written as text."""
    name, linked = graph.partition("/")[0], np.zeros((n, n), bool)
    i = np.arange(n)
    if name == "complete":
        linked[:] = True
    elif name == "star":
        linked[0] = True
    elif name in ("path", "ring"):
        linked[i[:-1], i[1:]] = True
        linked[-1, 0] |= name == "ring"
    elif name.startswith("geometric:"):
        p = uniform((np.zeros(1, np.uint32), np.array([n], np.uint32)), n, 2)[0]
        linked = np.hypot(*(p[:, None] - p[None]).T) < float(name[10:])
    else:
        for edge in name.split(","):
            linked[tuple(int(end) for end in edge.split("-"))] = True
    return (linked | linked.T) & (i[:, None] != i)


def places(linked: np.ndarray, graph: str) -> np.ndarray:
    """Whom each agent observes [agent, slot], in ascending order; -1 in a slot that is empty."""
    rows = [np.flatnonzero(row) for row in linked]
    room = int(graph.partition("/")[2] or max(map(len, rows)))
    return np.array([np.append(row, np.full(room, -1))[:room] for row in rows]).reshape(
        len(rows), room
    )


def hops(linked: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Edges from the nearest source to each agent; -1 where there is no path."""
    distance, reached, step = np.where(sources, 0, -1), sources, 0
    while (fresh := linked[reached].any(axis=0) & (distance < 0)).any():
        step += 1
        distance[fresh], reached = step, fresh
    return distance


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
