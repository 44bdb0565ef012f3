"""An independent checker of certificates: NumPy in float64, and nothing of what made them.

From the recorded seed it draws starts, disturbances and times anew; it integrates, and evaluates
observations, networks and V from the recorded arrays; it counts again, computes the exact bounds,
and writes claims, scopes and worst cases anew. All of it has to be what the file says, for what was
asked. What it does not know it refuses by name; what no rollout can show it lists as not checked.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from marlyap.recheck import checks
from marlyap.recheck.checks import Case, near
from marlyap.recheck.reader import Arrays, Rejected, agree, policy_hash, read, record
from marlyap.recheck.sentences import Sentences
from marlyap.recheck.world import FLAG, LIST, NUMBER, OBJECT, TEXT, WHOLE, World


MALFORMED = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)
NONE = type(None)
FILE = dict(schema=WHOLE, holds=FLAG, confidence=(float,), confidence_each=(float,))
FILE |= dict(checkpoints=WHOLE, seed=WHOLE, policy=TEXT, game=OBJECT, controller=OBJECT, V=OBJECT)
FILE |= dict(certificates=OBJECT, verdicts=OBJECT)
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
    "Proof": dict(c=NUMBER, rho=NUMBER, inner=NUMBER, half=LIST, eta=NUMBER, decay=NUMBER)
    | dict(most=WHOLE, batch=WHOLE, resume=(str, NONE), show=FLAG),
}
CHECKS: dict[str, Callable[[Case], dict[str, Any]]] = {
    "Reach": checks.reach,
    "ReachAndStay": checks.reach,
    "Decrease": checks.decrease,
    "Contraction": checks.contraction,
    "Basin": checks.basin,
    "Quantiles": checks.quantiles,
    "Robustness": checks.robustness,
    "Composition": checks.composition,
    "Theorem1": checks.theorem1,
}
STATISTICAL = CHECKS.keys()  # those that share the confidence
ASKS_V = ("Decrease", "Basin", "Quantiles", "Theorem1")


def recheck(
    path: Path | str, tell: Callable[[str, dict[str, Any]], None] = lambda name, verdict: None
) -> dict[str, Any]:
    """Derive every verdict of a certificate anew.

    Returns `agrees` (whether every verdict was derived again, each as the file says), `holds` (what
    the file says of all together; None where not all could be derived), `rechecked` and
    `not_rechecked` (names, with the reason). `tell` hears of each verdict as soon as it agrees.

    Raises Rejected (a UserError) at the first thing that differs and for a file that is damaged or
    no certificate, and UserError for one about a game or a controller that it does not know.
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
    sim = World(meta, arrays)
    shared = max(1, sum(kind in STATISTICAL for kind in kinds.values()))
    tail = (1 - meta["confidence"]) / (shared * meta["checkpoints"])
    near("the confidence of each certificate", 1 - tail, meta["confidence_each"], 1e-12)
    say, done, left = Sentences(meta["game"], meta["V"]), {}, {}
    for name, v in verdicts.items():
        c, kind = asked[name], kinds[name]
        record(f"the verdict of {name}", v, VERDICT)
        agree("the name of a verdict", name, v["name"])
        near(f"the confidence asked of {name}", 1 - tail, c["confidence"], 1e-12)
        if kind in STATISTICAL:
            near(f"the confidence of {name}", 1 - tail, v["confidence"], 1e-12)
        else:
            agree(f"the confidence of {name}", None, v["confidence"])
        if kind in ASKS_V:
            sim.asked()
        if kind not in CHECKS:
            left[name] = unchecked(sim, kind)
            continue
        found = CHECKS[kind](Case(sim, say, v, c, tail))
        if "left" in found:
            left[name] = found["left"]
            continue
        done[name] = found
        tell(name, v)
    agree("whether all hold", all(v["holds"] for v in verdicts.values()), meta["holds"])
    holds = None if left else meta["holds"]
    return {"agrees": not left, "holds": holds, "rechecked": done, "not_rechecked": left}


def kind_of(name: str, asked: Any) -> str:
    """The kind of a certificate, which has to be known, and to have its own name and fields."""
    if asked is None:
        raise Rejected(f"certificate: {name} was not asked for.")
    kind = asked.get("kind") if isinstance(asked, dict) else None
    if kind not in ASKED:
        raise Rejected(f"certificate: {name} is of kind {kind}, which recheck does not know.")
    usual = re.sub("(?!^)(?=[A-Z])", "-", kind).lower()
    if name != usual:
        raise Rejected(f"certificate: a {kind} is called {usual}, not {name}.")
    record(f"what is asked of {name}", asked, ASKED[kind] | dict(kind=TEXT, confidence=(float,)))
    return kind


def unchecked(sim: World, kind: str) -> str:
    """Why a verdict of a kind that is known cannot be derived here."""
    if sim.game["agents"] != 1:
        raise Rejected("certificate: a proof is about one agent, and the game has more.")
    return "a proof over boxes is not repeated here; repeat it with experiments/proof.py"
