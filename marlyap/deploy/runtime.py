"""One robot of a trained team, with NumPy alone: what it measures and hears in, its command out.

    import runtime
    robot = runtime.Role.load("bundle", "agent_0")
    command, is_fallback = robot.command(state, goal, neighbours, present, age)

Every bundle has a copy of this file. It needs neither JAX nor marlyap. `contract.json` says what
the numbers are: names, units, frames, order, limits.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np


TYPES = {"F32": "<f4", "F64": "<f8", "I32": "<i4", "U8": "u1", "BOOL": "?"}  # of safetensors
FLOAT = np.float32


class Role:
    """One robot of the team. Leading axes of what it is given are a batch.

    Arguments: contract, of the bundle; arrays, its weights by name; name, such as agent_0.
    """

    def __init__(self, contract, arrays, name):
        self.contract: dict[str, Any] = contract
        self.role: dict[str, Any] = next((r for r in contract["roles"] if r["name"] == name), {})
        if not self.role:
            names = ", ".join(r["name"] for r in contract["roles"])
            raise ValueError(f"role: there is none called {name!r}; there is {names}.")
        net, count = self.role["network"], contract["action"]["layers"]
        pick = lambda k, what: np.ascontiguousarray(arrays[f"{net}.{k}.{what}"].T, FLOAT)
        self.layers = [(pick(k, "weight"), pick(k, "bias")) for k in range(count)]
        self.limits = np.array([c["limit"] for c in contract["action"]["channels"]], FLOAT)
        self.max_age = contract["timing"]["max_own_age"]
        self.brake = np.array(contract["fallback"]["gain"], FLOAT).T  # [state, input]
        if sight := contract["sight"]:
            self.leads = bool(self.role["leads"])
            self.shift, self.slots = self.role["shift"], len(self.role["shift"])
            self.scale = sight["scale"]
            self.heading, self.rates = sight["heading"], sight["rates"]
            self.along, self.velocity = sight["along"], sight["velocity"]
            self.tells = sight["message"]

    @classmethod
    def load(cls, bundle, name):
        """The robot called `name` of the bundle in a folder, as its contract has it."""
        contract = json.loads((Path(bundle) / "contract.json").read_text())
        return cls(contract, read_arrays(Path(bundle) / "weights.safetensors"), name)

    def command(self, own, goal=None, neighbours=None, present=None, age=0.0):
        """The command, in its units, and whether it is the fallback.

        Arguments: own [state], its own state; goal [2] (m), or None where it is told none;
        neighbours [slot, message] and present [slot], what it has heard, in the order of the
        contract; age (s), of its own state. The fallback comes where a number that counts is not
        finite, where a leader has no goal, or where its own state is too old. Slots that are not
        present may hold anything.
        """
        own = np.asarray(own, FLOAT)
        one = own.ndim == 1
        parts = floats if one else columns
        x, blank = parts(own), [0.0] * self.tells
        there, heard = [0.0] * self.slots, [blank] * self.slots
        if neighbours is not None:
            there = parts(np.asarray(present, FLOAT))
            neighbours = np.asarray(neighbours, FLOAT)
            heard = seen_by_one(neighbours, there, blank) if one else seen(neighbours, present)
        counts = sum(x) + sum(map(sum, heard))
        if self.leads:
            goal = [np.nan] * 2 if goal is None else parts(np.asarray(goal, FLOAT))
            counts = counts + sum(goal)
        with_age = np.asarray(age) <= self.max_age if not one else age <= self.max_age
        if one:
            if math.isfinite(counts) and with_age:
                u = self.decide(np.array(self.observe(x, goal, heard, there, math), FLOAT))
                if math.isfinite(u.sum()):
                    return u, False
            return self.fallback(own), True
        with np.errstate(all="ignore"):
            sight = np.broadcast_arrays(*self.observe(x, goal, heard, there, np))
            u = self.decide(np.stack(sight, -1).astype(FLOAT))
        sound = np.isfinite(counts) & with_age & np.isfinite(u.sum(-1))
        return np.where(sound[..., None], u, self.fallback(own)), ~sound

    def command_of(self, observation, age=0.0):
        """As `command`, for a policy whose observation is made elsewhere: [..., size]."""
        observation = np.asarray(observation, FLOAT)
        sound = np.isfinite(observation.sum(-1)) & (np.asarray(age) <= self.max_age)
        with np.errstate(all="ignore"):
            u = self.decide(observation)
        sound = sound & np.isfinite(u.sum(-1))
        return np.where(sound[..., None], u, FLOAT(0)), ~sound

    def fallback(self, own):
        """The brake: what stops the robot within a period, as far as its limits allow."""
        known = np.where(np.isfinite(own), own, FLOAT(0))
        return np.clip(known @ self.brake, -self.limits, self.limits)

    def observe(self, x, goal, heard, there, lib):
        """The entries of the observation, each a float or an array over the batch.

        Arguments: x, the entries of the own state; goal, two; heard, those of each slot's message;
        there, 1 or 0 for each slot; lib, math or NumPy.
        """
        c, s = self.ahead(x, lib)

        def turned(a, b):
            return a * c + b * s, b * c - a * s

        def gap(a, b):
            a, b = turned(a, b)
            size = lib.sqrt(a * a + b * b + 1e-12) + self.scale
            return a, b, a / size, b / size

        out = [x[k] for k in self.rates]
        out.append(1.0 if self.leads else 0.0)
        out += gap(goal[0] - x[0], goal[1] - x[1]) if self.leads else (0.0, 0.0, 0.0, 0.0)
        for m, present, shift in zip(heard, there, self.shift, strict=True):
            entries = [1.0, *gap(m[0] - x[0] + shift[0], m[1] - x[1] + shift[1])]
            for k in range(2, self.tells, 2):
                entries += turned(m[k], m[k + 1])
            out += [present * entry for entry in entries]
        return out

    def ahead(self, x, lib):
        """The robot's first axis in the world."""
        if self.heading is None:
            return 1.0, 0.0
        return lib.cos(x[self.heading]), lib.sin(x[self.heading])

    def decide(self, observation):
        """The command [..., input] that the network gives for observations [..., size]."""
        x = observation
        for weight, bias in self.layers[:-1]:
            x = x @ weight
            x += bias
            np.maximum(x, 0, out=x)
        weight, bias = self.layers[-1]
        return self.limits * np.tanh(x @ weight + bias)

    def message(self, own):
        """What the robot tells its neighbours [..., message]: place, velocity, heading."""
        own = np.asarray(own, FLOAT)
        x = columns(own)
        c, s = self.ahead(x, np)
        velocity = [x[k] for k in self.velocity] or [0.0, 0.0]
        if self.along is not None:
            velocity = [x[self.along] * c, x[self.along] * s]
        told = [x[0], x[1], *velocity, c, s][: self.tells]
        return np.stack(np.broadcast_arrays(*told), -1).astype(FLOAT)


def floats(array):
    """The entries of a vector."""
    return array.tolist()


def columns(array):
    """The entries of many vectors [..., entry], each an array."""
    return [array[..., k] for k in range(array.shape[-1])]


def seen_by_one(messages, there, blank):
    """What counts of messages [slot, message], as lists."""
    return [m if p else blank for m, p in zip(messages.tolist(), there, strict=True)]


def seen(messages, present):
    """What counts of messages [..., slot, message], as arrays over the batch by slot and entry."""
    counts = np.where(np.asarray(present, bool)[..., None], messages, FLOAT(0))
    return [columns(counts[..., k, :]) for k in range(counts.shape[-2])]


def read_arrays(path):
    """The arrays of a safetensors file by name."""
    raw = Path(path).read_bytes()
    (length,) = struct.unpack("<Q", raw[:8])
    body, found = raw[8 + length :], {}
    for name, entry in json.loads(raw[8 : 8 + length]).items():
        start, end = entry["data_offsets"]
        found[name] = np.frombuffer(body[start:end], TYPES[entry["dtype"]]).reshape(entry["shape"])
    return found


def at_rest(message):
    """A message as it would be if its sender stood where it was last heard."""
    still = np.array(message, FLOAT)
    still[..., 2:4] = 0
    return still


def answers(robot, given):
    """Commands [pair, input] and fallbacks [pair] for golden pairs, each asked for alone."""
    found = []
    for k in range(len(given["own"])):
        own, age = given["own"][k], given["age"][k]
        if robot.contract["sight"]:
            goal = given["goal"][k] if given["told"][k] else None
            heard = given["neighbours"][k], given["present"][k]
            found.append(robot.command(own, goal, *heard, age))
        else:
            found.append(robot.command_of(own, age))
    return np.stack([u for u, _ in found]), np.array([bool(f) for _, f in found])
