"""The credit shield measured: what it costs, what it guarantees, and where it decides.

    ./run python experiments/shield.py                     everything that is missing, hours
    ./run python experiments/shield.py --only runaway      the unstable agents alone
    ./run python experiments/shield.py --seeds 0           one training seed
    ./run python experiments/shield.py --draw              the sums again, from the tables alone
    ./run python experiments/shield.py --quick             seconds, to see that it works

It leaves in `--results`

    shield.csv         a row for each policy, training seed, setting, with and without the shield
    shield-starts.csv  the cost of each start in the undisturbed game, to pair policies by start
    shield-any.csv     what policies that were never trained, or mean ill, make of a shielded team

A row that is there is not made again. The policies, each trained once a seed:

    residual      analytic policy gradients through the base law plus a learnt part, shield off
    masac-behind  MASAC whose actions are residuals behind the shield, half the budget
    control       MASAC with the T-step cost critic as its constraint, no shield
    masac         plain MASAC, no shield
    tree          the hand-written pursuit, which is also the base law; nothing is trained
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from common import Case, options, put, read, train

from marlyap.controllers import CONTROLLERS
from marlyap.controllers.predicting import Predicting
from marlyap.games.perturbed import Perturbed
from marlyap.learning.algorithms import APG, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.schedule import Schedule
from marlyap.learning.trainer import schedule_for
from marlyap.runs.provenance import provenance
from marlyap.shields import Shield, Shielded, behind
from marlyap.simulation.evaluation import Evaluation, evaluate, share
from marlyap.simulation.rollout import Decentralised, rollout
from marlyap.tasks import TASKS


RESIDUAL = APG(growth=0.0, sharpness=0.0)
CONTROL = MASAC(constraint=Lyapunov(reading="critic", weight=1.0))
BY_HAND = {"rendezvous": "tree-pursuit", "rendezvous-path5": "tree-pursuit"}
BY_HAND |= {"runaway": "point-pursuit"}
STEPS = {"runaway": 80}  # T, where it is not the usual one
THOROUGH = 1  # training seeds that are measured in every setting, the others in the plain game
KEY = ["task", "policy", "seed", "shield", "setting"]
ROBUST = {
    "far3": {"spread": 3.0},
    "drop .5": {"drop": 0.5},
    "gone": {"gone": (2,)},
    "cut": {"cut": ((0, 2),)},
    "noise .3": {"noise": 0.3},
    "gain 2": {"gain": 2.0},
    "delay 1, predicted": {"delay": 1},
}
UNSTABLE = {
    "far2": {"spread": 2.0},
    "far4": {"spread": 4.0},
    "jump 4": {"jump": 4.0, "every": 100},
    "noise .3": {"noise": 0.3},
    "gain .7": {"gain": 0.7},
    "gain .7, cautious": {"gain": 0.7},
    "gain 1, cautious": {},
}
ALONE = {"noise .3", "drop .5", "gone", "cut", "delay 1, predicted", "far2"}  # with a shield only
SETTINGS = {"rendezvous": ROBUST, "runaway": UNSTABLE, "rendezvous-path5": {"far3": ROBUST["far3"]}}


@dataclass(frozen=True)
class Team:
    """A policy to be trained on a task, and how it acts: by itself or on top of the base law."""

    task: str
    name: str
    algorithm: Any
    schedule: Schedule
    trained: Shield | None = None  # behind which it is trained

    def case(self) -> Case:
        game = behind(TASKS[self.task], self.trained)
        return Case({"task": self.task, "policy": self.name}, game, self.algorithm, self.schedule)

    def shield(self, on: bool, cautious: bool) -> Shield | None:
        """The one that it is judged behind."""
        if self.trained is None and not on:
            return None
        made = Shield(action=self.trained.action if self.trained else "proposal", on=on)
        made = replace(made, steps=STEPS.get(self.task, 60))
        return replace(made, caution=0.7) if cautious else made


def teams() -> list[Team]:
    """In the order of their worth."""
    usual, off = Schedule(), Shield(action="residual", on=False)
    quick = Schedule(steps=3_072_000, environments=64, select_every=100)
    half = replace(usual, steps=102_400)
    behind_it = lambda task: Shield(action="residual", steps=STEPS.get(task, 60))
    found = []
    for task in ("rendezvous", "runaway"):
        found += [
            Team(task, "residual", RESIDUAL, quick, off),
            Team(task, "masac-behind", MASAC(), half, behind_it(task)),
            Team(task, "control", CONTROL, usual),
            Team(task, "masac", MASAC(), usual),
        ]
    path = schedule_for(APG())
    return [*found, Team("rendezvous-path5", "apg", APG(), path)]


def row(found: Evaluation) -> dict[str, Any]:
    """The columns of one evaluation."""
    s, mean = share(found.successes, 0.95), lambda x: round(float(np.mean(x)), 5)
    low, high = s["interval"]
    watched = {"stayed": mean(found.stayed), "lost": mean(found.lost)} if found.beyond else {}
    watched |= {"ended": float(np.quantile(found.ended, 0.95))} if found.beyond else {}
    blank = {"stayed": "", "lost": "", "ended": ""}
    counted = {"episodes": s["episodes"], "success": mean(found.successes), "low": low}
    return counted | {"high": high, "cost": mean(found.cost)} | blank | watched


def judged(team: Team, controller: Any, seed: Any, args: Any) -> Iterator[tuple[Any, ...]]:
    """(key, evaluation) of every setting that has no row yet."""
    there = {tuple(r[c] for c in KEY) for r in read(args, "shield")}
    harder = {} if isinstance(seed, int) and seed >= THOROUGH else SETTINGS[team.task]
    for setting, change in {"nominal": {}, **harder}.items():
        for on in (False, True):
            key = (team.task, team.name, seed, "on" if on else "off", setting)
            cautious = "cautious" in setting
            if tuple(map(str, key)) in there or (not on and (cautious or setting in ALONE)):
                continue
            disturbed = Perturbed(inner=TASKS[team.task], **change) if change else TASKS[team.task]  # pyright: ignore
            game = behind(disturbed, team.shield(on, cautious))
            act = controller(game)
            if "predicted" in setting:
                act = Predicting(act, game)
            nominal = setting == "nominal"
            count = args.episodes if nominal else min(args.episodes, 200)
            long = 9 if nominal or team.task == "runaway" or setting == "far3" else 0
            yield key, evaluate(game, act, count, beyond=long * game.horizon)


def keep(team: Team, controller: Any, seed: Any, args: Any) -> None:
    """Measure what is missing and add it to the tables."""
    for key, found in judged(team, controller, seed, args):
        about = dict(zip(KEY, key, strict=True))
        if key[-1] == "nominal":
            own = {k: v for k, v in about.items() if k != "setting"}
            costs = enumerate(found.cost * TASKS[team.task].horizon)
            rows = [own | {"start": k, "cost": f"{c:.4f}"} for k, c in costs]
            put(args, "shield-starts", ["task", "policy", "seed", "shield", "start"], rows)
        put(args, "shield", KEY, [about | row(found) | provenance()])
        print(*key, row(found)["success"], row(found)["cost"], row(found)["lost"], flush=True)


def trained(team: Team, seed: int, args: Any) -> Any:
    """The policy of a seed, as a controller for any game; trained if it is not there."""
    case = team.case().quick() if args.quick else team.case()
    run = case.run(args.runs / "shield", seed)
    if not run.finished:
        train([run], args.quick)
    policy = run.deployed()[0]
    return lambda game: Decentralised(policy, game)


ILL = {  # what is proposed by those who were not trained, or mean ill
    "random": lambda game, s, k: jax.random.uniform(k, (game.agents, game.du), minval=-1.0),
    "full": lambda game, s, k: jnp.ones((game.agents, game.du)),
    "away": lambda game, s, k: away(game, s),
}


def away(game: Any, s: Any) -> Any:
    """Full throttle away from the target, straight on."""
    p, h = s.x[:, :2], jax.vmap(game.dynamics.heading)(s.x)
    ahead = jnp.sum((game.goals(s) - p) * h, axis=1) > 0
    return jnp.stack([jnp.where(ahead, -1.0, 1.0), jnp.zeros(game.agents)], axis=1)


def untrained(weights: float, seed: int) -> Any:
    """A policy whose weights are random, and so many times their usual size."""

    def act(game, s, k):
        obs = game.observations(s)
        keys = jax.random.split(jax.random.key(seed), 2)
        inside = weights * jax.random.normal(keys[0], (obs.shape[1], 32)) / obs.shape[1] ** 0.5
        out = weights * jax.random.normal(keys[1], (32, game.du)) / 32**0.5
        return jnp.tanh(jnp.tanh(obs @ inside) @ out)

    return act


@eqx.filter_jit
def ends(game: Shielded, act: Any, keys: Any, steps: int) -> dict[str, Any]:
    """At rest in the last step, where, since when, and the accounts of a leader."""

    def one(key):
        k_start, k_act = jax.random.split(key)
        seen = rollout(game, lambda s, k: act(game, s, k), game.reset(k_start), k_act, steps)
        rates = jnp.abs(jax.vmap(jax.vmap(game.dynamics.rates))(seen.state.x)).max(axis=(1, 2))
        last = jax.tree.map(lambda x: x[-1], seen.state)
        m = last.memory
        moving = jnp.max(jnp.where(rates > 0, jnp.arange(steps + 1), 0))
        paid = m["paid"][0] / ((1 + game.shield.sigma) * m["first"][0])
        used = jnp.sum(m["admitted"]) / jnp.maximum(jnp.sum(m["asked"]), 1)
        return {"rest": rates[-1] == 0, "off": jnp.max(game.distance(last))} | {
            "step": moving, "paid": paid, "used": used,
        }  # fmt: skip

    return jax.vmap(one)(keys)


def any_policy(args: Any) -> None:
    """Every policy of `ILL`, and nets with random weights, on three agents and a path of eight."""
    there = {(r["game"], r["policy"]) for r in read(args, "shield-any")}
    acts = ILL | {f"untrained {k}": untrained(1.0, k) for k in range(2)}
    acts |= {"weights x10": untrained(10.0, 2)}
    path = replace(TASKS["rendezvous-path5"], agents=8)
    far = Shielded(path, Shield(window=0)), Shielded(path, Shield(window=30))
    cases = {"three": (Shielded(TASKS["rendezvous"]), 200, 400)}  # pyright: ignore
    cases |= {"path of eight": (far[0], 100, 500), "path of eight, window 30": (far[1], 40, 500)}
    for name, (game, count, steps) in cases.items():
        for policy, act in acts.items():
            if (name, policy) in there:
                continue
            count = 4 if args.quick else count
            found = ends(game, act, jax.random.split(jax.random.key(0), count), steps)
            found = {k: np.asarray(v) for k, v in found.items()}
            said = {"starts": count, "at rest": int(found["rest"].sum())}
            said |= {"worst": float(found["off"].max()), "bound": game.agents * game.shield.rho}
            said |= {"median step": float(np.median(found["step"]))}
            said |= {"last step": int(found["step"].max()), "paid": float(found["paid"].max())}
            said |= {"admitted": float(np.mean(found["used"]))}
            about = {"game": name, "policy": policy} | said | provenance()
            put(args, "shield-any", ["game", "policy"], [about])
            print(name, policy, said, flush=True)


def differences(args: Any) -> None:
    """Costs paired by start; intervals resample training seeds, then starts."""
    costs: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    for r in read(args, "shield-starts"):
        one = costs.setdefault((r["task"], r["policy"], r["shield"]), {})
        one.setdefault(r["seed"], []).append(float(r["cost"]))
    rng = np.random.default_rng(0)
    for task in dict.fromkeys(k[0] for k in costs):
        those = {k[1:]: np.array([*v.values()]) for k, v in costs.items() if k[0] == task}
        base = those.get(("by hand", "off"))
        for name, values in those.items():
            print(f"{task} {' '.join(name)}: {values.mean():.3f}, seeds {values.mean(axis=1)}")
            pairs = {"by hand": base, "unshielded": those.get((name[0], "off"))}
            pairs |= {"control": those.get(("control", "off"))}
            for other, against in pairs.items():
                if against is not None and against is not values:
                    print(f"  - {other}: {paired(values, against, rng)}")


def paired(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> str:
    """Mean difference over seeds [seed, start] with a two-level bootstrap interval.

    Starts are drawn together, and so are training seeds where both have as many.
    """
    drawn, n = [], a.shape[1]
    for _ in range(2_000):
        starts = rng.integers(n, size=n)
        seeds = rng.integers(len(a), size=len(a))
        others = seeds if len(a) == len(b) else rng.integers(len(b), size=len(b))
        drawn.append(a[seeds][:, starts].mean() - b[others][:, starts].mean())
    low, high = np.quantile(drawn, [0.025, 0.975])
    return f"{a.mean() - b.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def measure(args: Any) -> None:
    chosen = [t for t in teams() if args.only in f"{t.task} {t.name}"]
    if args.list:
        print(*(f"{t.task} {t.name}" for t in chosen), sep="\n")
        return
    if args.quick:
        chosen, args.episodes = chosen[:1], 20
    if args.only in "any":
        any_policy(args)
    for task in dict.fromkeys(t.task for t in chosen):
        by_hand = Team(task, "by hand", None, Schedule())
        keep(by_hand, CONTROLLERS[BY_HAND[task]], "", args)
    for seed in args.seeds[: 1 if args.quick else None]:
        for team in chosen:
            keep(team, trained(team, seed, args), seed, args)


if __name__ == "__main__":
    args = options(__doc__ or "")
    args.results.mkdir(parents=True, exist_ok=True)
    if not args.draw:
        measure(args)
    if not args.list:
        differences(args)
