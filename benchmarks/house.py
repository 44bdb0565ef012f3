"""How the package is laid out: folders, files, imports between them, long files and functions.

    python benchmarks/house.py                  the package as it lies here
    python benchmarks/house.py v0.1.0 HEAD      at several commits, side by side
    python benchmarks/house.py --json           the same as JSON

A unit is a folder of the package, or a module beside the folders. An arrow is a pair of units of
which one imports the other; the depth is the number of units on the longest chain of arrows. A
function's lines include its signature and docstring, not its decorators.
"""

import argparse
import ast
import io
import json
import subprocess
import tarfile
from functools import cache
from pathlib import Path
from typing import Any


ROOT = Path(__file__).parents[1]
PACKAGE = "marlyap"
LONG = 40  # lines of a function that is called long

Sources = dict[str, str]  # text by path, such as marlyap/tasks/formation.py


def sources(commit: str | None) -> Sources:
    """The Python files of the package at a commit, or as they lie here."""
    if commit is None:
        paths = [p for p in (ROOT / PACKAGE).rglob("*.py") if "__pycache__" not in p.parts]
        return {str(p.relative_to(ROOT)): p.read_text() for p in paths}
    command = ["git", "-C", str(ROOT), "archive", commit, PACKAGE]
    archive = tarfile.open(fileobj=io.BytesIO(subprocess.check_output(command)))
    files = {m.name: archive.extractfile(m) for m in archive if m.name.endswith(".py")}
    return {name: file.read().decode() for name, file in files.items() if file}


def counts(files: Sources) -> dict[str, Any]:
    """What the table shows of one layout."""
    trees = {path: ast.parse(text) for path, text in files.items()}
    files = {path: text for path, text in files.items() if text.strip()}
    lines = {path: text.count("\n") for path, text in files.items()}
    modules = {_module(path): _unit(path) for path in trees}
    inner = [path for path in trees if path.count("/") > 1 or path.endswith("__main__.py")]
    beside = [path for path in trees if path not in inner and not path.endswith("__init__.py")]
    arrows = {
        (_unit(path), modules[name])
        for path, tree in trees.items()
        if _unit(path) != PACKAGE  # it lists the public names
        for name in _imported(tree, modules)
        if modules[name] not in (_unit(path), PACKAGE)
    }
    functions = {
        f"{path}: {node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    }
    longest, widest = max(functions, key=lambda k: functions[k]), max(lines, key=lambda k: lines[k])
    return {
        "folders": len({str(Path(path).parent) for path in trees}) - 1,
        "modules beside the folders": len(beside),
        "files": len(files),
        "lines": sum(lines.values()),
        "arrows between units": len(arrows),
        "depth of imports": _depth(arrows),
        "longest file": f"{widest} ({lines[widest]})",
        "longest function": f"{longest} ({functions[longest]})",
        f"functions of more than {LONG} lines": sum(n > LONG for n in functions.values()),
    }


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _unit(path: str) -> str:
    """The folder below the package, or the module beside the folders."""
    name = _module(path)
    return name.split(".")[1] if "." in name else name


def _imported(tree: ast.Module, modules: dict[str, str]) -> set[str]:
    """The modules of the package that are imported anywhere in a file."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            below = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
            found |= below | ({node.module} if len(below) < len(node.names) else set())
    return found & modules.keys()


def _depth(arrows: set[tuple[str, str]]) -> int:
    uses = {a: {b for c, b in arrows if c == a} for a, _ in arrows}

    @cache
    def below(unit: str) -> int:
        return 1 + max((below(used) for used in uses.get(unit, ())), default=0)

    return max(map(below, uses))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commits", nargs="*", help="commits; none: the files as they lie here")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    table = {commit or "here": counts(sources(commit)) for commit in args.commits or [None]}
    if args.json:
        print(json.dumps(table, indent=1))
        return
    print("| | " + " | ".join(table) + " |\n" + "|---" * (len(table) + 1) + "|")
    for name in next(iter(table.values())):
        print(f"| {name} | " + " | ".join(f"{column[name]}" for column in table.values()) + " |")


if __name__ == "__main__":
    main()
