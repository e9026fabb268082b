"""The public names of the library, imported from the modules that define them."""

from .errors import SuperSdfError as SuperSdfError
from .files.sparse import read_field as read_field
from .files.fields import write_field as write_field
from .files.grids import grid_from_image as grid_from_image
from .files.grids import read_grid as read_grid
from .files.meshes import write_mesh as write_mesh
from .functions.function import DistanceFunction as DistanceFunction
from .grid.sdf_grid import SdfGrid as SdfGrid
from .grid.sdf_grid import make_grid as make_grid
from .labels.reconstruct import reconstruct_labels as reconstruct_labels
from .surface.mesh import Mesh as Mesh
from .network.network import load_network as load_network
from .pipeline import reconstruct as reconstruct
from .pipeline import upsample as upsample
from .simplify.simplify import simplify_mesh as simplify_mesh
from .refine.field import FineField as FineField
from .refine.field import fine_grid as fine_grid
from .surface.extract import extract_mesh as extract_mesh
