"""Our games as environments of other libraries: their own test suites, and what a rollout says."""

import warnings

import jax
import numpy as np
import pytest

from marlyap.errors import UserError
from marlyap.outside import Team, Teams, frame_of
from marlyap.simulation.rollout import rollout
from marlyap.tasks import TASKS


SHORT = dict(horizon=6)


def test_a_team_is_stepped_as_a_rollout_has_it():
    team = Team.of("rendezvous", **SHORT)
    game, actions = team.game, np.random.default_rng(0).uniform(-1, 1, (6, 3, 2))
    actions = actions.astype(np.float32)
    first = team.reset(5)
    start = game.reset(jax.random.key(np.uint32(5)))
    played = jax.jit(
        lambda start: rollout(
            game, lambda s, k: jax.numpy.asarray(actions)[s.t], start, jax.random.key(0)
        )
    )(start)
    seen = jax.vmap(game.observations)(played.state)
    np.testing.assert_allclose(first, seen[0], atol=1e-6)
    for t, action in enumerate(actions):
        told = team.step(action)
        np.testing.assert_allclose(told.obs, seen[t + 1], atol=1e-5)
        np.testing.assert_allclose(told.reward, played.reward[t], atol=1e-5)


def test_several_teams_begin_anew_one_by_one():
    teams = Teams(Team.of("rendezvous"), 3, max_cycles=4)
    teams.reset(1)
    for k in range(9):
        told = teams.step(np.zeros((3, 3, 2), np.float32))
        assert told.cut.all() == (k in (3, 7)) and not told.ended.any()
        assert np.array_equal(told.obs, told.final) == (k not in (3, 7))


def test_unknown_fields_and_tasks():
    with pytest.raises(UserError, match="did you mean 'horizon'"):
        Team.of("rendezvous", horizn=3)
    with pytest.raises(UserError, match="no task is called"):
        Team.of("rendevous")


def test_pictures():
    for name in ("rendezvous", "frequency"):  # the second has no map
        team = Team.of(name)
        assert frame_of(team).min() == 255
        team.reset(0)
        drawn = frame_of(team)
        assert drawn.shape == (240, 240, 3) and drawn.dtype == np.uint8 and drawn.min() < 255


# ---- PettingZoo ----


@pytest.fixture
def zoo():
    pytest.importorskip("pettingzoo")
    import marlyap.pettingzoo as zoo

    return zoo


@pytest.fixture(autouse=True)
def strict():
    """A warning of their checkers is a failure here."""
    with jax.numpy_rank_promotion("allow"), warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        warnings.filterwarnings("ignore", message=".*infinity")  # observations have no bounds
        yield


def test_all_suites_of_pettingzoo_pass(zoo, capsys):
    from pettingzoo.test import (
        api_test,
        max_cycles_test,
        parallel_api_test,
        parallel_seed_test,
        seed_test,
        state_test,
    )  # fmt: skip

    make = lambda **more: zoo.parallel_env("rendezvous", **SHORT, **more)
    aec = lambda **more: zoo.env("rendezvous", **SHORT, **more)
    parallel_api_test(make(), num_cycles=30)
    parallel_seed_test(make, num_cycles=10)
    api_test(aec(), num_cycles=20)
    seed_test(aec, num_cycles=10)
    state_test(aec(), make())

    class Module:
        parallel_env, env = staticmethod(make), staticmethod(aec)

    max_cycles_test(Module)
    capsys.readouterr()


def test_renders_and_is_registered(zoo):
    from pettingzoo import make

    with pytest.raises(UserError, match="render_mode"):
        zoo.parallel_env(render_mode="human")
    zoo.register()
    env = make("parallel", "marlyap/rendezvous-v0", render_mode="rgb_array", horizon=6)
    env.reset(seed=0)
    assert env.render().shape == (240, 240, 3) and env.state_space.contains(env.state())
    assert {a: env.action_space(a).shape for a in env.possible_agents} == dict.fromkeys(
        ("agent_0", "agent_1", "agent_2"), (2,)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_every_game_is_a_parallel_env(zoo, name):
    from pettingzoo.test import parallel_api_test

    env = zoo.parallel_env(name, max_cycles=5)
    parallel_api_test(env, num_cycles=12)
    obs, _ = env.reset(seed=3)
    assert all(env.observation_space(a).contains(obs[a]) for a in env.agents)
    assert env.state_space.contains(env.state())


# ---- Gymnasium ----


def test_the_checker_of_gymnasium_passes():
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    import marlyap.gymnasium as ours

    ours.register()
    env = gymnasium.make("marlyap/rendezvous-v0", horizon=6, render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    *_, cut, info = [env.step(env.action_space.sample()) for _ in range(6)][-1]
    assert cut and info["success"] in (True, False) and env.render().shape == (240, 240, 3)


def test_the_vector_environment_tells_the_last_observation():
    pytest.importorskip("gymnasium")
    from marlyap.gymnasium import VectorEnv

    env = VectorEnv("rendezvous", num_envs=3, max_cycles=4)
    obs, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    assert np.array_equal(obs, again) and env.observation_space.contains(obs)
    for k in range(4):
        obs, reward, ended, cut, info = env.step(env.action_space.sample())
        assert reward.shape == (3,) and cut.all() == (k == 3) and not ended.any()
    assert info["_final_obs"].all() and not np.array_equal(info["final_obs"][0], obs[0])


def test_a_foreign_learner_takes_our_games():
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env

    from marlyap.gymnasium import TeamEnv

    check_env(TeamEnv("rendezvous"))
    model = sb3.SAC("MlpPolicy", TeamEnv("rendezvous"), seed=0, learning_starts=100)
    model.learn(300)
