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


def share(text: str) -> float:
    number = float(text)
    if not 0 <= number <= 1:
        raise argparse.ArgumentTypeError(f"{text}: give a number from 0 to 1")
    return number


def positive(text: str) -> float:
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give a number greater than 0")
    return number


def at_least(least: int) -> Callable[[str], int]:
    """Return a parser for whole numbers of at least ``least``."""

    def whole(text: str) -> int:
        if int(text) < least:
            raise argparse.ArgumentTypeError(f"{text}: give at least {least}")
        return int(text)

    return whole
