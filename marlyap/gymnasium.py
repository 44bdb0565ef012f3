"""Games of marlyap for everyone else: as Gymnasium environments.

`TeamEnv` is the whole team as one agent, `VectorEnv` many such teams stepped in one compiled
program. Needs the extra `marlyap[games]`.
"""

from typing import Any

import numpy as np

from marlyap.errors import UserError
from marlyap.outside import Team, Teams, frame_of


try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError(
        f"task: this needs gymnasium ({error}): pip install 'marlyap[games]'."
    ) from None


class TeamEnv(gymnasium.Env):
    """A task whose team is one agent: it observes what all observe, and is paid their mean reward.

    Arguments: task, a name of `marlyap list` or a game; max_cycles, steps after which an episode is
    cut (by default the game's horizon); render_mode, "rgb_array" or None; any field of the task.
    Raises UserError for an unknown task or field.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        task: Any = "rendezvous",
        max_cycles: int | None = None,
        render_mode: str | None = None,
        **fields: Any,
    ):
        self.team = Team.of(task, **fields)
        self.render_mode, self.max_cycles = render_mode, max_cycles or self.team.game.horizon
        self.observation_space, self.action_space = _spaces(self.team)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.time = 0
        obs = self.team.reset(int(self.np_random.integers(2**31)))
        return obs.ravel(), {}

    def step(self, action: Any):
        self.time += 1
        rows = np.asarray(action, np.float32).reshape(self.team.agents, self.team.du)
        told = self.team.step(rows)
        cut = not told.ended and self.time >= self.max_cycles
        info = {"success": told.success}
        return told.obs.ravel(), float(np.mean(told.reward)), told.ended, cut, info

    def render(self):
        return frame_of(self.team) if self.render_mode else None


class VectorEnv(gymnasium.vector.VectorEnv):
    """So many teams, each as one agent, stepped in one compiled program.

    A team whose episode has ended begins the next one in the same step; what the ended one led to
    is `infos["final_obs"]`. Arguments as those of `TeamEnv`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: Any = "rendezvous",
        num_envs: int = 16,
        max_cycles: int | None = None,
        **fields: Any,
    ):
        self.teams = Teams(Team.of(task, **fields), num_envs, max_cycles)
        self.num_envs, self.render_mode = num_envs, None
        self.single_observation_space, self.single_action_space = _spaces(self.teams.team)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        obs = self.teams.reset(int(self.np_random.integers(2**31)))
        return obs.reshape(self.num_envs, -1), {}

    def step(self, actions: Any):
        rows = np.asarray(actions, np.float32)
        told = self.teams.step(rows.reshape(self.num_envs, self.teams.team.agents, -1))
        wide = lambda obs: obs.reshape(self.num_envs, -1)
        info: dict[str, Any] = {"success": told.success}
        over = told.ended | told.cut
        if over.any():
            final = np.empty(self.num_envs, object)
            for k in np.flatnonzero(over):
                final[k] = wide(told.final)[k]
            info |= {"final_obs": final, "_final_obs": over}
        return wide(told.obs), told.reward.mean(axis=1), told.ended, told.cut, info


def _spaces(team: Team) -> tuple[spaces.Box, spaces.Box]:
    seen, decided = (team.agents * team.obs,), (team.agents * team.du,)
    return (
        spaces.Box(-np.inf, np.inf, seen, np.float32),
        spaces.Box(-1.0, 1.0, decided, np.float32),
    )


def register() -> None:
    """Make every task of `marlyap list` known as marlyap/NAME-v0 to Gymnasium's registry."""
    from marlyap.tasks import TASKS

    for name in TASKS:
        gymnasium.register(
            f"marlyap/{name}-v0",
            entry_point="marlyap.gymnasium:TeamEnv",
            vector_entry_point="marlyap.gymnasium:VectorEnv",
            kwargs={"task": name},
        )
