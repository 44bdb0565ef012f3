"""An independent checker of certificates: NumPy in float64, and nothing of what made them.

From the recorded seed it draws starts, disturbances and times anew, by a generator of its own; it
integrates, and evaluates observations, networks and V from the recorded arrays; it counts again,
and computes the exact bounds by bisection on the binomial tail. What differs it rejects. What no
rollout can show it lists: proofs, and constants taken from the rollouts that calibrate.
"""

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from marlyap import store
from marlyap.errors import UserError


KNOWN = {"Unicycle": 5, "DoubleIntegrator": 4, "SingleIntegrator": 2}  # numbers in a state
CLOSE = 2e-3  # relative to the threshold: a rollout this near to it may fall on either side
MOST = 10**9  # agent-steps of the longest set of rollouts that is played
GRID = np.linspace(-6.0, 6.0, 20_001)  # of standard normal numbers, and their distribution
BELOW = np.array([(1 + math.erf(z / math.sqrt(2))) / 2 for z in GRID])


class Rejected(UserError):
    """The file does not say what its own starts and arrays give."""


def recheck(path: Path | str, tell: Callable[[str], None] = lambda name: None) -> dict[str, Any]:
    """Derive every sampled figure anew. Returns what agreed and what was not looked at.

    `tell` hears of each certificate as soon as its figures agree.

    Raises Rejected (a UserError) at the first figure that differs and for a file that is no
    certificate, and UserError for one that is damaged or about a game this checker does not know.
    """
    try:
        return derive(*store.read(Path(path), "certificate"), tell)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        what = f"{type(error).__name__}: {error}".rstrip(".")
        raise Rejected(f"{path} is no certificate ({what}); use another copy of it.") from error


def derive(arrays: dict, meta: dict, tell: Callable[[str], None]) -> dict[str, Any]:
    own = store.hash_arrays({k[11:]: v for k, v in arrays.items() if k.startswith("controller/")})
    agree("the hash of the policy", own, meta["policy"])
    verdicts, sim = meta["verdicts"], Simulator(meta, arrays)
    sampled = [n for n, v in verdicts.items() if v["confidence"] is not None]
    tail = (1 - meta["confidence"]) / (max(1, len(sampled)) * meta["checkpoints"])
    done, left = {}, [n for n in verdicts if n not in sampled]
    for name in sampled:
        near("the confidence", verdicts[name]["confidence"], 1 - tail, 1e-12)
        worst, check = verdicts[name]["worst"], CHECKS.get(verdicts[name]["name"])
        if worst is not None:
            x = sim.starts(worst["episode"])[0][0]
            x[..., :2] *= worst.get("change", {}).get("spread", 1.0)
            far = np.abs(x - worst["state"]["x"]).max() / (1 + sim.game["size"])
            near(f"the distance of {name}'s worst start from the one drawn", far, 0.0, 1e-4)
        if check is not None:
            done[name] = check(sim, verdicts[name], meta["certificates"][name], tail)
            tell(name)
        left += [name] if check is None else done[name].pop("left", [])
    return {"agrees": True, "rechecked": done, "not_rechecked": left}


def threefry(key: Any, high: Any, low: Any) -> tuple[np.ndarray, np.ndarray]:
    """Threefry-2x32 in 20 rounds (Salmon et al., 2011), which the seeds of the file are meant for.

    A key is a pair of arrays of 32-bit words, one for each stream.
    """
    keys = (*key, key[0] ^ key[1] ^ np.uint32(0x1BD11BDA))
    a, b = keys[0] + high, keys[1] + low
    for i in range(5):
        for r in ((13, 15, 26, 6), (17, 29, 16, 24))[i % 2]:
            a = a + b
            b = a ^ (b << np.uint32(r) | b >> np.uint32(32 - r))
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + np.uint32(i + 1)
    return a, b


def fold(key: Any, number: Any) -> tuple[np.ndarray, np.ndarray]:
    """Other streams, one for each number."""
    return threefry(key, np.uint32(0), np.asarray(number, np.uint32))


def uniform(key: Any, *shape: int) -> np.ndarray:
    """Numbers in [0, 1) from every stream [stream, *shape], in float32."""
    a, b = fold([word[:, None] for word in key], np.arange(math.prod(shape)))
    bits = (a ^ b) >> np.uint32(9) | np.uint32(0x3F800000)
    return (bits.view(np.float32) - 1).reshape(-1, *shape)


def normal(key: Any, *shape: int) -> np.ndarray:
    return np.interp(uniform(key, *shape) + 2.0**-25, BELOW, GRID)


def mass(n: int, p: float) -> np.ndarray:
    """P(X = 0 ... n) for X ~ Binomial(n, p), 0 < p < 1."""
    i, log = np.arange(n + 1), np.array([math.lgamma(j + 1) for j in range(n + 1)])
    return np.exp(log[n] - log - log[::-1] + i * math.log(p) + (n - i) * math.log1p(-p))


def lower(k: int, n: int, tail: float) -> float:
    """Clopper and Pearson's lower bound: the p at which P(X >= k) = tail, by bisection."""
    if k == n:
        return tail ** (1 / n)
    low, high = 0.0, float(k > 0)
    for _ in range(50):
        p = (low + high) / 2
        low, high = (low, p) if k == 0 or mass(n, p)[k:].sum() > tail else (p, high)
    return low


def order(sample: np.ndarray, q: float, tail: float) -> float:
    """The j-th smallest value, for the smallest j with P(Binomial(n, q) <= j - 1) >= 1 - tail."""
    n = len(sample)
    j = int(np.searchsorted(np.cumsum(mass(n, q))[:n], 1 - tail))
    return float(np.sort(sample)[j]) if j < n else math.inf


class Simulator:
    """The closed loop of a rendezvous, with a change to the game where one is asked for."""

    def __init__(self, meta: dict[str, Any], arrays: dict[str, np.ndarray]):
        self.game, self.controller, self.V = meta["game"], meta["controller"], meta["V"]
        self.arrays, self.cache, self.seed = arrays, {}, meta["seed"]
        model = self.game.get("dynamics", {})
        self.kind, self.limits = model.get("kind"), np.array(model.get("limits", []))
        world = self.game["kind"], self.controller["kind"], model.get("integrator")
        fixed = not self.game["graph"].startswith("disk")
        if world != ("Rendezvous", "Decentralised", "euler") or not fixed or self.kind not in KNOWN:
            known = "rendezvous on a fixed graph by Euler steps with a trained policy"
            raise UserError(f"recheck: only {known} is known, not {world} of {self.kind}.")
        self.slots, self.leads = arrays["graph/slots"], arrays["graph/leads"]

    def keys(self, episodes: Any) -> tuple[np.ndarray, np.ndarray]:
        """One stream per episode of those that certify."""
        seed = np.zeros(1, np.uint32), np.array([self.seed], np.uint32)
        return fold(fold(seed, zlib.crc32(b"certify")), np.atleast_1d(episodes))

    def starts(self, episodes: Any) -> tuple[np.ndarray, np.ndarray, Any]:
        """States [episode, agent, .], goals, and the stream of each episode's disturbances."""
        key, size = fold(self.keys(episodes), 0), self.game["size"]
        draw = lambda i, *shape: 2.0 * uniform(fold(key, i), *shape) - 1
        x = np.zeros((len(key[0]), len(self.slots), KNOWN[self.kind]))
        x[..., :2] = size * draw(0, len(self.slots), 2)
        if self.kind == "Unicycle":
            x[..., 2] = np.pi * draw(1, len(self.slots))
        goal = np.repeat(size * draw(2, 2)[:, None], len(self.slots), axis=1)
        return x, goal, fold(key, zlib.crc32(b"perturb"))

    def roll(self, n: int, steps: int, change: dict[str, Any]) -> dict[str, Any]:
        """States [n, steps + 1, agent, .] and distances, from the first n starts."""
        if (name := (n, steps, repr(change))) not in self.cache:
            if not 0 <= n * steps * len(self.slots) <= MOST:
                raise Rejected(f"certificate: {n} rollouts of {steps} steps are too many to check.")
            self.cache = {name: self.drive(*self.starts(np.arange(n)), steps, change)}
        return self.cache[name]

    def drive(self, x: Any, goal: Any, key: Any, steps: int, change: Any) -> dict[str, Any]:
        x[..., :2] *= change.get("spread", 1.0)
        noise, drop = change.get("noise", 0.0), np.float32(change.get("drop", 0.0))
        linked, present = self.arrays["graph/linked"].copy(), np.ones(x.shape[1], bool)
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
        x[..., -2:] += dt * u  # the velocities; of a single integrator, the position itself
        if self.kind == "Unicycle":
            x[..., 2] += dt * x[..., 4]
        x[..., :2] += dt * self.motion(x)[0]
        return x

    def heading(self, x: np.ndarray) -> np.ndarray:
        if self.kind == "Unicycle":
            return np.stack([np.cos(x[..., 2]), np.sin(x[..., 2])], axis=-1)
        return np.broadcast_to([1.0, 0.0], (*x.shape[:-1], 2))

    def motion(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of the position in the world, and what the agent feels of its motion."""
        if self.kind == "Unicycle":
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


def agree(what: str, found: Any, said: Any) -> None:
    if found != said:
        raise Rejected(f"certificate: {what} is {found}, not {said} as the file says.")


def near(what: str, found: Any, said: Any, room: Any) -> None:
    if said is None or not abs(found - said) <= room:
        agree(what, found if math.isfinite(found) else None, said)


def counted(v: dict, worse: Any, limit: Any, sound: Any, tail: float, scale: float = 0.0) -> dict:
    """Count rollouts with worse <= limit, and compare count and bound with the verdict's."""
    n, room = len(worse), CLOSE * max(abs(limit), scale)
    with np.errstate(invalid="ignore"):
        k = int((sound & (worse <= limit)).sum())
        border = int((sound & (np.abs(worse - limit) <= room)).sum())
    agree(f"the number of rollouts of {v['name']}", n, v["trials"])
    near(f"the successes of {v['name']}", k, v["successes"], border)
    bound = lower(v["successes"], n, tail) if n else 0.0
    near(f"the bound of {v['name']}", bound, v["bound"], 1e-9)
    if v["holds"] and v["bound"] < v["figures"].get("share_asked", 0.0):
        raise Rejected(f"certificate: {v['name']} does not hold by its bound, as the file says.")
    return {"trials": n, "successes": k, "bound": bound, "border": border}


def reach(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    seen = sim.roll(c["rollouts"], sim.game["horizon"] + c.get("stay", 0), {})
    worse = seen["distance"][:, sim.game["horizon"] :].max(axis=(1, 2))
    return counted(v, worse, sim.game["radius"], seen["sound"], tail)


def decrease(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H = sim.game["horizon"]
    seen = sim.roll(c["rollouts"], H + (sim.V.get("T") or 0), {})
    inside = (seen["distance"][:, : H + 1] <= sim.game["radius"]).all(axis=2)
    before = np.cumsum(inside[:, :-1], axis=1) == 0
    value = sim.values(seen, H + 1)
    cost = np.maximum(seen["distance"][:, :H] - sim.V["ball"], 0).mean(axis=2)
    excess = np.where(before, np.diff(value, axis=1) + c["beta"] * cost, -np.inf).max(axis=1)
    return counted(v, excess, 0.0, seen["sound"] & inside.any(axis=1), tail, scale=1e-2)


def contraction(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H, T, beta = sim.game["horizon"], c["T"], v["figures"]["beta"]
    seen = sim.roll(c["rollouts"], H + 1, {})
    cost = seen["distance"].mean(axis=2)
    floor = sim.game["radius"] if c["c_min"] is None else c["c_min"]
    now, ahead = np.maximum(cost[:, : H - T + 1], 1e-300), cost[:, T : H + 1]
    ratio = np.where(now >= floor, ahead / now, -np.inf).max(axis=1)
    return counted(v, ratio, 1 - beta, seen["sound"], tail, scale=1.0)


def basin(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H = sim.game["horizon"]
    seen = sim.roll(c["rollouts"], H + max(c["stay"], sim.V.get("T") or 0), {})
    level, V0 = v["figures"]["level"] or 0.0, sim.values(seen, 1)[:, 0]
    inside, edge = V0 <= level * (1 + 1e-5), np.abs(V0 - level) <= CLOSE * level
    near("the number of starts in the level set", inside.sum(), v["trials"], edge.sum())
    pick = np.argsort(V0)[: v["trials"]]
    worse = seen["distance"][:, H : H + c["stay"] + 1].max(axis=(1, 2))[pick]
    return counted(v, worse, sim.game["radius"], seen["sound"][pick], tail / 2)


def quantiles(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H, bounds = sim.game["horizon"], v["figures"]["bounds"]
    seen = sim.roll(c["rollouts"], H + (sim.V.get("T") or 0), {})
    distance = seen["distance"][:, : H + 1].max(axis=2)
    stays = np.cumprod((distance <= sim.game["radius"])[:, ::-1], axis=1)[:, ::-1] > 0
    value = sim.values(seen, H + 1)
    sample = {
        "final_distance": distance[:, -1],
        "settling_time": np.where(stays[:, -1], stays.argmax(axis=1) * sim.game["dt"], np.inf),
        "largest_rise": (value - np.minimum.accumulate(value, axis=1)).max(axis=1),
    }
    for name, s in sample.items():
        found = order(np.where(seen["sound"], s, np.inf), c["q"], tail / 3)
        room = CLOSE * abs(bounds[name] or 0.0) + (name == "settling_time") * sim.game["dt"]
        near(name, found, bounds[name], room + 1e-4)
    return {"bounds": bounds}


def robustness(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    curve, out = v["figures"]["curve"], {}
    for point in curve:
        seen = sim.roll(c["rollouts"], sim.game["horizon"], point["change"])
        said = point | {"name": point["perturbation"], "figures": {"share_asked": c["share"]}}
        worse, part = seen["distance"][:, -1].max(axis=1), tail / len(curve)
        out[said["name"]] = counted(said, worse, sim.game["radius"], seen["sound"], part)
    return {"curve": out}


def composition(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    T, said = c["T"], v["figures"]
    seen = sim.roll(c["rollouts"], sim.game["horizon"] + c["stay"] + T, {})
    M, delta = (np.array(said[k], float) for k in ("M", "delta"))
    V = np.lib.stride_tricks.sliding_window_view(seen["distance"], T, axis=1).max(axis=-1)
    excess = (V[:, T:] - V[:, :-T] @ M.T - delta).max(axis=(1, 2))
    if fitted := bool(np.isfinite(M).all()):
        near("the spectral radius", np.abs(np.linalg.eigvals(M)).max(), said["rho"], 1e-6)
        ultimate = np.abs(np.linalg.solve(np.eye(len(M)) - M, delta) - said["ultimate"]).max()
        near("the distance to the ultimate bound said", ultimate, 0.0, 1e-6)
    within = sim.game["radius"] if c["within"] is None else c["within"]
    if v["holds"] and not (fitted and said["rho"] < 1 and max(said["ultimate"]) <= within):
        raise Rejected("certificate: composition does not hold by its bounds, as the file says.")
    return counted(v, excess, 0.0, seen["sound"], tail, scale=1e-2)


def theorem1(sim: Simulator, v: dict, c: dict, tail: float) -> dict[str, Any]:
    n, H, said = c["rollouts"], sim.game["horizon"], v["figures"]
    if c["old"] is not None:
        return {"left": ["theorem1: its tuples, of another policy"]}
    seen, beyond, pick = sim.roll(n, H, {}), sim.V.get("T") or 0, np.arange(n)
    key = fold(sim.keys(pick), 2)
    t = (H * uniform(fold(key, 0))).astype(int)
    x, goal = seen["x"][pick, t], seen["goal"]
    new = sim.act(x, goal, sim.arrays["graph/linked"])
    old = np.clip(new + c["noise"] * normal(fold(key, 1), *new.shape[1:]), -1, 1)
    go = lambda x: sim.values(sim.drive(x, goal, key, beyond, {}), 1)[:, 0]
    V, after = go(x.copy()), go(sim.step(x, sim.limits * old))
    moved = np.linalg.norm((new - old) * sim.limits, axis=(1, 2))
    dt, orders = sim.game["dt"], (KNOWN[sim.kind] + 1) // 2  # 1, 2 and 3
    l_f = math.hypot(*[dt, dt**2, dt**3 * said["speed"]][:orders])
    near("l_f", l_f, said["l_f"], 1e-5)
    excess = after + said["l_L"] * l_f * moved - (1 - c["rate"]) * V
    pick = seen["distance"][pick, t].max(axis=1) > sim.game["radius"]
    found = counted(v, excess[pick], 0.0, seen["sound"][pick], tail, scale=1e-2)
    return found | {"left": ["theorem1: l_L and the speed in l_f, which come from other rollouts"]}


CHECKS = {f.__name__: f for f in (reach, decrease, contraction, basin, quantiles, robustness)}
CHECKS |= {"reach-and-stay": reach, "composition": composition, "theorem1": theorem1}
