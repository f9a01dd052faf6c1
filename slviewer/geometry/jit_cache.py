"""Cache folders for the kernels' machine code, one a module, named after a hash of the module's
sources.

numba itself checks the kernel's own file only. A kernel also compiles in what it calls and
constants of other files, and stale machine code is a wrong answer: so a folder's name carries a
hash over the sources of a module and of all the package's modules that it imports.
"""

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+(slviewer[\w.]*)[ \t]+)?import[ \t]+(\([^)]*\)|[^\n]*)", re.MULTILINE
)
_NAME = re.compile(rb"[\w.]+")


def cache_folder(module: str) -> Path | None:
    """The folder for the machine code of a module of this package; None where none is writable.

    Folders of the same module's earlier sources are deleted.
    """
    try:
        root = cache_root()
        if root is None:
            return None
        folder = root / f"{module}-{hash_sources(module)}"
        if not folder.is_dir():
            for old in root.glob(f"{module}-*"):
                if old != folder:  # another process may just have made it
                    shutil.rmtree(old, ignore_errors=True)
            folder.mkdir(exist_ok=True)
    except OSError:
        # no source beside the byte code, no temporary folder, or a disk that has filled up
        return None
    return folder


def hash_sources(module: str) -> str:
    """Hash over the sources of a module and of all package modules it imports. Raises OSError
    without sources."""
    digests, ahead = dict[str, bytes](), [module]
    while ahead:
        name = ahead.pop()
        if name in digests:
            continue
        digests[name], imported = _hash_source(name)
        ahead += imported
    whole = hashlib.blake2b(digest_size=8)
    for name in sorted(digests):
        whole.update(name.encode() + digests[name])
    return whole.hexdigest()


@cache
def _hash_source(module: str) -> tuple[bytes, tuple[str, ...]]:
    """A module's digest, and the modules of the package that its text imports, anywhere in it."""
    path = _source_path(module)
    if path is None:
        raise FileNotFoundError(f"{module} has no source file")
    text = path.read_bytes()
    named = set[str]()
    for where, what in _IMPORT.findall(text):
        names = [name.decode() for name in _NAME.findall(what)]
        named |= (
            {where.decode(), *(f"{where.decode()}.{name}" for name in names)}
            if where
            else set(names)
        )
    imported = (
        name
        for name in sorted(named)
        if name.split(".")[0] == "slviewer" and _source_path(name) is not None
    )
    return hashlib.blake2b(text, digest_size=20).digest(), tuple(imported)


def _source_path(module: str) -> Path | None:
    """Return the source file of a module; None where there is none of that name."""
    place = os.path.join(PACKAGE.parent, *module.split("."))
    files = f"{place}.py", os.path.join(place, "__init__.py")
    return next((Path(file) for file in files if os.path.isfile(file)), None)


@cache
def cache_root() -> Path | None:
    """The first candidate folder that can be used; None where there is none."""
    return next((place for place in _candidate_folders() if _is_private_and_writable(place)), None)


def _candidate_folders() -> Iterator[Path]:
    """Candidate cache folders, the best first; two installs never share a folder."""
    install = hashlib.blake2b(str(PACKAGE).encode(), digest_size=4).hexdigest()
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(given, f"slviewer-{install}")
    yield PACKAGE / "__pycache__" / "kernels"
    if sys.platform == "win32":
        caches = os.environ.get("LOCALAPPDATA", "")
    elif sys.platform == "darwin":
        caches = "~/Library/Caches"
    else:
        caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    caches = os.path.expanduser(caches)
    if os.path.isabs(caches):
        yield Path(caches, "slviewer", f"kernels-{install}")
    user = os.getuid() if hasattr(os, "getuid") else "user"
    yield Path(tempfile.gettempdir(), f"slviewer-{user}-kernels-{install}")


def _is_private_and_writable(place: Path) -> bool:
    """Whether this user, and no other, can write there: loading the cache runs the code it
    holds."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir(mode=0o700, exist_ok=True)
        status = place.lstat()
        if hasattr(os, "getuid") and (
            status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        ):
            return False
        tempfile.TemporaryFile(dir=place).close()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode)
