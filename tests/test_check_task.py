"""Every broken task is caught, and its fault named."""

import itertools
import json
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.conformance.laws import LAWS, Probe, _steepest, conformance, shapes
from marlyap.controllers import UniformlyRandom
from marlyap.games.dynamics import SingleIntegrator
from marlyap.simulation.evaluation import evaluate
from marlyap.tasks import Formation, Rendezvous
from marlyap.types import State


class Sound(Rendezvous):
    """A task as small as they come, in which agents 0 and 2 do not see each other."""

    agents: int = 3
    graph: str = "path"
    horizon: int = 4
    dynamics: SingleIntegrator = SingleIntegrator()


BROKEN = {}  # the class, the law it breaks, and what the fault must say


def breaks(law, says):
    def note(cls):
        BROKEN[cls] = (law, says)
        return cls

    return note


count = itertools.count()


@breaks("shapes", "reset: it returns a tuple; return State")
class StartIsNoState(Sound):
    def reset(self, key):
        return super().reset(key).x, jnp.zeros(2)


@breaks("shapes", r"reset: it raised KeyError \('start'\) at test_check_task.py:\d+; ")
class StartRaises(Sound):
    def reset(self, key):
        return {}["start"]


@breaks("shapes", r"reset: x: it is float32\[3\]; return floating\[3, 2\]")
class StartIsFlat(Sound):
    def reset(self, key):
        start = super().reset(key)
        return eqx.tree_at(lambda s: s.x, start, start.x[:, 0])


@breaks("shapes", r"reset: t: it is float32\[\]; return integer\[\]")
class TimeIsAFloat(Sound):
    def reset(self, key):
        return eqx.tree_at(lambda s: s.t, super().reset(key), jnp.zeros(()))


@breaks("shapes", r"observe: it is float32\[2, \d+\]; return floating\[3, any\]")
class OneAgentSeesNothing(Sound):
    def observe(self, state, links):
        return super().observe(state, links)[1:]


@breaks("shapes", "observe: it is int32.*return float32")
class WholeNumbersAreSeen(Sound):
    def observe(self, state, links):
        return super().observe(state, links).astype(int)


@breaks("shapes", r"costs: it is float32\[\]; return floating\[3\]")
class OneCostForAll(Sound):
    def costs(self, state, action):
        return jnp.mean(super().costs(state, action))


@breaks("shapes", "terminated: it is float32.*; return bool")
class EndIsANumber(Sound):
    def terminated(self, state):
        return jnp.zeros(())


@breaks("shapes", "step: t becomes float32.* from int32")
class StepChangesAType(Sound):
    def step(self, state, action):
        return eqx.tree_at(lambda s: s.t, super().step(state, action), state.t + 1.0)


@breaks("shapes", "step: its state has other parts than that of reset")
class StepAddsMemory(Sound):
    def step(self, state, action):
        after = super().step(state, action)
        return State(x=after.x, scenario=after.scenario, t=after.t, memory=action)


@breaks("shapes", "costs: it raised TracerBoolConversionError.*use jnp.where")
class CostHasAnIf(Sound):
    def costs(self, state, action):
        cost = super().costs(state, action)
        return cost if cost[0] > 0.1 else 0 * cost


@breaks("finite", r"rewards: a number is not finite in \d+ of 64 states")
class RewardIsALogarithm(Sound):
    def rewards(self, state, action):
        return -jnp.log(super().costs(state, action) - 1)


@breaks("finite", "costs: a number is not finite in 64 of 64 states, first at step 0")
class CostIsInfinite(Sound):
    def costs(self, state, action):
        return super().costs(state, action) / 0


@breaks("deterministic", "step: two calls with one state differ")
class StepHasItsOwnChance(Sound):
    def step(self, state, action):
        return super().step(state, action + 0.01 * np.random.standard_normal())


@breaks("deterministic", "reset: the same key gave two different starts")
class StartHasItsOwnChance(Sound):
    def reset(self, key):
        return super().reset(jax.random.fold_in(key, next(count)))


@breaks("deterministic", "step: the same key gave two different episodes")
class ChanceBehindTheCompiler(Sound):
    def step(self, state, action):
        after = super().step(state, action)
        late = jax.ShapeDtypeStruct((), jnp.float32)
        noise = jax.pure_callback(
            lambda t: np.float32(next(count)), late, state.t, vmap_method="sequential"
        )
        return eqx.tree_at(lambda s: s.x, after, after.x + 1e-3 * noise * (state.t == 3))


@breaks("compiled", "costs: under jit it differs")
class CostKnowsItIsTraced(Sound):
    def costs(self, state, action):
        return super().costs(state, action) * (1.0 if jax.config.jax_disable_jit else 2.0)


@jax.custom_batching.custom_vmap
def alone(x):
    return x


@alone.def_vmap
def _(size, batched, x):
    return x - jnp.mean(x, axis=0, keepdims=True), batched[0]


@breaks("batched", "observe: under vmap it differs")
class ViewOfTheWholeBatch(Sound):
    def observe(self, state, links):
        return alone(super().observe(state, links))


@breaks("traced_once", "fields: an equal task is compiled again")
class FieldIsAFunction(Sound):
    bonus: object = eqx.field(init=False)

    def __post_init__(self):
        self.bonus = lambda x: x  # a new one each time


@breaks("traced_once", "fields: the constructor does not take them")
class ConstructorTakesSomethingElse(Sound):
    def __init__(self, sizes=(1.0, 1.0)):
        self.size = sizes[0]


@breaks("resets", "reset: different keys gave the same start")
class AlwaysTheSameStart(Sound):
    def reset(self, key):
        return super().reset(jax.random.key(0))


@breaks("resets", "reset: an episode starts at t = 1")
class StartsLate(Sound):
    def reset(self, key):
        start = super().reset(key)
        return eqx.tree_at(lambda s: s.t, start, start.t + 1)


LEAK = []


@breaks("resets", "reset: it depends on steps taken before")
class EpisodesLeak(Sound):
    def reset(self, key):
        start = super().reset(key)
        return eqx.tree_at(lambda s: s.x, start, start.x + 0.1 * len(LEAK))

    def step(self, state, action):
        LEAK.append(1)
        return super().step(state, action)


@breaks("clock", "step: t does not grow by 1")
class TimeStandsStill(Sound):
    def step(self, state, action):
        return eqx.tree_at(lambda s: s.t, super().step(state, action), state.t)


@breaks("clock", "step: the scenario changes within an episode")
class GoalMoves(Sound):
    def step(self, state, action):
        return eqx.tree_at(
            lambda s: s.scenario.goal, super().step(state, action), state.scenario.goal + 0.01
        )


@breaks("local", "observe: a row changes with agent [02], which is not its neighbour")
class EverybodySeesEverybody(Sound):
    def observe(self, state, links):
        return jnp.concatenate(
            [super().observe(state, links), jnp.broadcast_to(state.x[:, 0], (3, 3))], axis=1
        )


@breaks(
    "local", "observe: a row changes with the goal .scenario. of agent 1, which it must not know"
)
class FollowersSeeTheirGoal(Sound):
    def observe(self, state, links):
        return jnp.concatenate(
            [super().observe(state, links), state.scenario.goal - state.x], axis=1
        )


@breaks("links", "observe: without links a row still changes with agent 0")
class LinksAreIgnored(Sound):
    def observe(self, state, links):
        return super().observe(state, self.linked(state))


@breaks("bounded_inputs", "step: an action of 4 does more than one of 1")
class UnboundedActions(Sound):
    def step(self, state, action):
        return State(x=state.x + self.dt * action, scenario=state.scenario, t=state.t + 1)


@breaks("target", "success: it is false with every agent on its goal")
class NeverSucceeds(Sound):
    def success(self, state):
        return jnp.asarray(False)


@breaks("target", "success: it holds in every state that occurred")
class AlwaysSucceeds(Sound):
    def success(self, state):
        return jnp.asarray(True)


@breaks("target", "errors: they are not 0 with every agent at rest on its goal")
class ErrorsFromTheOrigin(Sound):
    def errors(self, state):
        return state.x


@breaks("target", "errors: they are 0 beside the goal too")
class ErrorsOfOneAxis(Sound):
    def errors(self, state):
        return (state.x - state.scenario.goal) * jnp.array([[1.0, 0.0]])


@breaks("target", "step: from the target set, under the holding action, the errors become")
class Wind(Sound):
    def step(self, state, action):
        after = super().step(state, action)
        return eqx.tree_at(lambda s: s.x, after, after.x + 0.01)


@breaks("features", "features: they do not begin with the errors")
class FeaturesInReverse(Sound):
    def features(self, state):
        return super().features(state)[:, ::-1]


@breaks("features", "features: they do not begin with the errors")
class FeaturesOfTheOthers(Sound):
    def features(self, state):
        return super().features(state)[::-1]


@breaks("features", "features: they do not begin with the errors")
class FewerFeaturesThanErrors(Sound):
    def features(self, state):
        return super().features(state)[:, :1]


@breaks("violations", "violations: agent 1 breaks a rule in every state that occurred")
class AlwaysBroken(Sound):
    def violations(self, state):
        return jnp.array([False, True, True])


@breaks("costs", r"costs: one is -\d.*; make every cost >= 0")
class NegativeCost(Sound):
    def costs(self, state, action):
        return super().costs(state, action) * state.x[:, 0]


@breaks("costs", "costs: they are 0.5 on the target set")
class CostOfLiving(Sound):
    def costs(self, state, action):
        return super().costs(state, action) + 0.5


@breaks("costs", "costs: they are 0 in every state that occurred")
class NoCost(Sound):
    def costs(self, state, action):
        return 0 * super().costs(state, action)


@breaks("costs", "cost: it is not the mean of costs")
class CostIsTheSum(Sound):
    def cost(self, state, action):
        return jnp.sum(self.costs(state, action))


@breaks("rewards", "rewards: they rise with the cost")
class RewardHasTheWrongSign(Sound):
    def rewards(self, state, action):
        return self.costs(state, action)


@breaks("rewards", "rewards: they are the same in all states")
class NoReward(Sound):
    def rewards(self, state, action):
        return 0 * self.costs(state, action)


@breaks("smooth_cost", r"costs: .* the slope grows from .* \(Assumption 1\)")
class CostJumps(Sound):
    def costs(self, state, action):
        cost = super().costs(state, action)
        return cost + (cost > 0.5)


@breaks("smooth_cost", r"costs: .* the slope grows from .* \(Assumption 1\)")
class CostIsARoot(Sound):
    def costs(self, state, action):
        return jnp.sqrt(super().costs(state, action))


@breaks("smooth_step", r"step: .* the slope grows from .* \(Assumption 2\)")
class WorldIsATorus(Sound):
    def step(self, state, action):
        after = super().step(state, action)
        return eqx.tree_at(lambda s: s.x, after, (after.x + 1) % 2 - 1)


PAYS = r"at step \d stops its costs, so that ending early pays; count such states in `violations`"


@breaks("termination", PAYS)
class CollisionEnds(Sound):
    def terminated(self, state):
        return jnp.any(self.crowded(state, 0.4))


@breaks("failure", "failure_cost: it is 0, and the steps before a failure cost")
class FailureIsFree(Sound):
    def failed(self, state):
        return jnp.any(jnp.abs(self.positions(state)) > 1.05)


@breaks("time_limit", "terminated: it depends on the time limit")
class TheHorizonTerminates(Sound):
    def terminated(self, state):
        return state.t >= self.horizon


@breaks("time_limit", "terminated: every episode ends after one step")
class OverAtOnce(Sound):
    def terminated(self, state):
        return jnp.asarray(True)


@breaks("time_limit", "step: nothing moves after the horizon")
class FrozenAtTheHorizon(Sound):
    def step(self, state, action):
        after = super().step(state, action)
        x = jnp.where(state.t < self.horizon, after.x, state.x)
        return eqx.tree_at(lambda s: s.x, after, x)


@breaks("shapes", "fields: agents = 2 needs a type, as in agents: int = 2; ")
class FieldWithoutAType(Sound):
    agents = 2


@breaks("shapes", r"fields: leaders = \(0, 1\) needs a type, as in leaders: tuple\[int, ...\] = ")
class TupleWithoutAType(Sound):
    leaders = (0, 1)


@breaks("channels", "observation_entries: they name 19 numbers, and an observation has 20")
class OneMoreThanItSays(Sound):
    def observe(self, state, links):
        seen = super().observe(state, links)
        return jnp.concatenate([seen, seen[:, :1]], axis=1)


CHANCE = {"compiled", "batched", "bounded_inputs", "target", "smooth_step"}
ALSO = {  # other laws that the same mistake may break
    CostIsInfinite: {"costs", "rewards", "smooth_cost"},
    StepHasItsOwnChance: CHANCE,
    ChanceBehindTheCompiler: CHANCE,
    StartHasItsOwnChance: {"resets"},
    ViewOfTheWholeBatch: {"compiled", "local", "links"},
    NoCost: {"rewards"},
    EverybodySeesEverybody: {"channels", "links"},
    FollowersSeeTheirGoal: {"links"},
    GoalMoves: {"target"},
    OverAtOnce: {"termination"},
    WorldIsATorus: {"bounded_inputs"},
}
SLOW = {"deterministic", "compiled", "batched", "resets"}  # they also look uncompiled


def faults(found):
    return {finding.law: finding.faults for finding in found if finding.faults}


first = {law: cls for cls, (law, _) in reversed(BROKEN.items())}  # of each law
often = lambda cls: BROKEN[cls][0] == "shapes" or cls in first.values()
EACH = [cls if often(cls) else pytest.param(cls, marks=pytest.mark.slow) for cls in BROKEN]


@pytest.mark.parametrize("cls", EACH, ids=lambda cls: cls.__name__)
def test_a_broken_task_is_caught_and_its_fault_named(cls, recwarn):
    law, says = BROKEN[cls]
    laws = [l for l in LAWS if l.__name__ == law or l.__name__ not in SLOW]
    found = faults(conformance(cls(), laws=laws))
    assert law in found, found
    text = " / ".join(found[law])
    assert re.search(says, text), text
    assert found.keys() - {law} <= ALSO.get(cls, set()), found
    for sentence in itertools.chain(*found.values()):
        assert sentence.endswith(".") and ": " in sentence and "; " in sentence, sentence
        assert "\n" not in sentence


@pytest.fixture(scope="module")
def sound():
    return conformance(Sound())


def test_every_law_is_broken_by_one_and_kept_by_a_sound_task(sound):
    assert len(BROKEN) >= 20
    assert {law for law, _ in BROKEN.values()} == {law.__name__ for law in (shapes, *LAWS)}
    found = sound
    assert not faults(found) and all(f.faults == () for f in found)
    assert [f.law for f in found] == ["shapes", *(law.__name__ for law in LAWS)]
    assert all(f.says and not f.says.endswith(".") for f in found)


def test_the_slopes_are_lipschitz_constants(sound):
    """Of distance to the goal it is 1 an agent, of a step of x' = u it is 1 in x and dt in u."""
    found = {f.law: f.figures for f in sound}
    assert 0.3 < found["smooth_cost"]["slope"] <= 3**-0.5 + 1e-3
    assert 0.9 < found["smooth_step"]["slope"] <= (1 + 0.1**2) ** 0.5 + 1e-3
    assert found["rewards"]["correlation"] == pytest.approx(-1)


def only(law, game, seed=0):
    """The faults and the figures of one law."""
    (law,) = [l for l in LAWS if l.__name__ == law]
    _, finding = conformance(game, seed, laws=[law])
    return finding.faults, finding.figures


class Penalty(Formation):
    """A hinge penalty on the gap between agents: Lipschitz, however steep."""

    agents: int = 4
    leaders: tuple[int, ...] = (0, 1, 2, 3)
    horizon: int = 10
    dynamics: SingleIntegrator = SingleIntegrator()
    weight: float = 10.0  # cost per metre below 0.25 m

    def gap(self, state):
        p = self.positions(state)
        square = jnp.sum((p[:, None] - p[None]) ** 2, axis=-1)
        return jnp.sqrt(jnp.min(jnp.where(jnp.eye(self.agents, dtype=bool), 9.0, square), axis=1))

    def costs(self, state, action):
        return self.distance(state) + self.weight * jax.nn.relu(0.25 - self.gap(state))

    def features(self, state):
        return jnp.concatenate([super().features(state), self.gap(state)[:, None]], axis=1)


def test_a_steep_penalty_is_no_jump():
    faults, figures = only("smooth_cost", Penalty())
    assert faults == () and figures["slope"] > 2.5


class Falls(WorldIsATorus):
    """Where the world would jump the team has failed."""

    def failed(self, state):
        return ~jnp.all(jnp.abs(state.x) < 0.9)

    @property
    def failure_cost(self):
        return 10.0


class Coarse(CostJumps):
    """It says that its costs jump."""

    @property
    def smooth(self):
        return False


def test_a_jump_that_is_a_failure_is_none():
    assert only("smooth_step", WorldIsATorus())[0] and not only("smooth_step", Falls())[0]


def test_costs_may_jump_where_the_game_says_so(capsys):
    """The law is then waived, and not said to be kept."""
    assert only("smooth_cost", CostJumps())[0]
    finding = next(f for f in conformance(Coarse()) if f.law == "smooth_cost")
    assert finding.faults == () and finding.waived == "the game says that its costs jump (`smooth`)"
    assert main(["check-task", "coverage"]) == 0
    said = capsys.readouterr().out
    assert "coverage: 21 of 22 laws kept, 1 waived." in said and "its costs jump" in said


@pytest.mark.parametrize("seed", range(3))
def test_slopes_tell_steepness_from_jumps_and_roots(seed):
    """On one probe for all: the cost as a function of the gap between agents, in NumPy."""
    probe = Probe(Penalty(), seed)

    def grows(of_gap):
        cost = lambda out: np.mean(out["distance"] + of_gap(out["features"][..., -1]), axis=1)
        before, last = _steepest(probe, lambda out: cost(out)[:, None])
        return last / before

    for weight in (1, 3, 5, 10, 30, 100, 1000):
        for smooth in (lambda g: np.maximum(0, 0.25 - g), lambda g: np.maximum(0, 0.25 - g) ** 2):
            assert grows(lambda g, w=weight, f=smooth: w * f(g)) < 1.2, weight
    for size in (0.02, 0.1, 1, 10, 1000):
        assert grows(lambda g, size=size: size * (g < 0.25)) > 2, size
    for size in (0.3, 1, 30):
        for root in (lambda g: np.abs(g - 0.25) ** 0.5, lambda g: np.maximum(0, 0.25 - g) ** 0.5):
            assert grows(lambda g, size=size, root=root: size * root(g)) > 1.8, size


@pytest.mark.parametrize("charged", [False, True])
def test_a_termination_pays_unless_the_rest_is_charged(charged):
    class Crash(CollisionEnds):
        def rewards(self, state, action):
            reward, after = super().rewards(state, action), self.step(state, action)
            left = self.horizon - state.t
            return reward * jnp.where(self.terminated(after) & charged, left, 1)

    said, figures = only("termination", Crash(horizon=30))
    assert figures["ended without success"] > 3 and bool(said) is not charged, (said, figures)


def test_an_ending_that_is_success_does_not_pay():
    class Arrival(Sound):
        radius: float = 0.8

        def terminated(self, state):
            return self.success(state)

    assert only("termination", Arrival(horizon=30)) == ((), {"ended without success": 0})


def test_a_typed_random_key_in_the_state_is_legal():
    """For noise in the plant; such a game is checked, played and evaluated."""

    class Noisy(Sound):
        def reset(self, key):
            k_start, k_noise = jax.random.split(key)
            start = super().reset(k_start)
            return State(x=start.x, scenario=start.scenario, t=start.t, memory=k_noise)

        def step(self, state, action):
            after = super().step(state, action)
            key = jax.random.fold_in(state.memory, state.t)
            noise = 0.1 * jnp.clip(action, -1, 1) * jax.random.normal(key, action.shape)
            return eqx.tree_at(lambda s: s.x, after, after.x + noise)

    assert not faults(conformance(Noisy()))
    assert evaluate(Noisy(), UniformlyRandom(Noisy()), 4).final.shape == (4,)


def test_after_wrong_shapes_nothing_else_is_looked_at():
    first, *rest = conformance(OneCostForAll())
    assert first.faults and all(finding.faults is None for finding in rest)


def test_a_task_that_raises_when_it_runs_is_told_so():
    class Late(Sound):
        def distance(self, state):
            return jax.pure_callback(
                lambda x: 1 / 0,
                jax.ShapeDtypeStruct((3,), jnp.float32),
                state.x,
                vmap_method="sequential",
            )

    found = conformance(Late())
    assert "task: it raised" in found[0].faults[0]
    assert all(finding.faults is None for finding in found[1:])


FILE = """
import jax.numpy as jnp
from marlyap.games.dynamics import SingleIntegrator
from marlyap.simulation.evaluation import evaluate
from marlyap.tasks import Formation, Rendezvous

class Mine(Rendezvous):
    horizon: int = 4
    dynamics: SingleIntegrator = SingleIntegrator()

class Bad(Mine):
    def observe(self, state, links):
        return state.x[:1]
"""


def test_the_command_line(tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(FILE)
    assert main(["check-task", f"{file}:Mine"]) == 0
    out = capsys.readouterr().out
    assert "smooth_cost" in out and "slope 0." in out

    assert main(["check-task", f"{file}:Bad", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["passes"] is False
    assert said["laws"]["shapes"]["faults"] == [
        "observe: it is float32[1, 2]; return floating[3, any]."
    ]
    assert said["laws"]["local"]["faults"] is None

    assert main(["check-task", f"{file}:Bad"]) == 1
    assert "observe: it is float32[1, 2]" in " ".join(capsys.readouterr().out.split())

    assert main(["check-task", f"{file}:Missing"]) == 2
    assert main(["check-task", str(Path("nowhere.py:Mine"))]) == 2
    assert main(["check-task", "rendezvouz"]) == 2
    assert "did you mean 'rendezvous'?" in capsys.readouterr().err
    assert main(["check-task", f"{file}:Mine", "--task.graph", "ring", "--seed", "3"]) == 0
