"""Many grids to meshes in several processes or on a Dask cluster; resumed after a kill."""
