"""What is said over the bus: keys with the team's name in them, and packed numbers.

marlyap/TEAM/ROBOT/odometry   what the robot's own sensors say       simulator -> robot
marlyap/TEAM/ROBOT/goal       for a leader                           simulator -> robot
marlyap/TEAM/ROBOT/message    place, velocity, perhaps heading       robot -> neighbours
marlyap/TEAM/ROBOT/command    its inputs                             robot -> simulator
marlyap/TEAM/ROBOT/alive      a token, as long as the robot is there
marlyap/TEAM/ROBOT/figures    what it measured of itself, at the end robot -> simulator
marlyap/TEAM/all/stop         the end                                simulator -> robots

Every packet begins with session, episode and tick. The session is drawn when a sender starts, so
that one that starts again is not taken for an old one. There is no time in a packet: whoever
receives it goes by its own clock.
"""

import re
import struct
from typing import NamedTuple

import numpy as np

from marlyap.errors import UserError


HEAD = struct.Struct("<IIIB")
ODOMETRY, GOAL, MESSAGE, COMMAND = "odometry", "goal", "message", "command"
ALIVE, FIGURES, STOP, ALL = "alive", "figures", "stop", "all"


class Packet(NamedTuple):
    """Some numbers of one instant."""

    session: int
    episode: int
    tick: int  # periods since the start
    flag: bool  # of a command: whether it is the fallback
    numbers: np.ndarray

    def follows(self, other: "Packet | None") -> bool:
        """Whether this is newer than the other, of the same sender."""
        if other is None or other.session != self.session:
            return True
        return (self.episode, self.tick) > (other.episode, other.tick)


def key(team: str, robot: str, what: str) -> str:
    """Where something is said."""
    return f"marlyap/{team}/{robot}/{what}"


def robot_of(path: str) -> str:
    """Whose key it is."""
    return path.split("/")[2]


def what_of(path: str) -> str:
    """What it is about."""
    return path.split("/")[3]


def team_name(name: str) -> str:
    """The name, if it can be part of a key. Raises UserError."""
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise UserError(f"team: '{name}' must be 1 to 64 letters, digits, - or _.")
    return name


def pack(packet: Packet) -> bytes:
    """As it is sent."""
    head = HEAD.pack(packet.session, packet.episode, packet.tick, packet.flag)
    return head + np.asarray(packet.numbers, "<f4").tobytes()


def unpack(payload: bytes, count: int) -> Packet | None:
    """What was sent; None where it is no packet of so many numbers."""
    if len(payload) != HEAD.size + 4 * count:
        return None
    session, episode, tick, flag = HEAD.unpack(payload[: HEAD.size])
    return Packet(session, episode, tick, bool(flag), np.frombuffer(payload[HEAD.size :], "<f4"))
