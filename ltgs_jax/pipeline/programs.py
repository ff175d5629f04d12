"""Compiled programs held by this process."""

from pathlib import Path

import jax

_MAPS = Path("/proc/self/maps")
_MOST = 25_000  # of the 65 530 memory maps that Linux lets a process have; one visit adds up to 10 000


def free_programs(most: int = _MOST) -> bool:
    """Drop all compiled programs when they, and all else, take more than `most` memory maps; whether it did.

    A process that runs out of maps is ended by the compiler, without an exception. What is needed again comes from the
    persistent cache where there is one. Systems without /proc have no such bound, and nothing is done there.
    """
    if not _MAPS.exists() or _MAPS.read_bytes().count(b"\n") <= most:
        return False
    jax.clear_caches()
    return True
