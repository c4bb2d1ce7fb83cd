"""Bytes with a checksum behind them, by which damage is noticed before anything is made of them."""

import hashlib

# Of SHA-256, which tells any two contents apart.
SEAL = 32


class Damaged(ValueError):
    """Bytes are not what was written."""


def sealed(content: bytes) -> bytes:
    """The content with its checksum."""
    return content + hashlib.sha256(content).digest()


def unsealed(data: bytes) -> bytes:
    """The content again.

    **Raises:** `Damaged` where it is not what was sealed.
    """
    content, seal = data[:-SEAL], data[-SEAL:]
    if hashlib.sha256(content).digest() != seal:
        raise Damaged(f"{len(data)} bytes are not what was written.")
    return content
