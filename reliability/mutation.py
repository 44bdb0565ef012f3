"""Mutants of the files that matter most, and how many of them the tests aimed at them kill.

    python reliability/mutation.py [--file WORD] [--sample N] [--minutes M]

A mutant differs in one place: a comparison, an arithmetic or logical operator, a number, a sign, a
condition, min for max. Left alone are docstrings and messages, annotations, decorators, and the
defaults of hyperparameters, which no test should pin.
"""

import argparse
import ast
import copy
import json
import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from sandbox import changed, run, sandbox


AIMED = {
    "marlyap/statistics.py": ["tests/test_statistics.py"],
    "marlyap/learning/algorithms/masac.py": ["tests/test_paper.py"],
    "marlyap/learning/constraints/lyapunov.py": ["tests/test_paper.py"],
    "marlyap/learning/constraints/readings.py": ["tests/test_paper.py"],
    "marlyap/learning/on_policy.py": ["tests/test_on_policy.py"],
}
OTHER = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Pow: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "all": "any"}
NAMES |= {"any": "all", "low": "high", "high": "low", "sum": "mean", "mean": "sum"}


def places(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int | None]]:
    """(node, field, index) of all that may be changed."""
    for node in _code(tree):
        if isinstance(node, ast.Compare):
            yield from ((node, "ops", i) for i, op in enumerate(node.ops) if type(op) in OTHER)
        elif isinstance(node, (ast.BinOp, ast.AugAssign, ast.BoolOp)) and type(node.op) in OTHER:
            yield node, "op", None
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
            yield node, "value", None
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not, ast.Invert)):
            yield node, "operand", None
        elif isinstance(node, (ast.If, ast.IfExp)):
            yield node, "test", None
        elif isinstance(node, ast.Attribute) and node.attr in NAMES:
            yield node, "attr", None


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """What is executed: no annotations, decorators, messages or class-level defaults."""
    yield node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        if isinstance(node, (ast.AnnAssign, ast.JoinedStr)):
            continue
        if isinstance(node, ast.Raise):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def mutants(source: str) -> Iterator[tuple[int, str, str]]:
    """(line, what was changed, source) of every mutant."""
    tree = ast.parse(source)
    for number in range(len(list(places(tree)))):
        twin = copy.deepcopy(tree)
        node, field, index = list(places(twin))[number]
        before = ast.unparse(node)
        old = getattr(node, field)
        if field == "value":
            new = not old if type(old) is bool else old + 1
        elif field == "attr":
            new = NAMES[old]
        elif field == "test":
            new = ast.UnaryOp(ast.Not(), old)
        elif field == "operand":
            new = None
        else:
            new = OTHER[type(old if index is None else old[index])]()
        if new is None:  # the sign goes
            for parent in ast.walk(twin):
                for name, value in ast.iter_fields(parent):
                    if value is node:
                        setattr(parent, name, old)
                    elif isinstance(value, list) and node in value:
                        value[value.index(node)] = old
            after = ast.unparse(old)
        else:
            if index is None:
                setattr(node, field, new)
            else:
                old[index] = new
            after = ast.unparse(node)
        ast.fix_missing_locations(twin)
        yield getattr(node, "lineno", 0), f"{_short(before)} -> {_short(after)}", ast.unparse(twin)


def _short(text: str) -> str:
    return " ".join(text.split())[:70]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--file", default="", help="files whose name has this word in it")
    parser.add_argument("--sample", type=int, default=0, help="mutants of each file (0: all)")
    parser.add_argument("--minutes", type=float, default=30.0, help="to stop after, in all")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    parser.add_argument("--list", action="store_true", help="only count them")
    args = parser.parse_args()
    end, table = time.monotonic() + 60 * args.minutes, {}
    with sandbox() as place:
        for file, tests in AIMED.items():
            if args.file not in file:
                continue
            found = list(mutants((place / file).read_text()))
            print(f"{file}: {len(found)} mutants", flush=True)
            if args.list:
                continue
            chosen = random.Random(0).sample(found, min(args.sample or len(found), len(found)))
            row = {"mutants": len(found), "tried": 0, "killed": 0, "survivors": []}
            for line, what, source in chosen:
                if time.monotonic() > end:
                    break
                with changed(place, {file: source}):
                    verdict, seconds, _ = run(place, tests)
                row["tried"] += 1
                row["killed"] += verdict != "passed"
                if verdict == "passed":
                    row["survivors"].append([line, what])
                print(f"{verdict:7} {seconds:6.1f} s  {file}:{line}  {what}", flush=True)
            table[file] = row
            print(f"{file}: {row['killed']} of {row['tried']} killed", flush=True)
    if args.out:
        args.out.write_text(json.dumps(table, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
