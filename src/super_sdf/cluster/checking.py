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
from ..machine.memory import free_memory, reuse_freed
from ..machine.serving import settle_signals
from ..network.cuda import onnxruntime_version
from ..network.fingerprint import Fingerprint, fingerprint_of
from ..network.network import find_model, shipped_models
from ..options import AUTO_PRECISION
from .connecting import Cluster, Limits, share_of

Judge = Callable[[Any], str]
"""Returns what is wrong with what a worker answered or raised, "" if nothing."""

MOST_FILES = 100  # whose presence each worker checks
VERSION = "super_sdf:__version__"
PACKAGE = Path(__file__).parent.parent
PROBE = ".super-sdf-probe-"  # a file in the output folder while the workers are checked


@dataclass(frozen=True)
class Needs:
    """What the work needs of every worker.

    Attributes
    ----------
    model, precision, device : str
        The network: see ``load_network``.
    modules : tuple of str
        Python modules beyond those that are always installed.
    files : sequence of Path
        Inputs; absolute paths. If they are many, some of them are looked at.
    folder : Path, optional
        The folder of the outputs; absolute. It exists.
    """

    model: str
    precision: str = AUTO_PRECISION
    device: str = "auto"
    modules: tuple[str, ...] = ()
    files: Sequence[Path] = ()
    folder: Path | None = None


class Report(NamedTuple):
    """What a worker has and may use, as it reports it.

    Attributes
    ----------
    identity : str
        Dask's name of this process: a restarted worker has another.
    host, pid : str, int
        Its machine and process number.
    models : dict
        SHA-256 of the networks by name: those that are shipped, and the one that is asked for.
    versions : dict
        What results depend on in the last bits, with version.
    lacking : tuple of str
        Modules that are not installed.
    sizes : tuple
        Bytes of each file asked for; None if it is not seen, -1 for a folder.
    folder : str
        Why the output folder cannot be used, "" if it can.
    limit, free : int, optional
        The bytes at which Dask kills it, and those that are free on its machine.
    """

    identity: str
    host: str
    pid: int
    models: dict[str, str]
    versions: dict[str, str]
    lacking: tuple[str, ...]
    sizes: tuple[int | None, ...]
    folder: str
    limit: int | None
    free: int | None


class Question(NamedTuple):
    """What a worker is asked: the needs, the files to look at, and what stands in the probe."""

    needs: Needs
    files: tuple[Path, ...]
    probe: tuple[Path, str] | None
    is_local: bool


class Member(NamedTuple):
    """A worker that was checked: its address, what it said and computed, what it may use."""

    address: str
    report: Report
    values: Fingerprint
    limits: Limits


class Checked(NamedTuple):
    """Workers that can do the work; the faults of others by address, and warnings."""

    members: list[Member]
    faults: dict[str, str]
    warnings: list[str]


def check_workers(cluster: Cluster, needs: Needs) -> Checked:
    """Check all workers that the cluster has now.

    Raises
    ------
    ClusterError
        If one of them lacks something: what, and how to mend it.
    """
    checked = check_some(cluster, needs, cluster.workers())
    if checked.faults:
        raise ClusterError(name_workers(checked.faults))
    if not checked.members:
        raise ClusterError(f"the workers at {cluster.address} ended before they were checked")
    return checked


def check_some(
    cluster: Cluster, needs: Needs, threads: Mapping[str, int], members: Sequence[Member] = ()
) -> Checked:
    """Check some workers, given by address with their threads; those that end meanwhile are out.

    ``members`` are those that are at work already: the others must compute the same values.
    """
    faults: dict[str, str] = {}

    def ask(workers: Iterable[str], judge: Judge, *call: Any) -> dict[str, Any]:
        """Return the answers that are right; keep the faults of the others."""
        answers = cluster.run(*call, workers=list(workers)) if workers else {}
        there = {address: a for address, a in answers.items() if not isinstance(a, OSError)}
        faults.update({a: fault for a, answer in there.items() if (fault := judge(answer))})
        return {address: answer for address, answer in there.items() if address not in faults}

    # The first call needs nothing of this package, the second no more than one function of it.
    good = ask(threads, judge_version, pkgutil.resolve_name, VERSION)
    good = ask(good, judge_sources, digest_of_sources)
    with probing(needs.folder) as probe:
        question = Question(needs, some_of(needs.files), probe, cluster.is_local)
        own = report_here(question)
        good = ask(good, lambda r: judge_report(r, own, question), report_to, question)
    network = needs.model, needs.precision, needs.device
    values = ask(good, judge_values, fingerprint_of, *network)
    known = {member.address: member.values for member in members}
    faults.update(differing({**known, **values}))
    reports = {a: report for a, report in good.items() if a in values and a not in faults}
    found = members_of(cluster, reports, values, threads)
    return Checked(found, faults, warnings_of(reports, own))


def judge_version(answer: Any) -> str:
    """Return what is wrong with the version of super-sdf that a worker has, "" if nothing."""
    if isinstance(answer, ImportError):
        return f"does not have super-sdf: install version {__version__} of it there"
    if isinstance(answer, Exception):
        return f"cannot import super-sdf ({describe(answer)}): install {__version__} there"
    if answer != __version__:
        return (
            f"has super-sdf {answer}, and here is {__version__}: install the same version there "
            "and here"
        )
    return ""


def judge_sources(answer: Any) -> str:
    """Return what is wrong with the sources of super-sdf that a worker has, "" if nothing."""
    if answer == digest_of_sources():
        return ""
    return (
        f"has other sources of super-sdf {__version__} than are here: install the same state there "
        "and restart it"
    )


def judge_report(report: Any, own: Report, question: Question) -> str:
    """Return what a worker lacks of what is here and needed, "" if nothing."""
    if not isinstance(report, Report):
        return f"cannot be checked ({describe(report)}): restart it"
    needs = question.needs
    for name, digest in own.models.items():
        if name not in report.models:
            return f"does not see the network {name}: put it where all machines see it"
        if report.models[name] != digest:
            return f"has another file of the network {name}: copy the one from here"
    if report.lacking:
        return f"lacks {', '.join(report.lacking)}: install there what is installed here"
    for path, size, here in zip(question.files, report.sizes, own.sizes):
        if size is None and here is not None:
            return f"does not see {path}: put the inputs where all machines see them by this path"
        if size != here:
            return f"sees another {path}: its folder has to be the same on all machines"
    if report.folder:
        return f"{report.folder}: write to a folder that all machines share under {needs.folder}"
    return ""


def judge_values(answer: Any) -> str:
    """Return why a worker cannot run the network, "" if it can."""
    if isinstance(answer, Fingerprint):
        return ""
    why = answer if isinstance(answer, SuperSdfError) else describe(answer)
    return f"cannot run the network: {why}"


def differing(values: Mapping[str, Fingerprint]) -> dict[str, str]:
    """Return a fault for each worker whose values are not those of the first one, by address."""
    if not values:
        return {}
    first, own = next(iter(values.items()))
    return {
        address: f"({runs_on(found)}) gets other values from the network than worker {first} "
        f"({runs_on(own)}), so that meshes would differ or be torn: {way_to_agree(found, own)}"
        for address, found in values.items()
        if found.digest != own.digest
    }


def runs_on(found: Fingerprint) -> str:
    """Describe what computed values, and the values."""
    return f"{found.processor}, {found.precision} on {found.device}, {found.digest[:8]}"


def way_to_agree(one: Fingerprint, other: Fingerprint) -> str:
    """Return what to do so that two workers compute the same values."""
    if one.device != other.device:
        return "give --device cpu"
    return "use workers with the same kind of processor"


def warnings_of(reports: Mapping[str, Report], own: Report) -> list[str]:
    """Return a warning for each thing that workers have in another version than is here."""
    warnings = []
    for name, here in own.versions.items():
        others = {a: r.versions.get(name) for a, r in reports.items() if r.versions[name] != here}
        if others:
            have = "have" if len(others) > 1 else "has"
            there = ", ".join(sorted({str(version) for version in others.values()}))
            warnings.append(
                f"{first_of(list(others))} {have} {there}, and here is {here}: results may differ "
                "in their last bits"
            )
    return warnings


def name_workers(faults: Mapping[str, str]) -> str:
    """Return the first fault, with the workers that have it."""
    fault = next(iter(faults.values()))
    return f"{first_of([address for address, text in faults.items() if text == fault])} {fault}"


def first_of(addresses: Sequence[str]) -> str:
    """Return the first of some workers, and how many others there are."""
    more = len(addresses) - 1
    others = f" and {more} other{'s' * (more > 1)}" if more else ""
    return f"worker {addresses[0]}{others}"


def members_of(
    cluster: Cluster,
    reports: Mapping[str, Report],
    values: Mapping[str, Fingerprint],
    threads: Mapping[str, int],
) -> list[Member]:
    """Return the workers with what each may use; the free memory of a machine is shared equally."""
    on_host = Counter(report.host for report in reports.values())
    members = []
    for address, report in reports.items():
        free = None if report.free is None else report.free // on_host[report.host]
        limits = cluster.limits
        if not cluster.is_local:
            limits = share_of(limits, threads[address], report.limit, free)
        members.append(Member(address, report, values[address], limits))
    return members


def report_to(question: Question, dask_worker: Any) -> Report:
    """Return the report of a worker; called in it, on its main thread."""
    reuse_freed()
    if question.is_local:
        with suppress(ValueError, AttributeError):  # not the main thread, or Windows
            settle_signals()
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the batch hears it, too
    limit = dask_worker.memory_manager.memory_limit
    return report_here(question)._replace(identity=str(dask_worker.id), limit=limit or None)


def report_here(question: Question) -> Report:
    """Return what this process has of what is asked for."""
    needs = question.needs
    return Report(
        identity="",
        host=socket.gethostname(),
        pid=os.getpid(),
        models=digests_of_models(needs),
        versions={
            "numpy": f"numpy {np.__version__}",
            "onnxruntime": onnxruntime_version(),
        },
        lacking=tuple(missing_modules(needs.modules)),
        sizes=tuple(map(size_of, question.files)),
        folder=why_unusable(question.probe),
        limit=None,
        free=free_memory(),
    )


def digests_of_models(needs: Needs) -> dict[str, str]:
    """Return the SHA-256 of the shipped networks and of the one asked for, if it is there."""
    paths = {path.name: path for path in shipped_models().values()}
    with suppress(OSError, ValueError):
        path, _ = find_model(needs.model, needs.precision)
        paths[path.name if path in paths.values() else str(path)] = path
    digests = {}
    for name, path in paths.items():
        with suppress(OSError):
            digests[name] = digest_of(path)
    return digests


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


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


def some_of(files: Sequence[Path]) -> tuple[Path, ...]:
    """Return at most ``MOST_FILES`` of the files, evenly spread."""
    step = max(1, -(-len(files) // MOST_FILES))
    return tuple(files[::step])


def size_of(path: Path) -> int | None:
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


def why_unusable(probe: tuple[Path, str] | None) -> str:
    """Return why the folder of a probe cannot be used by this process, "" if it can."""
    if probe is None:
        return ""
    path, text = probe
    own = path.with_name(f"{path.name}-{socket.gethostname()}-{os.getpid()}")
    try:
        if not path.exists() or path.read_text() != text:
            return f"does not see the output folder {path.parent}"
        own.write_text(text)
        own.unlink()
    except OSError as error:
        return f"cannot write to the output folder {path.parent} ({error.strerror})"
    return ""


def describe(error: Any) -> str:
    """Describe an exception in one line."""
    first = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {first}" if isinstance(error, Exception) else repr(error)
