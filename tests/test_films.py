"""Films of games of any physics: what is drawn is what the game says, with a map or without."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from marlyap.games.game import AbstractGame
from marlyap.games.physics import AbstractPlant
from marlyap.report.data import Page
from marlyap.report.episodes import film
from marlyap.report.page import html
from marlyap.simulation.rollout import rollout
from marlyap.types import Entry, Scene, State


WAYS = ("x", "y", "z")
STEPS = 6


class Push(AbstractPlant):
    """Agents that move as they are pushed."""

    limits: tuple[float, ...] = (1.0, 2.0, 0.5)
    integrator: Any = "euler"
    states: tuple[Entry, ...] = tuple(Entry(way, "m") for way in WAYS)
    inputs: tuple[Entry, ...] = tuple(Entry(f"v{way}", "m/s") for way in WAYS)
    blocks: tuple[tuple[int, ...], ...] = ((0, 1, 2),)

    def field(self, x, u, scenario, time):
        return u


class Spots(AbstractGame):
    """Two agents and a third body that stands still, on a map of `d` dimensions or on none."""

    d: int = 0
    agents: int = 2
    graph: str = "complete"
    dt: float = 0.1
    horizon: int = STEPS
    plant: Push = Push()

    def reset(self, key):
        x = jax.random.uniform(key, (2, 3))
        return State(x=x, scenario=jnp.ones((2, 3)), t=jnp.asarray(0))

    def observe(self, state, links):
        return state.x

    def features(self, state):
        return state.x

    def costs(self, state, action):
        return self.distance(state)

    def distance(self, state):
        return jnp.abs(state.x - state.scenario).max(axis=1)

    def scene(self, state):
        if not self.d:
            return None
        place = jnp.concatenate([state.x[:, : self.d], jnp.zeros((1, self.d))])
        return Scene(
            position=place,
            velocity=jnp.zeros((3, self.d)),
            frame=jnp.broadcast_to(turned(state.t, self.d), (3, self.d, self.d)),
            goal=state.scenario[:, : self.d],
        )


def turned(angle, d):
    """The axes of a body that is turned about z."""
    c, s = jnp.cos(1.0 * angle), jnp.sin(1.0 * angle)
    return jnp.eye(3).at[:2, :2].set(jnp.array([[c, s], [-s, c]]))[:d, :d]


def across(state, key):
    return jnp.array([[1.0, -0.5, 0.2], [-1.0, 0.5, 2.0]])


@pytest.mark.parametrize("d", [0, 1, 2, 3])
def test_what_is_drawn_is_what_the_game_says(d):
    game, key = Spots(d=d), jax.random.key(0)
    path = rollout(game, across, game.reset(key), key, STEPS)
    shot = film(game, path, label="one")
    x, frames = np.asarray(path.state.x)[:-1], shot.frames
    assert np.allclose(frames.times, 0.1 * np.arange(STEPS))
    assert np.allclose(shot.distance, np.abs(x - 1).max(axis=(1, 2)), atol=1e-6)
    assert (shot.unit, shot.edge, shot.level_name, shot.rises) == ("tolerance", 1.0, "cost", False)
    assert frames.edge is None  # a tolerance is no length that could be drawn around a goal
    assert frames.leaders == (False, False) and frames.links == (((0, 1),),)
    if d:
        assert frames.positions is not None and frames.goals is not None
        assert np.allclose(frames.positions[:, :2], x[..., :d]) and frames.positions.shape[1] == 3
        assert np.allclose(frames.goals, 1.0)
    if d > 1:
        angle = np.arange(STEPS)
        ahead = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        assert np.allclose(frames.headings, ahead[:, None], atol=1e-5) and not frames.signals
    else:  # the plant's states, by default
        assert frames.headings is None and [*frames.signals] == ["x (m)", "y (m)", "z (m)"]
        assert np.allclose(frames.signals["y (m)"], x[..., 1])
    assert (frames.positions is None) == (d == 0)
    assert "final distance" in html(Page(title="t", films=(shot,)))
