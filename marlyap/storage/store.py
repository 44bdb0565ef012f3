"""The one place that writes arrays to disk and reads them back.

A *stored directory* holds two files:

    arrays.safetensors   the payload
    manifest.json        schema, kind, meta, versions, and the SHA-256 of the payload, of each array
                         in it, and of the manifest itself

It appears whole or not at all: it is written beside its place, flushed to the disk, then renamed.
It is believed only when every hash agrees and the payload begins with the header that the manifest
implies; that header is compared, never parsed. Nothing is unpickled or evaluated. The hashes find
accidents; they are no signature.

Scratch names are `.NAME.PID-SESSION-RANDOM.tmp`, for what is not yet in place, and `.old`, for what
is being replaced. Those of dead processes are cleaned up, or put back, by the next write of NAME.
"""

import errno
import fcntl
import functools
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
import stat
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from marlyap.errors import UserError
from marlyap.storage.strict import parse


SCHEMA = 1
PAYLOAD, MANIFEST = "arrays.safetensors", "manifest.json"
PACKAGES = ("marlyap", "jax", "jaxlib", "equinox", "optax", "numpy")
JSON_LIMIT = 16 * 2**20
RETRIES = 16  # of reading what others keep replacing
# NumPy's name of each dtype, and that of safetensors
DTYPES = {"bool": "BOOL", "float32": "F32", "float64": "F64"}
DTYPES |= {f"int{bits}": f"I{bits}" for bits in (8, 16, 32, 64)}
DTYPES |= {f"uint{bits}": f"U{bits}" for bits in (8, 16, 32, 64)}

SESSION = secrets.token_hex(4)  # tells this process from a dead one that had the same number
SCRATCH = re.compile(r"\.(.+)\.(\d{1,9})-([0-9a-f]{8})-[0-9a-f]{8}\.(tmp|old)")
ANOTHER, UNTRUSTED = "use another copy of this directory", "do not trust where it came from"
REMEDIES = {
    "free some disk space or choose another disk": (errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
    "choose a directory you may write in": (errno.EACCES, errno.EPERM, errno.EROFS),
    "make sure that its parent is a directory": (errno.ENOENT, errno.ENOTDIR),
    "move away what is already there": (errno.EEXIST, errno.ENOTEMPTY),
}

Arrays = Mapping[str, Any]  # of whatever np.asarray takes, JAX's arrays too
Table = Mapping[str, Mapping[str, Any]]


WRITTEN: list[Path] = []  # what this process has put in place


class CorruptError(UserError):
    """What is on the disk is not what was written there."""


# --- Stored directories --------------------------------------------------------------------------


def write(
    directory: Path, kind: str, arrays: Arrays, meta: Mapping[str, Any], *, replace: bool = False
) -> None:
    """Store `arrays` and the JSON object `meta` as `directory`, whole and durable or not at all."""
    payload, table = _packed(arrays)
    manifest = _manifest(kind, meta, payload, table)
    write_folder(directory, {PAYLOAD: payload, MANIFEST: [manifest]}, replace=replace)


def write_folder(
    directory: Path, files: Mapping[str, Iterable[Any]], *, replace: bool = False
) -> None:
    """Write these files, each given in chunks of bytes, as `directory`, whole or not at all.

    With `replace` the directory may be there, if it holds no other files. Raises UserError where
    it is in the way or cannot be written.
    """
    with _beside(directory) as scratch:
        _check_free(directory, replace, {*files})
        scratch.mkdir()
        for name, chunks in files.items():
            _write_file(scratch / name, chunks)
        _sync(scratch)
        _install(scratch, directory)


def packed(arrays: Arrays) -> bytes:
    """The arrays as the bytes of one safetensors file."""
    return b"".join(bytes(memoryview(chunk)) for chunk in _packed(arrays)[0])


def read(directory: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the meta that were stored as `directory`, every byte of them verified."""
    attempts = 0
    while True:
        handle = _open_directory(directory)
        try:
            return _read_at(handle, directory, kind)
        except CorruptError:
            attempts += 1
            if attempts == RETRIES or not _has_moved(handle, directory):
                raise
        finally:
            os.close(handle)


def expect(arrays: Mapping[str, Any], like: Mapping[str, Any], source: str) -> None:
    """Refuse `arrays`, read from `source`, that differ from `like` in names, dtypes or shapes.

    Both may hold anything with a `dtype` and a `shape`, as `jax.ShapeDtypeStruct` has.
    """
    remedy = "check that the config is the one it was made with"
    for key in sorted({*arrays, *like}):
        if key not in arrays or key not in like:
            what = "unexpected" if key in arrays else "missing"
            raise UserError(f"{source}: array {key!r} is {what}; {remedy}.")
        found, wanted = (f"{np.dtype(x.dtype)}{[*x.shape]}" for x in (arrays[key], like[key]))
        if found != wanted:
            raise UserError(f"{source}: array {key!r} is {found}, not {wanted}; {remedy}.")


def hash_arrays(arrays: Arrays) -> str:
    """SHA-256 over names, dtypes, shapes and contents, whatever their order: the policy hash."""
    table = _table({key: _plain(key, array) for key, array in arrays.items()})
    return _sha256([json.dumps(table, sort_keys=True, separators=(",", ":")).encode()])


# --- Checkpoints and the lock --------------------------------------------------------------------


class Saved(NamedTuple):
    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Checkpoints:
    """Stored directories `step-000000123` in `directory`, of which the last `keep` remain."""

    directory: Path
    kind: str = "checkpoint"
    keep: int = 2

    def path(self, step: int) -> Path:
        return self.directory / f"step-{step:09d}"

    def steps(self) -> list[int]:
        """The steps that are there, oldest first, whether or not they can be read."""
        names = _names(self.directory)
        names += [scratch[1] for scratch in _scratches(self.directory) if scratch[4] == "old"]
        found = (re.fullmatch(r"step-(\d{9,18})", name) for name in names)
        return sorted({int(name[1]) for name in found if name})

    def save(self, step: int, arrays: Arrays, meta: Mapping[str, Any]) -> None:
        """Store `step`; older checkpoints go only once it is durable."""
        with _explained(self.path(step)):
            self.directory.mkdir(exist_ok=True)
            sweep(self.directory)
            self._clear_the_way(step)
        write(self.path(step), self.kind, arrays, meta, replace=True)
        for old in self.steps()[: -self.keep]:
            _discard(self.path(old))

    def latest(self) -> Saved:
        """The newest checkpoint that can be read, with a warning for each newer one that cannot."""
        warnings: list[str] = []
        for step in reversed(self.steps()):
            try:
                return Saved(step, *read(self.path(step), self.kind), tuple(warnings))
            except CorruptError as fault:
                warnings.append(f"Checkpoint {step} was passed over: {fault}")
        reason = warnings[0].rstrip(".") if warnings else "there is none"
        raise UserError(f"{self.directory}: no checkpoint to load ({reason}); start a new run.")

    def _clear_the_way(self, step: int) -> None:
        """Refuse to save behind a good checkpoint; rename the bad ones from `step` on."""
        for later in (found for found in self.steps() if found >= step):
            path = self.path(later)
            try:
                read(path, self.kind)
            except CorruptError:
                os.rename(path, path.with_name(f"damaged-{path.name}-{secrets.token_hex(4)}"))
            else:
                if later > step:
                    raise UserError(
                        f"step {step} is behind {path}; resume that or start a new run."
                    )


@contextmanager
def lock(directory: Path) -> Iterator[None]:
    """Be the one process that writes in `directory`; the system frees the lock however it ends."""
    path = directory / ".lock"
    with _explained(path):
        file = open(path, "a+")
    with file:
        with _explained(path):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                holder = f"process {file.read(20).strip() or 'unknown'}"
                raise UserError(f"{directory} is in use by {holder}; wait or stop it.") from None
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
        yield


# --- Text ----------------------------------------------------------------------------------------


def write_text_atomic(path: Path, text: str) -> None:
    """Replace the file by `text`; at every instant the old or the new one is there, whole."""
    with _beside(path) as scratch:
        _write_file(scratch, [text.encode()])
        _replace(scratch, path)


def write_bytes_atomic(path: Path, writer: Callable[[BinaryIO], object]) -> None:
    """Replace the file by what `writer` writes into the open file it is given, whole or not at all.

    As in `write_bytes_atomic(path, lambda file: figure.savefig(file, format="png"))`: a full disk
    leaves the old file, and is said in one sentence (UserError).
    """
    with _beside(path) as scratch:
        with open(scratch, "xb") as file:
            writer(file)
            file.flush()
            os.fsync(file.fileno())
        _replace(scratch, path)


def read_json(path: Path, limit_bytes: int = JSON_LIMIT) -> Any:
    """Strict JSON: no key twice, no NaN or infinity, no unpaired surrogate, no deep nesting."""
    return _json(_content(path, limit_bytes).tobytes(), path)


def append_line(path: Path, text: str) -> None:
    """Add a line, first dropping one that was cut short; if that fails the file is as it was."""
    line = text.encode() + b"\n"
    if b"\n" in line[:-1]:
        raise ValueError("a line cannot hold a line break")
    with _explained(path), open(path, "a+b", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        if end and os.pread(file.fileno(), 1, end - 1) != b"\n":
            file.truncate(end := os.pread(file.fileno(), end, 0).rfind(b"\n") + 1)
        try:
            if file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except BaseException:
            file.truncate(end)
            raise


def read_jsonl(path: Path, limit_bytes: int = 16 * JSON_LIMIT) -> list[Any]:
    """The value on each line; a last one without its line break was cut short and is left out."""
    lines = _content(path, limit_bytes).tobytes().split(b"\n")[:-1]
    return [_json(line, f"{path}, line {number}") for number, line in enumerate(lines, 1)]


# --- The payload and its manifest ----------------------------------------------------------------


def _plain(key: str, array: Any) -> np.ndarray:
    """The array in C order and little endian, copied only where it is not so already."""
    array = np.asarray(array)
    if array.dtype.name not in DTYPES:
        known = ", ".join(DTYPES)
        raise UserError(f"array {key!r} has dtype {array.dtype}; convert it to one of {known}.")
    if key == "__metadata__":
        raise UserError(f"{key!r} cannot name an array; use another name.")
    return np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")


def _packed(arrays: Arrays) -> tuple[list[Any], dict[str, dict[str, Any]]]:
    """The payload in chunks, and the table of what is in it."""
    plain = {key: _plain(key, array) for key, array in arrays.items()}
    table = _table(plain)
    header, slots = _layout(table)
    return [header, *(_raw(plain[key]) for key in slots)], table


def _raw(array: np.ndarray) -> np.ndarray:
    return array.reshape(-1).view(np.uint8)


def _sha256(chunks: Iterable[Any]) -> str:
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()


def _table(plain: Arrays) -> dict[str, dict[str, Any]]:
    return {
        key: {"dtype": x.dtype.name, "shape": [*x.shape], "sha256": _sha256([_raw(x)])}
        for key, x in plain.items()
    }


def _layout(table: Table) -> tuple[bytes, dict[str, slice]]:
    """The header that belongs to `table`, and where each array lies behind it."""
    width = {key: np.dtype(entry["dtype"]).itemsize for key, entry in table.items()}
    entries, slots, end = {}, {}, 0
    for key in sorted(table, key=lambda key: (-width[key], key)):  # widest first: all are aligned
        dtype, shape = table[key]["dtype"], table[key]["shape"]
        start, end = end, end + width[key] * math.prod(shape)
        entries[key] = {"dtype": DTYPES[dtype], "shape": shape, "data_offsets": [start, end]}
        slots[key] = slice(start, end)
    text = json.dumps(entries, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text, slots


def _manifest(kind: str, meta: Mapping[str, Any], payload: list[Any], table: Table) -> bytes:
    size = sum(memoryview(chunk).nbytes for chunk in payload)
    files = {PAYLOAD: {"sha256": _sha256(payload), "bytes": size}}
    body = {"schema": SCHEMA, "kind": kind, "meta": dict(meta), "files": files, "arrays": table}
    try:
        raw = sealed(body | {"versions": versions()})
        parse(raw)
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(f"meta is not JSON ({error}); use finite numbers, text, lists.") from error
    if len(raw) > JSON_LIMIT:
        raise UserError(f"meta takes {len(raw)} bytes, which is too many; store it as arrays.")
    return raw


def sealed(body: Mapping[str, Any]) -> bytes:
    """The one way to write `body`, its own hash included, so that no altered byte passes."""
    seal = _sha256([json.dumps(body).encode()])
    return json.dumps({**body, "sha256": seal}, indent=1).encode() + b"\n"


@functools.cache
def versions() -> dict[str, str]:
    """Of what a result depends on."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in PACKAGES:
        found[package] = "not installed"
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


# --- Reading, strictly ---------------------------------------------------------------------------


def _read_at(handle: int, directory: Path, kind: str) -> tuple[dict[str, np.ndarray], dict]:
    for name in sorted({PAYLOAD, MANIFEST} ^ {*os.listdir(handle)}):
        fault = (
            f"is missing; {ANOTHER}"
            if name in (PAYLOAD, MANIFEST)
            else "does not belong there; use another copy"
        )
        raise CorruptError(f"{directory / name} {fault}.")
    raw = _content(directory / MANIFEST, JSON_LIMIT, handle).tobytes()
    manifest = _read_manifest(raw, directory / MANIFEST, kind)
    path, table, facts = directory / PAYLOAD, manifest["arrays"], manifest["files"][PAYLOAD]
    data = _content(path, facts["bytes"], handle)
    header, slots = _layout(table)
    if len(data) < facts["bytes"]:
        raise CorruptError(f"{path} has {len(data)} of {facts['bytes']} bytes; {ANOTHER}.")
    head, body = data[: len(header)], data[len(header) :]
    if _sha256([data]) != facts["sha256"]:
        damaged = (key for key in slots if _sha256([body[slots[key]]]) != table[key]["sha256"])
        where = next((f"array {key!r}" for key in damaged), "its header")
        raise CorruptError(f"{path} is damaged in {where}; {ANOTHER}.")
    end = max((slot.stop for slot in slots.values()), default=0)
    if head.tobytes() != header or len(body) != end:
        raise CorruptError(f"{path} does not hold what its manifest describes; {UNTRUSTED}.")
    views = {key: body[slots[key]].view(entry["dtype"]) for key, entry in table.items()}
    arrays = {key: view.reshape(table[key]["shape"]) for key, view in views.items()}
    return arrays, manifest["meta"]


def _read_manifest(raw: bytes, path: Path, kind: str) -> dict[str, Any]:
    found = _json(raw, path)
    if not isinstance(found, dict):
        raise CorruptError(f"{path} is not a manifest; {ANOTHER}.")
    schema = found.get("schema")
    if type(schema) is int and schema > SCHEMA:
        raise CorruptError(
            f"{path} was written by a newer marlyap (schema {schema}); upgrade yours."
        )
    if schema != SCHEMA or raw != sealed({key: found[key] for key in found if key != "sha256"}):
        raise CorruptError(f"{path} was altered after it was written; {ANOTHER}.")
    if found.get("kind") != kind:
        raise CorruptError(
            f"{path} is of kind {found.get('kind')!r}, not {kind!r}; check the path."
        )
    files = found.get("files")
    if not isinstance(files, dict) or [*files] != [PAYLOAD]:
        raise CorruptError(f"{path} lists other files than {PAYLOAD}; {UNTRUSTED}.")
    match files[PAYLOAD], found.get("meta"), found.get("arrays"):
        case {"bytes": int(), "sha256": str()}, dict(), dict(arrays):
            if all(map(_is_array, arrays.values())):
                return found
    raise CorruptError(f"{path} has a malformed entry; {UNTRUSTED}.")


def _is_array(entry: Any) -> bool:
    """Whether a manifest's entry describes an array that NumPy can hold."""
    match entry:
        case {"dtype": str(dtype), "shape": [*shape], "sha256": str()} if dtype in DTYPES:
            if len(shape) <= 32 and all(type(n) is int and n >= 0 for n in shape):
                return math.prod(max(n, 1) for n in shape) * np.dtype(dtype).itemsize < 2**63
    return False


def _content(path: Path, limit: int, directory: int | None = None) -> np.ndarray:
    """The bytes of a regular file; inside a stored directory, given as a handle, follow no link."""
    within = directory is not None
    flags = os.O_NONBLOCK | (os.O_NOFOLLOW if within else 0)  # do not wait for a pipe either

    def opener(name: str, mode: int) -> int:
        return os.open(name, mode | flags, dir_fd=directory)

    try:
        with open(path.name if within else path, "rb", opener=opener) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_size > limit:
                raise CorruptError(f"{path} is not a file of at most {limit} bytes; {ANOTHER}.")
            data = np.empty(status.st_size, np.uint8)
            return data[: file.readinto(data.data)]
    except OSError as error:
        reason = "it is a link" if error.errno == errno.ELOOP else error.strerror
        raise CorruptError(f"{path} cannot be read ({reason}); check the path.") from error


def _json(raw: bytes, path: Path | str) -> Any:
    try:
        return parse(raw)
    except ValueError as error:
        raise CorruptError(
            f"{path} is not sound JSON ({error}); correct it or use a copy."
        ) from None


# --- Files, durably ------------------------------------------------------------------------------


def sweep(directory: Path, name: str | None = None) -> None:
    """Clear up what dead processes left in `directory` while they wrote `name`, or anything."""
    for scratch in _scratches(directory):
        if name not in (None, scratch[1]) or _is_alive(int(scratch[2]), scratch[3]):
            continue
        if scratch[4] == "old" and not os.path.lexists(directory / scratch[1]):
            with suppress(OSError):
                os.rename(directory / scratch[0], directory / scratch[1])
        else:
            _erase(directory / scratch[0])


def _is_alive(pid: int, session: str) -> bool:
    if pid == os.getpid():
        return session == SESSION
    try:
        os.kill(pid, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


def _scratch(path: Path, role: str) -> Path:
    token = secrets.token_hex(4)
    return path.with_name(f".{path.name}.{os.getpid()}-{SESSION}-{token}.{role}")


def _scratches(directory: Path) -> list[re.Match[str]]:
    return [found for found in map(SCRATCH.fullmatch, _names(directory)) if found]


def _names(directory: Path) -> list[str]:
    try:
        return sorted(os.listdir(directory))
    except OSError:
        return []


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A scratch path for what will become `path`, which is gone after any failure."""
    scratch = _scratch(path, "tmp")
    with _explained(path):
        sweep(path.parent, path.name)
        try:
            yield scratch
        except BaseException:
            _erase(scratch)
            raise


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Say in one sentence why writing `path` failed."""
    try:
        yield
    except OSError as error:
        remedy = next(
            (m for m, numbers in REMEDIES.items() if error.errno in numbers), "check the disk"
        )
        raise UserError(f"{path} could not be written ({error.strerror}); {remedy}.") from error


def _replace(scratch: Path, path: Path) -> None:
    os.replace(scratch, path)
    WRITTEN.append(path)
    _sync(path.parent)


def _write_file(path: Path, chunks: Iterable[Any]) -> None:
    with open(path, "xb") as file:
        for chunk in chunks:
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())


def _sync(directory: Path) -> None:
    """Make the entries of the directory durable, not only the files they name."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _check_free(directory: Path, replace: bool, names: set[str]) -> None:
    if not os.path.lexists(directory):
        return
    if not replace:
        raise UserError(f"{directory} already exists; remove it or choose another name.")
    if directory.is_symlink() or {*os.listdir(directory)} - names:
        raise UserError(f"{directory} holds other files; move it away or choose another name.")


def _install(scratch: Path, directory: Path) -> None:
    """Rename into place. Between the two renames the old directory is the `.old` beside it."""
    old = _scratch(directory, "old")
    try:
        with suppress(FileNotFoundError):
            os.rename(directory, old)
        os.rename(scratch, directory)
        WRITTEN.append(directory)
    except BaseException:
        with suppress(OSError):
            os.rename(old, directory)
        raise
    _sync(directory.parent)
    _erase(old)


def _open_directory(directory: Path) -> int:
    """A handle on the directory or, while it is being replaced, on the old one beside it."""
    flags, reason = os.O_RDONLY | os.O_DIRECTORY, ""
    for _ in range(RETRIES):
        try:
            return os.open(directory, flags)
        except OSError as error:
            reason = error.strerror
        for scratch in _scratches(directory.parent):
            if scratch[4] == "old" and scratch[1] == directory.name:
                with suppress(OSError):
                    return os.open(directory.with_name(scratch[0]), flags)
    raise CorruptError(f"{directory} is not a stored directory ({reason}); check the path.")


def _has_moved(handle: int, directory: Path) -> bool:
    """Whether the open directory was replaced, and perhaps removed, since."""
    try:
        return not os.path.samestat(os.fstat(handle), os.stat(directory))
    except OSError:
        return True


def _discard(directory: Path) -> None:
    """Remove a stored directory without ever showing half of it."""
    scratch = _scratch(directory, "tmp")
    with suppress(OSError):
        os.rename(directory, scratch)
        _erase(scratch)


def _erase(path: Path) -> None:
    """Remove a directory, a file or a link, if it is there and if that is allowed."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
