"""Example data by name: a small set that ships with slviewer, and a larger one that is attached to
its releases."""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from slviewer.errors import InputError
from slviewer.pipeline.operation import Progress, ignore_progress, part
from slviewer.session.importers.archive import unpack
from slviewer.simulation.assets import asset

CACHE = "SLVIEWER_DATASETS"
"""Environment variable that names another folder for cached data sets."""
_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class Dataset:
    """A zip of captures as images, its hash, and where it is: below assets, or at the address of a
    release."""

    sha256: str
    archive: str = ""
    url: str = ""
    bytes: int = 0


SAMPLE = Dataset(
    "f0e00a31509568ae3265d4c1284b0593d815894399a77fd1dc858c6b7a739d8d",
    archive="datasets/sample.zip",
)
"""Eight target poses, a plane, a sphere and an object, simulated at 240x180 px."""


def datasets() -> dict[str, Dataset]:
    """Return {name: data set}: the sample, and what was attached to the release that is
    installed."""
    known = {"sample": SAMPLE}
    try:
        released = asset("datasets/released.json").read_text(encoding="utf-8")
    except InputError:  # an installation that was not built for a release
        return known
    return known | {name: Dataset(**each) for name, each in json.loads(released).items()}


def fetch(
    name: str = "sample", folder: Path | str | None = None, progress: Progress = ignore_progress
) -> Path:
    """Copy a data set into a folder.

    Args:
        name: Name of the data set: sample, which ships with slviewer, or letter (larger,
            downloaded, of releases).
        folder: Folder to make. Without it, the data set's folder in the user's cache, made when it
            is first used.

    Returns the folder; its subfolders hold images in a known layout: poses, scan, sphere and object
    of the sample; poses, planes, spheres and objects of letter. A download is kept in the user's
    cache, and ``progress`` may cancel it. Raises `InputError` for an unknown name, a download that
    fails, a damaged archive, or an existing folder.
    """
    known = datasets()
    if name not in known:
        also = (
            "; letter is attached to releases, and this is not a release: make it by"
            " assets/make_sample_data.py letter"
        )
        raise InputError(
            f"no data set is called {name!r}",
            f"use {' or '.join(known)}{also * (name == 'letter')}",
        )
    dataset = known[name]
    if folder is None:
        target = _cache_folder() / f"{name}-{dataset.sha256[:12]}"
        if target.is_dir():  # renamed to its place when it was complete
            return target
    else:
        target = Path(folder)
        if target.exists():
            raise InputError(f"{target} exists", "give the name of a new folder")
    if dataset.url:
        source = _download(name, dataset, part(progress, 0.0, 0.8))
    else:
        source = asset(dataset.archive)
        if hashlib.sha256(source.read_bytes()).hexdigest() != dataset.sha256:
            raise InputError(
                f"{source} is not the data set {name!r}: its hash differs; install slviewer again"
            )
    target.parent.mkdir(parents=True, exist_ok=True)
    with (
        TemporaryDirectory(dir=target.parent, prefix=".fetch-") as scratch,
        source.open("rb") as archive,
    ):
        unpacked, _ = unpack(
            archive, Path(scratch), lambda done: progress(0.8 + 0.2 * done, "unpacking")
        )
        try:
            unpacked.rename(target)
        except OSError:
            if folder is not None or not target.is_dir():  # else another process was faster
                raise
    return target


def _download(name: str, dataset: Dataset, progress: Progress) -> Path:
    """Return the archive of a data set in the cache, downloaded if it is not there or not what it
    should be."""
    import pooch
    import requests

    pooch.get_logger().setLevel("WARNING")  # progress is reported by us
    bar = _DownloadBar(progress, f"downloading {dataset.bytes / 1e6:.0f} MB")
    try:
        path = pooch.retrieve(
            dataset.url,
            f"sha256:{dataset.sha256}",
            fname=f"{name}-{dataset.sha256[:12]}.zip",
            path=_cache_folder(),
            downloader=pooch.HTTPDownloader(progressbar=bar, timeout=_TIMEOUT_S),
        )
    except requests.RequestException as error:
        raise InputError(
            f"{dataset.url} was not downloaded ({type(error).__name__})",
            "check the network, or download it elsewhere and unpack it; the data set 'sample' needs"
            " no network",
        ) from error
    except ValueError as error:  # pooch: the hash differs
        raise InputError(
            f"what {dataset.url} returned is not the data set {name!r}: its hash differs"
        ) from error
    return Path(path)


class _DownloadBar:
    """A progress bar, as pooch uses one: ``total`` bytes, of which each ``update`` brings some."""

    def __init__(self, progress: Progress, doing: str) -> None:
        self.total: int | None = None
        self._progress, self._doing, self._done = progress, doing, 0

    def update(self, count: int) -> None:
        """Report so many more bytes; pooch's last update, after a reset, brings all."""
        self._done += count
        self._progress(min(self._done / max(self.total or 0, 1), 1.0), self._doing)

    def reset(self) -> None:
        """Begin anew."""
        self._done = 0

    def close(self) -> None:
        """Do nothing: the caller goes on reporting."""


def _cache_folder() -> Path:
    """Return the user's folder for data sets."""
    if given := os.environ.get(CACHE):
        return Path(given)
    import pooch

    return Path(pooch.os_cache("slviewer")) / "datasets"
