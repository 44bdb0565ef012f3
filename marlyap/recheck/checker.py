"""An independent checker of certificates: NumPy in float64, and nothing of what made them.

From the recorded seed it draws starts, disturbances and times anew; it integrates, and evaluates
observations, networks and V from the recorded arrays; it counts again, and computes the exact
bounds by bisection on the binomial tail. Counts, bounds, and whether a claim holds have to agree,
for what was asked. Levels, rates and gains are taken as chosen, for they are tested on what is
drawn here; sentences, scopes and the figures beside a claim are not read. What no rollout can show
it lists: proofs, and constants seen on the rollouts that calibrate.
"""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from marlyap import store
from marlyap.recheck.world import KNOWN, Rejected, Replica, agree
from marlyap.threefry import fold, normal, uniform


CLOSE = 2e-3  # relative to the threshold: a rollout this near to it may fall on either side
SWEPT = dict(gain="gains", noise="noises", delay="delays", spread="spreads", drop="drops")
MALFORMED = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)
TOLD = {"share": "share_asked", "stay": "stay_steps", "T": "T", "q": "q"}  # repeated as figures


def recheck(path: Path | str, tell: Callable[[str], None] = lambda name: None) -> dict[str, Any]:
    """Derive every sampled claim anew. Returns what agreed and what was not looked at.

    `tell` hears of each certificate as soon as its figures agree.

    Raises Rejected (a UserError) at the first figure that differs and for a file that is no
    certificate, and UserError for one that is damaged or about a game this checker does not know.
    """
    try:
        return derive(*store.read(Path(path), "certificate"), tell)
    except MALFORMED as error:
        what = f"{type(error).__name__}: {error}".rstrip(".")
        raise Rejected(f"{path} is no certificate ({what}); use another copy of it.") from error


def derive(arrays: dict, meta: dict, tell: Callable[[str], None]) -> dict[str, Any]:
    own = {k[11:]: v for k, v in arrays.items() if k.startswith("controller/")}
    agree("the hash of the policy", store.hash_arrays(own), meta["policy"])
    agree("what the policy is made of", json.loads(own["words"].tobytes()), meta["controller"])
    verdicts, asked, sim = meta["verdicts"], meta["certificates"], Replica(meta, arrays)
    agree("the list of certificates", [*asked], [*verdicts])
    agree("whether all hold", all(v["holds"] for v in verdicts.values()), meta["holds"])
    kind = {n: re.sub("(?!^)(?=[A-Z])", "-", c["kind"]).lower() for n, c in asked.items()}
    sampled = [n for n, v in verdicts.items() if kind[n] in CHECKS or v["confidence"] is not None]
    if not 0 < meta["confidence"] < 1 or meta["checkpoints"] not in range(1, 10**9):
        raise Rejected("certificate: its confidence or number of checkpoints is impossible.")
    if not all(name.isprintable() for name in verdicts):
        raise Rejected("certificate: the name of a verdict cannot be printed.")
    tail = (1 - meta["confidence"]) / (max(1, len(sampled)) * meta["checkpoints"])
    done, left = {}, [n for n in verdicts if n not in sampled]
    for name in sampled:
        v, c = verdicts[name], asked[name]
        near("the confidence", 1 - tail, v["confidence"], 1e-12)
        if v["worst"] is not None:
            x = sim.starts(v["worst"]["episode"])[0][0]
            x[..., :2] *= v["worst"].get("change", {}).get("spread", 1.0)
            far = np.abs(x - v["worst"]["state"]["x"]).max() / (1 + sim.game["size"])
            near(f"the distance of {name}'s worst start from the one drawn", far, 0.0, 1e-4)
        found = {"left": [name]}
        if kind[name] in CHECKS:
            agree("the name of a verdict", kind[name], v["name"])
            if kind[name] != "theorem1":
                agree(f"the evidence of {name}", v["evidence"], "statistical")
            for key in TOLD.keys() & c.keys():
                if key != "stay" or kind[name] != "composition":
                    agree(f"{key} of {name}", v["figures"][TOLD[key]], c[key])
            found = CHECKS[kind[name]](sim, v, c, tail)
        left += found.pop("left", [])
        if found:
            done[name] = found
            tell(name)
    return {"agrees": True, "rechecked": done, "not_rechecked": left}


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


def near(what: str, found: Any, said: Any, room: Any) -> None:
    if said is None or not abs(found - said) <= room:
        agree(what, found if math.isfinite(found) else None, said)


def counted(
    v: dict, share: Any, worse: Any, limit: Any, sound: Any, tail: float, **more: Any
) -> dict:
    """Count rollouts with worse <= limit; compare count, bound and verdict with what is said.

    More: `scale` of what is compared, `also` has to be true, `edge` may as well not be counted.
    """
    n, room, edge = len(worse), CLOSE * max(abs(limit), more.get("scale", 0)), more.get("edge", 0)
    with np.errstate(invalid="ignore"):
        k = int((sound & (worse <= limit)).sum())
        border = int((sound & (np.abs(worse - limit) <= room)).sum())
    name, trials, successes, also = v["name"], v["trials"], v["successes"], more.get("also", True)
    near(f"the number of rollouts of {name}", n, trials, edge)
    near(f"the successes of {name}", k, successes, border + edge)
    if not 0 <= successes <= trials:
        raise Rejected(f"certificate: {name} has more successes than rollouts.")
    bound = lower(successes, trials, tail) if trials else 0.0
    near(f"the bound of {name}", bound, v["bound"], 1e-9)
    agree(f"whether {name} holds", bool(trials and bound >= share and also), v["holds"])
    return {"trials": trials, "successes": successes, "bound": bound, "border": border}


def reach(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    stay = c["stay"] if v["name"] == "reach-and-stay" else 0
    seen = sim.roll(c["rollouts"], sim.game["horizon"] + stay, {})
    worse = seen["distance"][:, sim.game["horizon"] :].max(axis=(1, 2))
    return counted(v, c["share"], worse, sim.game["radius"], seen["sound"], tail)


def decrease(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H = sim.game["horizon"]
    seen = sim.roll(c["rollouts"], H + (sim.V.get("T") or 0), {})
    inside = (seen["distance"][:, : H + 1] <= sim.game["radius"]).all(axis=2)
    before = np.cumsum(inside[:, :-1], axis=1) == 0
    value = sim.values(seen, H + 1)
    cost = np.maximum(seen["distance"][:, :H] - sim.V["ball"], 0).mean(axis=2)
    excess = np.where(before, np.diff(value, axis=1) + c["beta"] * cost, -np.inf).max(axis=1)
    agree("beta of decrease", c["beta"], v["figures"]["beta"])
    return counted(v, c["share"], excess, 0.0, seen["sound"] & inside.any(axis=1), tail, scale=1e-2)


def contraction(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H, T, beta = sim.game["horizon"], c["T"], v["figures"]["beta"]
    beta = -math.inf if beta is None else beta
    seen = sim.roll(c["rollouts"], H + 1, {})
    cost = seen["distance"].mean(axis=2)
    floor = sim.game["radius"] if c["c_min"] is None else c["c_min"]
    now, ahead = np.maximum(cost[:, : H - T + 1], 1e-300), cost[:, T : H + 1]
    ratio = np.where(now >= floor, ahead / now, -np.inf).max(axis=1)
    near("c_min of contraction", floor, v["figures"]["c_min"], 1e-9)
    also = beta >= c["least"] and bool(np.isfinite(ratio).any())
    return counted(v, c["share"], ratio, 1 - beta, seen["sound"], tail, scale=1.0, also=also)


def basin(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    H = sim.game["horizon"]
    seen = sim.roll(c["rollouts"], H + max(c["stay"], sim.V.get("T") or 0), {})
    level, V0 = v["figures"]["level"] or 0.0, sim.values(seen, 1)[:, 0]
    inside, edge = V0 <= level * (1 + 1e-5), np.abs(V0 - level) <= CLOSE * level
    near("the number of starts in the level set", inside.sum(), v["trials"], edge.sum())
    pick = np.argsort(V0)[: v["trials"]]
    worse = seen["distance"][:, H : H + c["stay"] + 1].max(axis=(1, 2))[pick]
    m, n = v["trials"], c["rollouts"]
    low, high = v["figures"]["mass"]
    near("the least mass of the level set", lower(m, n, tail / 4), low, 1e-9)
    near("the largest mass of the level set", 1 - lower(n - m, n, tail / 4), high, 1e-9)
    return counted(v, c["share"], worse, sim.game["radius"], seen["sound"][pick], tail / 2)


def quantiles(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
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
    agree("the rollouts of quantiles", c["rollouts"], v["trials"])
    agree("the bound of quantiles", bounds["final_distance"], v["bound"])
    agree("whether quantiles holds", None not in bounds.values(), v["holds"])
    return {"bounds": bounds}


def robustness(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    curve, out, H = v["figures"]["curve"], {}, sim.game["horizon"]
    swept = [{k: x} for k, field in SWEPT.items() for x in c[field]]
    swept = [change for change in swept if "drop" not in change or len(sim.slots) > 1]
    said = [point["change"] for point in curve]
    agree("what robustness sweeps", [x for x in said if SWEPT.keys() & x.keys()], swept)
    for point in curve:
        seen, about = sim.roll(c["rollouts"], H, point["change"]), {"name": point["perturbation"]}
        worse, part = seen["distance"][:, -1].max(axis=1), tail / len(curve)
        sound, r = seen["sound"], sim.game["radius"]
        out[about["name"]] = counted(point | about, c["share"], worse, r, sound, part)
    for key, total in (("trials", sum), ("successes", sum), ("bound", min), ("holds", all)):
        agree(f"{key} of robustness", total(p[key] for p in curve), v[key])
    return {"curve": out}


def composition(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    T, said = c["T"], v["figures"]
    seen = sim.roll(c["rollouts"], sim.game["horizon"] + c["stay"] + T, {})
    M, delta = (np.array(said[k], float) for k in ("M", "delta"))
    agree("the shapes of M and delta", (M.shape, delta.shape), (2 * delta.shape, sim.leads.shape))
    V = np.lib.stride_tricks.sliding_window_view(seen["distance"], T, axis=1).max(axis=-1)
    excess = (V[:, T:] - V[:, :-T] @ M.T - delta).max(axis=(1, 2))
    fitted = bool(np.isfinite(M).all() and (M >= 0).all() and (delta >= 0).all())
    if fitted:
        near("the spectral radius", np.abs(np.linalg.eigvals(M)).max(), said["rho"], 1e-6)
        ultimate = np.abs(np.linalg.solve(np.eye(len(M)) - M, delta) - said["ultimate"]).max()
        near("the distance to the ultimate bound said", ultimate, 0.0, 1e-6)
    within = sim.game["radius"] if c["within"] is None else c["within"]
    also = fitted and said["rho"] < 1 and max(said["ultimate"]) <= within
    return counted(v, c["share"], excess, 0.0, seen["sound"], tail, scale=1e-2, also=also)


def theorem1(sim: Replica, v: dict, c: dict, tail: float) -> dict[str, Any]:
    n, H, said = c["rollouts"], sim.game["horizon"], v["figures"]
    if c["old"] is not None:
        return {"left": ["theorem1: its tuples, of another policy"]}
    seen, beyond, pick = sim.roll(n, H, {}), sim.V.get("T") or 0, np.arange(n)
    key = fold(sim.keys(pick), 2)
    t = (H * uniform(fold(key, 0))).astype(int)
    x, goal = seen["x"][pick, t], seen["goal"]
    new = sim.act(x, goal, sim.linked)
    old = np.clip(new + c["noise"] * normal(fold(key, 1), *new.shape[1:]), -1, 1)
    go = lambda x: sim.values(sim.drive(x, goal, key, beyond, {}), 1)[:, 0]
    V, after = go(x.copy()), go(sim.step(x, sim.limits * old))
    moved = np.linalg.norm((new - old) * sim.limits, axis=(1, 2))
    dt, orders = sim.game["dt"], (KNOWN[sim.kind][0] + 1) // 2  # 1, 2 and 3
    l_f = math.hypot(*[dt, dt**2, dt**3 * said["speed"]][:orders])
    l_f = 1.0 if sim.kind == "LateUnicycle" else l_f
    near("l_f", l_f, said["l_f"], 1e-5)
    spectral = c["lipschitz"] == "spectral" and said["l_L"] == said.get("spectral")
    agree("the evidence of theorem1", "statistical" if spectral else "observed", v["evidence"])
    excess = after + max(said["l_L"], 0.0) * l_f * moved - (1 - c["rate"]) * V
    far = seen["distance"][pick, t].max(axis=1) - sim.game["radius"]
    edge, pick = (np.abs(far) <= CLOSE * sim.game["radius"]).sum(), far > 0
    sound, more = seen["sound"][pick], {"scale": 1e-2, "edge": edge}
    found = counted(v, c["share"], excess[pick], 0.0, sound, tail, **more)
    return found | {"left": ["theorem1: l_L and the speed in l_f, which come from other rollouts"]}


CHECKS = {f.__name__: f for f in (reach, decrease, contraction, basin, quantiles, robustness)}
CHECKS |= {"reach-and-stay": reach, "composition": composition, "theorem1": theorem1}
