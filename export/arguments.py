"""What the scripts are asked on the command line: wrong numbers and files end them in one line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from super_sdf.errors import SuperSdfError


class Parser(argparse.ArgumentParser):
    """A parser of arguments that says what is wrong in a line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"Error: {message}\n")

    @contextmanager
    def one_line_errors(self) -> Iterator[None]:
        """End with exit code 1 and a line where a file or what it holds is at fault."""
        try:
            yield
        except SuperSdfError as error:
            self.exit(1, f"Error: {error}\n")
        except OSError as error:
            self.exit(1, f"Error: {error}\n")


def share(text: str) -> float:
    """Parse a number from 0 to 1."""
    number = float(text)
    if not 0 <= number <= 1:
        raise argparse.ArgumentTypeError(f"{text}: give a number from 0 to 1")
    return number


def positive(text: str) -> float:
    """Parse a finite number over 0."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give a number greater than 0")
    return number


def at_least(least: int) -> Callable[[str], int]:
    """Return what parses a whole number that is not under ``least``."""

    def whole(text: str) -> int:
        number = int(text)
        if number < least:
            raise argparse.ArgumentTypeError(f"{text}: give at least {least}")
        return number

    return whole
