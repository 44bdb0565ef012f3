"""Write the bundle of a run: everything that a robot needs, and what is known of how it does."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from marlyap.deploy import c_source, check, contract as contracts, express, golden, onnx_graph
from marlyap.deploy.contract import GOLDEN, HEADER, RUNTIME, RUNTIMES, SOURCE, STARTS, WEIGHTS
from marlyap.deploy.extras import needs
from marlyap.deploy.margins import Margins, measured
from marlyap.deploy.starts import Starts, of as starts_of, played
from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractGame
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import Evaluation, evaluate
from marlyap.simulation.rollout import Decentralised
from marlyap.storage import hashing, store


KEPT = 100  # starts that a bundle holds, for its swarm
OWN_AGE, NEIGHBOUR_AGE = 2, 3  # periods after which what is known counts as old

Tell = Callable[[str], None]


def write(
    run: Run,
    out: Path,
    runtimes: Sequence[str] = RUNTIMES,
    starts: int = 500,
    tell: Tell = lambda text: None,
    game: AbstractGame | None = None,
) -> dict[str, Any]:
    """Write the bundle of a run's policy as the folder `out`, whole or not at all.

    Arguments: runtimes, of `RUNTIMES`; starts, how many evaluation starts the evidence and the
    margins rest on, 0 for none; tell, hears of each stage; game, another than the run's own.
    Returns the contract.
    Raises UserError for a policy that cannot be expressed, or if the NumPy runtime differs.
    """
    check_range("starts", starts, 0, 100_000)
    if out.exists():
        raise UserError(f"out: {out} already exists; choose another folder.")
    if "onnx" in runtimes:
        needs("onnx", "export --with onnx")
    there = (run.game if game is None else game).nominal
    controller = run.controller(there)
    arrays, nets = express.networks(express.actors(controller.policy), there.agents)
    body = described(run, there, controller, nets)
    tell("golden pairs ...")
    episodes = played(there, controller, max(starts, KEPT, golden.PAIRS))
    pairs = golden.pairs(there, controller, body, episodes.way)
    found = check.agreement(body, pairs, check.by_numpy(body, arrays))
    if found.fault:
        raise UserError(f"export: the NumPy runtime disagrees with JAX: {found.fault}.")
    begun = starts_of(there, episodes) if body["sight"] else None
    body["evidence"] = evidence(there, controller, starts, tell)
    body |= margins(body, arrays, begun.first(starts) if begun and starts else None, tell)
    files = {WEIGHTS: store.packed(arrays), GOLDEN: store.packed(pairs)}
    if begun is not None:
        files[STARTS] = store.packed(begun.first(KEPT)._asdict())
    files |= runtime_files(body, arrays, runtimes, tell)
    whole = files | {contracts.CONTRACT: contracts.sealed(body, files)}
    store.write_folder(out, {name: [raw] for name, raw in whole.items()})
    return contracts.load(out)


def runtime_files(
    body: dict[str, Any], arrays: check.Arrays, runtimes: Sequence[str], tell: Tell
) -> dict[str, bytes]:
    """The files of each runtime that is asked for."""
    files: dict[str, bytes] = {}
    if "numpy" in runtimes:
        files[RUNTIME] = (Path(__file__).parent / RUNTIME).read_bytes()
    if "onnx" in runtimes:
        tell("ONNX ...")
        for role in body["roles"]:
            files[f"{role['name']}.onnx"] = onnx_graph.graph(body, arrays, role)
    if "c" in runtimes:
        files[SOURCE] = c_source.source(body, arrays).encode()
        files[HEADER] = c_source.header(body).encode()
    return files


def described(
    run: Run, game: AbstractGame, controller: Decentralised, nets: list[str]
) -> dict[str, Any]:
    """The contract without its evidence."""
    sight = express.sight(game)
    obs = jax.eval_shape(lambda k: game.observations(game.reset(k)), jax.random.key(0)).shape[1]
    plant = game.plant
    return {
        "schema": contracts.SCHEMA,
        "task": run.labels.get("task", type(game).__name__),
        "algorithm": run.labels.get("algorithm", ""),
        "seed": run.seed,
        "policy": hashing.policy_hash(controller),
        "versions": store.versions(),
        "roles": roles(game, nets, sight is not None),
        "sight": sight,
        "frames": "right-handed, x ahead, y left, angles counter-clockwise (REP 103); all robots "
        "and the goal in one frame, which may be any",
        "observation": {
            "size": obs,
            "channels": [c._asdict() for c in game.channels()],
        },
        "state": [e._asdict() for e in plant.states],
        "action": {
            "layers": len(express.actors(controller.policy).net.layers),
            "channels": [
                {**e._asdict(), "limit": float(limit)}
                for e, limit in zip(plant.inputs, plant.limits, strict=True)
            ],
            "squash": "tanh, times the limit",
        },
        "timing": timing(game.dt),
        "silent": "a neighbour that is silent for longer than max_neighbour_age is taken to stand "
        "where it was last heard (hold), or its slot is empty (absent)",
        "fallback": {
            "when": "a number that counts is not finite, a leader has no goal, or the own state is "
            "older than max_own_age",
            "gain": express.brake(game, sight is not None),
            "command": "gain times the state, clipped to the limits",
        },
        "plant": moves(game, sight),
        "domain": domain(game),
    }


def timing(period: float) -> dict[str, Any]:
    """How often, how old, how late (s)."""
    return {
        "period": period,
        "hold": "a command is held until the next",
        "max_own_age": OWN_AGE * period,
        "max_neighbour_age": NEIGHBOUR_AGE * period,
        "max_actuation_delay": None,
        "clocks": "ages are taken on the robot's own clock; clocks need not agree",
    }


def roles(game: AbstractGame, nets: list[str], robots: bool) -> list[dict[str, Any]]:
    """Who is who, whom each hears and in which order."""
    found, shift = [], express.shifts(game)
    for i in range(game.agents):
        slots = [f"agent_{j}" if j >= 0 else None for j in game.slots[i]]
        role = {"name": f"agent_{i}", "index": i, "network": nets[i], "neighbours": slots}
        found.append(role | ({"leads": bool(game.leads[i]), "shift": shift[i]} if robots else {}))
    return found


def moves(game: AbstractGame, sight: dict[str, Any] | None) -> dict[str, Any]:
    """What a simulator has to integrate; without a kind where it cannot."""
    kind = game.plant.moves.__name__ if sight else None
    limits = [float(u) for u in game.plant.limits]
    return {"kind": kind, "integrator": game.plant.integrator, "limits": limits}


def domain(game: AbstractGame) -> dict[str, Any]:
    """What the policy was trained for."""
    return {
        "horizon": game.horizon,
        "edge": game.edge,
        "unit": game.unit,
        "game": hashing.as_json(game),
        "not_trained_for": [
            "actuation delay, stale, lost or silent neighbours and noise, unless the game says so",
            "starts other than those of the game",
        ],
    }


def evidence(
    game: AbstractGame, controller: Decentralised, starts: int, tell: Tell
) -> dict[str, Any]:
    """How many held-out starts succeed in JAX."""
    if not starts:
        return {"success": None}
    tell(f"{starts} held-out starts ...")
    found: Evaluation = evaluate(game, controller, starts, beyond=0)
    said = found.summary()
    return {"success": {k: said[k] for k in ("episodes", "successes", "success_rate", "interval")}}


def margins(
    body: dict[str, Any], arrays: check.Arrays, begun: Starts | None, tell: Tell
) -> dict[str, Any]:
    """The margins table, and the actuation delay that follows from it."""
    if begun is None:
        return {"margins": None}
    found: Margins = measured(body, arrays, begun, tell)
    body["timing"]["max_actuation_delay"] = found.max_actuation_delay
    return {"margins": found.rows}
