"""What workers lack, said before the work starts.

They need this version of super-sdf, the same network, and the same files under the same paths. All
must get the same values from the network, or slabs would not meet. Other versions of numpy and
onnxruntime may round differently all the same, which is a warning.
"""

from __future__ import annotations

import hashlib
import os
import pkgutil
import secrets
import signal
import socket
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import __version__
from ..errors import ClusterError, SuperSdfError, WriteError
from ..machine.extras import missing_modules
from ..machine.memory import SHARE, free_memory, reuse_freed
from ..batch.pool import settle_signals
from ..threads import Resources
from ..network.device import onnxruntime_version
from ..network.network import Fingerprint, find_model, fingerprint_of, shipped_models
from ..options import AUTO, AUTO_PRECISION, Device, Precision
from .connecting import Cluster

MOST_FILES = 100  # whose presence each worker checks
PAUSE_SHARE = 0.75  # of a worker's limit: Dask gives it no more work at 0.8, and kills it at 0.95
VERSION = "super_sdf:__version__"
PACKAGE = Path(__file__).parent.parent
PROBE = ".super-sdf-probe-"  # a file in the output folder while the workers are checked


@dataclass(frozen=True)
class Needs:
    """What the work needs of every worker; paths are absolute."""

    model: str  # the network: see ``load_network``
    precision: Precision = AUTO_PRECISION
    device: Device = AUTO
    modules: tuple[str, ...] = ()  # beyond those that are always installed
    files: Sequence[Path] = ()  # inputs; if they are many, some of them are looked at
    folder: Path | None = None  # of the outputs; it exists

    def digests_of_models(self) -> dict[str, str]:
        """Return the SHA-256 of the shipped networks and of this one, as far as they are here."""
        paths = {path.name: path for path in shipped_models().values()}
        with suppress(OSError, ValueError):
            path, _ = find_model(self.model, self.precision)
            paths[path.name if path in paths.values() else str(path)] = path
        digests = {}
        for name, path in paths.items():
            with suppress(OSError):
                digests[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        return digests


class Expected(NamedTuple):
    """What is here and has to be where a worker is; the probe is a file and the text in it."""

    needs: Needs
    models: dict[str, str]
    sizes: dict[Path, int | None]
    probe: tuple[Path, str] | None
    is_local: bool


class Report(NamedTuple):
    """A worker's report on itself: what is wrong there ("" if nothing), and what it has."""

    fault: str
    host: str
    versions: dict[str, str]
    limit: int | None = None  # bytes at which Dask kills it
    free: int | None = None  # bytes that are free on its machine
    values: Fingerprint | None = None  # of the network, if nothing is wrong


@dataclass(frozen=True)
class Checked:
    """Workers that can do the work, with their limits; the faults of others; by address.

    ``values`` are those of the first worker, which all others have to compute, too.
    """

    members: dict[str, Resources]
    values: tuple[str, Fingerprint] | None
    faults: dict[str, str]
    warnings: list[str]


def check_workers(cluster: Cluster, needs: Needs) -> Checked:
    """Check all workers that the cluster has now; ClusterError if one of them lacks something."""
    checked = check_some(cluster, needs, cluster.workers())
    if checked.faults:
        fault = next(iter(checked.faults.values()))
        those = [address for address, text in checked.faults.items() if text == fault]
        raise ClusterError(f"{first_of(those)} {fault}")
    if not checked.members:
        raise ClusterError(f"the workers at {cluster.address} ended before they were checked")
    return checked


def check_some(
    cluster: Cluster,
    needs: Needs,
    threads: Mapping[str, int],
    first: tuple[str, Fingerprint] | None = None,
) -> Checked:
    """Check some workers, given by address with their threads; those that end meanwhile are out.

    ``first`` is a worker that is at work already, and the values that it computes.
    """
    faults: dict[str, str] = {}

    def ask(workers: Iterable[str], judge: Callable[[Any], str], *call: Any) -> dict[str, Any]:
        """Return the answers that are right; keep the faults of the others."""
        asked = list(workers)
        answers = cluster.run(*call, workers=asked) if asked else {}
        there = {address: a for address, a in answers.items() if not isinstance(a, OSError)}
        faults.update({a: fault for a, answer in there.items() if (fault := judge(answer))})
        return {address: answer for address, answer in there.items() if address not in faults}

    # The first call needs nothing of this package, the second no more than one function of it.
    good = ask(threads, judge_version, pkgutil.resolve_name, VERSION)
    good = ask(good, judge_sources, digest_of_sources)
    sizes = {path: _size_of(path) for path in some_of(needs.files)}
    with probing(needs.folder) as probe:
        expected = Expected(needs, needs.digests_of_models(), sizes, probe, cluster.is_local)
        reports = ask(good, judge_report, _report_to, expected)
    values = {address: report.values for address, report in reports.items()}
    first = first or next(iter(values.items()), None)
    faults.update(differing(first, values))
    reports = {a: report for a, report in reports.items() if a not in faults}
    on_host = Counter(report.host for report in reports.values())
    members = {
        address: cluster.limits
        if cluster.is_local
        else share_of(cluster.limits, threads[address], report, on_host[report.host])
        for address, report in reports.items()
    }
    return Checked(members, first, faults, warnings_of(reports))


def share_of(limits: Resources, threads: int, report: Report, neighbours: int) -> Resources:
    """Return what a worker at an address may use, given what was asked for.

    Dask gave it ``threads``; ``neighbours`` share the free memory of its machine, itself included.
    """
    rooms = [int(PAUSE_SHARE * report.limit)] if report.limit else []
    if limits.memory is not None:
        rooms.append(limits.memory)
    elif report.free:
        rooms.append(int(SHARE * (report.free // neighbours)))
    return Resources(limits.threads or threads, min(rooms, default=None))


def judge_version(answer: Any) -> str:
    """Return what is wrong with the super-sdf of a worker, "" if nothing."""
    if isinstance(answer, ImportError):
        return f"does not have super-sdf: install version {__version__} of it there"
    if isinstance(answer, Exception):
        return f"cannot import super-sdf ({_describe(answer)}): install {__version__} there"
    if answer != __version__:
        both = f"{answer}, and here is {__version__}"
        return f"has super-sdf {both}: install the same version there and here"
    return ""


def judge_sources(answer: Any) -> str:
    """Return what is wrong with the sources of super-sdf that a worker has, "" if nothing."""
    if answer == digest_of_sources():
        return ""
    return (
        f"has other sources of super-sdf {__version__} than are here: install the same state there "
        "and restart it"
    )


def judge_report(report: Any) -> str:
    """Return what a worker says that it lacks, "" if nothing."""
    if isinstance(report, Report):
        return report.fault
    return f"cannot be checked ({_describe(report)}): restart it"


def differing(
    first: tuple[str, Fingerprint] | None, values: Mapping[str, Fingerprint]
) -> dict[str, str]:
    """Return a fault for each worker whose values are not those of the first one, by address."""
    faults = {}
    for address, found in values.items():
        if first and found.digest != first[1].digest:
            way = "use workers with the same kind of processor"
            way = "give --device cpu" if found.device != first[1].device else way
            faults[address] = (
                f"({_runs_on(found)}) gets other values from the network than worker {first[0]} "
                f"({_runs_on(first[1])}), so that meshes would differ or be torn: {way}"
            )
    return faults


def _runs_on(found: Fingerprint) -> str:
    return f"{found.processor}, {found.precision} on {found.device}, {found.digest[:8]}"


def warnings_of(reports: Mapping[str, Report]) -> list[str]:
    """Return a warning for each thing that workers have in another version than is here."""
    warnings = []
    for name, here in versions().items():
        others = {a: r.versions[name] for a, r in reports.items() if r.versions[name] != here}
        if others:
            have = "have" if len(others) > 1 else "has"
            warnings.append(
                f"{first_of(list(others))} {have} {', '.join(sorted(set(others.values())))}, and "
                f"here is {here}: results may differ in their last bits"
            )
    return warnings


def first_of(addresses: Sequence[str]) -> str:
    """Return the first of some workers, and how many others there are."""
    more = len(addresses) - 1
    others = f" and {more} other{'s' * (more > 1)}" if more else ""
    return f"worker {addresses[0]}{others}"


def _report_to(expected: Expected, dask_worker: Any) -> Report:
    """Return the report of a worker; called in it, on its main thread."""
    reuse_freed()
    if expected.is_local:
        with suppress(ValueError, AttributeError):  # not the main thread, or Windows
            settle_signals()
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the batch hears it, too
    limit, needs, values = dask_worker.memory_manager.memory_limit or None, expected.needs, None
    if not (fault := what_is_lacking(expected)):
        try:
            values = fingerprint_of(needs.model, needs.precision, needs.device)
        except Exception as error:
            why = str(error) if isinstance(error, SuperSdfError) else _describe(error)
            fault = f"cannot run the network: {why}"
    return Report(fault, socket.gethostname(), versions(), limit, free_memory(), values)


def what_is_lacking(expected: Expected) -> str:
    """Return what this process lacks of what is expected, "" if nothing."""
    models = expected.needs.digests_of_models()
    for name, digest in expected.models.items():
        if name not in models:
            return f"does not see the network {name}: put it where all machines see it"
        if models[name] != digest:
            return f"has another file of the network {name}: copy the one from here"
    if lacking := missing_modules(expected.needs.modules):
        return f"lacks {', '.join(lacking)}: install there what is installed here"
    for path, here in expected.sizes.items():
        size = _size_of(path)
        if size is None and here is not None:
            return f"does not see {path}: put the inputs where all machines see them by this path"
        if size != here:
            return f"sees another {path}: its folder has to be the same on all machines"
    why = why_unusable(*expected.probe) if expected.probe else ""
    folder = expected.needs.folder
    return why and f"{why}: write to a folder that all machines share under {folder}"


def versions() -> dict[str, str]:
    """Return the versions of what results depend on in their last bits."""
    return {"numpy": f"numpy {np.__version__}", "onnxruntime": onnxruntime_version()}


@lru_cache(maxsize=1)  # a worker keeps the code that it has loaded, whatever is installed later
def digest_of_sources() -> str:
    """Return the SHA-256 of this package's modules; of Python's version where they are compiled."""
    digest = hashlib.sha256()
    paths = sorted(PACKAGE.rglob("*.py"))
    for path in paths:
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    if not paths:
        digest.update(sys.version.encode())
    return digest.hexdigest()


def some_of(files: Sequence[Path]) -> Sequence[Path]:
    """Return at most ``MOST_FILES`` of the files, evenly spread."""
    return files[:: max(1, -(-len(files) // MOST_FILES))]


def _size_of(path: Path) -> int | None:
    """Return the bytes of a file, -1 for a folder, None if there is none."""
    try:
        return -1 if path.is_dir() else path.stat().st_size
    except OSError:
        return None


@contextmanager
def probing(folder: Path | None) -> Iterator[tuple[Path, str] | None]:
    """Keep a file with a random text in a folder, which shows whether workers see this folder."""
    if folder is None:
        yield None
        return
    text = secrets.token_hex(16)
    path = folder / f"{PROBE}{text}"
    try:
        path.write_text(text)
    except OSError as error:
        raise WriteError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield path, text
    finally:
        path.unlink(missing_ok=True)


def why_unusable(path: Path, text: str) -> str:
    """Return why this process cannot use the folder of a probe with a text, "" if it can."""
    own = path.with_name(f"{path.name}-{socket.gethostname()}-{os.getpid()}")
    try:
        if not path.exists() or path.read_text() != text:
            return f"does not see the output folder {path.parent}"
        own.write_text(text)
        own.unlink()
    except OSError as error:
        return f"cannot write to the output folder {path.parent} ({error.strerror})"
    return ""


def _describe(error: Any) -> str:
    first = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {first}" if isinstance(error, Exception) else repr(error)
