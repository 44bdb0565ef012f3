"""`marlyap swarm`: all robots of a bundle as processes, a simulator, one table and a film."""

import argparse
import re
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from marlyap.cli.agent import ways
from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.options import number, place
from marlyap.errors import UserError, check_range


SUMMARY = "play a bundle's team as separate processes, with what goes wrong; without JAX"
EPILOG = """
Each robot is a process with NumPy and zenoh; this process integrates their motion and tells each
what its own sensors say. --lock plays in step, with the integrator of training; otherwise by the
clock, the plant in steps of 5 ms. --bus local plays in one process and in no time.
"""
EXAMPLES = """
  marlyap swarm bundle --episodes 20 --lock
  marlyap swarm bundle --episodes 20 --loss 0.5 --command-delay 0.02
  marlyap swarm bundle --kill agent_1@1 --pause agent_2@1:0.5 --bus local"""


def options(p: ArgumentParser) -> None:
    p.add_argument("bundle", type=place, metavar="BUNDLE", help="what export wrote")
    p.add_argument("--episodes", type=number, default=5, help="evaluation starts (default 5)")
    first = "the first of them (default 0)"
    p.add_argument("--first", type=number, default=0, help=first)
    buses = "zenoh: processes; local: in this process"
    p.add_argument("--bus", choices=("zenoh", "local"), default="zenoh", help=buses)
    p.add_argument("--team", default=None, help="its name on the bus (default: drawn)")
    p.add_argument("--command-delay", type=float, default=0.0, help="s until a command acts")
    event = "ROBOT@SECONDS"
    p.add_argument("--kill", action="append", default=[], metavar=event, help="it dies then")
    p.add_argument("--late", action="append", default=[], metavar=event, help="it joins then")
    pause = "it stops then, for so long"
    p.add_argument("--pause", action="append", default=[], metavar=f"{event}:FOR", help=pause)
    p.add_argument("--film", type=number, default=0, help="which episode to film (default 0)")
    p.add_argument("--out", type=place, default=None, help="folder of film.gif and swarm.json")
    ways(p)


def run(args: Namespace, overrides: Overrides) -> Result:
    """Play the episodes."""
    import secrets

    from marlyap.deploy import contract as contracts, wire
    from marlyap.deploy.agent import Ways
    from marlyap.deploy.contract import STARTS, WEIGHTS
    from marlyap.deploy.runtime import Role, read_arrays
    from marlyap.deploy.swarm import Play, Simulator

    contract = contracts.load(args.bundle)
    contracts.for_robots(contract, "swarm")
    starts, arrays = read_arrays(args.bundle / STARTS), read_arrays(args.bundle / WEIGHTS)
    check_range("first", args.first, 0, len(starts["x"]) - 1)
    check_range("episodes", args.episodes, 1, len(starts["x"]) - args.first)
    starts = {name: part[args.first :] for name, part in starts.items()}
    check_range("film", args.film, 0, args.episodes - 1)
    place_for(args.out)
    how = Ways(args.lock, args.wait, args.silent, args.loss, args.delay, args.jitter, args.seed)
    play = Play(args.lock, args.command_delay, events(args, contract))
    team = wire.team_name(args.team or f"swarm-{secrets.token_hex(4)}")
    robots = [Role(contract, arrays, r["name"]) for r in contract["roles"]]
    stage = staged(args, robots, team, how)
    played = []
    try:
        simulator = Simulator(contract, robots, stage, team)
        for k in range(args.episodes):
            played.append(simulator.episode(k, starts["x"][k], starts["goal"][k], play))
            apart = played[-1].final[played[-1].alive].max()
            say(f"episode {k}: {'arrived' if played[-1].success else 'missed'}, {apart:.3f} m")
    finally:
        stage.close()
    result = summary(played, starts["final"], stage.said, args)
    if not args.json:
        show(result)
    if args.out is not None:
        keep(args, contract, played, result)
    return result, 0


def staged(args: Namespace, robots: Any, team: str, how: Any) -> Any:
    """Where the team plays: in this process, or in one for each robot."""
    if args.bus == "local":
        from marlyap.deploy.swarm import Together

        return Together(robots, team, how)
    from marlyap.deploy.processes import Processes

    return Processes(args.bundle, [r.role["name"] for r in robots], team, how)


def place_for(out: Path | None) -> None:
    """Raise UserError unless the folder is there or can be made."""
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"out: {out} cannot be made ({error.strerror}).") from None


def events(args: Namespace, contract: Any) -> tuple[Any, ...]:
    """What happens to robots, of ROBOT@SECONDS[:FOR]."""
    from marlyap.deploy import contract as contracts
    from marlyap.deploy.swarm import Event

    found = []
    for what in ("kill", "late", "pause"):
        for text in getattr(args, what):
            seconds = r"(\d+(?:\.\d*)?|\.\d+)"
            tail = f":{seconds}" if what == "pause" else "()"
            match = re.fullmatch(rf"(\w+)@{seconds}{tail}", text)
            if not match:
                form = "ROBOT@SECONDS:FOR" if what == "pause" else "ROBOT@SECONDS"
                raise UserError(f"{what}: '{text}' is not {form}, such as agent_1@1.")
            contracts.role(contract, match[1])
            found.append(Event(match[1], float(match[2]), what, float(match[3] or 0)))
    return tuple(found)


def summary(played: Any, final: Any, said: Any, args: argparse.Namespace) -> dict[str, Any]:
    """What the table shows."""
    import numpy as np

    worst = np.array([e.final[e.alive].max() for e in played])
    waits = 1000 * np.array([d for e in played for d in e.delays] or [np.nan])
    ages: dict[str, int] = {}
    for each in said.values():
        for age, count in each["ages"].items():
            ages[age] = ages.get(age, 0) + count
    apart = [float(np.abs(e.final - final[k]).max()) for k, e in enumerate(played)]
    found = {
        "bundle": str(args.bundle),
        "episodes": len(played),
        "successes": sum(e.success for e in played),
        "worst_distance_m": {"median": float(np.median(worst)), "most": float(worst.max())},
        "from_jax_m": max(apart),
        "state_to_command_ms": {str(q): float(np.percentile(waits, q)) for q in (50, 99)},
        "ticks_without_command": sum(e.missed for e in played),
        "fallbacks": sum(e.fallbacks for e in played),
        "age_of_messages_periods": dict(sorted(ages.items())),
    }
    if measured := [s for s in said.values() if s.get("wall_s")]:
        share = [s["cpu_s"] / s["wall_s"] for s in measured]
        memory = [s["peak_mb"] for s in measured if s["peak_mb"]]
        found |= {"agent_core_share": max(share), "agent_peak_mb": max(memory, default=None)}
    return found


def show(result: dict[str, Any]) -> None:
    """The table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False)
    for name, value in result.items():
        said = value
        if isinstance(value, dict):
            said = ", ".join(f"{k}: {_short(v)}" for k, v in value.items()) or "-"
        table.add_row(name.replace("_", " "), _short(said))
    Console().print(table)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def keep(args: Namespace, contract: Any, played: Any, result: dict[str, Any]) -> None:
    """Write what was found, and the film."""
    import json

    from marlyap.deploy.film import film
    from marlyap.report.gif import film_gif
    from marlyap.storage import store

    store.write_text_atomic(args.out / "swarm.json", json.dumps(result, indent=1) + "\n")
    film_gif(film(contract, played[args.film], args.film), args.out / "film.gif")
    say(f"Film: {(args.out / 'film.gif').resolve()}")
