"""The public names of the library, imported from the modules that define them."""

from .errors import SuperSdfError as SuperSdfError
from .files.grids import read_grid as read_grid
from .files.meshes import write_mesh as write_mesh
from .grid.sdf_grid import SdfGrid as SdfGrid
from .grid.sdf_grid import make_grid as make_grid
from .mesh import Mesh as Mesh
from .network.network import load_network as load_network
from .pipeline import reconstruct as reconstruct
from .pipeline import upsample as upsample
from .simplification.simplify import simplify_mesh as simplify_mesh
from .steps.field import FineField as FineField
from .steps.meshers import extract_mesh as extract_mesh
