"""The contract of a bundle: what it holds, sealed over itself and every file. No JAX is needed."""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.storage import store


SCHEMA = 1
CONTRACT, WEIGHTS, GOLDEN, STARTS = (
    "contract.json",
    "weights.safetensors",
    "golden.safetensors",
    "starts.safetensors",
)
RUNTIME, SOURCE, HEADER = "runtime.py", "controller.c", "controller.h"
RUNTIMES = ("numpy", "onnx", "c")
ANOTHER = "export it again, or use another copy"
MOST = 64 * 2**20  # bytes of a file that is read

Contract = dict[str, Any]


def sealed(body: Mapping[str, Any], files: Mapping[str, bytes]) -> bytes:
    """`contract.json`: the body, the size and SHA-256 of every file, and the seal over all."""
    table = {name: {"bytes": len(raw), "sha256": _sha(raw)} for name, raw in files.items()}
    return store.sealed({**body, "files": table})


def load(directory: Path) -> Contract:
    """The contract of a bundle, every byte of the bundle verified against it.

    Raises UserError for a directory that is no bundle, or in which anything was altered, is missing
    or does not belong.
    """
    path = directory / CONTRACT
    if not path.is_file():
        where = "is a run; export it first" if (directory / "run.json").is_file() else ""
        raise UserError(f"bundle: {directory} {where or 'holds no contract.json; check the path'}.")
    found = store.read_json(path)
    if not isinstance(found, dict) or type(found.get("schema")) is not int:
        raise UserError(f"bundle: {path} is not a contract; {ANOTHER}.")
    if found["schema"] > SCHEMA:
        raise UserError(
            f"bundle: {path} was written by a newer marlyap (schema {found['schema']}); upgrade "
            "yours."
        )
    body = {key: value for key, value in found.items() if key != "sha256"}
    if path.read_bytes() != store.sealed(body):
        raise UserError(f"bundle: {path} was altered after it was written; {ANOTHER}.")
    _compare(directory, found["files"])
    return found


def _compare(directory: Path, files: Mapping[str, Any]) -> None:
    """Raise UserError unless the directory holds these files, unaltered, and no other."""
    there = {name for name in os.listdir(directory) if name != "__pycache__"}
    for name in sorted({*files, CONTRACT} ^ there):
        what = "is missing" if name in files else "does not belong to the bundle; move it away"
        raise UserError(f"bundle: {directory / name} {what}; {ANOTHER}.")
    for name, facts in files.items():
        path = directory / name
        if path.is_symlink() or path.stat().st_size > MOST:
            raise UserError(f"bundle: {path} is a link or too large; {ANOTHER}.")
        raw = path.read_bytes()
        if (len(raw), _sha(raw)) != (facts["bytes"], facts["sha256"]):
            raise UserError(f"bundle: {path} was altered after it was written; {ANOTHER}.")


def runtimes(contract: Contract) -> tuple[str, ...]:
    """The runtimes that the bundle has."""
    files = contract["files"]
    there = {"numpy": RUNTIME in files, "c": SOURCE in files}
    there["onnx"] = any(name.endswith(".onnx") for name in files)
    return tuple(name for name in RUNTIMES if there[name])


def role(contract: Contract, name: str) -> dict[str, Any]:
    """What the contract says of one robot. Raises UserError where there is none of this name."""
    for found in contract["roles"]:
        if found["name"] == name:
            return found
    names = ", ".join(r["name"] for r in contract["roles"])
    raise UserError(f"role: there is none called '{name}'; there is {names}.")


def for_robots(contract: Contract, what: str) -> None:
    """Raise UserError unless the bundle's policy takes what a robot measures and hears."""
    if contract["sight"] is None:
        raise UserError(
            f"{what}: the policy of {contract['task']} takes a whole observation, which only its "
            "game can make; a team of processes needs robots in the plane."
        )


def _sha(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()
