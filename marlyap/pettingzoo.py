"""Games of marlyap for everyone else: as PettingZoo environments.

    from marlyap.pettingzoo import parallel_env
    env = parallel_env("rendezvous")

or, once `register()` has been called, `pettingzoo.make("parallel", "marlyap/rendezvous-v0")`.
Needs the extra `marlyap[games]`. All arrays are NumPy's; JAX runs behind them, so start further
processes by spawn and not by fork.
"""

import functools
from typing import Any

import numpy as np

from marlyap.errors import UserError
from marlyap.outside import Team, frame_of


try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
    from pettingzoo.utils.conversions import parallel_to_aec
except ImportError as error:
    raise UserError(
        f"task: this needs pettingzoo and gymnasium ({error}): pip install 'marlyap[games]'."
    ) from None


class MarlyapEnv(ParallelEnv):
    """A game of marlyap's. Agents act in [-1, 1] and observe what their policies would.

    Rewards are the game's own, one an agent. An episode is cut after `max_cycles` steps (by default
    the game's horizon) and ends where the game terminates or fails. `info["success"]` says whether
    the game counts the state as a success.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "name": "marlyap_v0",
        "is_parallelizable": True,
        "render_fps": 10,
    }

    def __init__(
        self,
        task: Any = "rendezvous",
        max_cycles: int | None = None,
        render_mode: Any = None,
        **fields: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode: '{render_mode}' must be rgb_array or None.")
        self.team = Team.of(task, **fields)
        self.render_mode, self.max_cycles = render_mode, max_cycles or self.team.game.horizon
        self.metadata = type(self).metadata | {"name": f"{self.team.name}_v0"}
        self.possible_agents = [f"agent_{i}" for i in range(self.team.agents)]
        self.agents: list[str] = []
        bound = lambda size: spaces.Box(-np.inf, np.inf, (size,), np.float32)
        seen, decided = bound(self.team.obs), spaces.Box(-1.0, 1.0, (self.team.du,), np.float32)
        self.observation_spaces = dict.fromkeys(self.possible_agents, seen)
        self.action_spaces = dict.fromkeys(self.possible_agents, decided)
        self.state_space = bound(self.team.size)
        self.draws = np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None):
        if seed is not None:
            self.draws = np.random.default_rng(seed)
        self.time, self.agents = 0, list(self.possible_agents)
        obs = self.team.reset(int(self.draws.integers(2**31)))
        return self._each(obs), {a: {} for a in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        self.time += 1
        given = np.stack([np.asarray(actions[a], np.float32) for a in self.agents])
        told = self.team.step(given)
        cut = not told.ended and self.time >= self.max_cycles
        obs, reward = self._each(told.obs), dict(zip(self.agents, told.reward, strict=True))
        ended, late = dict.fromkeys(self.agents, told.ended), dict.fromkeys(self.agents, cut)
        info = {a: {"success": told.success} for a in self.agents}
        if told.ended or cut:
            self.agents = []
        return obs, reward, ended, late, info

    def state(self) -> np.ndarray:
        """The features that the central critic sees, of all agents in a row."""
        return self.team.features

    def render(self) -> np.ndarray | None:
        return frame_of(self.team) if self.render_mode else None

    def close(self) -> None:
        self.agents = []

    def _each(self, rows: np.ndarray) -> dict[str, Any]:
        return dict(zip(self.possible_agents, rows, strict=True))


def parallel_env(task: Any = "rendezvous", **more: Any) -> MarlyapEnv:
    """The task as a `ParallelEnv`.

    Arguments: task, a name of `marlyap list` or a game; max_cycles, steps after which an episode is
    cut; render_mode, "rgb_array" or None; any field of the task, as in agents=5.
    Raises UserError for an unknown task or field.
    """
    return MarlyapEnv(task, **more)


def env(task: Any = "rendezvous", **more: Any) -> Any:
    """The task as an `AECEnv`, in which agents act one after the other; arguments as above."""
    return parallel_to_aec(parallel_env(task, **more))


def register() -> None:
    """Make every task of `marlyap list` known as marlyap/NAME-v0 to PettingZoo's registry."""
    from pettingzoo.env_registry import registration

    from marlyap.tasks import TASKS

    there = {"parallel": registration.parallel_registry, "aec": registration.aec_registry}
    for name in TASKS:
        for kind, maker in (("parallel", parallel_env), ("aec", env)):
            spec, made = f"marlyap/{name}-v0", functools.partial(maker, name)
            if spec not in there[kind]:
                registration.register(kind, spec, made)  # pyright: ignore
