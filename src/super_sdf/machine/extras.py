"""The names of ``errors`` for optional packages."""

from ..errors import EXTRAS as EXTRAS
from ..errors import check_modules as check_modules
from ..errors import how_to_install as how_to_install
from ..errors import missing_modules as missing_modules
