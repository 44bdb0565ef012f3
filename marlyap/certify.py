"""Every certificate of one controller, together: shared confidence, one file, fixed beforehand."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marlyap import store
from marlyap.certificate import AbstractCertificate, Verdict
from marlyap.errors import UserError
from marlyap.game import AbstractGame
from marlyap.identity import named_arrays, plain, policy_hash, without_arrays, words
from marlyap.lyapunov_function import AbstractLyapunov, CostSum, cost_sum, require_zero
from marlyap.rollout import Controller
from marlyap.seeds import stream
from marlyap.statistics import bonferroni


KIND = "certificate"


def certify(
    game: AbstractGame,
    controller: Controller,
    certificates: Mapping[str, AbstractCertificate],
    seed: int,
    confidence: float,
    *,
    V: AbstractLyapunov | None = None,
    checkpoints: int = 1,
    policy: str | None = None,
    tell: Callable[[Verdict], None] = lambda verdict: None,
) -> dict[str, Any]:
    """The verdicts of all `certificates`, true together with `confidence`; `holds` if all hold.

    Each sampled one is asked at 1 - (1 - confidence) / (claims * checkpoints) (Bonferroni), with
    `checkpoints` the number of controllers among which this one was or will be chosen by
    certificates. V is by default `cost_sum`. `policy` is the hash that the controller was declared
    with, and `tell` hears of each verdict at once.

    Raises UserError if V is asked about and not 0 on the target set, if there are too few rollouts
    for the confidence asked for, or if the controller is not the one declared.
    """
    if not certificates:
        raise UserError("certificates: there must be at least one.")
    digest = policy_hash(controller)
    if policy is not None and policy != digest:
        raise UserError(
            f"policy: its hash is {digest[:12]}, not the declared {policy[:12]}; a certificate is "
            "for a policy that was fixed beforehand."
        )
    key = stream(seed, "calibrate")
    V = cost_sum(game, controller, key) if V is None else V
    if any(c.asks_V for c in certificates.values()):
        require_zero(game, V, key)
    sampled = sum(c.evidence == "statistical" for c in certificates.values())
    each = bonferroni(confidence, max(1, sampled) * checkpoints)
    asked = {name: dataclasses.replace(c, confidence=each) for name, c in certificates.items()}
    verdicts = {}
    for name, certificate in asked.items():
        verdicts[name] = certificate.check(game, controller, V, seed)
        tell(verdicts[name])
    return {
        "schema": 1,
        "holds": all(v.holds for v in verdicts.values()),
        "confidence": confidence,
        "confidence_each": each,
        "checkpoints": checkpoints,
        "seed": seed,
        "policy": digest,
        "game": plain(game),
        "controller": plain(without_arrays(controller)),
        "V": plain(without_arrays(V)),
        "certificates": {name: plain(c) for name, c in asked.items()},
        "verdicts": {name: verdict.as_dict() for name, verdict in verdicts.items()},
    }


def save(
    directory: Path,
    result: Mapping[str, Any],
    game: AbstractGame,
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
    store.write(Path(directory), KIND, arrays, plain(dict(result)), replace=replace)
