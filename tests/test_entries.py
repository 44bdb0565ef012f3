"""Every entry of an observation is what its name, unit and frame say."""

import dataclasses

import jax
import numpy as np
import pytest

from marlyap.games.dynamics import DYNAMICS
from marlyap.games.perturbed import Perturbed
from marlyap.tasks import TASKS, Formation, Rendezvous


def by_hand(game, state, i):
    """Row i of the observation from the names of its entries alone, in NumPy and float64."""
    x, goal = np.asarray(state.x, float), np.asarray(state.scenario.goal, float)
    d, linked = game.dynamics, game.adjacency
    psi = x[:, 2] if "psi" in d.names else np.zeros(len(x))
    heading = np.stack([np.cos(psi), np.sin(psi)], 1)
    velocity = np.asarray(jax.vmap(d.velocity)(state.x), float)
    axes = {"ahead": heading[i], "left": np.array([-heading[i][1], heading[i][0]])}
    told = float(i in game.leaders)
    whom = np.flatnonzero(linked[i])
    row = []
    for entry in game.observation_entries():
        name, _, axis = entry.name.rpartition(", ")
        name = name or axis
        if name in d.felt:
            row.append(x[i, d.names.index(name)])
        elif entry.name.startswith("1 if the goal is told"):
            row.append(told)
        elif entry.name.startswith("1 if neighbour"):
            row.append(float(_slot(entry.name) < len(whom)))
        else:
            if "goal" in name:
                v = told * (goal[i] - x[i, :2])
            elif _slot(name) >= len(whom):
                v = np.zeros(2)
            else:
                j = whom[_slot(name)]
                parts = {"position": x[j, :2] - x[i, :2], "velocity": velocity[j]}
                parts["heading"] = heading[j]
                v = next(parts[w] for w in ("velocity", "heading", "position") if w in name)
            if name.startswith("e / (|e| + radius)"):
                v = v / (np.linalg.norm(v) + game.radius)
            row.append(v @ axes[axis])
    return np.array(row)


def _slot(name):
    return int(name.split("neighbour ")[1].split()[0].rstrip(","))


@pytest.mark.parametrize("dynamics", DYNAMICS)
@pytest.mark.parametrize("headings", (False, True))
def test_an_observation_can_be_built_from_its_entries(dynamics, headings):
    for base in (Rendezvous(graph="path"), Formation(agents=4, graph="star/2")):
        game = dataclasses.replace(base, dynamics=DYNAMICS[dynamics], headings=headings)
        rng = np.random.default_rng(0)
        start = game.reset(jax.random.key(1))
        x = np.asarray(start.x) + rng.standard_normal(start.x.shape).astype(np.float32)
        state = dataclasses.replace(start, x=jax.numpy.asarray(x))
        seen = np.asarray(game.observations(state))
        for i in range(game.agents):
            slots = game.slots[i]
            if (slots >= 0).sum() == game.adjacency[i].sum():
                np.testing.assert_allclose(seen[i], by_hand(game, state, i), atol=2e-5)


@pytest.mark.parametrize("name", TASKS)
def test_every_entry_of_every_task_has_a_name_and_a_unit(name):
    for game in (TASKS[name], Perturbed(TASKS[name])):
        entries, state = game.entries(), game.reset(jax.random.key(0))
        assert len(entries["observation"]) == game.observations(state).shape[1]
        assert len(entries["state"]) == state.x.shape[1]
        assert len(entries["action"]) == game.du
        for entry in (e for part in entries.values() for e in part):
            assert (
                entry.name and entry.unit not in ("", "?") and entry.frame in ("own", "world", "")
            )
