"""The command line by the name under which older installations start it."""

from .main import main as main
