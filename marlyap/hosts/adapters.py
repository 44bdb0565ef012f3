"""Environments of other libraries as copies: PettingZoo's parallel API and Gymnasium's."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from marlyap.errors import UserError, first_line
from marlyap.hosts.copies import AbstractEnvironment, View, missing
from marlyap.hosts.spec import Array, Side, Spec


SUCCESS = ("is_success", "success")  # what environments call it in their infos


class Parallel(AbstractEnvironment):
    """A PettingZoo `ParallelEnv`: all agents act at once, and may leave one by one."""

    def __init__(self, source: str, env: Any):
        self.env, self.names = env, tuple(env.possible_agents)
        if not self.names:
            raise UserError(f"task: {source} has no agents (possible_agents is empty).")
        sides = tuple(
            side(str(a), env.observation_space(a), env.action_space(a)) for a in self.names
        )
        obs, _ = env.reset(seed=0)
        self.there = list(env.agents)
        self.made = Spec(source, sides, self._size_of_state(obs))

    @property
    def spec(self):
        return self.made

    def reset(self, seed):
        obs, _ = self.env.reset(seed=seed)
        self.there = list(self.env.agents)
        return [self._of(obs, a, "observation") if a in self.there else None for a in self.names]

    def step(self, action):
        given = dict(zip(self.names, action, strict=True))
        before = self.there
        obs, reward, terminated, truncated, info = self.env.step({a: given[a] for a in before})
        self.there = list(self.env.agents)
        ended = {a: bool(self._of(terminated, a, "entry in terminations")) for a in before}
        cut = {a: bool(self._of(truncated, a, "entry in truncations")) for a in before}
        over = not self.there or all(ended[a] or cut[a] for a in before)
        return View(
            obs=[self._of(obs, a, "observation") if a in before else None for a in self.names],
            reward=[self._of(reward, a, "reward") if a in before else 0.0 for a in self.names],
            terminated=[ended.get(a, True) for a in self.names],
            over=over,
            cut=over and not all(ended.values()),
            active=[a in before for a in self.names],
            success=succeeded([info.get(a, {}) for a in before]) if over else float("nan"),
        )

    def state(self):
        return self.env.state()

    def frame(self):
        return self.env.render()

    def close(self):
        self.env.close()

    def _of(self, told: Mapping[str, Any], agent: str, what: str) -> Any:
        if not isinstance(told, Mapping) or agent not in told:
            raise missing(agent, what)
        return told[agent]

    def _size_of_state(self, obs: Mapping[str, Any]) -> int:
        """Of a state of its own; that of all observations in a row tells the critic nothing new."""
        try:
            state = np.asarray(self.env.state(), np.float32).ravel()
        except (NotImplementedError, AttributeError):
            return 0
        seen = np.concatenate([np.asarray(obs[a], np.float32).ravel() for a in self.there])
        return 0 if np.array_equal(state, seen) else state.size


class Single(AbstractEnvironment):
    """A Gymnasium environment: a team of one."""

    def __init__(self, source: str, env: Any):
        self.env = env
        alone = side("agent_0", env.observation_space, env.action_space)
        self.made = Spec(source, (alone,), 0)

    @property
    def spec(self):
        return self.made

    def reset(self, seed):
        return [self.env.reset(seed=seed)[0]]

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action[0])
        over = bool(terminated or truncated)
        cut = over and not terminated
        success = succeeded([info]) if over else float("nan")
        return View([obs], [reward], [bool(terminated)], over, cut, [True], success)

    def frame(self):
        return self.env.render()

    def close(self):
        self.env.close()


def side(name: str, seen: Any, decided: Any) -> Side:
    """One agent by its spaces. Raises UserError for a space that is not a box."""
    for what, space in (("observation", seen), ("action", decided)):
        if not hasattr(space, "low"):
            kind = type(space).__name__
            more = " (many environments have an argument for continuous actions)"
            raise UserError(
                f"task: agent {name} has an {what} space of kind {kind}, and only boxes can be "
                f"learnt here{more if what == 'action' else ''}; wrap the environment."
            )
    low, high = (np.asarray(x, float).ravel().tolist() for x in (decided.low, decided.high))
    return Side(name, int(np.prod(seen.shape)), tuple(low), tuple(high))


def succeeded(infos: Sequence[Mapping[str, Any]]) -> float:
    """1 or 0 where the infos of an episode's last step say so of every agent, else nan."""
    said = [bool(info[k]) for info in infos for k in SUCCESS if k in info]
    return float(all(said)) if said else float("nan")


def made(source: str, make: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """What a maker of environments makes with these arguments; what it raises is a sentence."""
    try:
        return make(**arguments)
    except ImportError as error:
        raise UserError(
            f"task: {source} needs a package that is missing ({first_line(error)})."
        ) from error
    except Exception as error:  # whatever others' code may raise
        raise UserError(f"task: {source} could not be made: {first_line(error)}.") from error


def flat(action: Sequence[Array]) -> Array:
    """All agents' numbers in a row."""
    return np.concatenate(list(action))
