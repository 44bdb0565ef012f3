"""The wire of ROS 2: byte for byte as an independent library writes it, and read back by it."""

import numpy as np
import pytest

from marlyap.cli import main
from marlyap.deploy import contract as contracts, ros2, wire
from marlyap.deploy.agent import Agent, Ways
from marlyap.deploy.bus import Hub, LocalBus
from marlyap.deploy.runtime import Role
from marlyap.errors import UserError


@pytest.fixture(scope="module")
def types():
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def as_rosbags(types, kind, message):
    """The same message as rosbags has it."""
    t, n = types.types, np.array(message.numbers)
    sec, ns = divmod(message.stamp, 10**9)
    stamp = t["builtin_interfaces/msg/Time"](sec, ns)
    header = t["std_msgs/msg/Header"](stamp, message.frames[0])
    vector = lambda v: t["geometry_msgs/msg/Vector3"](*v)
    if kind == ros2.POINT:
        return t[kind](header, t["geometry_msgs/msg/Point"](*n))
    if kind in (ros2.TWIST, ros2.ACCEL):
        inner = "Twist" if kind == ros2.TWIST else "Accel"
        return t[kind](header, t[f"geometry_msgs/msg/{inner}"](vector(n[:3]), vector(n[3:])))
    point = t["geometry_msgs/msg/Point"](*n[:3])
    pose = t["geometry_msgs/msg/Pose"](point, t["geometry_msgs/msg/Quaternion"](*n[3:7]))
    twist = t["geometry_msgs/msg/Twist"](vector(n[43:46]), vector(n[46:49]))
    poses = t["geometry_msgs/msg/PoseWithCovariance"](pose, n[7:43])
    return t[kind](
        header, message.frames[1], poses,
        t["geometry_msgs/msg/TwistWithCovariance"](twist, n[49:]),
    )  # fmt: skip


@pytest.mark.parametrize("kind", list(ros2.HASHES))
def test_the_bytes_are_those_of_rosbags(types, kind):
    rng = np.random.default_rng(0)
    letters = list("abcxyz_/0é")
    for _ in range(1000):
        frames = tuple(
            "".join(rng.choice(letters, rng.integers(0, 12))) for _ in range(ros2.FRAMES[kind])
        )
        numbers = rng.standard_normal(ros2.NUMBERS[kind]) * 10.0 ** rng.integers(-9, 9)
        message = ros2.Message(int(rng.integers(0, 2**60)), frames, numbers)
        raw = ros2.encode(kind, message)
        assert raw == bytes(types.serialize_cdr(as_rosbags(types, kind, message), kind))
        back = ros2.decode(kind, raw)
        assert (back.stamp, back.frames) == (message.stamp, frames)
        np.testing.assert_array_equal(back.numbers, numbers)


def test_the_hashes_are_those_of_the_definitions(types):
    for kind, digest in ros2.HASHES.items():
        assert types.hash_rihs01(kind) == f"RIHS01_{digest}"


def test_keys_and_attachments():
    key = ros2.topic_key(0, "robot0/odom", ros2.ODOMETRY)
    assert key.startswith("0/robot0/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_3cc97dc7")
    assert len(ros2.sender(1, 2, b"g" * 16)) == 33


def test_a_planar_robot_there_and_back():
    rng = np.random.default_rng(1)
    for x, y, psi, v, omega in rng.uniform(-3, 3, (50, 5)):
        raw = ros2.odometry(5, "r", (x, y, psi), (v, 0.0, omega))
        names = ["x", "y", "psi", "v", "omega"]
        np.testing.assert_allclose(ros2.state_of(names, raw), [x, y, psi, v, omega], atol=1e-5)
        told = [x, y, v * np.cos(psi), v * np.sin(psi), np.cos(psi), np.sin(psi)]
        np.testing.assert_allclose(ros2.message_of(6, raw), told, atol=1e-5)
    with pytest.raises(UserError, match="does not hold a, r"):
        ros2.state_of(["x", "a", "r"], raw)


@pytest.mark.parametrize("raw", [b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(20), b"\0\0" + bytes(99)])
def test_what_is_no_message_is_refused(raw):
    with pytest.raises(UserError, match="are no nav_msgs/msg/Odometry"):
        ros2.decode(ros2.ODOMETRY, raw)


def test_an_agent_among_robots_of_ros(small_bundle):
    contract, hub, time = contracts.load(small_bundle), Hub(), [0.0]
    base, said = LocalBus(hub), []
    robot = Role.load(small_bundle, "agent_0")
    bus = ros2.RosBus(LocalBus(hub), contract, "agent_0")
    agent = Agent(robot, bus, "any", Ways(), lambda: time[0])
    key = ros2.topic_key(0, "agent_0/cmd_accel", ros2.ACCEL)
    base.on(key, lambda key, raw: said.append(ros2.decode(ros2.ACCEL, raw)))
    tell = lambda name, x, y, v: base.put(
        ros2.topic_key(0, f"{name}/odom", ros2.ODOMETRY),
        ros2.odometry(77, name, (x, y, 0.0), (v, 0.0, 0.0)),
    )
    goal = ros2.encode(ros2.POINT, ros2.Message(0, ("odom",), np.array([1.0, 2.0, 0.0])))
    base.put(ros2.topic_key(0, "agent_0/goal", ros2.POINT), goal)
    tell("agent_0", 0.0, 0.0, 0.5)
    tell("agent_1", 1.0, 0.0, 0.25)
    tell("agent_2", 0.0, 1.0, 0.0)
    base.put(ros2.topic_key(0, "agent_2/odom", ros2.ODOMETRY), b"nonsense")
    agent.poll()
    own, near = [0, 0, 0, 0.5, 0], [[1.0, 0, 0.25, 0], [0, 1.0, 0, 0]]
    wanted, _ = robot.command(own, [1.0, 2.0], near, [1, 1])
    assert said[0].stamp == 77 and said[0].frames == ("agent_0/base_link",)
    np.testing.assert_allclose(said[0].numbers[[0, 5]], wanted, atol=1e-6)
    assert wire.COMMAND == "command" and len(said) == 1


def test_a_bag_is_read_back_by_rosbags(types, small_run, tmp_path, capsys):
    from rosbags.highlevel import AnyReader

    out = tmp_path / "episode.mcap"
    words = ["bag", str(small_run.directory), "--episode", "1", "--out", str(out)]
    assert main(words) == 0
    assert "64 messages" in capsys.readouterr().err  # 3 (11 states + 10 commands), one goal
    assert main(words) == 2 and "already exists" in capsys.readouterr().err
    with AnyReader([out], default_typestore=types) as reader:
        found = [
            (c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()
        ]
    topics = {topic for topic, _, _ in found}
    assert len(found) == 64 and "/agent_0/goal" in topics and "/agent_2/cmd_accel" in topics
    odom = [m for topic, _, m in found if topic == "/agent_1/odom"]
    assert odom[0].child_frame_id == "agent_1/base_link" and len(odom) == 11
    assert odom[0].twist.twist.linear.x == 0.0  # at rest at first


def test_without_rosbags_the_mend_is_said(small_run, tmp_path, monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    assert main(["bag", str(small_run.directory), "--out", str(tmp_path / "e.mcap")]) == 2
    assert "pip install 'marlyap[robots]'" in capsys.readouterr().err
