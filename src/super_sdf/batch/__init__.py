"""Many grids to meshes in several processes or on a Dask cluster; resumed after a kill.

``inputs`` finds the files, ``run`` plans and keeps the report (``record``), ``job`` converts one
file. This room may import ``convert`` and what lies below it.
"""
