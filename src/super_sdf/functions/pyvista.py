"""PyVista's accessor: a fine surface of a ``pyvista.ImageData``, in world coordinates.

>>> import pyvista
>>> image = pyvista.read("field.vti")                             # doctest: +SKIP
>>> image.super_sdf.contour(factor=4).plot()                      # doctest: +SKIP

PyVista, 0.48 or later, imports this module when ``super_sdf`` is first used of a dataset: it is an
entry point ``pyvista.accessors`` of the package.
"""

from __future__ import annotations

from typing import Any, cast

import pyvista
from typing_extensions import Unpack

from .. import SdfGrid, grid_from_image, reconstruct
from ..errors import check_modules
from ..options import Options, Values


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
        max_memory: int | None = None,
        **values: Unpack[Values],
    ) -> SdfGrid:
        """Return the samples as a grid, for the functions of super-sdf.

        Its ``notes`` say what was inferred, its ``field`` what the values were taken as.

        Parameters and errors are those of ``grid_from_image``; ``scalars`` are by default the
        active ones.
        """
        name = self._image.active_scalars_name if scalars is None else scalars
        return grid_from_image(self._image, name, max_memory=max_memory, **values)

    def contour(
        self,
        factor: int | None = None,
        *,
        scalars: str | None = None,
        residuals: bool = False,
        **how: Any,
    ) -> pyvista.PolyData:
        """Return the surface of the solid, refined, as triangles in world coordinates.

        It is the mesh that ``super-sdf upsample`` makes of the image as a ``.vti`` file.

        Parameters
        ----------
        factor, **how
            Keywords of ``reconstruct``, and what the values are, as in ``grid``.
        scalars : str, optional
            See ``grid``.
        residuals : bool
            Also return the array "residual" of the points, float32: how far the surface is from
            touching the balls of the nearest samples, in voxels of the image, negative where it
            pierces them, NaN where no exact sample is near. Needs the extra report.

        Returns
        -------
        pyvista.PolyData
            Triangles, counter-clockwise seen from outside.

        Raises
        ------
        SuperSdfError
            As ``grid`` and ``reconstruct`` raise it.
        """
        if residuals:
            check_modules("residuals=True", "report", ("igl",))
        most = how.get("max_memory")
        values = {name: how.pop(name) for name in Values.__annotations__ if name in how}
        grid = self.grid(scalars, max_memory=most, **cast(Any, values))
        mesh = reconstruct(grid, factor=factor, **how)
        surface = pyvista.PolyData.from_regular_faces(mesh.vertices, cast(Any, mesh.faces))
        if residuals:
            from ..check import check_mesh

            found = check_mesh(mesh, grid, Options(offset=how.get("offset", 0.0), max_memory=most))
            surface.point_data["residual"] = found.residuals_at(mesh.vertices)
        return surface
