"""The scope of an evaluation: what is measured, as a list of tasks."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import FileError, OptionError, seen
from ..files.regular import check_regular_file
from ..options import AUTO_PRECISION, MESHERS
from .cases import Setting
from .field_kinds import kinds_at, methods_on
from .measuring import NO_SETTING, Task, digest_of_file, digest_of_ours
from .names import (
    EXPERIMENTS,
    FIELD_GROUPS,
    FLOOR,
    MESHED,
    METHOD_LABELS,
    OURS,
    OURS_MESHED,
    SIMPLIFIED,
    matched,
    meshed_by,
)

MESH_SUFFIXES = (".ply", ".stl", ".obj", ".off", ".glb", ".gltf", ".3mf")
BASE_SIZE = 32  # samples along an axis in the paper's experiments
FACTORS = (2, 4, 8, 16)
NOISES = (0.0, 0.2, 0.5, 1.0)
PASSES = (1, 2)
SCALES = (0.25, 0.5, 0.75)
MESHER_FACTORS = (1, 2, 4)  # every mesher; with 1 the field is refined, but the lattice is coarse
SIMPLIFIED_FACTOR = 4  # at which meshes are simplified, and every size is measured

MethodsIn = tuple[Setting, tuple[str, ...]]
"""A setting, and the methods that are measured in it."""


@dataclass(frozen=True)
class Scope:
    """What an evaluation measures: shapes, sizes, methods, experiments, peers.

    Attributes
    ----------
    paths : tuple of Path
        The mesh files.
    sizes, factor, methods
        Of the main table.
    model, precision : str
        A shipped network or an ONNX file, and its arithmetic: see ``load_network``.
    experiments : tuple of str
        Some of ``EXPERIMENTS``, measured on ``experiment_shapes`` of the shapes.
    kinds : tuple of str
        Some of ``FIELD_GROUPS``: what the experiment "fields" measures.
    peers : tuple of str
        Some of ``PEERS``, measured at ``peer_size`` on ``peer_shapes`` of the shapes, each within
        ``peer_limit`` seconds.
    jobs, threads : int
        Processes at a time, and threads of the network in each.
    turned : int, optional
        Seed by which the shapes are turned at random.
    peer_meshes : Path, optional
        Folder in which the meshes of peers are kept, so that each is made once.
    """

    paths: tuple[Path, ...]
    sizes: tuple[int, ...] = (32, 64, 128)
    factor: int = 4
    methods: tuple[str, ...] = tuple(METHOD_LABELS)
    model: str = "base"
    precision: str = AUTO_PRECISION
    experiments: tuple[str, ...] = ()
    experiment_shapes: int = 10
    peers: tuple[str, ...] = ()
    peer_shapes: int = 6
    peer_size: int = 32
    peer_limit: float = 900.0
    jobs: int = 1
    threads: int = 1
    turned: int | None = None
    peer_meshes: Path | None = None
    kinds: tuple[str, ...] = FIELD_GROUPS

    def check(self) -> None:
        """Raise OptionError if a number is out of range, or there is nothing to measure."""
        for size in self.sizes:
            Setting(size, self.factor).check()
        if not self.paths or not self.sizes:
            raise OptionError("nothing to measure: give meshes and sizes")
        Setting(self.peer_size).check("peer size")
        if not self.peer_limit > 0:
            raise OptionError(f"peer limit is {self.peer_limit:g}: give more than 0 seconds")
        if self.turned is not None and self.turned < 0:
            raise OptionError(f"turned is {seen(self.turned)}: give a seed of 0 or more")

    def settings(self) -> list[Setting]:
        """Return the settings of the main table."""
        return [Setting(size, self.factor) for size in self.sizes]

    def experiment_paths(self) -> tuple[Path, ...]:
        """Return the shapes that the experiments take."""
        return spread(self.paths, self.experiment_shapes)

    def peer_paths(self) -> tuple[Path, ...]:
        """Return the shapes that the peers take."""
        return spread(self.paths, self.peer_shapes)

    def tasks(self) -> list[Task]:
        """Return the tasks, those of the main table first; no method is measured twice."""
        wanted: list[tuple[Path, MethodsIn]] = [
            (path, (NO_SETTING, (FLOOR,))) for path in self.paths
        ]
        for setting in self.settings():
            wanted += [(path, (setting, self.methods)) for path in self.paths]
        for name in self.experiments:
            pairs = experiment(name, self.sizes, self.kinds)
            wanted += [(path, pair) for pair in pairs for path in self.experiment_paths()]
        # Ours and the coarse mesh stand beside the peers.
        names = ("mc", "bspline", *OURS_MESHED.values())
        beside = (Setting(self.peer_size), names) if self.peers else None
        wanted += [(path, beside) for path in self.peer_paths() if beside]
        tasks = self._as_tasks(merged(wanted))
        # A task for each peer alone, because the limit is for one peer and what needs its mesh.
        alike = [task for task in tasks if task.setting == Setting(self.peer_size)]
        return tasks + [
            replace(task, methods=with_matched(peer), limit=self.peer_limit)
            for peer in self.peers
            for task in alike
            if task.path in self.peer_paths()
        ]

    def _as_tasks(self, wanted: Iterable[tuple[Path, MethodsIn]]) -> list[Task]:
        """Return a task for each shape and setting."""
        ours = digest_of_ours(self.model, self.precision)
        sums = {path: digest_of_file(path) for path in self.paths}
        return [
            Task(
                path,
                sums[path],
                setting,
                methods,
                self.model,
                ours,
                self.precision,
                self.threads,
                turned=self.turned,
                peer_meshes=self.peer_meshes,
            )
            for path, (setting, methods) in wanted
        ]


def experiment(
    name: str, sizes: Sequence[int], kinds: Sequence[str] = FIELD_GROUPS
) -> list[MethodsIn]:
    """Return the settings and methods of an experiment; "fields" measures these groups of kinds.

    "scale", "meshers" and "fields" are at the sizes of the main table. "timings" has none: whole
    processes are timed one at a time (see ``timing``).
    """
    refined = ("bspline", OURS, "bound")
    if name == "factors":
        coarse: list[MethodsIn] = [(Setting(BASE_SIZE), ("mc",))]
        return coarse + [(Setting(BASE_SIZE, factor), refined) for factor in FACTORS]
    if name == "noise":
        return [(Setting(BASE_SIZE, noise=noise), ("mc", "bspline", OURS)) for noise in NOISES]
    if name == "iterated":
        return [(Setting(BASE_SIZE, passes=passes), (OURS,)) for passes in PASSES]
    if name == "scale":
        return [(Setting(n, scale=s), ("mc", *refined)) for n in sizes for s in SCALES]
    if name == "meshers":
        methods = tuple(meshed_by(method, mesher) for mesher in MESHERS for method in MESHED)
        pairs = [(Setting(n, factor), methods) for n, factor in mesher_settings(sizes)]
        return [*pairs, (Setting(min(sizes), SIMPLIFIED_FACTOR), tuple(SIMPLIFIED))]
    if name == "fields":
        return [(Setting(n), methods_on(kinds_at(n, sizes, kinds))) for n in sizes]
    if name == "timings":
        return []
    raise OptionError(f"experiment is {name!r}: give one of {', '.join(EXPERIMENTS)}")


def mesher_settings(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Return the sizes and factors at which meshers are compared.

    Coarser lattices, and simplified meshes, at the smallest size only: there a mesh has the fewest
    triangles to spare.
    """
    coarser = [(min(sizes), factor) for factor in MESHER_FACTORS if factor != SIMPLIFIED_FACTOR]
    return coarser + [(size, SIMPLIFIED_FACTOR) for size in sorted(sizes)]


def with_matched(peer: str) -> tuple[str, ...]:
    """Return a peer, and our methods simplified to as many triangles."""
    return (peer, *(matched(name, peer) for name in OURS_MESHED.values()))


def merged(wanted: Iterable[tuple[Path, MethodsIn]]) -> list[tuple[Path, MethodsIn]]:
    """Return the entries with those of one shape and setting joined; each method once."""
    methods: dict[tuple[Path, Setting], dict[str, None]] = {}
    for path, (setting, names) in wanted:
        methods.setdefault((path, setting), {}).update(dict.fromkeys(names))
    return [(path, (setting, tuple(names))) for (path, setting), names in methods.items()]


def spread(paths: tuple[Path, ...], count: int) -> tuple[Path, ...]:
    """Return ``count`` of the paths, evenly spread over them."""
    if count >= len(paths):
        return paths
    return tuple(paths[i * len(paths) // count] for i in range(count))


def meshes_in(folder: Path) -> list[Path]:
    """Return the mesh files of a folder, sorted by name."""
    try:
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
    except OSError as error:
        raise FileError(f"{folder} cannot be read: {error.strerror}") from error
    if not paths:
        raise FileError(f"{folder} holds no mesh: give {', '.join(MESH_SUFFIXES)}")
    return paths


def find_meshes(sources: Sequence[Path]) -> tuple[Path, ...]:
    """Return the given mesh files, and those in the given folders, sorted by name.

    Raises
    ------
    FileError
        If a source does not exist, is no regular file or holds no mesh, or if two shapes have the
        same name.
    """
    paths: list[Path] = []
    for source in sources:
        inside = meshes_in(source) if os.path.isdir(source) else [source]
        paths += [check_regular_file(path) for path in inside]
    names = [path.stem for path in paths]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise FileError(f"two meshes are named {twice!r}: shapes are known by their file names")
    return tuple(paths)
