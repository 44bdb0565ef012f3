"""Read a stored certificate, and believe nothing in it that its hashes and layout do not bear out.

A certificate is a directory of two files: `manifest.json`, strict JSON sealed by a SHA-256 of its
own, and `arrays.safetensors`, whose every array has a SHA-256 in the manifest.
"""

import hashlib
import json
import math
import os
import stat
import struct
from pathlib import Path
from typing import Any

import numpy as np

from marlyap.errors import UserError


MANIFEST, PAYLOAD = "manifest.json", "arrays.safetensors"
MOST_TEXT, MOST_DATA = 16 * 2**20, 2**30  # bytes
DEEPEST = 64  # levels of nested JSON
SCHEMA = 1
PARTS = ("schema", "kind", "meta", "files", "arrays", "versions", "sha256")
# The names that safetensors has for NumPy's types.
TYPES = {"bool": "BOOL", "float32": "F32", "float64": "F64"}
TYPES |= {f"{u}int{n}": f"{u[:1].upper() or 'I'}{n}" for u in ("", "u") for n in (8, 16, 32, 64)}

Arrays = dict[str, np.ndarray]


class Rejected(UserError):
    """The file does not say what its own starts and arrays give."""


def agree(what: str, found: Any, said: Any) -> None:
    """Raise Rejected unless both are the same JSON, so that neither 1.0 nor true passes for 1.

    Of objects it names the first part that differs.
    """
    if json.dumps(found, sort_keys=True) == json.dumps(said, sort_keys=True):
        return
    if isinstance(found, dict) and isinstance(said, dict):
        for key in [*said, *found]:
            if key not in found or key not in said:
                has = "nothing that recheck knows" if key not in found else "missing"
                raise Rejected(f"certificate: {key!r} of {what} is {has}.")
            agree(f"{key} of {what}", found[key], said[key])
    short = lambda value: value if isinstance(value, str) else f"{value!r:.200}"
    told = f"not {short(said)} as the file says"
    raise Rejected(f"certificate: {what} is {short(found)}, {told}.")


def record(what: str, value: Any, types: dict[str, tuple[type, ...]]) -> None:
    """Raise Rejected unless `value` is an object of exactly these keys, of these types."""
    if not isinstance(value, dict):
        raise Rejected(f"certificate: {what} is not an object.")
    for key in [*value, *types]:
        if key not in types:
            raise Rejected(f"certificate: {what} has {key!r}, which recheck does not know.")
        if key not in value:
            raise Rejected(f"certificate: {what} has no {key!r}.")
        if type(value[key]) not in types[key]:
            kind = " or ".join(t.__name__ for t in types[key])
            raise Rejected(
                f"certificate: {key} of {what} is {value[key]!r:.80}, not of type {kind}."
            )


def read(directory: Path) -> tuple[Arrays, dict[str, Any]]:
    """The arrays and the meta, every byte verified.

    Raises Rejected for a directory that is no certificate or was damaged or altered.
    """
    try:
        handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        what = f"cannot be opened as a certificate ({error.strerror})"
        raise Rejected(f"{directory} {what}; check the path.") from None
    try:
        listed(directory, {*os.listdir(handle)})
        manifest = opened(content(handle, directory, MANIFEST, MOST_TEXT), directory / MANIFEST)
        data = content(handle, directory, PAYLOAD, MOST_DATA)
    finally:
        os.close(handle)
    return unpacked(data, manifest, directory / PAYLOAD), manifest["meta"]


def listed(directory: Path, names: set[str]) -> None:
    """Raise Rejected unless these are the names of the two files."""
    if "run.json" in names:
        place = directory / "certificate"
        has = f"its certificate is {place}" if "certificate" in names else "it has no certificate"
        raise Rejected(f"{directory} is not a certificate: that is a run; {has}.")
    for name in sorted({MANIFEST, PAYLOAD} - names):
        raise Rejected(f"{directory / name} is missing; use another copy of this certificate.")
    for name in sorted(names - {MANIFEST, PAYLOAD}):
        other = f"{name} does not belong to a certificate, which is {PAYLOAD} and {MANIFEST} only"
        raise Rejected(f"{directory}: {other}; check the path.")


def content(handle: int, directory: Path, name: str, most: int) -> bytes:
    """The bytes of a regular file of at most `most` bytes; a link is not followed."""
    path, flags = directory / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        file = os.open(name, flags, dir_fd=handle)
    except OSError as error:
        what = "it is a link" if path.is_symlink() else error.strerror
        raise Rejected(f"{path} cannot be read ({what}); use another copy.") from None
    with os.fdopen(file, "rb") as stream:
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            raise Rejected(f"{path} is not a file of at most {most} bytes; use another copy.")
        return stream.read(most)


def opened(raw: bytes, path: Path) -> dict[str, Any]:
    """The manifest: sealed, of this schema, with the parts it has to have and no other."""
    try:
        found = strict(raw)
    except ValueError as error:
        raise Rejected(f"{path} is not strict JSON ({error}); use another copy.") from None
    if not isinstance(found, dict):
        raise Rejected(f"{path} is not a manifest; use another copy.")
    if type(found.get("schema")) is int and found["schema"] > SCHEMA:
        raise Rejected(f"{path} was written by a newer marlyap; check it with that one.")
    if set(found) != {*PARTS} or type(found["schema"]) is not int or found["schema"] != SCHEMA:
        raise Rejected(f"{path} is not a manifest of schema {SCHEMA}; use another copy.")
    body = {key: value for key, value in found.items() if key != "sha256"}
    seal = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    if raw != json.dumps({**body, "sha256": seal}, indent=1).encode() + b"\n":
        raise Rejected(f"{path} was altered after it was written; use another copy.")
    if found["kind"] != "certificate":
        raise Rejected(f"{path} is of kind {found['kind']!r}, not a certificate; check the path.")
    file, meta, arrays = found["files"], found["meta"], found["arrays"]
    sound = isinstance(file, dict) and [*file] == [PAYLOAD] and isinstance(file[PAYLOAD], dict)
    sound = sound and {*file[PAYLOAD]} == {"sha256", "bytes"} and isinstance(meta, dict)
    versions = found["versions"]
    sound = sound and isinstance(versions, dict)
    sound = sound and all(isinstance(text, str) for text in versions.values())
    sound = sound and isinstance(arrays, dict) and all(map(described, arrays.values()))
    if not sound:
        raise Rejected(f"{path} has a malformed entry; do not trust where it came from.")
    return found


def described(entry: Any) -> bool:
    """Whether an entry of the manifest describes an array."""
    if not isinstance(entry, dict) or {*entry} != {"dtype", "shape", "sha256"}:
        return False
    shape, dtype = entry["shape"], entry["dtype"]
    if not isinstance(dtype, str) or dtype not in TYPES or not isinstance(shape, list):
        return False
    return len(shape) <= 32 and all(type(n) is int and 0 <= n < 2**32 for n in shape)


def unpacked(data: bytes, manifest: dict[str, Any], path: Path) -> Arrays:
    """The arrays, laid out as the payload's header says and as the manifest describes them."""
    table, said = manifest["arrays"], manifest["files"][PAYLOAD]
    whole = hashlib.sha256(data).hexdigest()
    if (len(data), whole) != (said["bytes"], said["sha256"]) or type(said["bytes"]) is not int:
        raise Rejected(f"{path} is damaged; use another copy of this certificate.")
    other = Rejected(f"{path} does not hold what its manifest describes; use another copy.")
    length = struct.unpack("<Q", data[:8])[0] if len(data) >= 8 else len(data)
    if length > len(data) - 8:
        raise other
    try:
        header = strict(data[8 : 8 + length].rstrip(b" "))
    except ValueError:
        raise other from None
    if not isinstance(header, dict) or {*header} != {*table}:
        raise other
    arrays, end, body = {}, 0, data[8 + length :]
    for key, entry in header.items():
        dtype, shape = np.dtype(table[key]["dtype"]), table[key]["shape"]
        stop = end + dtype.itemsize * math.prod(shape)
        expected = {"dtype": TYPES[dtype.name], "shape": shape, "data_offsets": [end, stop]}
        part = body[end:stop]
        if json.dumps(entry, sort_keys=True) != json.dumps(expected, sort_keys=True):
            raise other
        if len(part) != stop - end or hashlib.sha256(part).hexdigest() != table[key]["sha256"]:
            raise other
        arrays[key], end = np.frombuffer(part, dtype.newbyteorder("<")).reshape(shape), stop
    if end != len(body):
        raise other
    return arrays


def strict(raw: bytes) -> Any:
    """JSON without a key written twice, NaN, infinity, half a surrogate pair or deep nesting."""
    try:
        value = json.loads(
            raw.decode(),
            object_pairs_hook=unique,
            parse_float=finite_number,
            parse_constant=finite_number,
        )
        if deep(value, DEEPEST):
            raise ValueError("it is nested too deeply")
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    json.dumps(value, ensure_ascii=False).encode()
    return value


def deep(value: Any, room: int) -> bool:
    """Whether JSON is nested more than `room` levels."""
    inner = [*value.values()] if isinstance(value, dict) else value
    return isinstance(inner, list) and (room == 0 or any(deep(v, room - 1) for v in inner))


def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, each key of which is written once."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is written twice")
    return found


def finite_number(text: str) -> float:
    """A number that is finite."""
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text[:20]} is not a finite number")
    return number


def policy_hash(arrays: Arrays) -> str:
    """SHA-256 over names, types, shapes and contents of a controller's arrays and words."""
    of = lambda a: hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest()
    table = {
        key: {"dtype": a.dtype.name, "shape": [*a.shape], "sha256": of(a)}
        for key, a in arrays.items()
    }
    text = json.dumps(table, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
