"""Teams of agents on a bus: in step they are the game; nobody's clock or other team matters."""

import time

import numpy as np
import pytest

from marlyap.deploy import contract as contracts, swarm, wire
from marlyap.deploy.agent import Agent, Ways
from marlyap.deploy.bus import Hub, LocalBus, matches
from marlyap.deploy.contract import STARTS, WEIGHTS
from marlyap.deploy.runtime import Role, at_rest, read_arrays
from marlyap.deploy.starts import Starts
from marlyap.deploy.swarm import Event, Play, Simulator, Together
from marlyap.deploy.team import Faults, distances, simulate
from marlyap.deploy.wire import Packet
from marlyap.errors import UserError


BY_CLOCK, USUAL = Play(), Ways()


@pytest.fixture(scope="module")
def contract(small_bundle):
    return contracts.load(small_bundle)


@pytest.fixture(scope="module")
def robots(small_bundle, contract):
    arrays = read_arrays(small_bundle / WEIGHTS)
    return [Role(contract, arrays, role["name"]) for role in contract["roles"]]


@pytest.fixture(scope="module")
def starts(small_bundle):
    return Starts(**read_arrays(small_bundle / STARTS))


def played(contract, robots, starts, play=BY_CLOCK, ways=USUAL, hub=None, team="red", episodes=3):
    """Episodes in one process, and the stage."""
    stage = Together(robots, team, ways, hub)
    simulator = Simulator(contract, robots, stage, team)
    done = [simulator.episode(k, starts.x[k], starts.goal[k], play) for k in range(episodes)]
    stage.close()
    return done, stage


def sent(x, tick=0, session=1, episode=0, flag=False):
    return wire.pack(Packet(session, episode, tick, flag, np.asarray(x, np.float32)))


class Bench:
    """One agent on a bus by itself, with a clock that the test moves."""

    def __init__(self, robot, ways=USUAL, offset=0.0, rate=1.0):
        self.time, self.offset, self.rate = 0.0, offset, rate
        self.hub = Hub()
        self.bus, self.said = LocalBus(self.hub), []
        self.agent = Agent(robot, LocalBus(self.hub), "red", ways, self.clock)
        self.bus.on("marlyap/red/*/command", lambda key, raw: self.said.append(wire.unpack(raw, 2)))

    def clock(self):
        return self.offset + self.rate * self.time

    def tell(self, robot, what, numbers, **kwargs):
        self.bus.put(wire.key("red", robot, what), sent(numbers, **kwargs))

    def at(self, seconds):
        """Let the agent look at this time."""
        self.time = seconds
        return self.agent.poll()


# --- The team ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("loss", "episodes"), [(0.0, 20), (0.5, 2)])
def test_in_step_it_is_the_game(contract, robots, starts, loss, episodes):
    ways = Ways(lock=True, loss=loss)
    done, stage = played(contract, robots, starts, Play(lock=True), ways, episodes=episodes)
    apart = max(np.abs(e.final - starts.final[k]).max() for k, e in enumerate(done))
    assert apart < 1e-4 and all(e.missed == 0 for e in done)
    assert {age for s in stage.said.values() for age in s["ages"]} == {"0"}


def test_many_at_once_are_the_game_too(contract, robots, starts):
    x = simulate(contract, robots, starts.x, starts.goal, Faults(pieces=False))
    np.testing.assert_allclose(distances(x[:, -1], starts.goal), starts.final, atol=1e-4)


def test_by_the_clock_it_is_nearly_the_game(contract, robots, starts):
    done, _ = played(contract, robots, starts)
    fine = simulate(contract, robots, starts.x[:3], starts.goal[:3])
    np.testing.assert_allclose([e.x[-1] for e in done], fine[:, -1], atol=0.5)
    assert all(e.missed == 0 and e.fallbacks == 0 for e in done)


def test_two_teams_on_one_bus_do_not_hear_each_other(contract, robots, starts):
    alone, _ = played(contract, robots, starts, Play(lock=True), Ways(lock=True))
    hub = Hub()
    other = Together(robots, "blue", Ways(lock=True), hub)
    other_simulator = Simulator(contract, robots, other, "blue")
    beside, _ = played(contract, robots, starts, Play(lock=True), Ways(lock=True), hub)
    blue = other_simulator.episode(0, starts.x[5], starts.goal[5], Play(lock=True))
    for a, b in zip(alone, beside, strict=True):
        np.testing.assert_array_equal(a.x, b.x)
    assert np.abs(blue.final - starts.final[5]).max() < 1e-4


def test_events_happen_to_robots(contract, robots, starts):
    events = (Event("agent_1", 0.3, "kill"), Event("agent_2", 0.5, "late"))
    done, stage = played(contract, robots, starts, Play(events=events))
    for episode in done:  # who died in one episode is there in the next
        assert episode.alive.tolist() == [True, False, True]
        np.testing.assert_array_equal(episode.x[5, 2], episode.x[0, 2])  # not there yet
        assert (episode.x[6:, 2] != episode.x[0, 2]).any()
        assert np.abs(episode.x[-1, 1, 3:]).max() < 0.5  # its drive has braked
    assert stage.said["agent_0"]["ages"]["old"] > 0


def test_a_pause_passes(contract, robots, starts):
    events = (Event("agent_1", 0.3, "pause", 0.25),)
    (episode,), _ = played(contract, robots, starts, Play(events=events), episodes=1)
    assert 1 <= episode.missed <= 3 and episode.alive.all()


def test_a_team_in_step_that_lost_a_robot_says_so(contract, robots, starts, monkeypatch):
    monkeypatch.setattr(swarm, "ANSWER", 1.0)
    stage = Together(robots, "red", Ways(lock=True))
    simulator = Simulator(contract, robots, stage, "red")
    stage.pause("agent_2", True)
    stage.gather = lambda robots: None
    with pytest.raises(UserError, match="did not answer within"):
        simulator.episode(0, starts.x[0], starts.goal[0], Play(lock=True))


def test_commands_act_late(contract, robots, starts):
    late, _ = played(contract, robots, starts, Play(command_delay=0.05), episodes=1)
    x = late[0].x[1, :, 3:] - late[0].x[0, :, 3:]
    soon, _ = played(contract, robots, starts, episodes=1)
    y = soon[0].x[1, :, 3:] - soon[0].x[0, :, 3:]
    np.testing.assert_allclose(x, y * (0.05 / 0.095), rtol=0.15, atol=1e-3)


# --- One agent -----------------------------------------------------------------------------------


OWN, NEAR, FAR = np.zeros(5), np.array([1.0, 0, 0.5, 0]), np.array([0, 1.0, 0, 0])


@pytest.mark.parametrize(("offset", "rate"), [(0.0, 1.0), (-1e9, 1.0), (1e6, 1.0001)])
def test_no_clock_of_another_machine_matters(robots, offset, rate):
    """Only what this agent's own clock says of arrivals counts, whatever time others have."""
    bench = Bench(robots[1], offset=offset, rate=rate)
    bench.tell("agent_0", wire.MESSAGE, NEAR)
    bench.tell("agent_2", wire.MESSAGE, FAR)
    bench.tell("agent_1", wire.ODOMETRY, OWN)
    bench.at(0.01)
    wanted, _ = robots[1].command(OWN, None, [NEAR, FAR], [1, 1])
    np.testing.assert_array_equal(bench.said[0].numbers, wanted)
    assert dict(bench.agent.ages) == {"0": 2}


@pytest.mark.parametrize("silent", ["hold", "absent"])
def test_what_a_silent_neighbour_becomes(robots, silent):
    bench = Bench(robots[1], Ways(silent=silent))
    bench.tell("agent_0", wire.MESSAGE, NEAR)
    bench.at(0.0)
    bench.tell("agent_2", wire.MESSAGE, FAR, tick=5)
    bench.time = 0.5
    bench.tell("agent_1", wire.ODOMETRY, OWN, tick=5)
    assert bench.at(0.5) == pytest.approx(0.53) and not bench.said  # it waits for agent_0
    bench.tell("agent_2", wire.MESSAGE, FAR, tick=6)
    bench.at(0.54)
    heard = [at_rest(NEAR), FAR] if silent == "hold" else [NEAR, FAR]
    wanted, _ = robots[1].command(OWN, None, heard, [silent == "hold", 1])
    np.testing.assert_array_equal(bench.said[0].numbers, wanted)
    assert bench.agent.ages["old"] == 1


def test_old_and_unsound_messages_are_passed_over(robots):
    bench = Bench(robots[1])
    bench.tell("agent_0", wire.MESSAGE, NEAR, tick=3)
    bench.tell("agent_0", wire.MESSAGE, FAR, tick=2)  # overtaken on its way
    bench.tell("agent_0", wire.MESSAGE, [np.nan, 0, 0, 0], tick=4)
    bench.bus.put(wire.key("red", "agent_0", wire.MESSAGE), b"nonsense")
    bench.tell("agent_1", wire.ODOMETRY, OWN, tick=3)
    bench.at(0.0)
    bench.at(0.04)
    wanted, _ = robots[1].command(OWN, None, [NEAR, FAR], [1, 0])
    np.testing.assert_array_equal(bench.said[0].numbers, wanted)


def test_a_neighbour_that_starts_again_is_heard(robots):
    bench = Bench(robots[1])
    bench.tell("agent_0", wire.MESSAGE, FAR, tick=900, session=1)
    bench.tell("agent_0", wire.MESSAGE, NEAR, tick=0, session=2)
    bench.tell("agent_1", wire.ODOMETRY, OWN)
    bench.at(0.0)
    bench.at(0.04)
    wanted, _ = robots[1].command(OWN, None, [NEAR, FAR], [1, 0])
    np.testing.assert_array_equal(bench.said[0].numbers, wanted)


def test_a_leader_without_goal_brakes(robots):
    bench = Bench(robots[0])
    bench.tell("agent_0", wire.ODOMETRY, [0, 0, 0, 0.1, 0])
    bench.at(0.0)
    bench.at(0.04)
    assert bench.said[0].flag and bench.agent.fallbacks == 1
    np.testing.assert_allclose(bench.said[0].numbers, [-1.0, 0.0], atol=1e-6)


def test_a_state_that_waited_too_long_brakes(robots):
    bench = Bench(robots[1])
    bench.tell("agent_1", wire.ODOMETRY, [0, 0, 0, 0.1, 0])
    bench.at(0.25)  # the process was held up
    assert bench.said[0].flag


def test_delays_are_kept_and_losses_are_counted_on_arrival(robots):
    bench = Bench(robots[1], Ways(delay=0.02))
    bench.tell("agent_0", wire.MESSAGE, NEAR)
    bench.tell("agent_2", wire.MESSAGE, FAR)
    bench.tell("agent_1", wire.ODOMETRY, OWN)
    assert bench.at(0.0) == pytest.approx(0.02) and not bench.said
    bench.at(0.021)
    assert len(bench.said) == 1 and bench.agent.ages["0"] == 2
    lost = Bench(robots[1], Ways(loss=1.0))
    lost.tell("agent_0", wire.MESSAGE, NEAR)
    lost.tell("agent_1", wire.ODOMETRY, OWN)
    lost.at(0.0)
    lost.at(0.04)
    assert lost.agent.ages == {"never": 2}


def test_keys_match_word_by_word():
    assert matches("a/*/c", "a/b/c") and not matches("a/*/c", "a/b/d")
    assert not matches("a/*", "a/b/c") and not matches("marlyap/red/*/x", "marlyap/blue/b/x")


# --- Processes -----------------------------------------------------------------------------------


def test_three_processes_in_step_are_the_game(small_bundle, contract, robots, starts):
    pytest.importorskip("zenoh")
    from marlyap.deploy.processes import Processes

    stage = Processes(small_bundle, [r.role["name"] for r in robots], "test", Ways(lock=True))
    try:
        simulator = Simulator(contract, robots, stage, "test")
        done = simulator.episode(0, starts.x[0], starts.goal[0], Play(lock=True))
    finally:
        stage.close()
    assert np.abs(done.final - starts.final[0]).max() < 1e-4
    assert {*stage.said} == {"agent_0", "agent_1", "agent_2"}
    assert all(s["peak_mb"] is None or s["peak_mb"] < 80 for s in stage.said.values())


@pytest.mark.slow
def test_a_killed_process_comes_back(small_bundle, contract, robots, starts):
    pytest.importorskip("zenoh")
    from marlyap.deploy.processes import Processes

    stage = Processes(small_bundle, [r.role["name"] for r in robots], "again")
    try:
        simulator = Simulator(contract, robots, stage, "again")
        play = Play(events=(Event("agent_1", 0.3, "kill"), Event("agent_2", 0.2, "pause", 0.2)))
        for k in range(2):
            done = simulator.episode(k, starts.x[k], starts.goal[k], play)
            assert done.alive.tolist() == [True, False, True] and len(done.delays) > 10
    finally:
        stage.close()


@pytest.mark.slow
def test_agents_end_with_their_parent(small_bundle):
    pytest.importorskip("zenoh")
    import subprocess
    import sys

    words = [sys.executable, "-m", "marlyap", "agent", str(small_bundle), "agent_0"]
    agent = subprocess.Popen([*words, "--end-with-input"], stdin=subprocess.PIPE)
    time.sleep(2)
    assert agent.poll() is None
    agent.stdin.close()
    assert agent.wait(60) == 0
