"""PyVista's accessor: a fine surface of a ``pyvista.ImageData``, in world coordinates.

>>> import pyvista
>>> image = pyvista.read("field.vti")                             # doctest: +SKIP
>>> image.super_sdf.contour(factor=4).plot()                      # doctest: +SKIP

PyVista imports this module when ``super_sdf`` is first used of a dataset, since the package has the
entry point ``pyvista.accessors``; ``import super_sdf.pyvista`` does so at once. PyVista 0.48 or
later is needed, and is not imported by ``import super_sdf``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyvista

from .errors import FileError, OptionError
from .files.images import grid_from_image
from .grid.sdf_grid import SdfGrid
from .machine.extras import check_modules, how_to_install
from .mesh import Mesh
from .network.decoder import Decoder
from .network.names import DEFAULT_QUALITY
from .network.network import load_network
from .pipeline import reconstruct
from .progress import Progress
from .steps.mesher_names import DEFAULT_MESHER

RESIDUAL = "residual"  # the name of the array at the points of a surface

if not hasattr(pyvista, "register_dataset_accessor"):
    raise FileError(
        f"super_sdf.pyvista needs PyVista 0.48 or later, this is {pyvista.__version__}: "
        f"{how_to_install('pyvista')}"
    )


@pyvista.register_dataset_accessor("super_sdf", pyvista.ImageData)
class ImageAccessor:
    """What super-sdf makes of a ``pyvista.ImageData``: ``image.super_sdf``.

    Parameters
    ----------
    image : pyvista.ImageData
        Signed distances at its points, or in its cells, in the unit of its spacing. Or a mask,
        labels, densities, or another field; see ``make_grid``.
    """

    def __init__(self, image: pyvista.ImageData) -> None:
        self._image = image

    def grid(
        self,
        scalars: str | None = None,
        *,
        inside: str = "auto",
        field: str = "auto",
        label: int | None = None,
        level: float | None = None,
        scale: float | None = None,
        max_memory: int | None = None,
    ) -> SdfGrid:
        """Return the samples as a grid, for the functions of super-sdf.

        Its ``notes`` say what was inferred, its ``field`` what the values were taken as.

        Parameters
        ----------
        scalars : str, optional
            The name of an array of points or cells. Default: the active scalars.
        inside, field, label, level, scale
            What the values are; see ``make_grid``.
        max_memory : int, optional
            Bytes that this process may hold in all. Default: a share of the free memory.

        Raises
        ------
        GridError
            If there is no such array, or its values are not a signed distance grid.
        OptionError
            If ``inside`` or ``field`` is unknown.
        """
        return grid_from_image(
            self._image,
            self._image.active_scalars_name if scalars is None else scalars,
            inside=inside,
            field=field,
            label=label,
            level=level,
            scale=scale,
            max_memory=max_memory,
        )

    def contour(
        self,
        factor: int = 4,
        *,
        scalars: str | None = None,
        offset: float = 0.0,
        quality: str | Path | None = None,
        network: Decoder | None = None,
        mesher: str = DEFAULT_MESHER,
        cap: bool = True,
        residuals: bool = False,
        inside: str = "auto",
        field: str = "auto",
        label: int | None = None,
        level: float | None = None,
        scale: float | None = None,
        max_memory: int | None = None,
        progress: Progress | None = None,
    ) -> pyvista.PolyData:
        """Return the surface of the solid, refined, as triangles in world coordinates.

        It is the mesh that ``super-sdf upsample`` makes of the image as a ``.vti`` file.

        Parameters
        ----------
        factor : int
            How many times finer than the image per axis: an even number from 2 to 16.
        scalars : str, optional
            The name of an array of points or cells. Default: the active scalars.
        offset : float
            The surface at this distance from the solid, in world units; positive is outwards.
        quality : str or path, optional
            "fast", "base" (default) or "best", or an ONNX file; see ``load_network``.
        network : Network, optional
            From ``load_network``, to load it only once; instead of ``quality``.
        mesher : str
            "marching" for marching cubes; "sharp" also puts vertices on edges and corners.
        cap : bool
            Close the surface along the border of the image where the solid runs out of it.
        residuals : bool
            Also return the array "residual" of the points, float32: how far the surface is from
            touching the balls of the nearest samples, in voxels of the image, negative where it
            pierces them, NaN where no exact sample is near. Needs the extra eval.
        inside, field, label, level, scale
            What the values are; see ``make_grid``.
        max_memory : int, optional
            Bytes that this process may hold in all, besides the mesh. Default: a share of the free
            memory.
        progress : callable, optional
            Called with (done, total), see ``progress.Progress``.

        Returns
        -------
        pyvista.PolyData
            Triangles, counter-clockwise seen from outside.

        Raises
        ------
        SuperSdfError
            As ``grid`` and ``reconstruct`` raise it; if ``quality`` and ``network`` are both given.
        """
        if quality is not None and network is not None:
            raise OptionError(f"quality {str(quality)!r} and a network are given: give only one")
        if network is None:
            network = load_network(DEFAULT_QUALITY if quality is None else quality)
        grid = self.grid(
            scalars,
            inside=inside,
            field=field,
            label=label,
            level=level,
            scale=scale,
            max_memory=max_memory,
        )
        mesh = reconstruct(
            grid,
            network,
            factor,
            offset=offset,
            cap=cap,
            mesher=mesher,
            max_memory=max_memory,
            progress=progress,
        )
        faces: Any = mesh.faces  # PyVista takes them with any integers
        surface = pyvista.PolyData.from_regular_faces(mesh.vertices, faces)
        if residuals:
            surface.point_data[RESIDUAL] = residuals_of(mesh, grid, offset, max_memory)
        return surface


def residuals_of(
    mesh: Mesh, grid: SdfGrid, offset: float, max_memory: int | None
) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return the residual at each vertex, in voxels; see ``certificate``."""
    check_modules("residuals=True", "eval")
    from .certificate.check import CheckOptions, check_mesh
    from .certificate.coloured import vertex_residuals

    options = CheckOptions(offset=offset, max_memory=max_memory, intersections=False)
    certificate = check_mesh(mesh, grid, options)
    vertices = certificate.mesh.vertices.astype(np.float64)
    return vertex_residuals(vertices, certificate.touching, certificate.voxel_size)
