"""Giving ranges of planes to the workers of a cluster, and putting the results in order.

Each worker mostly gets bricks that lie beside each other, since it keeps the layers that it has
unpacked. A brick whose worker died is given to another one, once.
"""

from __future__ import annotations

import pickle
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby, pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..cluster.checking import Checked, Needs
from ..cluster.connecting import Cluster
from ..cluster.pool import ClusterPool, ClusterPoolOptions
from ..cluster.serving import ClusterPrepare
from ..errors import ClusterError
from ..files.unpacking import scratch_folder
from ..grid.planes import Ranges, Result, SamplePlanes
from ..machine.pool import Death
from .meshing import Failed, RangesTask, prepare_ranges
from .stored import Facts, Source, StoredPlanes

BRICKS_PER_WORKER = 4  # of a pass over all planes
SPOOLED = 4_000_000  # bytes of a result that waits in memory; larger ones wait in a file
Item = TypeVar("Item")


class Brick(NamedTuple):
    """A task for some planes: its number, its first plane, its last one, and what is to be done."""

    number: int
    first: int
    last: int
    task: Any


@dataclass
class Queue:
    """Bricks that wait, in parts that each lie beside each other: one for each worker.

    Attributes
    ----------
    parts : list of deques
        The bricks of each worker.
    owners : dict
        Which part a worker at an address has.
    died : set of int
        Numbers of the bricks whose worker died.
    """

    parts: list[deque[Brick]]
    owners: dict[str, int]
    died: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, bricks: Sequence[Brick], addresses: Sequence[str]) -> Queue:
        """Share bricks among the workers at some addresses."""
        parts = [deque(map(bricks.__getitem__, p)) for p in _shares(len(bricks), len(addresses))]
        return cls(parts, {address: part for part, address in enumerate(addresses)})

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def popleft(self) -> Brick:
        """Return the next brick of the part that has most."""
        return max(self.parts, key=len).popleft()

    def pop_for(self, address: str) -> Brick:
        """Return the next brick for a worker: its own, else the last of the part with most."""
        own = self.parts[self.owners[address]] if address in self.owners else None
        return own.popleft() if own else max(self.parts, key=len).pop()

    def take_back(self, brick: Brick, cause: str) -> None:
        """Put back the brick of a worker that died; ClusterError if it is the second time."""
        if brick.number in self.died:
            raise ClusterError(
                f"the worker that had planes {brick.first} to {brick.last - 1} {cause}, and so did "
                "the next one: see their logs, or give less memory (--max-memory)"
            )
        self.died.add(brick.number)
        min(self.parts, key=len).appendleft(brick)


def _shares(count: int, parts: int) -> list[range]:
    """Cut numbers from 0 to before ``count`` into nearly equal ranges."""
    ends = np.linspace(0, count, parts + 1).round().astype(int).tolist()
    return [range(a, b) for a, b in pairwise(ends)]


@dataclass(frozen=True)
class Team:
    """The workers of a cluster that were checked for a grid.

    Attributes
    ----------
    cluster, checked, needs
        See ``ClusterPool``.
    warn : callable
        Called with a sentence about a worker that came later and is not used.
    """

    cluster: Cluster
    checked: Checked
    needs: Needs
    warn: Callable[[str], None]

    @property
    def size(self) -> int:
        """The number of workers at the beginning."""
        return len(self.checked.members)

    def in_order(self, bricks: Sequence[Brick], prepare: ClusterPrepare) -> Iterator[Any]:
        """Yield the results of bricks in their order.

        Raises
        ------
        SuperSdfError
            What a worker raised; ClusterError if a second worker died of a brick, or all did.
        """
        addresses = [member.address for member in self.checked.members]
        queue = Queue.of(bricks, addresses)
        options = ClusterPoolOptions[Brick](
            is_suspect=lambda brick: brick.number in queue.died,
            warn=self.warn,
            choose=lambda tasks, address: queue.pop_for(address),
        )
        pool = ClusterPool(self.cluster, self.checked, self.needs, queue, prepare, options)
        with closing(pool.results()) as results:
            yield from ordered(_checked(results, queue))


def _checked(
    results: Generator[tuple[Brick, Any], None, None], queue: Queue
) -> Iterator[tuple[int, Any]]:
    """Yield number and result of each brick; put those of workers that died back into the queue."""
    for brick, result in results:
        if isinstance(result, Failed):
            raise result.error
        if isinstance(result, Death):
            queue.take_back(brick, result.cause)
        else:
            yield brick.number, result


def ordered(results: Iterable[tuple[int, Item]]) -> Iterator[Item]:
    """Yield results by their numbers from 0 on; those that come too early wait in files."""
    waiting: dict[int, Any] = {}
    following = 0
    for number, result in results:
        if number != following:
            waiting[number] = _put_aside(result)
            continue
        del number
        yield result
        del result  # before the next one is taken
        following += 1
        while following in waiting:
            with waiting.pop(following) as file:
                yield pickle.load(file)
            following += 1


def _put_aside(result: Any) -> Any:
    """Return a temporary file with a result; small ones stay in memory."""
    folder = scratch_folder()
    file = tempfile.SpooledTemporaryFile(SPOOLED, dir=folder, prefix="super-sdf-")  # noqa: SIM115
    pickle.dump(result, file, protocol=5)
    file.seek(0)
    return file


class TeamPlanes(StoredPlanes):
    """The samples of a store as the workers of a cluster see them; here, none is read.

    Parameters
    ----------
    source : Source
        The file.
    facts : Facts
        What it says.
    team : Team
        The workers.
    """

    def __init__(self, source: Source, facts: Facts, team: Team) -> None:
        super().__init__(source, facts.shape, facts.dtype)
        self.facts, self.team = facts, team

    def read(self, first: int, last: int) -> Any:
        """Raise ClusterError: what reads planes here needs the whole grid."""
        raise ClusterError(
            f"{self.name} has unknown samples (NaN, or numbers that may stand for them), labels, "
            "none inside, or not the label that is asked for: to look into that takes the whole "
            "grid, so convert it on one machine (without --cluster)"
        )

    @property
    def block(self) -> int:
        """Planes that are read at a time when iterating over all: no more than a brick."""
        return min(super().block, self.brick)

    @property
    def brick(self) -> int:
        """Planes of the bricks of a pass: whole layers, some bricks for each worker."""
        planes = -(-self.shape[0] // (BRICKS_PER_WORKER * self.team.size))
        return -(-planes // self.facts.layer) * self.facts.layer

    def _brick_of(self, planes: tuple[Any, ...]) -> int:
        """Return the number of the brick in which the middle of a range of planes lies."""
        return int(sum(planes[:2]) // 2 // self.brick)

    def over(
        self, samples: SamplePlanes, work: Callable[..., Result], ranges: Ranges
    ) -> Iterator[Result]:
        """Yield what a function makes of ranges of ``samples``, in order, made by the workers."""
        groups = [list(group) for _, group in groupby(ranges, self._brick_of)]
        bricks = [
            Brick(number, group[0][0], group[-1][1], RangesTask(samples, work, tuple(group)))
            for number, group in enumerate(groups)
        ]
        if bricks:
            prepare = partial(prepare_ranges, self.source)
            for results in self.team.in_order(bricks, prepare):
                yield from results
