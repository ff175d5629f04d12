"""One run at a time in a folder."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ltgs_jax.io import InputError

_LOCK = ".running"


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Holds the folder for this process; a second run into it is refused, and a dead one holds nothing.

    The hold is the kernel's lock on a file, which ends with the process however it ends. Raises InputError when another
    run holds the folder or it cannot be written.
    """
    lock = folder / _LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    try:
        if not _take(handle, lock):
            holder = os.pread(handle, 32, 0).decode(errors="replace").strip() or "unknown"
            raise InputError(f"{folder}: another run (process {holder}) is writing there")
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _take(handle: int, lock: Path) -> bool:
    """Lock the file and write this process's number into it; False when another has it, or had it until just now."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        held = os.stat(lock).st_ino == os.fstat(handle).st_ino
    except (BlockingIOError, FileNotFoundError):
        return False
    if held:
        os.ftruncate(handle, 0)
        os.pwrite(handle, str(os.getpid()).encode(), 0)
    return held
