"""Training on games outside JAX: the memory, the padding, runs on disk, and what is refused."""

import json
from pathlib import Path

import equinox as eqx
import host_envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.cli import main
from marlyap.errors import UserError
from marlyap.learning.algorithms import APG, MADDPG, MASAC, DecentralisedSAC
from marlyap.learning.constraints.lyapunov import Lyapunov
from marlyap.learning.host_trainer import HostTrainer
from marlyap.learning.hosted import Hosted
from marlyap.learning.schedule import Schedule
from marlyap.learning.steps import Steps, Stored
from marlyap.nets.nets import Actors, Sampled, Shape
from marlyap.runs import config
from marlyap.runs.hosted import evaluate_hosted
from marlyap.runs.run import Run, begin, flatten, load_policy
from marlyap.storage import store


WALK = f"{Path(host_envs.__file__)}:walk"
TINY = dict(actor_width=8, critic_width=8, batch=16)
PLAN = Schedule(steps=72, environments=3, steps_per_update=4, warmup=24, capacity=90)
GAMMA = 0.9


# ---- the memory ----


def remembered(rng, time=9, copies=2):
    """Random steps in which agents end at random, and some episodes are cut."""
    draw = lambda *size: jnp.asarray(rng.standard_normal((time, copies, *size)), jnp.float32)
    alive, cut = rng.random((time, copies, 2)) > 0.3, rng.random((time, copies)) > 0.8
    return Stored(
        obs=draw(2, 4), state=draw(2, 1), action=draw(2, 3), log_prob=draw(2), reward=draw(2),
        next_obs=draw(2, 4), next_state=draw(2, 1), alive=jnp.asarray(alive),
        ended=jnp.asarray(cut | ~alive.any(axis=2)),
    )  # fmt: skip


@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_a_transition_is_what_the_sums_say(n):
    """Each agent's own discount and rewards, up to an end, a cut or the newest step."""
    new = remembered(np.random.default_rng(0))
    memory = Steps.empty(jax.tree.map(lambda x: x[0], new), 6).add(
        jax.tree.map(lambda x: x[:4], new)
    )
    memory = memory.add(jax.tree.map(lambda x: x[4:], new))  # the first three are overwritten
    assert int(memory.size) == 6
    noise = jnp.zeros((2, 2, 3))
    look = jax.jit(jax.vmap(lambda age, c: memory.transition(age, c, noise, GAMMA, n)))
    where = [(age, c) for age in range(6) for c in range(2)]
    found = look(*(jnp.asarray(x) for x in zip(*where, strict=True)))
    for i, (age, c) in enumerate(where):
        t, reward, left = age + 3, np.zeros(2), np.ones(2)
        for k in range(n):
            reward += GAMMA**k * left * np.asarray(new.reward[t + k, c])
            left = left * np.asarray(new.alive[t + k, c])
            last = t + k
            if new.ended[last, c] or last == 8:
                break
        np.testing.assert_allclose(found.reward[i], reward, rtol=1e-5)
        np.testing.assert_allclose(found.discount[i], GAMMA ** (last - t + 1) * left, rtol=1e-5)
        np.testing.assert_array_equal(found.obs[i], new.obs[t, c])
        np.testing.assert_array_equal(found.next_obs[i], new.next_obs[last, c])
        np.testing.assert_array_equal(found.features[i][:, :4], new.obs[t, c])
        np.testing.assert_array_equal(found.next_features[i][:, 4:], new.next_state[last, c])


def test_every_step_of_every_copy_is_drawn():
    new = remembered(np.random.default_rng(1))
    memory = Steps.empty(jax.tree.map(lambda x: x[0], new), 20).add(new)
    drawn = jax.jit(lambda key: memory.sample(key, 400, GAMMA))(jax.random.key(0))
    seen = {round(float(x), 5) for x in drawn.obs[:, 0, 0]}
    assert seen == {round(float(x), 5) for x in new.obs[:, :, 0, 0].ravel()}


# ---- padding ----

UNEVEN = Shape(agents=2, obs=4, features=5, errors=0, du=3, kinds=(0, 1), inputs=(1, 3))


@pytest.mark.parametrize("shared", [pytest.param(False, marks=pytest.mark.slow), True])
def test_padded_actions_are_zero_and_have_no_gradient(shared):
    pi = Actors(UNEVEN, 8, shared, key=jax.random.key(0))
    obs, noise = jax.random.normal(jax.random.key(1), (2, 2, 4))
    noise = jnp.concatenate([noise, noise], axis=1)[:, :3]

    def J(pi, obs):
        s = pi.sample(obs, noise, 0.1 * noise)
        spread = jnp.sum(s.action**2) + jnp.sum(s.log_prob) + jnp.sum(s.log_prob_memory)
        return spread + jnp.sum(pi.mode(obs) ** 3)

    batched = lambda pi: jnp.sum(jax.vmap(lambda o: J(pi, o))(jnp.stack([obs, -obs])))
    last = eqx.filter_grad(batched)(pi).net.layers[-1]
    of_a = slice(1, 3), slice(4, 6)  # means and deviations of the two actions that `a` has not
    for part in (last.weight[0], last.bias[0]):
        assert not any(np.any(part[rows]) for rows in of_a)
        assert np.any(part[0]) and np.any(part[3])
    assert np.all(np.abs(last.bias[1]) > 0)
    sample = pi.sample(obs, noise, noise)
    assert not sample.action[0, 1:].any() and sample.action[0, 0] and sample.action[1].all()
    assert not pi.mode(obs)[0, 1:].any()
    action = Sampled(pi)(obs, jax.random.key(2))
    assert action.shape == (2, 3) and not action[0, 1:].any()


# ---- trainings ----


def trainer(algorithm=None, source=WALK, plan=PLAN, **fields):
    game = Hosted(source, rollout=8, **fields).opened()
    return HostTrainer(game, algorithm or MASAC(**TINY), plan)


def advanced(made, begun=None):
    """The state after all iterations, and what was told."""
    *_, (done, carry, told) = made.advance(begin(begun or made, 0))
    return done, carry, told


def test_the_same_learner_for_every_number_of_processes():
    hashes, alone = [], trainer()
    for workers in (0, 2):
        done, carry, told = advanced(trainer(workers=workers), alone)
        assert done == 3 and float(told.log["episodes"][0]) > 10
        hashes.append(store.hash_arrays(flatten(carry)))
    assert len({*hashes}) == 1
    assert -1 <= float(told.log["success"][0]) <= 1 and np.isfinite(told.log["return"][0])
    steps, memory = carry.learner.memory.kept, carry.learner.memory
    assert memory.rows == 30 and int(memory.size) == 30  # 24 + 72 steps of 3 copies, of which 90
    assert not steps.action[:, :, 0, 1:].any() and steps.action[:, :, 1].all()
    assert steps.state.shape == (30, 3, 2, 2)  # three numbers of state for two agents
    # b leaves at the third of five steps: of the two that follow nothing is worth anything to it.
    t = np.asarray(steps.obs[:, :, 0, 1])
    np.testing.assert_array_equal(steps.alive[:, :, 1], t < 2)
    np.testing.assert_array_equal(steps.ended, t == 4)
    assert np.all(steps.alive[:, :, 0])


@pytest.mark.parametrize(
    "algorithm, word",
    [
        (APG(), "algorithm"),
        (MASAC(constraint=Lyapunov()), "algorithm.constraint"),
        (DecentralisedSAC(), "decide equally many"),
    ],
)
def test_what_cannot_learn_from_steps_is_refused(algorithm, word):
    with pytest.raises(UserError, match=word):
        begin(trainer(algorithm), 0)


@pytest.mark.slow
def test_other_algorithms_take_uneven_agents():
    made = trainer(MADDPG(**TINY, critics=2, smoothing=0.2))
    _, carry, told = advanced(made)
    assert all(np.isfinite(v).all() for k, v in told.log.items() if k != "success")
    last = carry.learner.networks.pi.memory.mu.net.layers[-1].weight
    assert not np.any(last[0, 1:3]) and np.any(last[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("ends", [False, True])
def test_a_cut_is_bootstrapped_and_an_end_is_not(ends, full_compilation):
    """Reward 1 for a, ten for b until it leaves: Q of a is 1 / (1 - gamma) where it is cut."""
    algorithm = MASAC(
        gamma=0.8, alpha=1e-4, rate_alpha=0.0, reward_scale=1.0, tau=0.05, **TINY | {"batch": 128}
    )
    plan = Schedule(steps=4000, environments=4, steps_per_update=1, warmup=400)
    made = trainer(algorithm, plan=plan, arguments=(f"ends={str(ends).lower()}",))
    _, carry, _ = advanced(made)
    kept = jax.tree.map(lambda x: x[-200:, 0], carry.learner.memory.kept)
    features = jnp.concatenate([kept.obs, kept.state], axis=-1)
    Q = jax.vmap(carry.learner.networks.Q.value)(features, kept.action).mean(axis=1)
    t = np.asarray(kept.obs[:, 0, 1])
    for step in range(5):
        want = (1 - 0.8 ** (5 - step)) / 0.2 if ends else 5.0
        assert np.mean(Q[t == step, 0]) == pytest.approx(want, rel=0.06)
        want = 10 * (1 - 0.8 ** max(3 - step, 0)) / 0.2  # its own discount only
        assert np.mean(Q[t == step, 1]) == pytest.approx(want, rel=0.06, abs=0.5)


# ---- runs on disk ----

SMALL = """--task.rollout 8 --steps 72 --schedule.environments 3 --schedule.steps_per_update 4
--schedule.warmup 24 --schedule.capacity 90 --schedule.select_every 1
--algorithm.actor_width 8 --algorithm.critic_width 8 --algorithm.batch 16""".split()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("hosted")
    assert main(["train", WALK, "masac", *SMALL, "--out", str(out)]) == 0
    return out / "seed0"


def refused(capsys, *words):
    assert main([str(w) for w in words]) == 2
    *_, said = capsys.readouterr().err.strip().splitlines()
    assert said.startswith("marlyap: ")
    return said


def test_a_run_is_a_directory_like_any_other(run):
    about = json.loads((run / "run.json").read_text())
    assert about["task"]["kind"] == "Hosted" and about["task"]["decided"] == [1, 3]
    assert about["code"]["task"]["file"] == WALK.rpartition(":")[0]
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["steps"] for line in lines] == [24, 48, 72]
    assert all("return" in line and "success" in line for line in lines)
    own = config.load_task(WALK)
    opened = Run.open(run, own)
    assert opened.finished and opened.labels["task"] == "walk"


def test_code_of_ones_own_is_executed_only_where_it_is_named(run, capsys):
    for words in (["evaluate", run], ["train", "--resume", run], ["watch", run]):
        assert "name it with --task" in refused(capsys, *words)


def test_evaluate_report_and_watch(run, capsys, tmp_path):
    assert main(["evaluate", str(run), "--task", WALK, "--episodes", "7", "--json"]) == 0
    row = json.loads(capsys.readouterr().out)["runs"][0]
    assert row["episodes"] == 7 and row["return_of_agents"] == [5.0, 30.0]
    assert row["return_mean"] == 17.5 and 0 <= row["success_rate"] <= 1
    assert json.loads((run / "evaluation.json").read_text()) == row
    out = tmp_path / "page.html"
    words = ["report", str(run), "--task", WALK, "--episodes", "3", "--out", str(out)]
    assert main(words) == 0
    assert "walk masac" in out.read_text() and "17.50" in out.read_text()
    assert (tmp_path / "page-learning.png").exists()
    from PIL import Image

    with Image.open(tmp_path / "page-film.gif") as film:
        assert film.n_frames == 5 and film.size == (8, 8)
    assert main(["watch", str(run), "--task", WALK, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "film.gif").exists()


def test_what_needs_a_game_in_jax_refuses(run, capsys):
    for words in (["certify", run, "--task", WALK], ["recheck", run], ["check-task", WALK]):
        refused(capsys, *words)
    said = refused(capsys, "evaluate", run, "--task", WALK, "--task.workers", "2")
    assert "--task.workers" in said
    assert "task: " in refused(capsys, "train", "pettingzoo:no_such.game", "masac")


@pytest.mark.slow
def test_a_resumed_run_has_learner_memory_and_keys_and_says_so(run, tmp_path, capsys):
    import shutil

    again = tmp_path / "again"
    shutil.copytree(run, again)
    store.Checkpoints(again / "checkpoints").steps()
    about = json.loads((again / "run.json").read_text())
    about["schedule"]["steps"] = 96
    about["schedule"]["capacity"] = 90
    (again / "run.json").write_text(json.dumps(about))
    before = Run.open(run, config.load_task(WALK)).load()[0]
    after = Run.open(again, config.load_task(WALK)).load()[0]
    assert store.hash_arrays(flatten(before)) == store.hash_arrays(flatten(after))
    assert main(["train", "--resume", str(again), "--task", WALK]) == 0
    assert "begin new episodes" in capsys.readouterr().err
    last = json.loads((again / "log.jsonl").read_text().splitlines()[-1])
    assert last["steps"] == 96 and last["fresh_episodes"] == 1.0
    assert int(Run.open(again, config.load_task(WALK)).load()[0].played.episodes.min()) > 5


def test_a_fault_leaves_the_last_checkpoint_sound(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["train", WALK, "masac", *SMALL, "--task.arguments", "fault=nan,at=4"]
    said = refused(capsys, *words, "--out", out)
    assert "copy 0, agent a, step 4" in said
    assert not (out / "seed0").exists()  # nothing had been learnt


def test_a_game_that_has_changed_is_refused(run):
    made = Run.open(run, config.load_task(WALK)).trainer
    other = eqx.tree_at(lambda t: t.game.observed, made, (3, 4))
    with pytest.raises(UserError, match="this run was made with"):
        other.game.open(1)


def test_python(run):
    opened = Run.open(run, config.load_task(WALK))
    assert evaluate_hosted(opened, 3).returns.shape == (3, 2)
    with pytest.raises(UserError, match="at least 1"):
        evaluate_hosted(opened, 0)
    policy = load_policy(run, WALK)
    obs = np.zeros((2, 4), np.float32)
    team = np.asarray(policy(obs))
    assert team.shape == (2, 3)
    np.testing.assert_allclose(policy.agent(0, obs[0]), team[0, :1], rtol=1e-6)


# ---- from another run, and longer ----

QUICK = """--schedule.environments 4 --schedule.warmup 160 --schedule.select_episodes 4
--algorithm.actor_width 8 --algorithm.critic_width 8 --algorithm.batch 16""".split()


@pytest.mark.slow
def test_a_run_is_made_longer_and_begins_from_another(tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    train = ["train", "rendezvous", "masac", *QUICK]
    assert main([*train, "--steps", "320", "--out", str(first)]) == 0
    before = Run.open(first / "seed0").load()[0]
    rows, head = before.learner.memory.rows, int(before.learner.memory.head)
    assert "take more" in refused(capsys, "train", "--resume", first / "seed0", "--steps", "320")
    longer = Run.open(first / "seed0").lengthened(640)
    after = longer.load()[0]
    assert after.learner.memory.rows > rows and not longer.finished
    old, new = (c.learner.memory.episodes.obs for c in (before, after))
    order = (np.arange(rows) + head) % rows
    np.testing.assert_array_equal(np.asarray(old)[order], np.asarray(new)[:rows])
    assert main(["train", "--resume", str(first / "seed0")]) == 0
    assert Run.open(first / "seed0").finished

    words = [*train, "--steps", "160", "--out", str(second), "--from", str(first / "seed0")]
    learnt = Run.open(first / "seed0").load()[0].learner.networks
    assert main(words) == 0
    carry = Run.open(second / "seed0").load()[0]
    moved = [
        float(np.abs(a - b).max())
        for a, b in zip(
            jax.tree.leaves(eqx.filter(learnt.pi.value, eqx.is_array)),
            jax.tree.leaves(eqx.filter(carry.learner.networks.pi.value, eqx.is_array)),
            strict=True,
        )
    ]
    assert 0 < max(moved) < 0.05  # a few updates away
    other = ["train", "formation", "masac", *QUICK, "--out", tmp_path / "third"]
    refused(capsys, *other, "--from", first / "seed0")
    assert not (tmp_path / "third" / "seed0").exists()
