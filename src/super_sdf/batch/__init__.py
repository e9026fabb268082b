"""Many grids to meshes in several processes or on a Dask cluster; resumed after a kill.

``inputs`` finds the files, ``work`` converts one of them, ``run`` plans and keeps the report
(``record``). This room may import ``pages`` and what lies below it.
"""
