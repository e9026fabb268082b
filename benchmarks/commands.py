"""Running the command in a process of its own: seconds, CPU seconds and memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from super_sdf.evaluation.timing import run_python

# Runs the command in this process; prints its CPU seconds, those of its workers, and its peak.
COMMAND = """
import resource, sys, time
from super_sdf.cli.main import main
from super_sdf.machine.memory import held_memory
sys.argv[0] = "super-sdf"
try:
    main()
except SystemExit as end:
    if end.code:
        raise
workers = resource.getrusage(resource.RUSAGE_CHILDREN)
print(time.process_time(), workers.ru_utime + workers.ru_stime, held_memory(peak=True))
"""


class Taken(NamedTuple):
    """What a run of the command printed and took: seconds, CPU seconds, and bytes at its peak."""

    printed: str
    seconds: float
    cpu: float
    cpu_of_workers: float
    peak: float


def run_command(words: Sequence[str]) -> Taken:
    """Run ``super-sdf`` once.

    Raises
    ------
    SuperSdfError
        If the command fails.
    """
    seconds, _, printed = run_python(["-c", COMMAND, *words])
    text, _, last = printed.rstrip().rpartition("\n")
    own, others, peak = map(float, last.split())
    return Taken(text, seconds, own, others, peak)
