"""Command line arguments of the scripts: invalid numbers and files end them with one line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from super_sdf.errors import SuperSdfError


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"Error: {message}\n")

    @contextmanager
    def one_line_errors(self) -> Iterator[None]:
        """Exit with code 1 and one line if a file or its content is invalid."""
        try:
            yield
        except (SuperSdfError, OSError) as error:
            self.exit(1, f"Error: {getattr(error, 'flagged', error)}\n")


def numbers(
    said: str, allowed: Callable[[float], bool], kind: Callable[[str], float] = float
) -> Callable[[str], float]:
    """Return a parser for the numbers that are ``allowed``; others are told what is ``said``."""

    def number(text: str) -> float:
        if not allowed(value := kind(text)):
            raise argparse.ArgumentTypeError(f"{text}: give {said}")
        return value

    return number


share = numbers("a number from 0 to 1", lambda number: 0 <= number <= 1)
positive = numbers("a number greater than 0", lambda number: 0 < number < math.inf)


def at_least(least: int) -> Callable[[str], float]:
    return numbers(f"at least {least}", lambda number: number >= least, int)
