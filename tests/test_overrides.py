"""A game may replace any of its methods. Whoever judges, disturbs or draws it must ask them all.

`Own` replaces every method at once, each by something that its default is not. What is measured by
the package is compared with a plain loop over the game's own methods.
"""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.certificates.basin import Basin
from marlyap.certificates.certify import certify, save
from marlyap.certificates.closed_form import ClosedForm
from marlyap.certificates.composition import _Windows
from marlyap.certificates.contraction import Contraction
from marlyap.certificates.decrease import Decrease
from marlyap.certificates.linearisation import Linearisation
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import AbstractLyapunov, CostSum
from marlyap.certificates.proof import Proof
from marlyap.certificates.quantiles import Quantiles
from marlyap.certificates.reach import Reach, ReachAndStay
from marlyap.certificates.safety import Apart, Safe
from marlyap.errors import UserError
from marlyap.games.dynamics import SingleIntegrator
from marlyap.games.perturbed import Perturbed
from marlyap.games.planar import AbstractPlanar, Goals
from marlyap.learning.algorithms import MASAC
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.recheck import recheck
from marlyap.report.episodes import film
from marlyap.seeds import stream
from marlyap.simulation.evaluation import evaluate, outcomes
from marlyap.simulation.rollout import Decentralised, rollout
from marlyap.tasks import Rendezvous
from marlyap.types import State


class Own(Rendezvous):
    """Every method is its own: nothing here is what `AbstractPlanar` or `Rendezvous` would do."""

    agents: int = 3
    graph: str = "path"
    horizon: int = 6
    radius: float = 0.35
    dynamics: SingleIntegrator = SingleIntegrator((1.0, 1.0))

    def reset(self, key):
        start = super().reset(key)
        return State(
            x=start.x,
            scenario=Goals(0.5 * start.scenario.goal),
            t=start.t,
            memory=jnp.zeros((3, 2)),
        )

    def linked(self, state):
        return super().linked(state) & (state.t % 2 == 0)

    def observe(self, state, links):
        return jnp.concatenate([super().observe(state, links), state.memory], axis=1)

    def step(self, state, action):
        after = super().step(state, action)
        return State(x=0.95 * after.x, scenario=after.scenario, t=after.t, memory=action)

    def distance(self, state):
        return 1.5 * super().distance(state)

    def errors(self, state):
        return -super().errors(state)

    def features(self, state):
        return jnp.concatenate([self.errors(state), state.memory, 2 * state.scenario.goal], axis=1)

    def costs(self, state, action):
        return super().costs(state, action) + 0.1 * jnp.sum(action**2, axis=1)

    def rewards(self, state, action):
        return 1.0 - self.costs(state, action)

    def success(self, state):
        return jnp.all(self.distance(state)[:2] <= self.radius)

    def terminated(self, state):
        return jnp.any(state.x[:, 0] > 0.7)

    def violations(self, state):
        return state.x[:, 1] < -0.5

    def failed(self, state):
        return jnp.any(state.x[:, 0] < -0.93)

    @property
    def failure_cost(self):
        return 2.5

    def hold(self, state):
        return jnp.full((self.agents, 2), 0.01)

    def at_target(self, state):
        return eqx.tree_at(lambda s: s.x, state, self.goals(state))

    def goals(self, state):
        return state.scenario.goal + 0.02

    def scene(self, state):
        scene = super().scene(state)
        return eqx.tree_at(lambda s: s.velocity, scene, scene.velocity + 0.5)

    def positions(self, state):
        return super().positions(state) + 0.01

    def motion(self, state):
        return 3 + super().motion(state)


class ToGoal(eqx.Module):
    """A law that sees everything; row i drives agent i to its goal."""

    gain: float = 1.5

    def __call__(self, state, key):
        return jnp.clip(self.gain * (state.scenario.goal - state.x), -1.0, 1.0)


GAME, LAW = Own(), ToGoal()
PROOF = Proof(c=1.0, rho=0.1, inner=0.1, half=(1.0, 1.0, 1.0, 1.0), most=64)
KEYS = jax.random.split(stream(0, "evaluate"), 24)


def played(game, start, steps):
    """The rollout by a plain loop: what every method says at every step."""
    step = eqx.filter_jit(lambda s, a: game.step(s, a))
    says = eqx.filter_jit(
        lambda s, a: {
            "cost": game.cost(s, a),
            "reward": jnp.mean(game.rewards(s, a)),
            "success": game.success(s),
            "terminated": game.terminated(s),
            "failed": game.failed(s),
            "violated": jnp.any(game.violations(s)),
            "distance": jnp.max(game.distance(s)),
            "observation": game.observe(s, game.linked(s)),
            "features": game.features(s),
            "errors": game.errors(s),
            "positions": game.positions(s),
        }
    )
    state, seen = start, []
    for _ in range(steps + 1):
        action = LAW(state, None)
        seen.append(says(state, action) | {"x": state.x})
        if seen[-1]["failed"]:
            seen[-1] |= {"cost": 2.5, "reward": -2.5}
        if not bool(seen[-1]["terminated"] | seen[-1]["failed"]):
            state = step(state, action)
    return {k: np.stack([np.asarray(s[k]) for s in seen]) for k in seen[0]}


@pytest.fixture(scope="module")
def oracle():
    starts = [GAME.reset(jax.random.split(k)[0]) for k in KEYS]
    return [played(GAME, s, 2 * GAME.horizon) for s in starts]


def test_the_game_replaces_every_method():
    methods = {n for n, f in vars(AbstractPlanar).items() if callable(f) and not n.startswith("_")}
    final = {"local_view", "strengthened", "resized", "farther", "aside", "pushed", "retargeted"}
    final |= {"local_entries", "local_sight", "state_shapes"}  # words about them
    assert methods - final <= set(vars(Own))


def test_the_plain_loop_meets_all_that_can_happen(oracle):
    for name in ("success", "terminated", "violated", "failed"):
        hits = np.array([s[name].any() for s in oracle])
        assert 0 < hits.sum() < len(hits), name


def disagrees(got, oracle, H):
    """The figures of an evaluation that are not those of the plain loop."""
    at = lambda name: np.array([s[name] for s in oracle])
    wanted = {
        "success": at("success")[:, H],
        "held": at("success")[:, H - 4 : H + 1].all(1),
        "stayed": at("success")[:, H:].all(1),
        "final": at("distance")[:, H],
        "violated": at("violated")[:, : H + 1].any(1),
        "total": at("reward")[:, :H].sum(1),
    }
    near = lambda a, b: np.allclose(np.asarray(a, float), np.asarray(b, float), atol=1e-4)
    return [name for name, value in wanted.items() if not near(getattr(got, name), value)]


def test_an_evaluation_says_what_the_game_says(oracle):
    assert disagrees(outcomes(GAME, LAW, KEYS, GAME.horizon), oracle, GAME.horizon) == []
    assert evaluate(GAME, LAW, 24, beyond=6).success_rate == np.mean(
        [s["success"][GAME.horizon] for s in oracle]
    )


@pytest.mark.parametrize("nested", (1, 2))
def test_an_idle_perturbation_changes_nothing(oracle, nested):
    game = GAME
    for _ in range(nested):
        game = Perturbed(game)
    assert disagrees(outcomes(game, LAW, KEYS, GAME.horizon), oracle, GAME.horizon) == []
    state = game.reset(jax.random.split(KEYS[0])[0])
    assert np.allclose(game.observations(state), oracle[0]["observation"][0])
    assert np.allclose(game.features(state), oracle[0]["features"][0])
    assert np.allclose(game.errors(state), oracle[0]["errors"][0])
    assert np.allclose(game.positions(state), oracle[0]["positions"][0])


def test_perturbations_act_on_what_the_game_replaced():
    start = lambda game: game.reset(KEYS[0])
    alone, push = start(GAME), 0.5 * jnp.ones((3, 2))
    own = GAME.step(alone, push).x
    strong = Perturbed(Perturbed(GAME, gain=2.0), gain=1.5)
    moved = strong.step(start(strong), push).x
    assert np.allclose(moved, own + 0.95 * 2.0 * 0.1 * 0.5, atol=1e-6)
    silent = Perturbed(Perturbed(GAME, drop=1.0))
    flags = np.asarray(silent.observations(start(silent)))[:, 5]
    assert np.asarray(GAME.observations(alone))[:, 5].any() and not flags.any()
    noisy = Perturbed(Perturbed(GAME, noise=0.1), noise=0.1)
    first, second = (g.step(start(g), 0 * push).x for g in (Perturbed(GAME, noise=0.1), noisy))
    assert not np.allclose(first, second) and not np.allclose(second - own, 2 * (first - own))
    late = Perturbed(Perturbed(GAME, delay=1), delay=1)
    state = start(late)
    for action in (push, 0 * push, 0 * push):
        before, state = state, late.step(state, action)
    assert np.allclose(state.memory["inner"]["inner"], push)
    assert np.allclose(before.memory["inner"]["inner"], 0.01)  # the holding action


def test_an_agent_of_a_game_that_judges_the_whole_team_cannot_be_taken_away():
    with pytest.raises(UserError, match="^perturbation: an agent of Own cannot .* `success`"):
        Perturbed(Perturbed(GAME), gone=(2,))


def test_what_is_drawn_is_what_the_game_says(oracle):
    path = rollout(GAME, LAW, GAME.reset(jax.random.split(KEYS[0])[0]), KEYS[0], 7)
    drawn = film(GAME, path)
    assert np.allclose(drawn.frames.positions, oracle[0]["positions"][:7], atol=1e-6)
    assert np.allclose(drawn.distance, oracle[0]["distance"][:7], atol=1e-6)
    assert np.allclose(drawn.level, oracle[0]["cost"][:7], atol=1e-5)
    assert drawn.success == bool(oracle[0]["success"][6])
    assert drawn.frames.links[1] == () and drawn.frames.links[0] == ((0, 1), (1, 2))


def test_training_plays_and_selects_by_what_the_game_says():
    schedule = Schedule(
        steps=48, environments=4, steps_per_update=24, warmup=24, select_every=1, select_episodes=16
    )
    trainer = Trainer(GAME, MASAC(actor_width=8, critic_width=8, batch=8), schedule)
    carry, _ = eqx.filter_jit(trainer.begin)(jax.random.key(0))
    kept = carry.learner.memory.episodes
    obs = np.asarray(kept.obs)[0]
    assert obs.shape[-1] == GAME.observations(GAME.reset(KEYS[0])).shape[1]
    assert np.allclose(obs[1, :, -2:], np.asarray(kept.action)[0, 0], atol=1e-6)  # its memory
    assert np.allclose(np.asarray(kept.reward)[:4], 1 - np.asarray(kept.cost)[:4], atol=1e-5)
    _, look = eqx.filter_jit(trainer.select_best)(carry)
    policy = trainer.algorithm.policy(carry.learner.networks)
    keys = jax.random.split(stream(0, "select"), 16)
    found = outcomes(GAME, Decentralised(policy, GAME), keys)
    assert float(look["success"]) == pytest.approx(float(np.mean(found.success)))


class Rising(AbstractLyapunov):
    """V of the game's own distance: falls or rises with it."""

    ball: float = 0.0
    beyond = property(lambda self: 0)  # pyright: ignore[reportAssignmentType]

    def value(self, game, state):
        return jnp.sum(game.distance(state))

    def along(self, game, trajectory, time):
        states = jax.tree.map(lambda leaf: leaf[:time], trajectory.state)
        return jax.vmap(lambda s: self.value(game, s))(states)


def test_certificates_judge_what_the_game_says(oracle):
    H = GAME.horizon
    start = jax.vmap(lambda k: GAME.reset(jax.random.split(k)[0]))(KEYS)
    long = jax.vmap(lambda s: rollout(GAME, LAW, s, KEYS[0], 2 * H))(start)
    short = jax.tree.map(lambda leaf: leaf[:, : H + 1], long.state)
    success = np.array([s["success"] for s in oracle])

    def judged(certificate, V=None, steps=2 * H):
        cut = lambda leaf: leaf[:, :steps]
        seen = eqx.tree_at(
            lambda t: t.state, long, jax.tree.map(lambda x: x[:, : steps + 1], long.state)
        )
        seen = eqx.tree_at(
            lambda t: (t.action, t.reward, t.cost, t.terminated),
            seen,
            tuple(map(cut, (long.action, long.reward, long.cost, long.terminated))),
        )
        return jax.vmap(lambda t: certificate.judge(GAME, V, t, KEYS[0]))(seen)

    assert short.x.shape[1] == H + 1
    assert np.array_equal(judged(Reach(), steps=H).holds, success[:, H])
    assert np.array_equal(judged(ReachAndStay(stay=H)).holds, success[:, H:].all(1))
    entered = judged(Decrease(), Rising()).figures["entered"]
    assert np.array_equal(np.asarray(entered) > 0, success[:, : H + 1].any(1))
    final = judged(Quantiles(), Rising()).figures["final_distance"]
    assert np.allclose(final, [s["distance"][H] for s in oracle], atol=1e-5)
    assert CostSum(LAW).value(GAME, jax.tree.map(lambda x: x[0], start)) > 0
    safe = judged(Safe(stay=H))
    assert np.array_equal(safe.holds, ~np.array([s["violated"].any() for s in oracle]))
    basin = judged(Basin(stay=H), Rising())
    assert np.array_equal(basin.holds, success[:, H:].all(1))
    value = [np.sum(np.asarray(GAME.distance(jax.tree.map(lambda x: x[0], start))))]
    assert np.asarray(basin.figures["V"])[0] == pytest.approx(value[0], rel=1e-5)
    places = np.stack([s["positions"] for s in oracle])
    gaps = np.linalg.norm(places[:, :, :, None] - places[:, :, None], axis=-1)
    gaps[:, :, np.arange(3), np.arange(3)] = np.inf
    apart = judged(Apart(stay=H)).figures["gap"]
    assert np.allclose(apart, gaps.min(axis=(1, 2, 3)), atol=1e-5)
    cost = np.stack([s["cost"] for s in oracle])
    over = judged(Contraction(T=2), steps=H + 1).figures
    falls = 1 - cost[:, 2 : H + 1] / cost[:, : H - 1]
    falls = np.where(cost[:, : H - 1] >= GAME.radius, falls, np.inf).min(axis=1)
    assert np.allclose(over["beta"], np.minimum(falls, 1.0), atol=1e-4)
    farthest = np.stack([s["distance"] for s in oracle])
    windows = np.asarray(judged(SimpleNamespace(judge=_Windows(2))).figures["V"]).max(axis=2)
    assert np.allclose(windows, np.maximum(farthest[:, :-1], farthest[:, 1:]), atol=1e-5)


@pytest.mark.parametrize("certificate", (ClosedForm(), PROOF), ids=("closed-form", "proof"))
def test_formulas_refuse_a_game_with_methods_of_its_own(certificate):
    with pytest.raises(UserError):
        certificate.check(ClosedLoop(GAME, LAW, Rising()), 0)


def test_the_linearisation_is_that_of_the_games_own_step():
    """x+ = 0.95 (x + dt a) with a = 1.5 (goal - x): the target is no equilibrium of that."""
    verdict = Linearisation().check(ClosedLoop(GAME, LAW, Rising()), 0)
    assert not verdict.holds and "no equilibrium" in verdict.claim


def test_recheck_confirms_nothing_of_a_game_of_ones_own(tmp_path):
    table = {"reach": Reach(rollouts=100, share=0.1)}
    result = certify(GAME, LAW, table, 0, 0.9)
    save(tmp_path / "certificate", result, GAME, LAW)
    found = recheck(tmp_path / "certificate")
    assert not found["agrees"] and found["holds"] is None
    assert "no model of the game" in found["not_rechecked"]["reach"]
