"""An independent checker of certificates: NumPy in float64, and nothing of what made them.

From the recorded seed it draws starts, disturbances and times anew; it integrates, and evaluates
observations, networks and V from the recorded arrays; it counts again, computes the exact bounds,
and writes claims, scopes and worst cases anew. All of it has to be what the file says, for what was
asked. What it does not know it refuses by name; what no rollout can show it lists as not checked.
"""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from marlyap.recheck import checks, shield
from marlyap.recheck.bounds import lower
from marlyap.recheck.checks import Case, near
from marlyap.recheck.linear import linearisation
from marlyap.recheck.reader import Arrays, Rejected, agree, policy_hash, read, record
from marlyap.recheck.sentences import Sentences
from marlyap.recheck.world import FLAG, LIST, NUMBER, OBJECT, TEXT, WHOLE, World, unknown


MALFORMED = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)
NONE = type(None)
FILE = dict(schema=WHOLE, holds=FLAG, confidence=(float,), confidence_each=(float,))
FILE |= dict(checkpoints=WHOLE, seed=WHOLE, policy=TEXT, game=OBJECT, controller=OBJECT, V=OBJECT)
FILE |= dict(certificates=OBJECT, verdicts=OBJECT, information=TEXT, left_out=OBJECT)
VERDICT = dict(name=TEXT, claim=TEXT, evidence=TEXT, holds=FLAG, bound=(float, NONE))
VERDICT |= dict(confidence=(float, NONE), scope=OBJECT, trials=(int, NONE), successes=(int, NONE))
VERDICT |= dict(worst=(dict, NONE), figures=OBJECT)
SAMPLED = dict(rollouts=WHOLE, share=NUMBER)
# What each certificate asks for; all of them have a kind and a confidence, too.
ASKED = {
    "Reach": SAMPLED,
    "ReachAndStay": SAMPLED | dict(stay=WHOLE),
    "Decrease": SAMPLED | dict(beta=NUMBER),
    "Contraction": SAMPLED | dict(calibration=WHOLE, T=WHOLE, c_min=(*NUMBER, NONE), least=NUMBER),
    "Basin": SAMPLED | dict(calibration=WHOLE, stay=WHOLE),
    "Quantiles": dict(rollouts=WHOLE, q=NUMBER),
    "Robustness": SAMPLED
    | dict.fromkeys(("gains", "noises", "delays", "drops", "spreads"), LIST)
    | dict(remove=FLAG),
    "Composition": SAMPLED
    | dict(calibration=WHOLE, T=WHOLE, stay=WHOLE, weights=LIST, slack=NUMBER)
    | dict(within=(*NUMBER, NONE)),
    "Theorem1": SAMPLED | dict(old=(dict, NONE), noise=NUMBER, rate=NUMBER, lipschitz=TEXT),
    "Safe": SAMPLED | dict(stay=WHOLE),
    "Apart": SAMPLED | dict(calibration=WHOLE, stay=WHOLE, least=NUMBER),
    "Linearisation": dict(scenes=WHOLE, margin=NUMBER, decay=NUMBER),
    "Shielded": dict(rollouts=WHOLE),
    "Ellipsoid": dict(scenes=WHOLE),
    "Proof": dict(c=NUMBER, rho=NUMBER, inner=NUMBER, half=LIST, eta=NUMBER, decay=NUMBER)
    | dict(most=WHOLE, batch=WHOLE, resume=(str, NONE), show=FLAG),
}
# Between which numbers, both left out, what is asked for has to lie.
RANGES: dict[str, tuple[float, float]] = dict(share=(0, 1), q=(0, 1), beta=(0, math.inf))
RANGES |= dict(rollouts=(0, math.inf), calibration=(0, math.inf), T=(0, math.inf))
RANGES |= dict(stay=(-1, math.inf), margin=(0, 1), decay=(-1e-300, 1), scenes=(0, 1001))
CHECKS: dict[str, Callable[[Case], dict[str, Any]]] = {
    "Reach": checks.reach,
    "ReachAndStay": checks.reach,
    "Decrease": checks.decrease,
    "Contraction": checks.contraction,
    "Basin": checks.basin,
    "Quantiles": checks.quantiles,
    "Apart": checks.apart,
    "Robustness": checks.robustness,
    "Composition": checks.composition,
    "Theorem1": checks.theorem1,
}
STATISTICAL = {*CHECKS, "Safe"}  # those that share the confidence
SHARES = STATISTICAL - {"Quantiles", "Robustness"}  # whose bound follows from one pair of counts
CHECKS["Linearisation"] = linearisation
ASKS_V = ("Decrease", "Basin", "Quantiles", "Theorem1")


def recheck(
    path: Path | str, tell: Callable[[str, dict[str, Any]], None] = lambda name, verdict: None
) -> dict[str, Any]:
    """Derive every verdict of a certificate anew.

    Returns `agrees` (whether every verdict was derived again, each as the file says), `holds` (what
    the file says of all together; None where not all could be derived), `rechecked` and
    `not_rechecked` (names, with the reason). `tell` hears of each verdict as soon as it agrees.

    Raises Rejected (a UserError) at the first thing that differs and for a file that is damaged or
    no certificate. Of a game or a controller that it does not know it derives nothing anew, and
    checks what follows from the counts.
    """
    try:
        return derive(*read(Path(path)), tell)
    except MALFORMED as error:
        what = f"{type(error).__name__}: {error}".rstrip(".")
        raise Rejected(f"{path} is no certificate ({what}); use another copy of it.") from error


def derive(
    arrays: Arrays, meta: dict[str, Any], tell: Callable[[str, dict[str, Any]], None]
) -> dict[str, Any]:
    """`recheck`, of what was read."""
    record("the file", meta, FILE)
    agree("the schema", 1, meta["schema"])
    own = {k.partition("/")[2]: v for k, v in arrays.items() if k.startswith("controller/")}
    agree("the hash of the policy", policy_hash(own), meta["policy"])
    if not 0 <= meta["seed"] < 2**31:
        raise Rejected(f"certificate: no seed is {meta['seed']}.")
    if not 0 < meta["confidence"] < 1 or not 1 <= meta["checkpoints"] < 10**9:
        raise Rejected("certificate: its confidence or number of checkpoints is impossible.")
    asked, verdicts = meta["certificates"], meta["verdicts"]
    kinds = {name: kind_of(name, asked.get(name)) for name in [*verdicts, *asked]}
    for name in [*asked, *verdicts]:
        if name not in asked or name not in verdicts:
            what = "has no verdict" if name in asked else "was not asked for"
            raise Rejected(f"certificate: {name} {what}.")
    if not verdicts:
        raise Rejected("certificate: it has no verdict, so there is nothing to check.")
    shared = max(1, sum(kind in STATISTICAL for kind in kinds.values()))
    tail = (1 - meta["confidence"]) / (shared * meta["checkpoints"])
    near("the confidence of each certificate", 1 - tail, meta["confidence_each"], 1e-12)
    for name, v in verdicts.items():
        about(name, v, asked[name], kinds[name], tail)
    whole = all(v["holds"] for v in verdicts.values())
    if not (whole and meta["left_out"]):  # what is left out may have been optional, or not
        agree("whether all hold", whole, meta["holds"])
    if meta["game"].get("kind") == "Shielded":
        return behind_shield(arrays, meta, kinds, tail, tell)
    if what := unknown(meta["game"], meta["controller"]):
        left = {
            name: counted(v, asked[name], kinds[name], tail, what) for name, v in verdicts.items()
        }
        return {"agrees": False, "holds": None, "rechecked": {}, "not_rechecked": left}
    sim = World(meta, arrays)
    say, done, left = Sentences(meta["game"], meta["V"]), {}, {}
    agree("what the agents act on", say.information, meta["information"])
    if any(kind in ASKS_V for kind in kinds.values()):
        sim.asked()
        worst, usual = at_target(sim)
        if not worst <= 2 * ZERO * max(usual, 1e-12):
            raise Rejected(f"certificate: V is {worst:.3g} on the target set, where it must be 0.")
    for name, why in meta["left_out"].items():
        left |= left_out(sim, say, name, why, asked)
    for name, v in verdicts.items():
        c, kind = asked[name], kinds[name]
        if kind not in CHECKS:
            left[name] = unchecked(sim, kind)
            continue
        found = CHECKS[kind](Case(sim, say, v, c, tail))
        if "left" in found:
            left[name] = found["left"]
            continue
        done[name] = found
        tell(name, v)
    holds = None if left else meta["holds"]
    return {"agrees": not left, "holds": holds, "rechecked": done, "not_rechecked": left}


def behind_shield(
    arrays: Arrays,
    meta: dict[str, Any],
    kinds: dict[str, str],
    tail: float,
    tell: Callable[[str, dict[str, Any]], None],
) -> dict[str, Any]:
    """`derive` for a game behind a shield: what the shield is certified for, and counts.

    Whether an action is admitted may turn on the last digit, so that no other figure of a rollout
    can be asked to agree.
    """
    game, asked, done, left = meta["game"], meta["certificates"], {}, {}
    record("the game", game, dict(kind=TEXT, inner=OBJECT, shield=OBJECT))
    what = unknown(game["inner"], meta["controller"]) or shield.unknown(game)
    for name, v in meta["verdicts"].items():
        if what or kinds[name] != "Shielded":
            of = what or "single rollouts behind a shield"
            left[name] = counted(v, asked[name], kinds[name], tail, of)
            continue
        sim = World(meta, arrays)
        case = Case(sim, Sentences(game["inner"], meta["V"]), v, asked[name], tail)
        done[name] = shield.check(case, game["shield"])
        tell(name, v)
    why = "it was left out, and whether it had to be is not known here"
    left |= dict.fromkeys(meta["left_out"], why)
    holds = None if left else meta["holds"]
    return {"agrees": not left, "holds": holds, "rechecked": done, "not_rechecked": left}


def about(name: str, v: dict[str, Any], c: dict[str, Any], kind: str, tail: float) -> None:
    """Check what every verdict says of itself, whatever the game: its parts and its confidence."""
    record(f"the verdict of {name}", v, VERDICT)
    agree("the name of a verdict", name, v["name"])
    near(f"the confidence asked of {name}", 1 - tail, c["confidence"], 1e-12)
    if kind in STATISTICAL:
        near(f"the confidence of {name}", 1 - tail, v["confidence"], 1e-12)
    else:
        agree(f"the confidence of {name}", None, v["confidence"])


def counted(v: dict[str, Any], c: dict[str, Any], kind: str, tail: float, what: str) -> str:
    """Check what follows from the counts of a verdict alone; returns why no more can be checked."""
    why = f"no rollout was played again, since recheck has no model of {what}"
    if kind not in SHARES:
        return why
    k, n, name = v["successes"], v["trials"], v["name"]
    if k is None or n is None or not 0 <= k <= n <= c["rollouts"]:
        raise Rejected(f"certificate: {name} counts {k} successes in {n} trials, which cannot be.")
    if v["bound"] is not None:
        near(f"the bound of {name}", lower(k, n, tail), v["bound"], 1e-9)
    if v["holds"] and not (v["bound"] is not None and v["bound"] >= c["share"]):
        raise Rejected(f"certificate: {name} holds, but its bound is not the share that was asked.")
    return f"{why}; its bound is that of its counts" if v["bound"] is not None else why


def kind_of(name: str, asked: Any) -> str:
    """The kind of a certificate, which has to be known, and to have its own name and fields."""
    if asked is None:
        raise Rejected(f"certificate: {name} was not asked for.")
    kind = asked.get("kind") if isinstance(asked, dict) else None
    if kind not in ASKED:
        raise Rejected(f"certificate: {name} is of kind {kind}, which recheck does not know.")
    if name != usual(kind):
        raise Rejected(f"certificate: a {kind} is called {usual(kind)}, not {name}.")
    record(f"what is asked of {name}", asked, ASKED[kind] | dict(kind=TEXT, confidence=(float,)))
    for key, (low, high) in RANGES.items():
        if key in asked and not low < asked[key] < high:
            raise Rejected(f"certificate: {key} of {name}, {asked[key]}, is impossible.")
    return kind


ZERO = 1e-5  # of V's usual size: V on the target set


def at_target(sim: World) -> tuple[float, float]:
    """The largest |V| at 64 targets, and its median at as many starts."""
    key = sim.keys(np.arange(64), "calibrate")
    usual = np.median(np.abs(sim.value(*sim.starts(key)[:2])))
    return float(np.abs(sim.value(*sim.targets(key))).max()), float(usual)


def left_out(
    sim: World, say: Sentences, name: str, why: Any, asked: dict[str, Any]
) -> dict[str, str]:
    """Check why a certificate was left out; returns it with a reason where that cannot be done."""
    kind = {usual(kind): kind for kind in (*ASKED, "ClosedForm")}.get(name)
    if kind is None or name in asked:
        raise Rejected(f"certificate: {name!r} cannot have been left out.")
    V = re.compile(re.escape(say.not_zero("@", "@")).replace("@", "([0-9.e+-]{1,12})"))
    if kind in ASKS_V and (told := V.fullmatch(str(why))):
        sim.asked()
        for part, own, number in zip(
            ("worst", "usual"), at_target(sim), told.groups(), strict=True
        ):
            near(f"the {part} V of what was left out", own, float(number), 2e-2 * abs(own))
        if not at_target(sim)[0] > 0.5 * ZERO * at_target(sim)[1]:
            raise Rejected(f"certificate: {name} was left out, but V is 0 on the target set.")
        return {}
    T = re.fullmatch(r"contraction: (\d{1,9}) steps .*", str(why))
    fits = {"Safe": say.no_rule()}
    fits |= {"Shielded": say.no_shield()}
    fits |= {"Apart": say.alone()} if sim.game["agents"] == 1 else {}
    fits |= {"Contraction": say.too_long(int(T[1]))} if T and int(T[1]) > say.H else {}
    if fits.get(kind) == why:
        return {}
    if kind in ("ClosedForm", "Ellipsoid", "Proof"):
        return {name: "it was left out, and whether it had to be is not known here"}
    raise Rejected(f"certificate: the reason for leaving out {name} is not true.")


def usual(kind: str) -> str:
    """The name of the certificate of a kind: reach-and-stay for ReachAndStay."""
    return re.sub("(?!^)(?=[A-Z])", "-", kind).lower()


def unchecked(sim: World, kind: str) -> str:
    """Why a verdict of a kind that is known cannot be derived here."""
    if kind == "Safe":
        raise Rejected("certificate: safe is about rules, and a rendezvous has none.")
    if kind == "Shielded":
        raise Rejected("certificate: shielded is about games behind a shield, and this has none.")
    if kind == "Ellipsoid":
        return "a proof by intervals is not repeated here; repeat it with marlyap certify"
    if sim.game["agents"] != 1:
        raise Rejected("certificate: a proof is about one agent, and the game has more.")
    return "a proof over boxes is not repeated here; repeat it with experiments/proof.py"
