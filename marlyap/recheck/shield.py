"""The credit shield of unicycles once more, in NumPy and float64, and the certificate about it.

Written apart from the shield: a mistake in its plans, its accounts or its bounds shows here.
"""

import math
from typing import Any

import numpy as np

from marlyap.recheck.checks import Case, near
from marlyap.recheck.reader import Rejected, agree, record
from marlyap.recheck.world import FLAG, NUMBER, TEXT, WHOLE, World, hops
from marlyap.threefry import fold


NONE = type(None)
SHIELD = dict(kind=TEXT, action=TEXT, reach=NUMBER, sigma=NUMBER, rho=NUMBER, tau=NUMBER)
SHIELD |= dict(weight=NUMBER, steps=WHOLE, window=(int, NONE), caution=NUMBER, on=FLAG)
LONG_WINDOW = 45  # where no window is named and a follower does not hear a leader
# How often the decisions of float32 may differ, and what it then makes of the figures.
ADMITTED, BOUNDS, PAID = 0.03, 5e-3, 2e-3
# The base law: the cascade of tree pursuit (docs/reference.md), and how an agent stops.
NEAR, NEAR_ANGLE, K_A, K_R = 0.125, 0.045, 10.0, 9.0
BRAKING, ALIGNMENT, CALM, MARGIN = 0.7, 2.4, 0.005, 1.9


def unknown(game: dict[str, Any]) -> str | None:
    """What of a shielded game is not known here."""
    shield, kind = game.get("shield", {}), game.get("inner", {}).get("dynamics", {}).get("kind")
    if kind != "Unicycle":
        return f"a shield of {kind}"
    if shield.get("kind") != "Shield" or shield.get("on") is not True:
        return "such a shield"
    return None


class Shielded:
    """A world whose agents act behind the shield that the file names."""

    def __init__(self, sim: World, shield: dict[str, Any]):
        record("the shield", shield, SHIELD)
        self.sim, self.shield, self.dt = sim, shield, sim.game["dt"]
        self.limits = shield["caution"] * sim.limits
        self.hops = hops(sim.linked, sim.leads)
        far = np.where(self.hops < 0, len(sim.slots), self.hops)
        seen = np.where(sim.linked, far[None], len(sim.slots))
        self.parent = np.where(sim.leads | (seen.min(axis=1) >= len(far)), -1, seen.argmin(axis=1))
        chain = LONG_WINDOW if self.hops.max() > 1 else 0
        self.window = chain if shield["window"] is None else shield["window"]

    def step(self, x: np.ndarray, a: np.ndarray) -> np.ndarray:
        """One semi-implicit step of every agent, by the motors that plans count on."""
        x = x.copy()
        x[..., 3:5] += self.dt * self.limits * np.clip(a, -1, 1)
        x[..., 2] += self.dt * x[..., 4]
        x[..., :2] += self.dt * x[..., 3:4] * self.sim.heading(x)
        return x

    def arrived(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        slow = (np.abs(x[..., 3:5]) <= self.limits * self.dt).all(axis=-1)
        return (((x[..., :2] - q) ** 2).sum(axis=-1) <= self.shield["rho"] ** 2) & slow

    def law(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        """The cascade towards q, and braking where the agent has arrived, as actions."""
        e, h, (a, r) = q - x[..., :2], self.sim.heading(x), self.limits
        ahead = (e * h).sum(axis=-1)
        aside = e[..., 1] * h[..., 0] - e[..., 0] * h[..., 1]
        theta = np.arctan2(np.where(ahead < 0, -aside, aside), np.abs(ahead))
        turned = np.maximum(np.cos(theta), 0) ** ALIGNMENT
        v = self.speed(ahead, NEAR, a) * turned
        far = np.minimum(np.linalg.norm(e, axis=-1) / CALM, 1)
        w = self.speed(theta, NEAR_ANGLE, r) * far
        gains = np.minimum([K_A, K_R], 1 / self.dt)
        u = gains * (np.stack([v, w], axis=-1) - x[..., 3:5])
        there = self.arrived(x, q)[..., None]
        return np.clip(np.where(there, -x[..., 3:5] / self.dt, u) / self.limits, -1, 1)

    def speed(self, gap: np.ndarray, near: float, limit: float) -> np.ndarray:
        gain, gone = min(math.sqrt(limit / near), 1 / self.dt), np.abs(gap)
        return np.sign(gap) * np.minimum(gain * gone, np.sqrt(2 * BRAKING * limit * gone))

    def cost(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        s, off = self.shield, np.linalg.norm(x[..., :2] - q, axis=-1)
        out = s["tau"] + np.maximum(off - s["rho"], 0) + s["weight"] * np.abs(x[..., 3])
        return np.where(self.arrived(x, q), 0.0, out)

    def worth(self, x: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """J, and the steps of the plan; T + 1 where it does not arrive."""
        J, outside, T = np.zeros(x.shape[:-1]), np.zeros(x.shape[:-1], int), self.shield["steps"]
        for _ in range(T):
            away = ~self.arrived(x, q)
            if not away.any():
                break
            J, outside = J + self.cost(x, q), outside + away
            x = self.step(x, self.law(x, q))
        return J, np.where(self.arrived(x, q), outside, T + 1)

    def stop(self, x: np.ndarray) -> np.ndarray:
        way = MARGIN * x[..., 3] * np.abs(x[..., 3]) / (2 * self.limits[0])
        return x[..., :2] + way[..., None] * self.sim.heading(x)

    def references(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        q = np.where((self.parent >= 0)[:, None], self.stop(x)[:, self.parent], self.stop(x))
        return np.where(self.sim.leads[:, None], goal, q)

    def roll(self, n: int, steps: int) -> dict[str, np.ndarray]:
        """Accounts of n rollouts; they end early where every agent rests."""
        x, goal, _ = self.sim.starts(fold(self.sim.keys(np.arange(n)), 0))
        s, leads = self.shield, self.sim.leads
        q = self.references(x, goal)
        J, _ = self.worth(x, q)
        credit, held = s["sigma"] * J, q
        found = {"first": J, "paid": 0 * J, "admitted": 0 * J, "asked": 0 * J, "late": 0 * J}
        for _ in range(steps):
            q = self.references(x, goal)
            base = self.law(x, q)
            asked = self.sim.act(x, goal, self.sim.linked)
            if s["action"] == "residual":
                asked = np.clip(base + s["reach"] * asked, -1, 1)
            J, long = self.worth(x, q)
            then, short = self.worth(self.step(x, asked), q)
            c, outside = self.cost(x, q), ~self.arrived(x, q)
            balance = credit + J - c - then
            free = (((q - held) ** 2).sum(axis=-1) > 1e-12) & ~leads & (short <= self.window)
            yes = outside & (short <= s["steps"]) & ((balance >= -1e-5) | free)
            credit = np.where(yes, np.clip(balance, 0, s["sigma"] * then), credit)
            found["paid"] += c
            found["admitted"] += yes
            found["asked"] += outside
            found["late"] += long > s["steps"]
            real = self.sim.step(x, self.sim.limits * np.where(yes[..., None], asked, base))
            if not outside.any() and np.abs(real - x).max() < 1e-9:
                break
            x, held = real, q
        off = np.linalg.norm(x[..., :2] - goal, axis=-1)
        rest = np.abs(x[..., 3:]).max(axis=(1, 2)) < 1e-6
        rest &= (off <= (self.hops + 1) * s["rho"] + 1e-5).all(axis=1)
        return found | {"rest": rest}


def check(case: Case, shield: dict[str, Any]) -> dict[str, Any]:
    """Derive the verdict of `shielded` again: conditions, bounds, and what the rollouts did."""
    v, c, sim = case.v, case.c, case.sim
    team = Shielded(sim, shield)
    n, H = c["rollouts"], sim.game["horizon"]
    sim.bounded(n, 10 * H)
    found, leads = team.roll(n, 10 * H), sim.leads
    said, bound = v["figures"], (1 + shield["sigma"]) * found["first"][:, leads]
    paid = (found["paid"][:, leads] / np.maximum(bound, 1e-9)).max(axis=1)
    late = found["late"].sum()
    broken = sorted(text.partition(":")[0] for text in said["broken"])
    own = (["plans"] if late else []) + (["tree"] if (team.hops < 0).any() else [])
    agree("which conditions of shielded do not hold", sorted(own), broken)
    steps = np.ceil(bound.max() / shield["tau"] - 1e-4)
    near("the bound of shielded", float(steps), v["bound"], 1 + BOUNDS * steps)
    J = float(found["first"][:, leads].max())
    near("J_0 of shielded", J, said["J_0"], BOUNDS * J)
    near("what leaders paid", float(paid.max()), said["paid_over_bound"], 0.05)
    share = float(found["admitted"].sum() / max(found["asked"].sum(), 1))
    near("the share of actions admitted", share, said["admitted"], ADMITTED)
    if paid.max() > 1 + PAID or not (said["paid_over_bound"] <= 1 + PAID):
        raise Rejected("certificate: a leader paid more than the theorem of the shield allows.")
    holds = not own and bool(found["rest"].all())
    agree("whether shielded holds", holds, v["holds"])
    agree("the claim of shielded", claim(v["bound"], shield, said["broken"]), v["claim"])
    agree("the evidence of shielded", "observed", v["evidence"])
    return {"trials": n, "successes": int(found["rest"].sum()), "bound": v["bound"], "border": 0}


def claim(n: float, shield: dict[str, Any], broken: list[str]) -> str:
    """In words."""
    if broken:
        return f"the theorem does not apply: {'; '.join(broken)}"
    return (
        "by construction: whatever the policy does, every agent comes to rest for good, one that "
        f"is k hops from a leader within (k + 1) {shield['rho']:g} m of its place; from the starts "
        f"drawn a leader is on its way for at most {n:.0f} steps, and no leader pays more than "
        f"{1 + shield['sigma']:g} times what the base law would"
    )
