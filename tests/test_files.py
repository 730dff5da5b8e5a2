"""Files appear whole or not at all."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gdpro_sim
from gdpro_sim.errors import OutputError, RequestError
from gdpro_sim.files import atomic_write, check_writable, claimed, sha256_of
from tests.conditions import posix_only


def test_the_file_appears_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        assert not path.exists()
    assert path.read_text() == "new" and os.listdir(tmp_path) == ["a.txt"]
    assert sha256_of(path) == hashlib.sha256(b"new").hexdigest()


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_a_full_disk_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(OutputError, match=r"a\.txt: no space left"), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == []


@posix_only
def test_links_are_followed_and_stay_links(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "real" / "a.txt")
    with atomic_write(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and (tmp_path / "real" / "a.txt").read_text() == "new"


@posix_only
def test_only_regular_files_are_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "pipe", "not a regular file"),
        (tmp_path, "it is a folder"),
        (tmp_path / "absent" / "a", "does not exist"),
    ):
        with pytest.raises(RequestError, match=message):
            check_writable(path)


@posix_only
def test_one_run_at_a_time_writes_into_a_folder(tmp_path: Path) -> None:
    code = "import sys; from gdpro_sim.files import claimed\nwith claimed(sys.argv[1]): print(flush=True)"
    code += "; input()"
    out, link = tmp_path / "out", tmp_path / "link"
    out.mkdir()
    link.symlink_to(out)
    with subprocess.Popen(
        [sys.executable, "-c", code, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None and other.stdout.readline()
        for folder in (out, link):
            with pytest.raises(RequestError, match="another run writes there"), claimed(folder):
                pass
        with claimed(tmp_path / "elsewhere"):
            other.kill()
    with claimed(out):
        pass
    assert os.listdir(out) == []


@pytest.mark.parametrize("write", ["record", "rollout"])
def test_a_folder_that_a_run_writes_to_is_refused(tmp_path: Path, write: str) -> None:
    arguments = {"count": 1} if write == "rollout" else {}
    with claimed(tmp_path), pytest.raises(RequestError, match="another run writes there"):
        getattr(gdpro_sim, write)("tumbling_toys", tmp_path, **arguments)
