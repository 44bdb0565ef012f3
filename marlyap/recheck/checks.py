"""Each certificate derived again: what was counted, the bound, the verdict, the worst case.

A check gets the world and the file's verdict, and raises Rejected at the first thing that differs.
What a certificate chooses on other rollouts (levels, rates, gains) is taken as chosen, for it is
tested on those drawn here.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from marlyap.recheck.bounds import lower, needed, order
from marlyap.recheck.reader import Rejected, agree, record
from marlyap.recheck.sentences import Sentences
from marlyap.recheck.world import FLAG, KNOWN, LIST, NUMBER, OBJECT, TEXT, WHOLE, World, hops
from marlyap.threefry import fold, normal, uniform


CLOSE = 2e-3  # relative to the threshold: a rollout this near to it may fall on either side
WIDE, UNIT = 1e-2, 0.1  # a figure of one rollout, in float32, agrees to WIDE (UNIT + its size)
NEGATIVE = 1e-5  # V below minus this share of its usual size is negative
WORST = dict(seed=WHOLE, purpose=TEXT, episode=WHOLE, failed=FLAG, state=OBJECT, figures=OBJECT)
WORST |= dict(badness=(*NUMBER, type(None)))
POINT = dict(perturbation=TEXT, change=OBJECT, trials=WHOLE, successes=WHOLE, bound=NUMBER)
POINT |= dict(holds=FLAG, worst=OBJECT)


def state_of(said: dict[str, Any], what: str) -> dict[str, np.ndarray]:
    """Positions and goals of a start that the file tells."""
    record(f"the state of {what}", said, dict(x=LIST, scenario=OBJECT))
    record(f"the scenario of {what}", said["scenario"], dict(kind=TEXT, goal=LIST))
    agree(f"the kind of the scenario of {what}", "Goals", said["scenario"]["kind"])
    return {"x": np.array(said["x"], float), "goal": np.array(said["scenario"]["goal"], float)}


class Case(NamedTuple):
    """One verdict of the file, and what it is checked with."""

    sim: World
    say: Sentences
    v: dict[str, Any]  # the verdict
    c: dict[str, Any]  # the certificate that was asked for
    tail: float  # the probability with which it may be wrong

    @property
    def name(self) -> str:
        return self.v["name"]

    @property
    def figures(self) -> dict[str, Any]:
        return self.v["figures"]


class Found(NamedTuple):
    """n rollouts as a certificate judges them."""

    holds: np.ndarray
    close: np.ndarray  # `holds` may as well be the other
    badness: np.ndarray
    figures: dict[str, np.ndarray]
    asked: np.ndarray  # whether the rollout is a trial
    edge: np.ndarray  # `asked` may as well be the other


def near(what: str, found: float | int, said: Any, room: float | int) -> None:
    """Raise Rejected unless the file's number is of the same type, and this near; null: infinite"""
    if type(found) is not type(said) or not abs(found - said) <= room:
        agree(what, found if math.isfinite(found) else None, said)


def judged(
    sound: np.ndarray,
    worse: np.ndarray,
    limit: float = 0.0,
    scale: float = 0.0,
    *,
    badness: np.ndarray | None = None,
    figures: dict[str, np.ndarray] | None = None,
    asked: np.ndarray | None = None,
    edge: np.ndarray | None = None,
) -> Found:
    """A rollout holds if it is sound and worse <= limit; only sound ones can be close to it."""
    with np.errstate(invalid="ignore"):
        close = sound & (np.abs(worse - limit) <= CLOSE * max(abs(limit), scale))
        holds = sound & (worse <= limit)
    badness = worse if badness is None else badness
    badness = np.where(sound & ~np.isnan(badness), badness, np.inf)
    asked = np.ones(len(sound), bool) if asked is None else asked | ~sound
    edge = np.zeros(len(sound), bool) if edge is None else edge & sound
    return Found(holds, close, badness, figures or {}, asked, edge)


def of_share(
    case: Case,
    found: Found,
    steps: int,
    claim: Callable[[float], str],
    *,
    tail: float | None = None,
    voids: Sequence[str] = (),
    also: bool = True,
    to_judge: str = "leave something to judge",
    evidence: str = "statistical",
    scope: dict[str, Any] | None = None,
    figures: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Check a verdict that a share of the trials holds; `voids` are reasons why it bounds nothing.

    Returns the counts, the bound, and how many rollouts may fall on either side.
    """
    v, c, name, tail = case.v, case.c, case.name, case.tail if tail is None else tail
    trials, successes, edge = v["trials"], v["successes"], int(found.edge.sum())
    border = int((found.close & (found.asked | found.edge)).sum()) + edge
    near(f"the number of trials of {name}", int(found.asked.sum()), trials, edge)
    k = int((found.holds & found.asked).sum())
    near(f"the successes of {name}", k, successes, border)
    if not 0 <= successes <= trials:
        raise Rejected(f"certificate: {name} has more successes than trials.")
    least, share = needed(c["share"], tail), c["share"]
    bound = math.inf if voids else lower(successes, trials, tail)
    near(f"the bound of {name}", bound, v["bound"], 1e-9)
    agree(f"whether {name} holds", bool(not voids and bound >= share and also), v["holds"])
    few = case.say.nothing_to_judge(trials, c["rollouts"], to_judge, least, share)
    claims = voids or ([few] if trials < least else [claim(v["bound"])])
    if v["claim"] not in claims:
        agree(f"the claim of {name}", claims[0], v["claim"])
    agree(f"the evidence of {name}", evidence, v["evidence"])
    agree(f"the scope of {name}", case.say.scope(steps) | (scope or {}), v["scope"])
    own = {"share_asked": share, "drawn": c["rollouts"]} | (figures or {})
    agree(f"the figures of {name}", own, v["figures"])
    if trials:
        worst(case, found, v["worst"])
    else:
        agree(f"the worst case of {name}", None, v["worst"])
    return {"trials": trials, "successes": successes, "bound": v["bound"], "border": border}


def worst(case: Case, found: Found, said: Any, change: dict[str, Any] | None = None) -> None:
    """Check the rollout that is named as the one that failed worst or came closest to failing."""
    what, sim, n = f"the worst case of {case.name}", case.sim, len(found.holds)
    record(what, said, WORST)
    agree(f"the seed of {what}", sim.seed, said["seed"])
    agree(f"the purpose of {what}", "certify", said["purpose"])
    e = said["episode"]
    if not 0 <= e < n or not (found.asked | found.edge)[e]:
        raise Rejected(f"certificate: {what} is rollout {e}, which was not judged.")
    told = state_of(said["state"], what)
    x, goal, _ = sim.starts(fold(sim.keys(e), 0))
    x[..., :2] *= (change or {}).get("spread", 1.0)
    for part, own in (("x", x[0]), ("goal", goal[0])):
        close = 1e-4 * (1 + sim.game["size"])
        if told[part].shape != own.shape or not np.abs(told[part] - own).max() <= close:
            raise Rejected(f"certificate: {part} of {what} is not that of rollout {e}.")
    if not found.close[e]:
        agree(f"whether {what} failed", not found.holds[e], said["failed"])
    alike(f"the badness of {what}", found.badness[e], said["badness"])
    record(f"the figures of {what}", said["figures"], dict.fromkeys(found.figures, ROUGH))
    sure = not found.close[e] and not found.edge[e]
    rooms = {"settling_time": sim.game["dt"], "steps": 1.0, "windows": 1.0, "violations": 2.0}
    rooms |= dict.fromkeys(("entered", "outside"), 0.0 if sure else 1.0)
    for key, values in found.figures.items():
        alike(f"{key} of {what}", values[e], said["figures"][key], rooms.get(key, 0.0))
    badness, judged = np.clip(found.badness, -1e29, 1e29), found.asked & ~found.edge & ~found.close
    failing = judged & ~found.holds
    if failing.any() and not said["failed"]:
        raise Rejected(f"certificate: {what} did not fail, although others did.")
    rivals = badness[failing if said["failed"] else judged]
    if len(rivals) and badness[e] < rivals.max() - WIDE * (UNIT + abs(rivals.max())):
        raise Rejected(f"certificate: {what} is rollout {e}, but another one is worse.")


ROUGH = (*NUMBER, type(None))


def alike(what: str, found: Any, said: Any, room: float = 0.0) -> None:
    """`near`, for a figure of one rollout in float32; what float32 cannot hold is null."""
    found = float(found)
    if not abs(found) < 3e38:
        return near(what, math.inf, math.inf if said is None else said, 0.0) if said else None
    return near(what, found, said, room + WIDE * (UNIT + abs(found)))


def negative(case: Case, *sets: np.ndarray) -> list[str]:
    """What the claim says instead if V is negative along a rollout; nothing where it is not."""
    sure, perhaps = 0, 0
    for values in sets:
        lowest, largest = values.min(axis=1), np.abs(values).max(axis=1)
        floor = -NEGATIVE * np.median(largest[np.isfinite(largest)])
        sure, perhaps = sure + (lowest < 1.1 * floor).sum(), perhaps + (lowest < 0.9 * floor).sum()
    drawn = sum(map(len, sets))
    voids = [case.say.negative(k, drawn) for k in range(max(int(sure), 1), int(perhaps) + 1)]
    return voids if sure or case.v["claim"] in voids else []


def reach(case: Case) -> dict[str, Any]:
    sim, c, H = case.sim, case.c, case.sim.game["horizon"]
    steps = H + c.get("stay", 0)
    seen = sim.roll(c["rollouts"], steps)
    worse = seen["distance"][:, H:].max(axis=(1, 2))
    if "stay" not in c:
        found = judged(seen["sound"], worse, sim.game["radius"], figures={"final_distance": worse})
        return of_share(case, found, steps, case.say.reach)
    found = judged(seen["sound"], worse, sim.game["radius"], figures={"farthest": worse})
    claim = lambda bound: case.say.stay(bound, steps)
    return of_share(case, found, steps, claim, figures={"stay_steps": c["stay"]})


def decrease(case: Case) -> dict[str, Any]:
    sim, c, said, H = case.sim, case.c, case.figures, case.sim.game["horizon"]
    seen = sim.roll(c["rollouts"], H + sim.beyond)
    far = seen["distance"][:, : H + 1].max(axis=2) - sim.game["radius"]
    with np.errstate(invalid="ignore"):
        inside, border = far <= 0, np.abs(far) <= CLOSE * sim.game["radius"]
        before = np.cumsum(inside[:, :-1], axis=1) == 0
        value = sim.values(seen, H + 1)
        cost = np.maximum(seen["distance"][:, :H] - sim.V["ball"], 0).mean(axis=2)
        change = np.diff(value, axis=1) + c["beta"] * cost
        change = np.where(np.isnan(change), np.inf, change)
    entered = inside.any(axis=1)
    excess = np.where(before, change, -np.inf).max(axis=1)
    excess = np.where(entered, excess, np.inf)
    figures = {
        "steps": before.sum(axis=1),
        "violations": (before & ~(change <= 0)).sum(axis=1),
        "entered": entered,
    }
    found = judged(
        seen["sound"],
        excess,
        scale=1e-2,
        figures=figures,
        asked=before.any(axis=1),
        edge=border[:, 0],
    )
    unsure = ~entered & border.any(axis=1) | entered & (border | (far > 0)).all(axis=1)
    found = found._replace(close=found.close | unsure & seen["sound"])
    steps, touch = max(int(before.sum()), 1), (np.abs(change) <= CLOSE * 1e-2) & before
    room = (touch.sum() + H * border.any(axis=1).sum()) / steps
    part = "transitions_violating"
    near(part, float(figures["violations"].sum() / steps), said[part], float(room) + 1e-9)
    near("the number that entered", int(entered.sum()), said["entered"], int(unsure.sum()))
    own = {"beta": c["beta"], "V": sim.V["kind"], part: said[part], "entered": said["entered"]}
    claim = lambda bound: case.say.decrease(bound, c["beta"])
    voids, outside = negative(case, value), "begin outside the ball"
    return of_share(case, found, H, claim, voids=voids, to_judge=outside, figures=own)


def contraction(case: Case) -> dict[str, Any]:
    sim, c, said = case.sim, case.c, case.figures
    H, T, beta = sim.game["horizon"], c["T"], said["beta"]
    beta = -math.inf if beta is None else beta
    seen = sim.roll(c["rollouts"], H + 1)
    cost = sim.cost(seen)
    floor = sim.game["radius"] if c["c_min"] is None else c["c_min"]
    now, ahead = cost[:, : H - T + 1], cost[:, T : H + 1]
    above = now >= floor
    ratio = np.where(above, ahead / np.where(above, now, 1.0), -np.inf).max(axis=1)
    rate = np.minimum(1 - ratio, 1.0)
    found = judged(
        seen["sound"],
        ratio,
        1 - beta,
        scale=0.1,
        badness=-rate,
        figures={"beta": rate, "windows": above.sum(axis=1)},
        asked=above.any(axis=1),
        edge=(np.abs(now.max(axis=1) - floor) <= CLOSE * abs(floor)),
    )
    own = {"beta": said["beta"], "T": T, "c_min": floor, "calibration": c["calibration"]}
    own["rollouts_with_a_window"] = case.v["trials"]
    claim = lambda bound: case.say.contraction(bound, beta, T, floor, c["least"])
    also, what = beta >= c["least"], f"have a cost above {floor:g} with {T} steps to go"
    return of_share(case, found, H, claim, also=also, to_judge=what, figures=own)


def basin(case: Case) -> dict[str, Any]:
    sim, v, c, said, H = case.sim, case.v, case.c, case.figures, case.sim.game["horizon"]
    steps, level = H + max(c["stay"], sim.beyond), said["level"]
    level = -math.inf if level is None else level
    sets, values, worse, sound = {}, {}, {}, {}
    for purpose, count in (("calibrate", c["calibration"]), ("certify", c["rollouts"])):
        seen = sim.roll(count, steps, purpose=purpose)
        values[purpose] = sim.values(seen, steps + 1 - sim.beyond)
        worse[purpose] = seen["distance"][:, H : H + c["stay"] + 1].max(axis=(1, 2))
        sound[purpose] = seen["sound"]
        sets[purpose] = judged(sound[purpose], worse[purpose], sim.game["radius"])
    first, V0, failed = sets["calibrate"], values["certify"][:, 0], "failures_calibrating"
    near(failed, int((~first.holds).sum()), said[failed], int(first.close.sum()))
    inside, edge = V0 <= level * (1 + 1e-5), np.abs(V0 - level) <= CLOSE * level
    near("the number of starts in the level set", int(inside.sum()), v["trials"], int(edge.sum()))
    found, lowest = sets["certify"], np.zeros(len(V0), bool)
    lowest[np.argsort(V0)[: v["trials"]]] = True
    found = found._replace(asked=lowest, figures={"V": V0})
    m, n, tail = v["trials"], c["rollouts"], case.tail / 2
    low, high = said["mass"]
    near("the least mass of the level set", lower(m, n, tail / 2), low, 1e-9)
    near("the largest mass of the level set", 1 - lower(n - m, n, tail / 2), high, 1e-9)
    own = {"level": said["level"], "mass": [low, high], "needed_inside": needed(c["share"], tail)}
    own |= {"stay_steps": c["stay"], "V": sim.V["kind"], failed: said[failed]}
    return of_share(
        case,
        found,
        H + c["stay"],
        lambda bound: case.say.basin(bound, level, c["stay"], low),
        tail=tail,
        voids=negative(case, *values.values()),
        to_judge=f"begin with V <= {level:.4g}, below the least V of a failure",
        scope={"starts_with": f"V <= {level:.6g}"},
        figures=own,
    )


def quantiles(case: Case) -> dict[str, Any]:
    sim, v, c, H = case.sim, case.v, case.c, case.sim.game["horizon"]
    said, n = case.figures["bounds"], c["rollouts"]
    seen = sim.roll(n, H + sim.beyond)
    distance = seen["distance"][:, : H + 1].max(axis=2)
    stays = np.cumprod((distance <= sim.game["radius"])[:, ::-1], axis=1)[:, ::-1] > 0
    value = sim.values(seen, H + 1)
    sample = {
        "final_distance": distance[:, -1],
        "settling_time": np.where(stays[:, -1], stays.argmax(axis=1) * sim.game["dt"], np.inf),
        "largest_rise": (value - np.minimum.accumulate(value, axis=1)).max(axis=1),
    }
    record("the bounds of quantiles", said, dict.fromkeys(sample, ROUGH))
    for name, s in sample.items():
        found = order(np.where(seen["sound"] & ~np.isnan(s), s, np.inf), c["q"], case.tail / 3)
        room = CLOSE * abs(said[name] or 0.0) + (name == "settling_time") * sim.game["dt"]
        near(name, found, said[name], room + 1e-4)
    voids = negative(case, value)
    agree("the rollouts of quantiles", n, v["trials"])
    agree("the successes of quantiles", None, v["successes"])
    agree("the bound of quantiles", None if voids else said["final_distance"], v["bound"])
    holds = not voids and None not in said.values()
    agree("whether quantiles holds", holds, v["holds"])
    claims = voids or [case.say.quantiles(c["q"], said)]
    if v["claim"] not in claims:
        agree("the claim of quantiles", claims[0], v["claim"])
    agree("the evidence of quantiles", "statistical", v["evidence"])
    agree("the scope of quantiles", case.say.scope(H), v["scope"])
    own = {"q": c["q"], "bounds": said, "V": sim.V["kind"]}
    agree("the figures of quantiles", own, case.figures)
    limit = np.where(seen["sound"], distance[:, -1], np.inf)
    worst(case, judged(seen["sound"], limit, np.inf, figures=sample), v["worst"])
    return {"bounds": said}


def apart(case: Case) -> dict[str, Any]:
    sim, c, said = case.sim, case.c, case.figures
    steps, d = sim.game["horizon"] + c["stay"], said["gap"]
    if len(sim.slots) < 2:
        raise Rejected("certificate: apart is about several agents, and the game has one.")
    seen, gap = sim.roll(c["rollouts"], steps), np.full(c["rollouts"], np.inf)
    for i in range(1, len(sim.slots)):
        way = seen["x"][..., i:, :2] - seen["x"][..., : len(sim.slots) - i, :2]
        gap = np.minimum(gap, np.linalg.norm(way, axis=-1).min(axis=(1, 2)))
    found = judged(seen["sound"], -gap, -d, scale=1e-2, figures={"gap": gap})
    claim = lambda bound: case.say.apart(bound, d, c["least"], steps)
    own = {"gap": d, "stay_steps": c["stay"], "calibration": c["calibration"]}
    return of_share(case, found, steps, claim, also=d >= c["least"], figures=own)


def robustness(case: Case) -> dict[str, Any]:
    sim, v, c, H = case.sim, case.v, case.c, case.sim.game["horizon"]
    curve, said, out = case.figures["curve"], swept(sim, c), {}
    told = [(point["perturbation"], point["change"]) for point in curve]
    agree("what robustness sweeps", [*said.items()], told)
    tail, radius, n = case.tail / len(curve), sim.game["radius"], c["rollouts"]
    for point in curve:
        name, change = point["perturbation"], point["change"]
        record(f"robustness with {name}", point, POINT)
        seen = sim.roll(n, H, change)
        worse = seen["distance"][:, -1].max(axis=1)
        found = judged(seen["sound"], worse, radius, figures={"final_distance": worse})
        agree(f"the rollouts with {name}", n, point["trials"])
        k, border = point["successes"], int(found.close.sum())
        near(f"the successes with {name}", int(found.holds.sum()), k, border)
        if not 0 <= k <= n:
            raise Rejected(f"certificate: {name} has more successes than trials.")
        near(f"the bound with {name}", lower(k, n, tail), point["bound"], 1e-9)
        agree(f"whether {name} holds", point["bound"] >= c["share"], point["holds"])
        worst(case, found, point["worst"], change)
        out[name] = {"trials": n, "successes": k, "bound": point["bound"], "border": border}
    for key, total in (("trials", sum), ("successes", sum), ("bound", min), ("holds", all)):
        agree(f"{key} of robustness", total(p[key] for p in curve), v[key])
    weakest = min(curve, key=lambda point: point["successes"])
    least = weakest["worst"] | {"change": weakest["change"]}
    agree("the worst case of robustness", least, v["worst"])
    near("the confidence of each point", 1 - tail, case.figures["confidence_each"], 1e-12)
    own = {"share_asked": c["share"], "curve": curve, "without": {}}
    own["confidence_each"] = case.figures["confidence_each"]
    agree("the figures of robustness", own, case.figures)
    agree("the claim of robustness", case.say.robustness(v["bound"], len(curve)), v["claim"])
    agree("the evidence of robustness", "statistical", v["evidence"])
    disturbance = f"each in turn: {', '.join(said)}"
    agree("the scope of robustness", case.say.scope(H, disturbance), v["scope"])
    return {"curve": out}


def swept(sim: World, c: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The perturbations that were asked for, by name."""
    curve: dict[str, dict[str, Any]] = {f"gain {x:g}": {"gain": x} for x in c["gains"]}
    curve |= {f"action noise {x:g}": {"noise": x} for x in c["noises"]}
    curve |= {f"delay {x} steps": {"delay": x} for x in c["delays"]}
    curve |= {f"starts {x:g} times as far": {"spread": x} for x in c["spreads"]}
    n, edges = len(sim.slots), [*np.argwhere(np.triu(sim.linked)).tolist()]
    if n > 1:
        curve |= {f"messages lost {x:g}": {"drop": x} for x in c["drops"]}
    followers = np.flatnonzero(~sim.leads).tolist()
    if c["remove"] and followers:
        curve[f"without agent {followers[-1]}"] = {"gone": followers[-1:]}
    if c["remove"] and edges:
        spare = [edge for edge in edges if connected(sim.linked, edge)]
        a, b = (spare or edges)[-1]
        curve[f"without edge {a}-{b}"] = {"cut": [[a, b]]}
    return curve


def connected(linked: np.ndarray, without: list[int]) -> bool:
    """Whether the graph stays connected without an edge."""
    left = linked.copy()
    left[without, without[::-1]] = False
    return bool((hops(left, np.arange(len(left)) == 0) >= 0).all())


def composition(case: Case) -> dict[str, Any]:
    sim, c, said, T = case.sim, case.c, case.figures, case.c["T"]
    steps, radius, agents = sim.game["horizon"] + c["stay"] + T, sim.game["radius"], len(sim.slots)
    seen = sim.roll(c["rollouts"], steps)
    M, delta, ultimate = (np.array(said[k], float) for k in ("M", "delta", "ultimate"))
    shapes = [[agents, agents], [agents], [agents]]
    agree("the shapes of M, delta and ultimate", shapes, [[*a.shape] for a in (M, delta, ultimate)])
    V = np.lib.stride_tricks.sliding_window_view(seen["distance"], T, axis=1).max(axis=-1)
    if np.isfinite(M).all():
        if not ((M >= 0).all() and (delta >= 0).all()):
            raise Rejected("certificate: M or delta of composition has a negative entry.")
        if M[~(sim.linked | np.eye(agents, dtype=bool))].any():
            raise Rejected("certificate: M of composition joins agents that are no neighbours.")
        near("the spectral radius", float(np.abs(np.linalg.eigvals(M)).max()), said["rho"], 1e-6)
        if not said["rho"] < 1 or not M.any():
            raise Rejected("certificate: the inequalities of composition contract nothing.")
        excess = (V[:, T:] - V[:, :-T] @ M.T - delta).max(axis=(1, 2))
        apart = np.abs(np.linalg.solve(np.eye(agents) - M, delta) - ultimate).max()
        near("the distance to the ultimate bound said", float(apart), 0.0, 1e-6)
        rho, farthest = said["rho"], max(said["ultimate"])
    else:
        nothing = [*np.full((agents, agents), None).tolist()], [None] * agents, [None] * agents
        agree("M, delta and ultimate", nothing, [said[k] for k in ("M", "delta", "ultimate")])
        agree("the spectral radius", None, said["rho"])
        excess, rho, farthest = np.full(len(V), np.inf), math.inf, math.inf
    with np.errstate(invalid="ignore"):
        over = np.nan_to_num(V[:, 0] - np.where(np.isfinite(ultimate), ultimate, np.inf), nan=-1.0)
    above, edge = (over > 0).any(axis=1), (np.abs(over) <= CLOSE * farthest).any(axis=1)
    part, voids = "begin_above", []
    near("the number that begin above", int(above.sum()), said[part], int(edge.sum()))
    if rho == math.inf:
        voids = [case.say.no_inequalities()]
    elif 2 * said[part] < len(above):
        voids = [case.say.nothing_contracted(said[part], len(above), farthest)]
    within = radius if c["within"] is None else c["within"]
    own = {k: said[k] for k in ("rho", "M", "delta", "ultimate", part)} | {"T": T}
    found = judged(seen["sound"], excess, scale=1e-2, figures={"excess": excess})
    claim = lambda bound: case.say.composition(bound, rho, farthest, steps)
    return of_share(case, found, steps, claim, voids=voids, also=farthest <= within, figures=own)


def theorem1(case: Case) -> dict[str, Any]:
    sim, c, said = case.sim, case.c, case.figures
    H = sim.game["horizon"]
    if c["old"] is not None:
        return {"left": "its tuples are of another policy, which is not in the file"}
    first, found = tuples(case, "calibrate"), tuples(case, "certify")
    dt, orders = sim.game["dt"], (KNOWN[sim.kind][0] + 1) // 2  # 1, 2 and 3
    for key in ("speed", "reach"):
        alike(f"{key} of theorem1", np.nanmax(first[key]), said[key])
    l_f = math.hypot(*[dt, dt**2, dt**3 * said["speed"]][:orders])
    near("l_f", 1.0 if sim.kind == "LateUnicycle" else float(l_f), said["l_f"], 1e-5)
    kept = ["speed", "reach", "l_f", "empirical", "l_L", "margin_median", "margin_worst"]
    spectral = math.nan
    if sim.V["kind"] == "Norm":
        kept, spectral = [*kept, "spectral"], sim.lipschitz() * math.sqrt(1 + said["reach"] ** 2)
        near("the spectral bound", spectral, said["spectral"], 1e-3 * spectral)
        spectral = said["spectral"]
    by = c["lipschitz"] if c["lipschitz"] in said else "empirical"
    agree("l_L of theorem1", said[by], said["l_L"])
    l, moved, V = said["l_L"], found["moved"], found["V"]
    excess = found["next_V"] + max(l, 0.0) * said["l_f"] * moved - (1 - c["rate"]) * V
    far, keys = found["far"], ("V", "next_V", "moved", "gradient", "speed", "reach", "outside")
    edge = np.abs(far) <= CLOSE * sim.game["radius"]
    about = {key: found[key] for key in keys}
    result = judged(found["sound"], excess, scale=1e-2, figures=about, asked=far > 0, edge=edge)
    if (outside := far > 0).any():
        margins = -excess[outside]
        alike("margin_median of theorem1", np.median(margins), said["margin_median"])
        if not edge.any():
            alike("margin_worst of theorem1", margins.min(), said["margin_worst"])
    counts = of_share(
        case,
        result,
        H,
        case.say.theorem1,
        voids=negative(case, first["along"], found["along"]),
        to_judge="gave a state outside the ball",
        evidence="statistical" if l == spectral else "observed",
        scope={"tuples": "one per rollout, at a random time"},
        figures={key: said[key] for key in kept} | {"V": sim.V["kind"]},
    )
    return counts | {"left": "its constant l_L is the largest gradient of V on other rollouts"}


def tuples(case: Case, purpose: str) -> dict[str, np.ndarray]:
    """For each rollout a state at a random time, V there and after the old policy's action."""
    sim, c, H = case.sim, case.c, case.sim.game["horizon"]
    n, size = c["rollouts"], max(sim.limits)
    seen, pick = sim.roll(n, H + sim.beyond, purpose=purpose), np.arange(n)
    key = fold(sim.keys(pick, purpose), 2)
    t = (H * uniform(fold(key, 0))).astype(int)
    x, goal = seen["x"][pick, t], seen["goal"]
    new = sim.act(x, goal, sim.linked)
    old = np.clip(new + c["noise"] * normal(fold(key, 1), *new.shape[1:]), -1, 1)
    value = lambda x: sim.value(x, goal)
    worst = case.v["worst"] or {"episode": 0}
    gradient = np.full(n, np.nan)
    e = worst["episode"]
    if purpose == "certify" and 0 <= e < n:
        gradient[e] = np.linalg.norm(sim.gradient(x[e], goal[e]))
    return {
        "V": value(x),
        "next_V": value(sim.step(x, sim.limits * old)),
        "moved": np.linalg.norm((new - old) * sim.limits, axis=(1, 2)),
        "gradient": gradient,
        "speed": np.linalg.norm(sim.motion(x)[0], axis=-1).max(axis=1) + sim.game["dt"] * size,
        "reach": seen["distance"][pick, t].max(axis=1),
        "outside": (seen["distance"][pick, t].max(axis=1) > sim.game["radius"]).astype(float),
        "far": seen["distance"][pick, t].max(axis=1) - sim.game["radius"],
        "sound": seen["sound"],
        "along": sim.values(seen, H + 1),
    }
