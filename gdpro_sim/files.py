"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import filelock

from gdpro_sim.errors import OutputError, RequestError


def check_writable(path: str | Path) -> Path:
    """The real path a file may be written to, symbolic links followed.

    Raises RequestError where the folder is missing or read-only, or where `path` is anything but a regular
    file: renaming over a device node such as /dev/null would destroy it.
    """
    target = Path(os.path.realpath(path))
    folder = target.parent
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "does not exist; create it first"
        raise RequestError(f"cannot write {path}: {folder} {what}")
    if target.is_dir():
        raise RequestError(f"cannot write {path}: it is a folder; give a file name")
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        raise RequestError(f"cannot write {path}: it exists and is not a regular file")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RequestError(f"cannot write {path}: no permission to write in {folder}")
    return target


def prepare_folder(folder: str | Path, file: str) -> Path:
    """Make the folder (and its parents) and check that `file` can be written in it. Raises RequestError."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise RequestError(f"output {path} is, or lies in, a file; give a folder") from None
    except OSError as error:
        raise RequestError(f"output folder {path} cannot be made: {error.strerror or error}") from None
    check_writable(path / file)
    return path


@contextlib.contextmanager
def claimed(folder: str | Path) -> Iterator[None]:
    """Keep other runs on this machine out of `folder`, which need not exist yet.

    Raises RequestError where one writes there already. The claim ends with the process, killed or not.
    """
    place = f"{os.path.expanduser('~')} {os.path.realpath(folder)}"  # users cannot open each other's locks
    name = hashlib.sha256(os.fsencode(place)).hexdigest()[:24]
    lock = filelock.FileLock(Path(tempfile.gettempdir()) / f"gdpro-{name}.lock", blocking=False)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise RequestError(
            f"{folder}: another run writes there; wait for its end, or give another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def temporary_beside(target: Path) -> Path:
    """A fresh hidden name in the folder of `target`, with its suffix (writers pick the format by suffix)."""
    return target.with_name(f".{target.stem}.{secrets.token_hex(6)}.tmp{target.suffix}")


def remove_stale(folder: str | Path) -> None:
    """Delete what killed processes left in `folder` under temporary names; no other may be writing there."""
    for path in Path(folder).glob(".*.tmp.*"):
        if re.fullmatch(r"\..*\.[0-9a-f]{12}\.tmp\..*", path.name):
            remove_quietly(path)


def commit_file(temporary: Path, target: Path) -> None:
    """Flush `temporary` to disk and rename it over `target`. Raises OutputError and removes it."""
    try:
        with open(temporary, "rb+") as handle:
            os.fsync(handle.fileno())
        os.replace(temporary, target)
        with contextlib.suppress(OSError):  # a folder cannot be flushed on every file system
            descriptor = os.open(target.parent, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except OSError as error:
        remove_quietly(temporary)
        raise output_error(target, error) from error


def remove_quietly(path: Path) -> None:
    """Delete a file if it is there and can be deleted."""
    with contextlib.suppress(OSError):
        path.unlink()


def output_error(path: str | Path, error: OSError) -> OutputError:
    """One line saying which file could not be written and why."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return OutputError(f"cannot write {path}: no space left on the disk; free some and run again")
    return OutputError(f"cannot write {path}: {error.strerror or error}")


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name to write to; on success it is flushed and renamed to `path`, else removed.

    >>> with atomic_write("figures.json") as temporary:  # doctest: +SKIP
    ...     temporary.write_text("{}")

    Raises RequestError where `path` cannot be written at all (before anything is written), OutputError where
    writing fails (disk full); `path` then keeps what it held.
    """
    target = check_writable(path)
    temporary = temporary_beside(target)
    try:
        yield temporary
    except OSError as error:
        remove_quietly(temporary)
        raise output_error(path, error) from error
    except BaseException:
        remove_quietly(temporary)
        raise
    commit_file(temporary, target)


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


__all__ = [
    "atomic_write",
    "check_writable",
    "claimed",
    "commit_file",
    "output_error",
    "prepare_folder",
    "remove_quietly",
    "remove_stale",
    "sha256_of",
    "temporary_beside",
]
