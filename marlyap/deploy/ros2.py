"""The wire of ROS 2 without ROS: CDR messages, and the keys that rmw_zenoh gives its topics.

Written from the message definitions, the CDR of OMG's DDS-XTypes and rmw_zenoh's description of its
keys; the bytes are compared with those of rosbags by the tests. No robot with ROS 2 was driven.
"""

import math
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from marlyap.deploy import wire
from marlyap.deploy.bus import Bus
from marlyap.deploy.wire import Packet
from marlyap.errors import UserError


START = b"\x00\x01\x00\x00"  # of CDR, little endian
# The hash of each message's definition (REP 2016): a part of the key
HASHES = {
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/TwistStamped": (
        "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
    ),
    "geometry_msgs/msg/AccelStamped": (
        "ef1df9eabae0a708cc049a061ebcddc4e2a5f745730100ba680e086a9698b165"
    ),
    "geometry_msgs/msg/PointStamped": (
        "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"
    ),
}
ODOMETRY, TWIST, ACCEL, POINT = HASHES
ODOM_TOPIC, ACCEL_TOPIC, TWIST_TOPIC, GOAL_TOPIC = "odom", "cmd_accel", "cmd_vel", "goal"
NUMBERS = {ODOMETRY: 85, TWIST: 6, ACCEL: 6, POINT: 3}  # after the header and the frames
FRAMES = {ODOMETRY: 2, TWIST: 1, ACCEL: 1, POINT: 1}


class Message(NamedTuple):
    """A stamped message: its time, its frames, and its numbers in the order of its definition."""

    stamp: int  # ns
    frames: tuple[str, ...]  # frame_id; of an Odometry child_frame_id too
    numbers: np.ndarray  # float64


def encode(kind: str, message: Message) -> bytes:
    """The message as CDR. Raises UserError for another number of frames or of numbers."""
    if (len(message.frames), len(message.numbers)) != (FRAMES[kind], NUMBERS[kind]):
        raise UserError(f"ros: a {kind} has {FRAMES[kind]} frames and {NUMBERS[kind]} numbers.")
    body = struct.pack("<iI", *divmod(message.stamp, 10**9))
    for frame in message.frames:
        text = frame.encode() + b"\0"
        body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(text)) + text
    body += b"\0" * (-len(body) % 8)
    return START + body + np.asarray(message.numbers, "<f8").tobytes()


def decode(kind: str, raw: bytes) -> Message:
    """What `encode` wrote. Raises UserError for bytes that are no such message."""
    wrong = UserError(f"ros: these {len(raw)} bytes are no {kind} in little-endian CDR.")
    if raw[:4] != START or len(raw) < 12:
        raise wrong
    body, at, frames = raw[4:], 8, []
    sec, ns = struct.unpack_from("<iI", body)
    for _ in range(FRAMES[kind]):
        at += -at % 4
        if at + 4 > len(body):
            raise wrong
        (size,) = struct.unpack_from("<I", body, at)
        text, at = body[at + 4 : at + 4 + size], at + 4 + size
        if size < 1 or len(text) != size or text[-1]:
            raise wrong
        frames.append(text[:-1].decode(errors="replace"))
    at += -at % 8
    if len(body) - at != 8 * NUMBERS[kind]:
        raise wrong
    return Message(sec * 10**9 + ns, tuple(frames), np.frombuffer(body, "<f8", offset=at))


def topic_key(domain: int, topic: str, kind: str) -> str:
    """The key under which rmw_zenoh says a topic, such as robot/odom."""
    package, _, name = kind.split("/")
    return f"{domain}/{topic}/{package}::msg::dds_::{name}_/RIHS01_{HASHES[kind]}"


def sender(sequence: int, stamp: int, gid: bytes) -> bytes:
    """What goes with a message: its number, its time (ns), and 16 bytes that name the sender."""
    return struct.pack("<qqB16s", sequence, stamp, 16, gid)


def odometry(stamp: int, robot: str, pose: Any, twist: Any) -> bytes:
    """A nav_msgs/Odometry: pose x, y (m), yaw (rad) in `odom`; twist vx, vy, omega of the body."""
    numbers = np.zeros(85)
    numbers[:2] = pose[:2]
    numbers[5], numbers[6] = math.sin(pose[2] / 2), math.cos(pose[2] / 2)
    numbers[43:45], numbers[48] = twist[:2], twist[2]
    return encode(ODOMETRY, Message(stamp, ("odom", f"{robot}/base_link"), numbers))


def planar(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of an Odometry: x, y, yaw; vx and vy in the world, and omega."""
    x, y, z, w = numbers[3:7]
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    c, s = math.cos(yaw), math.sin(yaw)
    ahead, left, omega = numbers[43], numbers[44], numbers[48]
    world = np.array([c * ahead - s * left, s * ahead + c * left, omega])
    return np.array([numbers[0], numbers[1], yaw]), world


def state_of(names: list[str], raw: bytes) -> np.ndarray:
    """A robot's own state, of its Odometry. Raises UserError for a state that it does not hold."""
    pose, twist = planar(decode(ODOMETRY, raw).numbers)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    known = {"x": pose[0], "y": pose[1], "psi": pose[2], "omega": twist[2]}
    known |= {"vx": twist[0], "vy": twist[1], "v": c * twist[0] + s * twist[1]}
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"ros: an Odometry does not hold {', '.join(unknown)} of the state.")
    return np.array([known[name] for name in names], np.float32)


def message_of(tells: int, raw: bytes) -> np.ndarray:
    """What a neighbour's Odometry tells: place, velocity and perhaps heading in the world."""
    pose, twist = planar(decode(ODOMETRY, raw).numbers)
    all_of_it = [*pose[:2], *twist[:2], math.cos(pose[2]), math.sin(pose[2])]
    return np.array(all_of_it[:tells], np.float32)


def command(stamp: int, robot: str, inputs: list[str], u: np.ndarray) -> tuple[str, str, bytes]:
    """Topic, kind and bytes of a robot's inputs.

    Accelerations go as AccelStamped in the robot's frame: a or ax as linear.x, ay as linear.y, r as
    angular.z. Velocities (vx, vy) go as TwistStamped.
    """
    places = {"a": 0, "ax": 0, "ay": 1, "r": 5, "vx": 0, "vy": 1}
    numbers = np.zeros(6)
    for name, value in zip(inputs, u, strict=True):
        numbers[places[name]] = value
    speeds = inputs[0] in ("vx", "vy")
    topic, kind = (TWIST_TOPIC, TWIST) if speeds else (ACCEL_TOPIC, ACCEL)
    return topic, kind, encode(kind, Message(stamp, (f"{robot}/base_link",), numbers))


class RosBus(Bus):
    """The bus of one agent, on which it meets ROS 2: odometry in, commands out.

    `/ROBOT/odom` of the robot and of its neighbours, and `/ROBOT/goal` of a leader, are heard;
    `/ROBOT/cmd_accel` (or `cmd_vel`) is said, with the stamp of the odometry that it answers.
    """

    def __init__(self, bus: Bus, contract: dict[str, Any], robot: str, domain: int = 0):
        self.bus, self.domain, self.robot = bus, domain, robot
        self.states = [s["name"] for s in contract["state"]]
        self.inputs = [u["name"] for u in contract["action"]["channels"]]
        self.tells = contract["sight"]["message"]
        state_of(self.states, odometry(0, robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        self.tick, self.stamp, self.count = 0, 0, 0
        self.gid = struct.pack("<16s", robot.encode()[:16])

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        if wire.what_of(key) != wire.COMMAND:
            return  # neighbours read our odometry, which the robot itself says
        packet = wire.unpack(payload, len(self.inputs))
        assert packet is not None
        topic, kind, raw = command(self.stamp, self.robot, self.inputs, packet.numbers)
        self.count += 1
        about = sender(self.count, time.time_ns(), self.gid)
        self.bus.put(topic_key(self.domain, f"{self.robot}/{topic}", kind), raw, about)

    def on(self, pattern: str, listener: Callable[[str, bytes], None]) -> None:
        robot, what = wire.robot_of(pattern), wire.what_of(pattern)
        if what in (wire.ODOMETRY, wire.MESSAGE):
            self.bus.on(
                topic_key(self.domain, f"{robot}/{ODOM_TOPIC}", ODOMETRY),
                self._odom(pattern, listener),
            )
        elif what == wire.GOAL:
            self.bus.on(
                topic_key(self.domain, f"{robot}/{GOAL_TOPIC}", POINT),
                self._goal(pattern, listener),
            )

    def _odom(self, pattern: str, listener: Callable[[str, bytes], None]) -> Callable[..., None]:
        own = wire.what_of(pattern) == wire.ODOMETRY

        def heard(_: str, raw: bytes) -> None:
            for message in _sound(ODOMETRY, raw):
                self.count += 1
                if own:
                    self.tick, self.stamp = self.tick + 1, message.stamp
                told = state_of(self.states, raw) if own else message_of(self.tells, raw)
                # A session of its own: the order of arrival counts, and no number of the sender.
                session = 1 if own else self.count
                listener(pattern, wire.pack(Packet(session, 0, self.tick, False, told)))

        return heard

    def _goal(self, pattern: str, listener: Callable[[str, bytes], None]) -> Callable[..., None]:
        def heard(_: str, raw: bytes) -> None:
            for message in _sound(POINT, raw):
                listener(pattern, wire.pack(Packet(1, 0, 0, False, message.numbers[:2])))

        return heard

    def alive(self, key: str) -> None:
        """Tokens of a node and its publisher, as rmw_zenoh has them."""
        self.bus.alive(f"@ros2_lv/{self.domain}/{self.robot}/0/0/NN/%/%/{self.robot}")

    def watch(self, pattern: str, watcher: Callable[[str, bool], None]) -> None:
        """ROS 2 keeps no such list."""

    def close(self) -> None:
        self.bus.close()


def _sound(kind: str, raw: bytes) -> Iterator[Message]:
    """The message, or nothing where these bytes are none."""
    try:
        yield decode(kind, raw)
    except UserError:
        return
