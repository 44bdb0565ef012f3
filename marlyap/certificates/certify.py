"""Every certificate of one controller, together: shared confidence, one file, fixed beforehand."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marlyap.certificates.certificate import AbstractCertificate, Verdict
from marlyap.certificates.information import information
from marlyap.certificates.loop import ClosedLoop
from marlyap.certificates.lyapunov import AbstractLyapunov, CostSum, cost_sum, require_zero
from marlyap.errors import UserError
from marlyap.games.game import AbstractRegulation
from marlyap.seeds import stream
from marlyap.simulation.evaluation import drives
from marlyap.simulation.rollout import Controller
from marlyap.statistics import bonferroni
from marlyap.storage import store
from marlyap.storage.hashing import as_json, named_arrays, policy_hash, without_arrays, words
from marlyap.types import Key


KIND = "certificate"


def certify(
    game: AbstractRegulation,
    controller: Controller,
    certificates: Mapping[str, AbstractCertificate],
    seed: int,
    confidence: float,
    *,
    V: AbstractLyapunov | None = None,
    checkpoints: int = 1,
    policy: str | None = None,
    optional: Collection[str] = (),
    begin: Callable[[str], None] = lambda name: None,
    tell: Callable[[Verdict], None] = lambda verdict: None,
) -> dict[str, Any]:
    """The verdicts of all `certificates`, true together with `confidence`; `holds` if all hold.

    A certificate that is not about such a game, controller or V is left out, and `left_out` says
    why: those that need V, for one, where V is not 0 on the target set. `holds` is then false,
    unless the certificate was `optional`. `information` says what the agents act on, and is part of
    every verdict's scope.

    Each sampled one is asked at 1 - (1 - confidence) / (claims * checkpoints) (Bonferroni), with
    `checkpoints` the number of controllers among which this one was or will be chosen by
    certificates. V is by default `cost_sum`. `policy` is the hash that the controller was declared
    with. `begin` hears of each certificate before it is checked, `tell` of each verdict at once.

    Raises UserError if no certificate is left, if there are too few rollouts for the confidence
    asked for, or if the controller is not the one declared, or not one for this game.
    """
    if not certificates:
        raise UserError("certificates: there must be at least one.")
    digest = policy_hash(controller)
    if policy is not None and policy != digest:
        raise UserError(
            f"policy: its hash is {digest[:12]}, not the declared {policy[:12]}; a certificate is "
            "for a policy that was fixed beforehand."
        )
    drives(game, controller)
    key = stream(seed, "calibrate")
    V = cost_sum(game, controller, key) if V is None else V
    loop = ClosedLoop(game, controller, V)
    left_out = refused(certificates, loop, key)
    kept = {name: c for name, c in certificates.items() if name not in left_out}
    if not kept:
        raise UserError(" ".join(dict.fromkeys(left_out.values())))
    sampled = sum(c.evidence == "statistical" for c in kept.values())
    each = bonferroni(confidence, max(1, sampled) * checkpoints)
    asked = {name: dataclasses.replace(c, confidence=each) for name, c in kept.items()}
    uses, verdicts = information(game, loop.controller, key), {}
    for name, certificate in asked.items():
        begin(name)
        verdict = certificate.check(loop, seed)
        scope = verdict.scope | {"information": uses}
        verdicts[name] = dataclasses.replace(verdict, scope=scope)
        tell(verdicts[name])
    return {
        "schema": 1,
        "holds": all(v.holds for v in verdicts.values()) and {*left_out} <= {*optional},
        "information": uses,
        "left_out": left_out,
        "confidence": confidence,
        "confidence_each": each,
        "checkpoints": checkpoints,
        "seed": seed,
        "policy": digest,
        "game": as_json(game),
        "controller": as_json(without_arrays(controller)),
        "V": as_json(without_arrays(V)),
        "certificates": {name: as_json(c) for name, c in asked.items()},
        "verdicts": {name: verdict.as_dict() for name, verdict in verdicts.items()},
    }


def refused(
    certificates: Mapping[str, AbstractCertificate], loop: ClosedLoop, key: Key
) -> dict[str, str]:
    """Which certificates are not about such a game, controller or V, each with one sentence."""
    reasons, zero = {}, None
    if any(c.asks_V for c in certificates.values()):
        zero = why_not(lambda: require_zero(loop.game, loop.V, key))
    for name, certificate in certificates.items():
        why = why_not(lambda c=certificate: c.refuse(loop))
        why = why or (zero if certificate.asks_V else None)
        if why is not None:
            reasons[name] = why
    return reasons


def why_not(check: Callable[[], None]) -> str | None:
    """The sentence of the UserError that `check` raises; None if it raises none."""
    try:
        check()
    except UserError as error:
        return str(error)
    return None


def save(
    directory: Path | str,
    result: Mapping[str, Any],
    game: AbstractRegulation,
    controller: Controller,
    V: AbstractLyapunov | None = None,
    *,
    replace: bool = False,
) -> None:
    """Store a result of `certify` with all that an independent checker needs.

    That is the arrays of the controller and of V; what was drawn at random follows from the seed.
    """
    if policy_hash(controller) != result["policy"]:
        raise UserError("policy: this controller is not the one that was certified.")
    V = CostSum(controller=controller, ball=result["V"]["ball"]) if V is None else V
    arrays = {f"controller/{k}": v for k, v in named_arrays(controller).items()}
    arrays["controller/words"] = words(controller)
    arrays |= {f"V/{k}": v for k, v in named_arrays(V).items()}
    arrays = {k: np.asarray(v) for k, v in arrays.items()}
    store.write(Path(directory), KIND, arrays, as_json(dict(result)), replace=replace)
