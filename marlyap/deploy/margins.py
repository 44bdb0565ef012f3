"""How much a team stands: success over many starts, one thing going wrong at a time."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from marlyap.deploy.runtime import Role
from marlyap.deploy.starts import Starts
from marlyap.deploy.team import Faults, distances, simulate
from marlyap.errors import UserError
from marlyap.statistics import clopper_pearson


DELAYS = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.15, 0.2)  # s
STALE = (1, 2, 3, 4, 5, 8, 12)  # periods
LOSSES = (0.1, 0.3, 0.5, 0.7, 0.9)
NOISE = (0.01, 0.02, 0.05, 0.1)  # m, rad, m/s, rad/s
STRETCHES = (0.8, 1.2)
DEATHS = (5, 10, 20)  # periods after the start
ENOUGH = 0.95  # what the lower bound of a success rate has to be
CONFIDENCE = 0.95
APART = 1e-3  # m, between this simulation and JAX, of the median episode

Row = dict[str, Any]


class Margins(NamedTuple):
    """The table, and what follows from it."""

    rows: list[Row]
    max_actuation_delay: float | None  # s; None where even no delay is stood


def conditions(contract: dict[str, Any]) -> Iterator[tuple[str, Faults]]:
    """What is tried, in words."""
    yield "the integrator of training", Faults(pieces=False)
    yield "the plant in steps of 5 ms", Faults()
    for delay in DELAYS:
        yield f"commands {1000 * delay:.0f} ms late", Faults(command_delay=delay)
    for stale in STALE:
        yield f"neighbours {stale} periods late", Faults(stale=stale)
    for silent in ("hold", "absent"):
        for loss in LOSSES:
            yield f"{loss:.0%} of messages lost, {silent}", Faults(loss=loss, silent=silent)
    for noise in NOISE:
        yield f"sensor noise {noise:g} (m, rad, m/s, rad/s)", Faults(noise=noise)
    for stretch in STRETCHES:
        yield f"periods {stretch:g} times as long", Faults(stretch=stretch)
    followers = [r["index"] for r in contract["roles"] if not r["leads"]]
    for dead in followers[:2]:
        for silent in ("hold", "absent"):
            for start in DEATHS:
                gone = Faults(dead=dead, dead_from=start, silent=silent)
                yield f"agent_{dead} dead from period {start}, {silent}", gone


def measured(
    contract: dict[str, Any],
    arrays: Any,
    starts: Starts,
    tell: Callable[[str], None] = lambda text: None,
) -> Margins:
    """The margins of a team from these starts.

    Raises UserError where the simulation without JAX is not the game, by their final distances.
    """
    robots = [Role(contract, arrays, r["name"]) for r in contract["roles"]]
    tried, rows = list(conditions(contract)), []
    for k, (words, faults) in enumerate(tried):
        tell(f"margins {k + 1} of {len(tried)}: {words} ...")
        rows.append(tried_once(contract, robots, starts, words, faults))
        if k == 0:
            agrees(contract, robots, starts)
    return Margins(rows, allowed(rows))


def tried_once(
    contract: dict[str, Any], robots: list[Role], starts: Starts, words: str, faults: Faults
) -> Row:
    """One row: the share of episodes in which all robots that are alive arrive."""
    with np.errstate(all="ignore"):
        last = simulate(contract, robots, starts.x, starts.goal, faults)[:, -1]
        alive = np.arange(last.shape[1]) != (-1 if faults.dead is None else faults.dead)
        near = distances(last, starts.goal) <= contract["domain"]["edge"]
    hits, n = int(near[:, alive].all(axis=1).sum()), len(near)
    low, high = clopper_pearson(hits, n, CONFIDENCE)
    rate = {"successes": hits, "episodes": n, "interval": [float(low), float(high)]}
    changed = {k: v for k, v in vars(faults).items() if v != getattr(Faults(), k)}
    return {"what": words, "faults": changed, "success_rate": hits / n} | rate


def agrees(contract: dict[str, Any], robots: list[Role], starts: Starts) -> None:
    """Raise UserError unless episodes end here as they end in JAX.

    The median over episodes: a closed loop that is not stable everywhere multiplies round-off.
    """
    last = simulate(contract, robots, starts.x, starts.goal, replace(Faults(), pieces=False))
    apart = np.abs(distances(last[:, -1], starts.goal) - starts.final).max(axis=1)
    if not np.median(apart) <= APART:
        raise UserError(
            f"export: episodes end {np.median(apart):.1e} m from where they end in JAX; this game "
            "moves, sees or judges otherwise than bundles know, so leave the margins out with "
            "--starts 0."
        )


def allowed(rows: list[Row]) -> float | None:
    """The largest command delay that it, and every smaller one, stands (s)."""
    found = None
    for row in rows:
        delay = row["faults"].get("command_delay", 0.0)
        if {*row["faults"]} - {"command_delay"}:
            continue
        if row["interval"][0] < ENOUGH:
            break
        found = delay
    return found
