"""Controllers, games, V functions and certificates that lie: none may be believed.

    ./run python reliability/liars.py            every liar, and the sentence it is answered with
    ./run python reliability/liars.py --quick    fewer rollouts: what the tests run

A liar would like to hear that something false holds, is proved or agrees. It is caught if it is
refused or if the verdict does not hold; where the lie is in what a true sentence leaves out, if the
sentence says that too. Each kind of liar has an honest twin that has to pass: a tool that refuses
everybody catches nobody. Exit code 1 if a liar passed or an honest one did not.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from marlyap.certificates.basin import Basin
from marlyap.certificates.certificate import Verdict, sentence
from marlyap.certificates.certify import certify, save
from marlyap.certificates.closed_form import ClosedForm
from marlyap.certificates.composition import Composition
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.linearisation import Linearisation
from marlyap.certificates.lyapunov import AbstractLyapunov, Approach
from marlyap.certificates.proof import Proof
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.robustness import Robustness
from marlyap.certificates.safety import Apart, Safe
from marlyap.conformance import conformance
from marlyap.controllers.point_offset import PointOffset
from marlyap.controllers.pursuit import TreePursuit
from marlyap.errors import UserError
from marlyap.games.dynamics import DoubleIntegrator, SingleIntegrator
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.learning.algorithms.sac import Joint
from marlyap.learning.source import shape
from marlyap.nets.nets import Actors, Greedy
from marlyap.recheck import recheck
from marlyap.simulation.evaluation import evaluate
from marlyap.simulation.rollout import Decentralised
from marlyap.tasks import Formation, Rendezvous
from marlyap.types import State


@dataclass(frozen=True)
class Answer:
    """What a liar was told."""

    believed: bool
    says: str


@dataclass(frozen=True)
class Case:
    """One liar, or an honest twin, and the question it is asked."""

    kind: str
    name: str
    ask: Callable[[int], Answer]  # given a number of rollouts
    honest: bool = False


CASES: list[Case] = []


def case(kind: str, name: str, honest: bool = False) -> Callable:
    """Put the function below into the table."""
    return lambda ask: CASES.append(Case(kind, name, ask, honest)) or ask


def verdicts(
    game: AbstractPlanar,
    controller: Any,
    certificate: Any,
    V: AbstractLyapunov | None = None,
    must_say: str | None = None,
) -> Answer:
    """What `certify` answers; with `must_say` a liar is caught by these words."""
    try:
        result = certify(game, controller, {"asked": certificate}, 1, 0.99, V=V)
    except UserError as error:
        return Answer(False, f"refused: {error}")
    (verdict,) = result["verdicts"].values()
    says = sentence(Verdict(**verdict))
    if must_say is not None:
        says += f" [{result['information']}]"
        return Answer(must_say not in says, says)
    return Answer(bool(result["holds"] and verdict["holds"]), says)


def refused(call: Callable[[], Any]) -> Answer:
    """Whether a call raises UserError."""
    try:
        call()
    except UserError as error:
        return Answer(False, f"refused: {error}")
    return Answer(True, "was let pass")


def law(game: AbstractPlanar, name: str) -> Answer:
    """What `check-task` says of one law."""
    faults = [f for found in conformance(game) if found.law == name for f in found.faults or ()]
    return Answer(not faults, faults[0] if faults else f"keeps the law {name}")


# --- Plants -------------------------------------------------------------------------------------


class Plant(Rendezvous):
    """One agent, x+ = growth x + dt u, started in a square of side 2 `size` round its goal 0."""

    agents: int = 1
    growth: float = 1.0
    dynamics: SingleIntegrator = SingleIntegrator((2.0, 2.0))

    def reset(self, key):
        x = jax.random.uniform(key, (self.agents, 2), minval=-self.size, maxval=self.size)
        return State(x=x, scenario=Goals(jnp.zeros((self.agents, 2))), t=jnp.asarray(0))

    def step(self, state, action):
        u = 2.0 * jnp.clip(action, -1.0, 1.0)
        return State(x=self.growth * state.x + self.dt * u, scenario=state.scenario, t=state.t + 1)


class Push(eqx.Module):
    """u = gain (goal - x) + bias, until step `until`; drifts outwards afterwards."""

    gain: float = 0.0
    bias: float = 0.0
    until: int = 10**9
    limit: float = 2.0

    def __call__(self, state, key):
        u = self.gain * (state.scenario.goal - state.x[:, :2]) + self.bias
        u = jnp.where(state.t < self.until, u, state.x[:, :2] - state.scenario.goal + 0.3)
        return jnp.clip(u / self.limit, -1.0, 1.0)


GOOD = Push(gain=3.0)


# --- Linearisation ------------------------------------------------------------------------------


@case("linearisation", "a stable loop at rest on its goal", honest=True)
def _(n):
    return verdicts(Plant(), GOOD, Linearisation())


for growth in (1.0, 1.00001, 0.9999999):

    @case("linearisation", f"an eigenvalue of {growth:g}")
    def _(n, growth=growth):
        return verdicts(Plant(growth=growth), Push(), Linearisation())


@case("linearisation", "rest half a metre beside the goal")
def _(n):
    return verdicts(Plant(), Push(gain=3.0, bias=1.5), Linearisation())


@case("linearisation", "rest a millimetre beside the goal")
def _(n):
    return verdicts(Plant(), Push(gain=3.0, bias=0.003), Linearisation())


@case("linearisation", "a controller that gives up after the horizon")
def _(n):
    return verdicts(Plant(), Push(gain=3.0, until=41), Linearisation())


class Unstable(Rendezvous):
    """Its dynamics could be stabilised; its own step explodes."""

    agents: int = 1
    dynamics: DoubleIntegrator = DoubleIntegrator()

    def step(self, state, action):
        after = super().step(state, action)
        x = after.x.at[:, :2].add(1.5 * (after.x[:, :2] - state.scenario.goal))
        return eqx.tree_at(lambda s: s.x, after, x)


class Brake(eqx.Module):
    """A damped spring to the goal for double integrators."""

    def __call__(self, state, key):
        return jnp.clip(
            (4 * (state.scenario.goal - state.x[:, :2]) - 4 * state.x[:, 2:]) / 5, -1, 1
        )


@case("linearisation", "a damped spring on double integrators", honest=True)
def _(n):
    return verdicts(Rendezvous(agents=1, dynamics=DoubleIntegrator()), Brake(), Linearisation())


@case("linearisation", "a step that is not that of the dynamics")
def _(n):
    return verdicts(Unstable(), Brake(), Linearisation())


class Holonomic(Rendezvous):
    """Unicycles by name; its own step moves them in any direction."""

    agents: int = 1

    def step(self, state, action):
        x = state.x.at[:, :2].add(0.4 * jnp.clip(action, -1, 1)).at[:, 3:].set(0.0)
        return State(x=x, scenario=state.scenario, t=state.t + 1)


@case("linearisation", "'no feedback is exponential' of robots that its own step moves sideways")
def _(n):
    result = certify(Holonomic(), Push(gain=1.0), {"asked": Linearisation()}, 1, 0.99)
    (verdict,) = result["verdicts"].values()
    return Answer(verdict["evidence"] == "proved", verdict["claim"])


@case("linearisation", "'no feedback is exponential' of unicycles", honest=True)
def _(n):
    game = Rendezvous()
    result = certify(game, TreePursuit(game), {"asked": Linearisation()}, 1, 0.99)
    (verdict,) = result["verdicts"].values()
    return Answer(verdict["evidence"] == "proved" and not verdict["holds"], verdict["claim"])


# --- Composition --------------------------------------------------------------------------------

small_gain = lambda n: Composition(rollouts=n, calibration=n)


@case("composition", "a team that contracts", honest=True)
def _(n):
    return verdicts(Plant(), GOOD, small_gain(n))


for name, growth, size in (
    ("doubles in 40 steps, from a ball of 0.01 m", 2 ** (1 / 40), 0.01),
    ("grows by a fifth in 40 steps, from 0.03 m", 1.2 ** (1 / 40), 0.03),
    ("grows by 1.00001 a step, from 0.05 m", 1.00001, 0.05),
    ("never moves, from 0.05 m", 1.0, 0.05),
):

    @case("composition", name)
    def _(n, growth=growth, size=size):
        return verdicts(Plant(growth=growth, size=size), Push(), small_gain(n))


# --- Sampled certificates -----------------------------------------------------------------------

reach = lambda n: Reach(rollouts=n, share=0.95)
stay = lambda n: ReachAndStay(rollouts=n, share=0.95)
fall = lambda n: Decrease(rollouts=n, share=0.95)
contract = lambda n: Contraction(rollouts=n, calibration=n, share=0.95)
basin = lambda n: Basin(rollouts=n, calibration=n, share=0.95)
quantile = lambda n: Quantiles(rollouts=n)

for name, make in (
    ("reach", reach),
    ("reach-and-stay", stay),
    ("decrease", fall),
    ("contraction", contract),
    ("basin", basin),
    ("quantiles", quantile),
):

    @case(name, "a point driven to its goal", honest=True)
    def _(n, make=make):
        return verdicts(Plant(), GOOD, make(n))

    @case(name, "NaN on one start in twenty")
    def _(n, make=make):
        return verdicts(Plant(), Poison(0.1), make(n))


class Poison(eqx.Module):
    """Drives to the goal; from a share of the starts it returns NaN."""

    share: float

    def __call__(self, state, key):
        bad = state.x[0, 0] > 1 - 2 * self.share
        return jnp.where(bad & (state.t == 0), jnp.nan, GOOD(state, key))


@case("reach", "fails from a start in five hundred, where .999 is asked")
def _(n):
    certificate = Reach(rollouts=max(n, 8_000), share=0.999)
    return verdicts(Plant(), Poison(0.002), certificate)


@case("reach", "too few rollouts for what is asked")
def _(n):
    return verdicts(Plant(), GOOD, Reach(rollouts=30, share=0.98))


@case("reach", "a controller of another shape")
def _(n):
    return verdicts(Plant(), lambda state, key: jnp.zeros(2), reach(n))


class Easy(Plant):
    """Success is what the task says it is: always."""

    def success(self, state):
        return jnp.asarray(True)


@case("reach", "success that a task defines anew, passed off as being near the goal")
def _(n):
    answer = verdicts(Easy(), Push(), reach(n), must_say="Easy.success")
    return Answer(answer.believed or "of its goal" in answer.says, answer.says)


@case("reach", "success that holds everywhere, to check-task")
def _(n):
    return law(Easy(), "target")


@case("reach-and-stay", "arrives, and leaves after the horizon")
def _(n):
    return verdicts(Plant(), Push(gain=3.0, until=45), stay(n))


class Circle(eqx.Module):
    """Drives round the goal, 0.12 m away."""

    def __call__(self, state, key):
        e = state.x[:, :2] - state.scenario.goal
        r = jnp.linalg.norm(e, axis=1, keepdims=True) + 1e-9
        u = 5 * (0.12 - r) * e / r + jnp.stack([-e[:, 1], e[:, 0]], axis=1)
        return jnp.clip(u / 2, -1, 1)


@case("reach-and-stay", "circles just outside the ball")
def _(n):
    return verdicts(Plant(), Circle(), stay(n))


@case("decrease", "starts inside the ball of an unstable plant")
def _(n):
    return verdicts(Plant(growth=1.01, size=0.02), Push(), fall(n))


@case("contraction", "starts inside the ball of an unstable plant")
def _(n):
    return verdicts(Plant(growth=1.01, size=0.02), Push(), contract(n))


@case("contraction", "a cost that grows from 0.1 to metres")
def _(n):
    answer = verdicts(Plant(growth=1.1, size=0.3), Push(), contract(n))
    return Answer(answer.believed or "contracts by 0.0000" in answer.says, answer.says)


@case("contraction", "a cost that stays where it is")
def _(n):
    return verdicts(Plant(), Push(), contract(n))


@case("quantiles", "a plant that goes to infinity")
def _(n):
    return verdicts(Plant(growth=30.0), Push(), quantile(n))


# --- Lyapunov functions -------------------------------------------------------------------------


class V(AbstractLyapunov):
    """|e|, or a lie about it."""

    lie: str = ""
    ball: float = 0.0
    beyond = property(lambda self: 0)  # pyright: ignore[reportAssignmentType]
    meaning = property(lambda self: "|e|")  # pyright: ignore[reportAssignmentType]

    def value(self, game, state):
        e = jnp.max(game.distance(state))
        there = (state.x[0, 0] > 0.6) & (state.x[0, 1] > 0.6)  # a corner of the starts
        return {
            "": e,
            "negative": jnp.where(there, -e, e),
            "nan": jnp.where(there, jnp.nan, e),
            "offset": e + 0.1,
            "nowhere": jnp.where(e > 0, 100.0 - state.t, 0.0),
        }[self.lie]

    def along(self, game, trajectory, time):
        states = jax.tree.map(lambda leaf: leaf[:time], trajectory.state)
        return jax.vmap(lambda s: self.value(game, s))(states)


for name, make in (("decrease", fall), ("basin", basin), ("quantiles", quantile)):

    @case("V", f"|e|, to {name}", honest=True)
    def _(n, make=make):
        return verdicts(Plant(), GOOD, make(n), V())

    for lie, words in (
        ("negative", "negative in a corner of the starts"),
        ("nan", "NaN in a corner of the starts"),
        ("offset", "not 0 on the target"),
    ):

        @case("V", f"{words}, to {name}")
        def _(n, make=make, lie=lie):
            return verdicts(Plant(), GOOD, make(n), V(lie))


@case("V", "falls for ever on the way to nowhere")
def _(n):
    return verdicts(Plant(), Push(), fall(n), V("nowhere"))


# --- What the agents act on ---------------------------------------------------------------------

PATH = Rendezvous(graph="path", dynamics=SingleIntegrator((2.0, 2.0)))


class Told(eqx.Module):
    """Every follower reads the target, which only the leader is told."""

    def __call__(self, state, key):
        return jnp.clip(1.5 * (state.scenario.goal - state.x), -1, 1)


class Stranger(eqx.Module):
    """Agent 2 follows agent 0, to which it is not linked."""

    def __call__(self, state, key):
        to = jnp.stack([state.scenario.goal[0], state.x[0], state.x[0]])
        return jnp.clip(1.5 * (to - state.x), -1, 1)


class Clock(eqx.Module):
    """Everybody drives to a neighbour, and waits in every other step."""

    def __call__(self, state, key):
        to = jnp.stack([state.scenario.goal[0], state.x[0], state.x[1]])
        return jnp.where(state.t % 2 == 0, jnp.clip(1.5 * (to - state.x), -1, 1), 0.0)


class Local(eqx.Module):
    """Each follows the agent before it on the path; the leader knows the target."""

    def __call__(self, state, key):
        to = jnp.stack([state.scenario.goal[0], state.x[0], state.x[1]])
        return jnp.clip(1.5 * (to - state.x), -1, 1)


def policy(game: AbstractPlanar, joint: bool = False) -> Decentralised:
    """Untrained weights, large enough to act."""
    size = shape(game)
    size = size._replace(obs=size.agents * size.obs) if joint else size
    pi = Actors(size, 8, False, key=jax.random.key(0))
    pi = jax.tree.map(lambda x: 3 * x if eqx.is_inexact_array(x) else x, pi)
    return Decentralised(Joint(Greedy(pi)) if joint else Greedy(pi), game)


for name, controller in (
    ("followers that read the target", Told()),
    ("an agent that sees one it is not linked to", Stranger()),
    ("a clock", Clock()),
    ("one policy for all observations", policy(PATH, joint=True)),
):

    @case("information", name)
    def _(n, controller=controller):
        return verdicts(PATH, controller, reach(n), must_say="NOT decentralised")


for name, controller in (
    ("each follows its neighbour", Local()),
    ("own observations", policy(PATH)),
):

    @case("information", name, honest=True)
    def _(n, controller=controller):
        return verdicts(PATH, controller, reach(n), must_say="NOT decentralised")


# --- Tasks --------------------------------------------------------------------------------------


class Crash(Formation):
    """Ends on a collision, which stops its costs."""

    def terminated(self, state):
        return jnp.any(self.crowded(state, 0.5))


class Blind(Rendezvous):
    """Looks up its neighbours itself, so that no message is ever lost."""

    def observe(self, state, links):
        return self.local_view(state, self.linked(state))


class Backwards(Rendezvous):
    """Features that do not begin with the errors."""

    def features(self, state):
        return super().features(state)[:, ::-1]


class Paid(Rendezvous):
    """A reward that rises with the cost."""

    def rewards(self, state, action):
        return self.costs(state, action)


class Wired(Rendezvous):
    """Its own limits, so that a change of the dynamics' limits changes nothing."""

    def step(self, state, action):
        x = state.x.at[:, :2].add(0.1 * jnp.clip(action, -1, 1))
        return State(x=x, scenario=state.scenario, t=state.t + 1)


for game, name, words in (
    (Crash(), "termination", "a termination that pays"),
    (Blind(), "links", "messages that cannot be lost"),
    (Backwards(), "features", "features that do not begin with the errors"),
    (Paid(), "rewards", "a reward that rises with the cost"),
):

    @case("check-task", words)
    def _(n, game=game, name=name):
        return law(game, name)

    @case("check-task", f"the law {name}, to rendezvous", honest=True)
    def _(n, name=name):
        return law(Rendezvous(), name)


@case("robustness", "inputs made stronger, of a game that does not notice")
def _(n):
    table = Robustness(n, (2.0,), (), (), (), spreads=(1.0,), remove=False)
    return verdicts(Wired(), TreePursuit(Wired()), table, must_say="gain 2")


@case("safe", "a game without rules")
def _(n):
    return verdicts(Rendezvous(), policy(Rendezvous()), Safe(rollouts=n, share=0.95))


@case("safe", "a rule that never fires")
def _(n):
    return verdicts(Formation(), policy(Formation()), Safe(rollouts=n, share=0.95))


@case("safe", "robots that collide")
def _(n):
    game = Formation(clearance=0.3, dynamics=SingleIntegrator((2.0, 2.0)))
    return verdicts(game, Told(), Safe(rollouts=n, share=0.95))


@case("apart", "robots that meet")
def _(n):
    return verdicts(PATH, Told(), Apart(rollouts=n, calibration=n, share=0.95))


@case("closed-form", "the point-offset law", honest=True)
def _(n):
    game = Rendezvous()
    return verdicts(game, PointOffset(game), ClosedForm())


class Slippery(Rendezvous):
    """Unicycles that slip by a tenth."""

    def step(self, state, action):
        after = super().step(state, action)
        x = state.x + 0.9 * (after.x - state.x)
        return eqx.tree_at(lambda s: s.x, after, x)


@case("closed-form", "robots that slip")
def _(n):
    return verdicts(Slippery(), PointOffset(Slippery()), ClosedForm())


@case("closed-form", "another controller")
def _(n):
    return verdicts(Rendezvous(), TreePursuit(Rendezvous()), ClosedForm())


class Squint(Rendezvous):
    """Sees a tenth more than there is."""

    def observe(self, state, links):
        return 1.1 * super().observe(state, links)


def proof(game: AbstractPlanar) -> Answer:
    number = lambda x: jnp.asarray(x, jnp.float32)
    form = Approach(*map(number, (0.3, 1.0, 0.5, 2.0, 0.2, 0.05, 0.1)))
    region = Proof(c=1.0, rho=0.1, inner=0.1, half=(1.0, 1.0, 1.0, 1.0), most=64)
    return verdicts(game, policy(game), region, form)


for game, words in (
    (Slippery(agents=1), "robots that slip"),
    (Squint(agents=1), "an observation of its own"),
):

    @case("proof", words)
    def _(n, game=game):
        answer = proof(game)
        return Answer(not answer.says.startswith("refused"), answer.says)


@case("evaluate", "robots that spin inside the ball, passed off as resting")
def _(n):
    game = Rendezvous(agents=1, size=0.01)
    found = evaluate(game, lambda state, key: jnp.array([[0.0, 1.0]]), 50, beyond=0)
    says = f"{found.success_rate:.0%} success: {found.rests()}"
    return Answer("turns on the spot" not in says, says)


@case("certify", "another policy than the one declared")
def _(n):
    table, declared = {"asked": reach(n)}, "0" * 64
    return refused(lambda: certify(Plant(), GOOD, table, 1, 0.99, policy=declared))


# --- Forged certificates ------------------------------------------------------------------------


def forge(change: Callable[[dict], None], rollouts: int, seal: bool = True) -> Answer:
    """What `recheck` says of a certificate of an untrained policy, after a change of its text."""
    place = _certificate(rollouts)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "certificate"
        copy.mkdir()
        for file in place.iterdir():
            (copy / file.name).write_bytes(file.read_bytes())
        manifest = json.loads((copy / "manifest.json").read_text())
        change(manifest["meta"])
        if seal:
            manifest.pop("sha256")
            manifest["sha256"] = _sha256(json.dumps(manifest))
        (copy / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
        try:
            found = recheck(copy)
        except UserError as error:
            return Answer(False, f"refused: {error}")
        missing = found["not_rechecked"]
        says = f"not checked: {', '.join(missing)}" if missing else "agrees"
        return Answer(not missing, says)


def _sha256(text: str) -> str:
    import hashlib

    return hashlib.sha256(text.encode()).hexdigest()


_made: dict[int, Path] = {}


def _certificate(rollouts: int) -> Path:
    """A certificate of an untrained policy on two robots, made once."""
    if rollouts not in _made:
        game = Rendezvous(agents=2, horizon=10, radius=0.8)
        controller = policy(game)
        table = {"reach": Reach(rollouts=rollouts, share=0.5), "linearisation": Linearisation()}
        table |= {"apart": Apart(rollouts=rollouts, calibration=rollouts, share=0.5, stay=5)}
        result = certify(game, controller, table, 1, 0.99)
        place = Path(tempfile.mkdtemp()) / "certificate"
        save(place, result, game, controller)
        _made[rollouts] = place
    return _made[rollouts]


@case("recheck", "an unchanged certificate", honest=True)
def _(n):
    return forge(lambda meta: None, n)


def embellish(**fields: Any) -> Callable[[dict], None]:
    return lambda meta: meta["verdicts"]["reach"].update(fields)


FORGED: dict[str, Callable[[dict], None]] = {
    "a claim embellished": lambda m: m["verdicts"]["reach"].update(
        claim="from every start every robot stays within 0.01 m for ever"
    ),
    "a scope embellished": lambda m: m["verdicts"]["reach"]["scope"].update(disturbance="any"),
    "a bound raised": embellish(bound=0.9999),
    "a verdict turned": lambda m: m["verdicts"]["reach"].update(
        holds=not m["verdicts"]["reach"]["holds"]
    ),
    "the whole turned": lambda m: m.update(holds=not m["holds"]),
    "evidence 'proved'": embellish(evidence="proved"),
    "a verdict renamed": embellish(name="guaranteed for ever"),
    "a verdict dropped": lambda m: (m["verdicts"].pop("reach"), m["certificates"].pop("reach")),
    "a linearisation dropped": lambda m: m["verdicts"].pop("linearisation"),
    "a verdict added": lambda m: m["verdicts"].update(
        {"safety-case": m["verdicts"]["reach"] | {"claim": "certified to SIL 4", "holds": True}}
    ),
    "a proof added": lambda m: (
        m["verdicts"].update(proof=m["verdicts"]["linearisation"] | {"evidence": "proved"}),
        m["certificates"].update(proof={"kind": "Proof"}),
    ),
    "the linearisation turned": lambda m: m["verdicts"]["linearisation"].update(
        holds=True, claim="globally exponentially stable"
    ),
    "a share asked for less": lambda m: m["verdicts"]["reach"]["figures"].update(share_asked=0.1),
    "successes doubled": lambda m: m["verdicts"]["reach"].update(
        trials=2 * m["verdicts"]["reach"]["trials"],
        successes=2 * m["verdicts"]["reach"]["successes"],
    ),
    "successes as a fraction": lambda m: m["verdicts"]["reach"].update(
        successes=float(m["verdicts"]["reach"]["successes"])
    ),
    "checkpoints: true": lambda m: m.update(checkpoints=True),
    "a confidence raised": embellish(confidence=0.99999),
    "a seed changed": lambda m: m.update(seed=7),
    "a worst case made harmless": lambda m: m["verdicts"]["reach"]["worst"].update(badness=1e-4),
    "a gap widened": lambda m: m["verdicts"]["apart"]["figures"].update(gap=3.0),
    "an extra key": lambda m: m.update(endorsed_by="an authority"),
    "a game changed": lambda m: m["game"].update(radius=5.0),
    "a policy's hash changed": lambda m: m.update(policy="0" * 64),
    "information embellished": lambda m: m.update(information="needs no sensors at all"),
}

for name, change in FORGED.items():

    @case("recheck", name)
    def _(n, change=change):
        return forge(change, n)


@case("recheck", "a bound raised, its seal not made anew")
def _(n):
    return forge(embellish(bound=0.9999), n, seal=False)


@case("recheck", "a task of one's own that is called Rendezvous")
def _(n):
    own = type("Rendezvous", (Slippery,), {"__module__": "mine"})
    game = own(agents=2, horizon=10, radius=0.8)
    controller = policy(game)
    result = certify(game, controller, {"reach": Reach(rollouts=n, share=0.5)}, 1, 0.99)
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder) / "c", result, game, controller)
        found = recheck(Path(folder) / "c")
    return Answer(found["agrees"] or "reach" in found["rechecked"], str(found["not_rechecked"]))


# --- The table ----------------------------------------------------------------------------------


def answers(rollouts: int, kinds: set[str] | None = None) -> Iterator[tuple[Case, Answer]]:
    """What every liar and every honest one is told."""
    for one in CASES:
        if kinds is None or one.kind in kinds:
            yield one, one.ask(rollouts)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer rollouts")
    parser.add_argument("--kind", action="append", help="only these kinds")
    args = parser.parse_args()
    wrong = 0
    for one, answer in answers(400 if args.quick else 4000, args.kind and {*args.kind}):
        right = answer.believed == one.honest
        wrong += not right
        who = "honest" if one.honest else "liar"
        print(
            f"{'' if right else 'WRONG '}{who} | {one.kind} | {one.name} | {answer.says}",
            flush=True,
        )
    liars = sum(not one.honest for one in CASES)
    print(f"{liars} liars, {len(CASES) - liars} honest; {wrong} wrong answers.")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
