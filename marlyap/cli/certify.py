"""`marlyap certify`: what holds of one controller, with what evidence."""

import sys
from argparse import ArgumentParser, Namespace

from marlyap.cli.common import Overrides, Result, say
from marlyap.cli.environment import prepare
from marlyap.cli.options import OWN_TASK, SUBJECT, measured_on, number, place
from marlyap.errors import UserError, check_range


SUMMARY = "say what holds of a run or controller, with what evidence"
EPILOG = SUBJECT
EXAMPLES = """
  marlyap certify runs/demo/seed0
  marlyap certify runs/demo/seed0 --certificates reach --task.size 2 --out certificate
  marlyap certify tree-pursuit --task rendezvous --out certificate
  marlyap certify runs/demo/seed0 --shield --certificates shielded --out certificate"""


def options(p: ArgumentParser) -> None:
    p.add_argument("run", metavar="RUN", help="a run directory or a controller name")
    measured_on(p, OWN_TASK)
    p.add_argument("--certificates", nargs="+", default=None, help="names (default: the sampled)")
    each = "fresh starts of each (default 10000; robustness 2000, theorem1 and composition 5000)"
    p.add_argument("--rollouts", type=number, default=None, help=each)
    p.add_argument("--confidence", type=float, default=0.999, help="of all claims together")
    p.add_argument("--seed", type=number, default=0, help="of the starts (default 0)")
    p.add_argument("--out", type=place, default=None, help="directory (default RUN/certificate)")
    p.add_argument("--force", action="store_true", help="overwrite a certificate that is there")


def run(args: Namespace, overrides: Overrides) -> Result:
    """The verdicts of several certificates on one controller, stored to be rechecked."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    if args.rollouts is not None:
        check_range("rollouts", args.rollouts, 1, 10_000_000)
    prepare()
    from marlyap.certificates.certificate import sentence
    from marlyap.certificates.certify import certify, save
    from marlyap.certificates.lyapunov import cost_sum
    from marlyap.cli import claims
    from marlyap.games.game import regulated
    from marlyap.seeds import stream

    controller, game, out = claims.about(
        args.run, args.task, args.algorithm, overrides, args.out, args.shield
    )
    if out.exists() and not args.force:
        raise UserError(f"out: {out} already exists; choose another or add --force.")
    usual = claims.usual(game)
    chosen = claims.chosen(args.certificates or usual, args.rollouts)
    game = regulated(game)
    V = cost_sum(game, controller, stream(args.seed, "calibrate"))
    if V.ball > game.edge:
        say(
            f"V ignores errors below {V.ball:g} {V.unit}: started on the target, this controller "
            "drifts that far."
        )
    tell = say if args.json else print

    def begin(name: str) -> None:
        if sys.stderr.isatty():  # each takes some seconds
            say(f"{name} ...")

    result = certify(
        game,
        controller,
        chosen,
        args.seed,
        args.confidence,
        V=V,
        optional=() if args.certificates else usual,
        begin=begin,
        tell=lambda verdict: tell(f"[{verdict.evidence}] {sentence(verdict)}"),
    )
    for name, why in result["left_out"].items():
        tell(f"[left out] {name}: {why.removeprefix(f'{name}: ')}")
    tell(f"Information: {result['information']}.")
    save(out, result, game, controller, V, replace=args.force)
    say(f"Certificate: {out}")
    return result | {"certificate": str(out)}, 0
