"""Games outside JAX: what copies tell, whoever plays them; and one sentence for what goes wrong."""

import json
import sys
from pathlib import Path

import host_envs
import numpy as np
import pytest

from marlyap.errors import UserError
from marlyap.hosts.opening import open_game
from marlyap.hosts.sources import parsed
from marlyap.hosts.spec import Fault, episode_seed


FILE = Path(host_envs.__file__)
WALK = f"{FILE}:walk"


def played(source=WALK, copies=3, workers=0, steps=12, seed=7, **arguments):
    """Everything that the copies tell, and the game's sizes."""
    rng = np.random.default_rng(0)
    with open_game(source, copies, workers, arguments) as game:
        spec, told = game.spec, [game.reset(seed, [0] * copies)]
        for _ in range(steps):
            action = rng.uniform(-1, 1, (copies, spec.agents, spec.du)).astype(np.float32)
            told.append(game.step(action))
    return spec, told


def as_bytes(told):
    return [np.ascontiguousarray(x).tobytes() for part in told for x in part]


def test_what_processes_tell_does_not_depend_on_how_many():
    spec, alone = played()
    for workers in (1, 2):
        again, told = played(workers=workers)
        assert again == spec and as_bytes(told) == as_bytes(alone)


def test_sizes_and_padding():
    spec, (first, *steps) = played()
    assert spec.names == ("a", "b") and (spec.obs, spec.du, spec.state) == (4, 3, 3)
    assert [side.obs for side in spec.sides] == [2, 4] and spec.sides[0].high == (4.0,)
    obs, state = first
    assert obs.shape == (3, 2, 4) and not obs[:, 0, 2:].any() and state.shape == (3, 3)
    assert all(not step.obs[:, 0, 2:].any() for step in steps)


def test_an_agent_that_leaves_and_an_episode_that_is_cut():
    _, (_, *steps) = played(copies=1)
    told = [s for s in steps[:5]]
    assert [bool(s.active[0, 1]) for s in told] == [True, True, True, False, False]
    assert [bool(s.terminated[0, 1]) for s in told] == [False, False, True, True, True]
    assert not any(s.terminated[0, 0] for s in told)
    assert [bool(s.truncated[0]) for s in told] == [False] * 4 + [True]
    assert [s.reward[0].tolist() for s in told] == [[1, 10]] * 3 + [[1, 0]] * 2
    assert not told[3].final_obs[0, 1].any()
    assert np.isnan(told[0].success[0]) and told[4].success[0] in (0, 1)
    # The next episode has begun in `obs`; what the old one led to is in `final_obs`.
    assert told[4].obs[0, 0, 1] == 0 and told[4].final_obs[0, 0, 1] == 5
    assert told[4].state[0, 2] == 0 and told[4].final_state[0, 2] == 5
    assert steps[5].active.all()


def test_an_end_is_no_cut():
    _, (_, *steps) = played(copies=1, ends=True)
    last = steps[4]
    assert last.terminated.all() and not last.truncated.any() and last.ended.all()


def test_actions_are_mapped_onto_each_agents_box():
    game = open_game(WALK, 1)
    game.reset(0, [0])
    game.step(np.array([[[1.0, 9.0, 9.0], [-1.0, 0.5, 1.0]]], np.float32))
    game.step(np.array([[[-0.5, 9.0, 9.0], [-7.0, 0.0, 0.0]]], np.float32))
    given = game.games[0].env.given
    np.testing.assert_allclose(given[0]["a"], [4.0])
    np.testing.assert_allclose(given[0]["b"], [-1.0, 0.5, 1.0])
    np.testing.assert_allclose(given[1]["a"], [1.0])
    np.testing.assert_allclose(given[1]["b"], [-1.0, 0.0, 0.0])


def test_episodes_follow_from_seed_copy_and_number():
    starts = {episode_seed(s, c, k) for s in (0, 1) for c in range(3) for k in range(3)}
    assert len(starts) == 18
    with open_game(WALK, 2) as game:
        second, _ = game.reset(3, [4, 0])
        game.reset(3, [3, 0])
        for _ in range(5):
            step = game.step(np.zeros((2, 2, 3), np.float32))
        assert step.obs[0, 0, 0] == second[0, 0, 0]  # episode 4 of copy 0, however it is reached


FAULTS = {
    "raises": "it raised ValueError (my bug)",
    "nan": "agent a, step 4: the observation holds a number that is not finite",
    "reward": "agent a, step 4: the reward holds a number that is not finite",
    "shape": "agent a, step 4: the observation has shape (7,) and not 2 numbers",
    "type": "agent a, step 4: the observation is a str and not numbers",
    "missing": "agent a, step 4: there is no observation",
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_sentence(name):
    with pytest.raises(Fault) as told:
        played(copies=2, fault=name)
    assert FAULTS[name] in str(told.value) and str(told.value).startswith("task: copy 0")
    assert "step 4" in str(told.value) and "last checkpoint" in str(told.value)


@pytest.mark.parametrize("name", ["nan", "dies", "hangs"])
def test_a_fault_in_a_process_of_its_own_is_one_sentence(name):
    said = {"dies": "its process ended (code 3)", "hangs": "it has not answered for 1 s"}
    with pytest.raises(Fault) as told:
        with open_game(WALK, 2, 2, {"fault": name}, patience=60.0) as game:
            game.reset(0, [0, 0])
            for t in range(5):
                game.patience = 1.0 if name == "hangs" and t == 3 else 60.0
                game.step(np.zeros((2, 2, 3), np.float32))
    assert said.get(name, FAULTS["nan"]) in str(told.value)
    assert str(told.value).startswith("task: copy 0") and "step 4" in str(told.value)
    assert not game.processes  # none is left behind


REFUSED = {
    f"{FILE}:few": "continuous",
    f"{FILE}:endless": "without bounds",
    f"{FILE}:broken": "RuntimeError (no display)",
    f"{FILE}:number": "no ParallelEnv",
    f"{FILE}:three": "no function called 'three'",
    f"{FILE}:nothing": "no function called 'nothing'",
    "nowhere.py:make": "there is no file nowhere.py",
    "pettingzoo:no_such_package.game": "not installed",
    "pettingzoo:host_envs": "outside the installed packages",
    "vmas:navigation": "pip install vmas",
    "jaxmarl:MPE_simple_spread_v3": "pip install jaxmarl",
}


@pytest.mark.parametrize("source", REFUSED, ids=lambda s: s.rpartition("/")[2])
def test_what_cannot_be_played_is_refused(source, monkeypatch):
    for package in ("vmas", "jaxmarl"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError) as told:
        open_game(source, 1)
    assert REFUSED[source] in str(told.value) and str(told.value).startswith("task: ")


def test_a_process_refuses_in_the_same_words():
    with pytest.raises(UserError, match="without bounds"):
        open_game(f"{FILE}:endless", 1, 1)


def test_arguments():
    assert parsed(("N=3", "x=0.5", "name=Hopper", "y=true", "z=True")) == {
        "N": 3, "x": 0.5, "name": "Hopper", "y": True, "z": True,
    }  # fmt: skip
    for word in ("N", "=3", "a b=3"):
        with pytest.raises(UserError, match="name=value"):
            parsed((word,))


def test_nothing_here_imports_jax():
    import subprocess

    code = "import sys, marlyap.hosts.worker, marlyap.hosts.workers, json; "
    code += (
        "print(json.dumps(sorted({'jax', 'gymnasium', 'pettingzoo', 'torch'} & {*sys.modules})))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(told.stdout) == []


# ---- other libraries ----

SPREAD = "pettingzoo:mpe2.simple_spread_v3"


def test_mpe2():
    pytest.importorskip("mpe2")
    spec, (_, *steps) = played(SPREAD, copies=2, steps=26)
    assert (spec.agents, spec.obs, spec.du, spec.state) == (3, 18, 5, 0)
    assert [int(s.truncated.sum()) for s in steps] == [0] * 24 + [2, 0]
    assert not any(s.terminated.any() for s in steps)
    spec, _ = played("pettingzoo:mpe2.simple_speaker_listener_v4", steps=1)
    assert [(side.obs, side.du) for side in spec.sides] == [(3, 3), (11, 5)]


def test_gymnasium():
    pytest.importorskip("gymnasium")
    spec, (_, *steps) = played("gymnasium:Pendulum-v1", copies=1, steps=200)
    assert spec.agents == 1 and spec.sides[0].high == (2.0,)
    assert steps[-1].truncated[0] and not steps[-1].terminated.any()
    with pytest.raises(UserError, match="continuous"):
        open_game("gymnasium:CartPole-v1", 1)


def test_multi_agent_mujoco():
    pytest.importorskip("gymnasium_robotics")
    pytest.importorskip("mujoco")
    spec, (_, *steps) = played("mamujoco:Hopper:3x1", copies=1, steps=120)
    assert [side.obs for side in spec.sides] == [8, 9, 8] and spec.state == 11
    assert any(s.terminated.all() for s in steps) and not any(s.truncated.any() for s in steps)


def test_vmas():
    pytest.importorskip("vmas")
    spec, (_, *steps) = played("vmas:navigation", copies=4, steps=6, max_steps=5, n_agents=3)
    assert (spec.agents, spec.obs, spec.du) == (3, 18, 2)
    assert steps[4].truncated.all() and not np.array_equal(steps[4].obs, steps[4].final_obs)


def test_jaxmarl():
    pytest.importorskip("jaxmarl")
    spec, (_, *steps) = played("jaxmarl:MPE_simple_spread_v3", copies=2, steps=26)
    assert (spec.agents, spec.obs) == (3, 18)
    assert sum(int(s.truncated.sum()) for s in steps) == 2
    assert not any(s.terminated.any() for s in steps)
