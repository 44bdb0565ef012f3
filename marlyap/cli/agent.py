"""`marlyap agent`: one robot of a bundle, as a process on a bus."""

from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result
from marlyap.cli.options import number, place


SUMMARY = "be one robot of a bundle: hear, tell, command, on zenoh; without JAX"
EPILOG = """
Runs until Ctrl-C, or until the team is stopped. What is said over the bus, and under which keys, is
in docs/robots.md. Robots of other teams are not heard.
"""
EXAMPLES = """
  marlyap agent bundle agent_0 --listen tcp/0.0.0.0:7601
  marlyap agent bundle agent_1 --listen tcp/0.0.0.0:7602 --connect tcp/192.168.1.10:7601"""


def options(p: ArgumentParser) -> None:
    p.add_argument("bundle", type=place, metavar="BUNDLE", help="what export wrote")
    p.add_argument("role", metavar="ROLE", help="which robot, such as agent_0")
    p.add_argument("--team", default=None, help="its name (default: of the bundle's seal)")
    ends = "zenoh endpoints, such as tcp/0.0.0.0:7601"
    p.add_argument("--listen", nargs="+", default=[], metavar="END", help=ends)
    p.add_argument("--connect", nargs="+", default=[], metavar="END", help="those of others")
    ros = "meet ROS 2 over rmw_zenoh's keys in this domain (not tried on a robot)"
    p.add_argument("--ros", type=number, default=None, metavar="DOMAIN", help=ros)
    p.add_argument("--end-with-input", action="store_true", help="end when standard input does")
    ways(p)


def ways(p: ArgumentParser) -> None:
    """How robots listen, for `swarm` too."""
    p.add_argument("--lock", action="store_true", help="in step: wait for every neighbour")
    p.add_argument("--wait", type=float, default=0.3, help="periods to wait for messages (0.3)")
    silent = "what a silent neighbour becomes: at rest where it was (hold), or absent"
    p.add_argument("--silent", choices=("hold", "absent"), default="hold", help=silent)
    p.add_argument("--loss", type=float, default=0.0, help="share of messages to lose")
    p.add_argument("--delay", type=float, default=0.0, help="s that messages come late")
    p.add_argument("--jitter", type=float, default=0.0, help="s, and up to so much more")
    p.add_argument("--seed", type=number, default=0, help="of losses and jitter")


def run(args: Namespace, overrides: Overrides) -> Result:
    """Be a robot."""
    import threading

    from marlyap.deploy import contract as contracts, wire
    from marlyap.deploy.agent import Agent, Ways
    from marlyap.deploy.bus import Bus, ZenohBus
    from marlyap.deploy.runtime import Role

    contract = contracts.load(args.bundle)
    contracts.for_robots(contract, "agent")
    contracts.role(contract, args.role)
    how = Ways(args.lock, args.wait, args.silent, args.loss, args.delay, args.jitter, args.seed)
    team = wire.team_name(args.team or contract["sha256"][:12])
    robot, ended = Role.load(args.bundle, args.role), threading.Event()
    bus: Bus = ZenohBus(args.listen, args.connect)
    if args.ros is not None:
        from marlyap.deploy.ros2 import RosBus

        bus = RosBus(bus, contract, args.role, args.ros)
    if args.end_with_input:
        threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
    try:
        agent = Agent(robot, bus, team, how)
        agent.run(ended.is_set)
    finally:
        bus.close()
    return {"role": args.role, "team": team, "fallbacks": agent.fallbacks}, 0


def _wait_for_end(ended) -> None:
    import sys

    sys.stdin.read()
    ended.set()
