"""What the linearisation at the target says: derivatives by complex steps, in float64."""

from typing import Any, NamedTuple

import numpy as np

from marlyap.recheck.checks import Case, near
from marlyap.recheck.reader import agree
from marlyap.recheck.world import World
from marlyap.threefry import fold, uniform64


TINY = 1e-30  # of a complex step: what it leaves out is far below float64
AT_REST = 1e-8  # what counts as no action and no motion
EXACT, CLEAR = 1e-10, 1e-6  # below the first a singular value is 0, above the second it is not
SMOOTH, SMALL = 1e-3, 1e-7  # relative gap to difference quotients, and their step
SAME = 5e-4  # eigenvalues of a chain are not known better
NOTES = {"starts": "a neighbourhood of the goal", "horizon_steps": None, "disturbance": "none"}


class Look(NamedTuple):
    """The target of one episode."""

    action: float
    moved: float
    radius: float
    smooth: bool


def linearisation(case: Case) -> dict[str, Any]:
    """Check what is said of the closed loop at rest on the goal, and of what no feedback moves."""
    sim, say, v, c, said = case.sim, case.say, case.v, case.c, case.figures
    x, goal = sim.targets(fold(sim.root, np.arange(c["scenes"])), uniform64)
    looks = [look(sim, one, there) for one, there in zip(x, goal, strict=True)]
    free = [fixed(sim, agent, c["decay"]) for agent in np.swapaxes(x, 0, 1)]
    rank, seen = sum(r for r, _, _ in free), sorted(e for _, e, _ in free for e in e)
    clear, action = all(fine for _, _, fine in free), max(l.action for l in looks)
    radius, moved = max(l.radius for l in looks), max(l.moved for l in looks)
    near("the spectral radius of linearisation", radius, said["spectral_radius"], SAME)
    near("the action at the goal", action, said["action_at_goal"], 1e-9 + 1e-6 * action)
    near("the step from the goal", moved, said["step_from_goal"], 1e-9 + 1e-6 * moved)
    values = said["uncontrollable_eigenvalues"]
    agree("the number of uncontrollable eigenvalues", len(seen), len(values))
    for own, told in zip(seen, values, strict=True):
        near("an uncontrollable eigenvalue", own, told, CLEAR)
    radius, fault = said["spectral_radius"], None
    for l in looks:
        if not max(l.action, l.moved) <= AT_REST:
            fault = say.no_equilibrium(l.action, l.moved)
        elif not l.smooth:
            fault = say.no_derivative()
        if fault:
            break
    claim = fault or say.linearised(radius, c["margin"], c["scenes"])
    claim = say.uncontrollable(len(seen), c["decay"]) if seen else claim
    shown = not seen and not fault
    agree("the claim of linearisation", claim, v["claim"])
    agree("whether linearisation holds", shown and radius <= 1 - c["margin"], v["holds"])
    agree("the bound of linearisation", radius if shown else None, v["bound"])
    proved = "proved" if seen and clear else "observed"
    agree("the evidence of linearisation", proved, v["evidence"])
    scope = NOTES | {"arithmetic": "float64", "information": say.information}
    agree("the scope of linearisation", scope, v["scope"])
    figures = {key: said[key] for key in ("spectral_radius", "action_at_goal", "step_from_goal")}
    figures |= {"controllability_rank": rank, "dimension": x[0].size, "gap_clear": clear}
    figures |= {"uncontrollable_eigenvalues": values, "margin": c["margin"], "scenes": c["scenes"]}
    agree("the figures of linearisation", figures, said)
    for key in ("trials", "successes", "worst"):
        agree(f"{key} of linearisation", None, v[key])
    return {"spectral_radius": radius, "uncontrollable": len(seen)}


def look(sim: World, x: np.ndarray, goal: np.ndarray) -> Look:
    """The closed loop of the whole team at rest on the goal [agent, .]."""
    act = lambda x: sim.act(x, np.broadcast_to(goal, (len(x), *goal.shape)), sim.linked)
    flat = lambda x: sim.step(x, sim.limits * act(x)).reshape(len(x), -1)
    put = lambda rows: (x.ravel() + rows).reshape(-1, *x.shape)
    J = np.imag(flat(put(1j * TINY * np.eye(x.size)))).T / TINY
    here = flat(x[None])
    ways = np.concatenate([np.eye(x.size), np.random.default_rng(0).normal(size=(8, x.size))])
    gap = 0.0
    for h in (SMALL, -SMALL):
        gap = max(gap, np.abs((flat(put(h * ways)) - here) / h - ways @ J.T).max())
    sound = np.isfinite(J).all()
    radius = float(np.abs(np.linalg.eigvals(J)).max()) if sound else np.inf
    smooth = bool(sound and gap <= SMOOTH * max(1.0, np.abs(J).max()))
    moved = float(np.abs(here - x.ravel()).max())
    return Look(float(np.abs(act(x[None])).max()), moved, radius, smooth)


def fixed(sim: World, agents: np.ndarray, decay: float) -> tuple[int, list[float], bool]:
    """Of one agent at rest: the rank of controllability, what no input moves, how clear that is.

    What no input moves is |lambda| >= 1 - decay with w A = lambda w, w B = 0 and w among the rows
    of the errors' derivative (Popov, Belevitch and Hautus). A turn of the agent turns all of it, so
    that any of its headings [target, .] will do.
    """
    x, n, m = agents[:1], agents.shape[1], len(sim.limits)
    step = lambda x, a: sim.step(x[:, None], sim.limits * a[:, None])[:, 0]
    slope = lambda y: np.imag(y).T / TINY
    states, none = x + 1j * TINY * np.eye(n), np.zeros((n, m))
    A, B = slope(step(states, none)), slope(step(x + np.zeros((m, n)) + 0j, 1j * TINY * np.eye(m)))
    goal = np.broadcast_to(x[0, :2], (n, 1, 2))
    E = slope(sim.errors(states[:, None], goal)[:, 0])
    blocks = [B]
    for _ in range(n - 1):
        blocks.append(A @ blocks[-1])
    columns = np.hstack(blocks)
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns[:, sizes > EXACT] / sizes[sizes > EXACT]
    rank, clear = counted(np.linalg.svd(columns, compute_uv=False))
    U, sizes, _ = np.linalg.svd(E.T, full_matrices=False)
    rows, found = U[:, sizes > EXACT], []
    for value in np.unique(np.round(np.linalg.eigvals(A), 5)):  # those of these models are 0 and 1
        if abs(value) < 1 - decay or rank == n:
            continue
        U, sizes, _ = np.linalg.svd(np.hstack([A - value * np.eye(n), B]))
        _, fine = counted(sizes)
        cosines = np.linalg.svd(rows.T @ U[:, sizes < EXACT].conj(), compute_uv=False)
        clear &= fine and bool(((cosines > 1 - EXACT) | (cosines < 1 - CLEAR)).all())
        found += [float(abs(value))] * int((cosines > 1 - EXACT).sum())
    return rank, found, clear


def counted(sizes: np.ndarray) -> tuple[int, bool]:
    """How many singular values are not zero, and whether none lies in between."""
    return int((sizes > EXACT).sum()), bool(((sizes < EXACT) | (sizes > CLEAR)).all())
