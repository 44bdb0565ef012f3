"""TensorBoard's event files, written without TensorBoard: a file of records, a record a step.

A record is its length (8 bytes, little endian), the masked CRC-32C of that, the message, and the
masked CRC-32C of the message (the format TFRecord). The message is an `Event` of protocol buffers:

    field 1, double   wall_time (s)         field 2, varint    step
    field 3, string   file_version          field 5, message   summary: field 1, repeated
    value             field 1, string tag   field 2, float     simple_value

Source: `event.proto` and `summary.proto` of TensorFlow, and RFC 3720 for the checksum.
"""

import math
import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path

from marlyap.storage import store


MASK = 0xA282EAD8
VERSION = b"brain.Event:2"


def _table() -> tuple[int, ...]:
    found = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
        found.append(byte)
    return tuple(found)


TABLE = _table()


def crc32c(data: bytes) -> int:
    """The checksum of Castagnoli."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def record(message: bytes) -> bytes:
    """The message with its length and both checksums."""
    length = struct.pack("<Q", len(message))
    return length + _masked(length) + message + _masked(message)


def _masked(data: bytes) -> bytes:
    crc = crc32c(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + MASK) & 0xFFFFFFFF)


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def _bytes(field: int, content: bytes) -> bytes:
    return bytes([field << 3 | 2]) + _varint(len(content)) + content


def event(values: Mapping[str, float], step: int, wall_time: float) -> bytes:
    """The message of one step; what is not finite is left out."""
    summary = b""
    for tag, value in values.items():
        if math.isfinite(value):
            single = max(-3.4028234e38, min(3.4028234e38, value))
            summary += _bytes(1, _bytes(1, tag.encode()) + b"\x15" + struct.pack("<f", single))
    head = b"\x09" + struct.pack("<d", wall_time) + b"\x10" + _varint(step)
    return head + _bytes(5, summary)


def began(path: Path) -> float:
    """The time in the name of an event file (s)."""
    return float(path.name.split(".")[3])


def path_in(directory: Path) -> Path:
    """The event file of a folder, a new name where there is none. TensorBoard asks for the form."""
    there = sorted(directory.glob("events.out.tfevents.*.marlyap"))
    name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.marlyap"
    return there[-1] if there else directory / name


def rewrite(path: Path, records: bytes) -> None:
    """The file with these records alone, behind the version of its format; whole or not at all."""
    first = record(b"\x09" + struct.pack("<d", began(path)) + _bytes(3, VERSION))
    store.write_bytes_atomic(path, lambda file: file.write(first + records))
