"""What a game outside JAX is, in NumPy: its sizes, a step of several copies, and who plays it.

A row is all that one copy tells after a reset or a step, in float32, one number after the other, so
that a copy in this process and a copy in another are told in the same way.
"""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marlyap.errors import UserError


Array = np.ndarray


class Side(NamedTuple):
    """One agent: how many numbers it observes, and between which bounds it decides."""

    name: str
    obs: int
    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def du(self) -> int:
        """How many numbers it decides."""
        return len(self.low)


class Spec(NamedTuple):
    """What a game is before it has been played."""

    source: str  # as the user typed it
    sides: tuple[Side, ...]
    state: int  # numbers of the global state; 0 where the game has none of its own

    @property
    def agents(self) -> int:
        return len(self.sides)

    @property
    def obs(self) -> int:
        """Numbers in a row of observations: those of the agent that observes most."""
        return max(side.obs for side in self.sides)

    @property
    def du(self) -> int:
        """Numbers in a row of actions: those of the agent that decides most."""
        return max(side.du for side in self.sides)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(side.name for side in self.sides)


class Step(NamedTuple):
    """What all copies tell after one step. Rows of small agents are padded with zeros.

    A copy whose episode has ended has begun the next one: `obs` and `state` are its first, and
    `final_obs` and `final_state` what the ended episode led to (of all other copies they are `obs`
    and `state` again).
    """

    obs: Array  # [copy agent obs] float32
    state: Array  # [copy state] float32
    reward: Array  # [copy agent] float32
    terminated: Array  # [copy agent] bool: nothing follows for this agent
    truncated: Array  # [copy] bool: the episode was cut; what would follow counts
    active: Array  # [copy agent] bool: it was there when the step began
    final_obs: Array  # [copy agent obs] float32
    final_state: Array  # [copy state] float32
    success: Array  # [copy] float32: 1 or 0 where an episode ended and the game says so, else nan

    @property
    def ended(self) -> Array:
        """[copy] bool: whether the episode is over, for whatever reason."""
        return self.truncated | np.all(self.terminated | ~self.active, axis=1)


class AbstractHostGame(abc.ABC):
    """Several copies of a game that are stepped together; each begins anew when it has ended."""

    @property
    @abc.abstractmethod
    def spec(self) -> Spec:
        """Its sizes."""

    @property
    @abc.abstractmethod
    def copies(self) -> int:
        """How many are stepped together."""

    @abc.abstractmethod
    def reset(self, seed: int, episodes: Sequence[int]) -> tuple[Array, Array]:
        """Copy c begins its episode number `episodes[c]`; later ones are counted on from there.

        How an episode begins follows from the seed, the copy and the episode's number alone.
        Returns observations [copy agent obs] and states [copy state].
        """

    @abc.abstractmethod
    def step(self, action: Array) -> Step:
        """One step of every copy; `action` [copy agent du] lies in [-1, 1]."""

    def frame(self) -> Array | None:
        """What the first copy looks like now, uint8 [height width 3]; None where it cannot say."""
        return None

    @abc.abstractmethod
    def close(self) -> None:
        """End it, and its processes. It can be called twice."""

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Fault(UserError):
    """A game outside JAX did what no game may do. The message names copy, agent and step."""


def fault(copy: int, step: int, what: str, agent: str = "") -> Fault:
    """The one sentence about it."""
    who = f", agent {agent}" if agent else ""
    when = f"step {step}" if step else "reset"
    return Fault(
        f"task: copy {copy}{who}, {when}: {what}; correct the environment, then resume from the "
        "last checkpoint."
    )


def episode_seed(seed: int, copy: int, episode: int) -> int:
    """The seed of one episode, below 2^31: by copy, so that processes do not matter."""
    words = np.random.SeedSequence([seed, copy, episode]).generate_state(1)
    return int(words[0]) >> 1


class Layout:
    """Where each part of a `Step` lies in a row."""

    def __init__(self, spec: Spec):
        n, o, s = spec.agents, spec.obs, spec.state
        sizes = [n * o, s, n, n, 1, n, n * o, s, 1]
        ends = np.cumsum(sizes)
        self.parts = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self.spec, self.size, self.agents, self.obs = spec, int(ends[-1]), n, o

    def read(self, rows: Array) -> Step:
        """The step that the rows [copy number] tell."""
        part = [rows[:, where] for where in self.parts]
        wide = lambda x: x.reshape(len(rows), self.agents, self.obs)
        return Step(
            obs=wide(part[0]),
            state=part[1],
            reward=part[2],
            terminated=part[3] != 0,
            truncated=part[4][:, 0] != 0,
            active=part[5] != 0,
            final_obs=wide(part[6]),
            final_state=part[7],
            success=part[8][:, 0],
        )


class Bounds:
    """[-1, 1] to what each agent may do, linearly, and the padding left out."""

    def __init__(self, spec: Spec):
        for side in spec.sides:
            if not np.isfinite([*side.low, *side.high]).all():
                raise UserError(
                    f"task: agent {side.name} of {spec.source} has an action without bounds; wrap "
                    "the environment so that its actions lie in a finite box."
                )
        wide = lambda x: np.pad(np.asarray(x, np.float32), (0, spec.du - len(x)))
        self.low = np.stack([wide(side.low) for side in spec.sides])
        self.high = np.stack([wide(side.high) for side in spec.sides])
        self.middle, self.half = (self.low + self.high) / 2, (self.high - self.low) / 2
        self.sizes = [side.du for side in spec.sides]

    def __call__(self, action: Array) -> list[Array]:
        """Of [*axes agent du], what each agent decides [*axes number], in its own units."""
        scaled = np.clip(self.middle + self.half * action, self.low, self.high)
        return [scaled[..., k, :size] for k, size in enumerate(self.sizes)]
