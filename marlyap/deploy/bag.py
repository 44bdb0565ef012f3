"""An episode of a run as an MCAP file with ROS 2 messages. Needs rosbags, of `robots`."""

import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from marlyap.deploy import ros2
from marlyap.deploy.extras import needs
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.runs.run import Run
from marlyap.seeds import stream
from marlyap.simulation.evaluation import episode
from marlyap.storage import store


Line = tuple[int, str, str, bytes]  # ns, topic, kind, CDR


def write(
    run: Run, out: Path, number: int = 0, seed: int = 0, game: AbstractGame | None = None
) -> int:
    """Write one evaluation episode as `out`; returns how many messages there are.

    Topics: /agent_i/odom (Odometry), /agent_i/cmd_accel (AccelStamped) or cmd_vel (TwistStamped),
    /agent_i/goal (PointStamped) of each leader, at the start.
    Raises UserError for a game that is not of robots in the plane, and without rosbags.
    """
    bags = needs("rosbags.rosbag2", "bag", "rosbags")
    types = needs("rosbags.typesys", "bag", "rosbags")
    if out.exists():
        raise UserError(f"out: {out} already exists; choose another file.")
    lines = recorded(run, (run.game if game is None else game).nominal, number, seed)
    kinds = types.get_typestore(types.Stores.ROS2_JAZZY)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder, "bag")
        plugin = bags.StoragePlugin.MCAP
        with bags.Writer(place, version=9, storage_plugin=plugin) as writer:
            known: dict[str, Any] = {}
            for stamp, topic, kind, raw in lines:
                if topic not in known:
                    known[topic] = writer.add_connection(topic, kind, typestore=kinds)
                writer.write(known[topic], stamp, raw)
        made = next(place.glob("*.mcap")).read_bytes()
    store.write_bytes_atomic(out, lambda file: file.write(made))
    return len(lines)


def recorded(run: Run, game: AbstractGame, number: int, seed: int) -> list[Line]:
    """The messages of an episode in their order."""
    if not 0 <= number < 500:
        raise UserError(f"episode: {number} is out of range; the evaluation has 0 to 499.")
    states, inputs = [s.name for s in game.plant.states], [u.name for u in game.plant.inputs]
    if game.sight() is None or not {"x", "y"} <= {*states}:
        raise UserError(f"bag: {type(game).__name__} is no game of robots in the plane.")
    start = jax.random.split(stream(seed, "evaluate"), 500)[number]
    path = eqx.filter_jit(episode)(game, run.controller(game), start)
    scene = jax.vmap(game.scene)(path.state)
    u = np.asarray(jax.vmap(game.plant.inputs_of)(path.action))
    place, velocity, goal = (
        np.asarray(getattr(scene, k)) for k in ("position", "velocity", "goal")
    )
    x, lines = np.asarray(path.state.x), []
    turn = {k: states.index(k) for k in ("psi", "omega") if k in states}
    of = lambda k, t, i: float(x[t, i, turn[k]]) if k in turn else 0.0
    for t in range(len(x)):
        stamp = round(t * game.dt * 1e9)
        for i in range(game.agents):
            robot, yaw = f"agent_{i}", of("psi", t, i)
            c, s = np.cos(yaw), np.sin(yaw)
            vx, vy = velocity[t, i]
            pose, twist = (*place[t, i], yaw), (c * vx + s * vy, c * vy - s * vx, of("omega", t, i))
            raw = ros2.odometry(stamp, robot, pose, twist)
            lines.append((stamp, f"/{robot}/{ros2.ODOM_TOPIC}", ros2.ODOMETRY, raw))
            if t < len(u):
                topic, kind, raw = ros2.command(stamp, robot, inputs, u[t, i])
                lines.append((stamp, f"/{robot}/{topic}", kind, raw))
            if t == 0 and game.leads[i]:
                point = ros2.Message(0, ("odom",), np.array([*goal[0, i], 0.0]))
                raw = ros2.encode(ros2.POINT, point)
                lines.append((0, f"/{robot}/{ros2.GOAL_TOPIC}", ros2.POINT, raw))
    return lines
