"""A whole team in NumPy, many episodes at once, with what goes wrong on a real one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from marlyap.deploy.plant import coasted, step, within
from marlyap.deploy.runtime import Role, at_rest


PIECE = 0.005  # s, of the plant between two commands


@dataclass(frozen=True)
class Faults:
    """What goes wrong. The default is nothing, with the integrator of training."""

    pieces: bool = True  # the plant in steps of PIECE; else in one step of training
    stale: int = 0  # periods by which neighbours' messages are late
    loss: float = 0.0  # probability that a message is lost
    silent: str = "hold"  # what an old message becomes: hold (at rest) or absent
    command_delay: float = 0.0  # s, from the state to the command that it leads to
    noise: float = 0.0  # standard deviation of what is measured (m, rad, m/s, rad/s)
    stretch: float = 1.0  # periods are this many times as long
    dead: int | None = None  # this robot stops and falls silent ...
    dead_from: int = 0  # ... from this period on


NONE = Faults()


class Ears:
    """What each robot has last heard of each neighbour: [episode, agent, slot, message]."""

    def __init__(self, contract: dict[str, Any], episodes: int):
        roles = contract["roles"]
        number = {r["name"]: r["index"] for r in roles}
        slots = [[number.get(name, -1) for name in r["neighbours"]] for r in roles]
        self.slots = np.array(slots, int).reshape(len(roles), -1)
        self.exist = self.slots >= 0
        self.reach = contract["sight"]["reach"]
        shape = (episodes, *self.slots.shape)
        self.message = np.zeros((*shape, contract["sight"]["message"]), np.float32)
        self.age = np.full(shape, np.inf)  # periods
        timing = contract["timing"]
        self.oldest = round(timing["max_neighbour_age"] / timing["period"])

    def hear(self, sent: np.ndarray, arrives: np.ndarray, late: int) -> None:
        """Take what was sent [episode, agent, message], `late` periods ago, where it arrives."""
        new = arrives & self.exist[None]
        self.age = np.where(new, late, self.age + 1)
        self.message = np.where(new[..., None], sent[:, self.slots], self.message)

    def heard(self, here: np.ndarray, silent: str) -> tuple[np.ndarray, np.ndarray]:
        """Messages and presence as `Role.command` wants them."""
        old = self.age > self.oldest
        present = np.isfinite(self.age) & self.exist[None]
        if silent == "absent":
            present &= ~old
        message = np.where(old[..., None], at_rest(self.message), self.message)
        if self.reach is not None:
            gap = np.linalg.norm(message[..., :2] - here[:, :, None, :2], axis=-1)
            present &= gap <= self.reach
        return message, present


def simulate(
    contract: dict[str, Any],
    robots: list[Role],
    x: np.ndarray,
    goal: np.ndarray,
    faults: Faults = NONE,
    seed: int = 0,
    horizon: int | None = None,
) -> np.ndarray:
    """States [episode, time, agent, state] of the team, driven by its robots.

    Arguments: x [episode, agent, state] and goal [episode, agent, 2], the starts.
    """
    rng, period = np.random.default_rng(seed), contract["timing"]["period"] * faults.stretch
    steps = contract["domain"]["horizon"] if horizon is None else horizon
    ears, seen, sent = Ears(contract, len(x)), [x], []
    waiting = [np.zeros((*x.shape[:2], len(contract["action"]["channels"])), np.float32)]
    waiting *= 2 + int(faults.command_delay / period)
    for t in range(steps):
        dead = np.arange(x.shape[1]) == (-1 if faults.dead is None else faults.dead)
        dead &= t >= faults.dead_from
        measured = x + faults.noise * rng.standard_normal(x.shape).astype(np.float32)
        sent.append(np.stack([r.message(measured[:, i]) for i, r in enumerate(robots)], 1))
        arrives = rng.random((len(x), *ears.slots.shape)) >= faults.loss
        arrives &= ~dead[ears.slots][None] & (t >= faults.stale)
        ears.hear(sent[max(0, t - faults.stale)], arrives, faults.stale)
        heard, present = ears.heard(measured, faults.silent)
        command = [
            r.command(measured[:, i], goal[:, i], heard[:, i], present[:, i])[0]
            for i, r in enumerate(robots)
        ]
        brake = np.stack([r.fallback(x[:, i]) for i, r in enumerate(robots)], 1)
        waiting = [*waiting[1:], np.where(dead[None, :, None], brake, np.stack(command, 1))]
        x = moved(contract["plant"], x, waiting, period, faults)
        seen.append(x)
    return np.stack(seen, 1)


def moved(
    plant: dict[str, Any], x: np.ndarray, commands: list[np.ndarray], period: float, faults: Faults
) -> np.ndarray:
    """The team a period later; `commands` are the latest, the newest last."""
    if not faults.pieces:
        return step(plant, x, commands[-1], period)
    pieces = max(1, round(period / PIECE))
    dt = period / pieces
    whole, rest = divmod(round(faults.command_delay / dt), pieces)
    x = coasted(plant, x, commands[-2 - whole], dt, rest)  # the one before it still acts
    x = coasted(plant, x, commands[-1 - whole], dt, pieces - rest)
    if plant["kind"] == "LateUnicycle":
        x[..., 5:] = within(plant, commands[-1 - whole])
    return x


def distances(x: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """How far each robot is from its goal (m), for states [..., agent, state]."""
    return np.linalg.norm(x[..., :2] - goal, axis=-1)
